"""Material parameters as the kernels see them: immutable tuples of numbers (SI, kelvin).

The type of the tuple chooses the model, so a kernel compiled for one material holds no code of
another and its disk cache stays valid.
"""

from __future__ import annotations

from typing import NamedTuple


class Bulk(NamedTuple):
    """What every material has."""

    density: float  # kg/m3 at zero pressure
    bulk_modulus: float  # Pa
    shear_modulus: float  # Pa
    specific_heat: float  # J/kg/K
    conductivity: float  # W/m/K
    taylor_quinney: float  # share of plastic work that becomes heat
    spall_pressure: float  # Pa, tension at which full material opens a void


class LinearPressure(NamedTuple):
    """p = K ln(rho / rho_0): constant bulk modulus in logarithmic strain."""

    bulk_modulus: float  # Pa


class MieGrueneisen(NamedTuple):
    """Mie-Grueneisen pressure on the shock Hugoniot U = c + s u."""

    density: float  # kg/m3
    sound_speed: float  # m/s
    slope: float  # s
    gamma: float  # Grueneisen parameter times rho_0 / rho


class Ge(NamedTuple):
    """Flow stress of the Ge model (named after its author)."""

    yield_stress: float  # sigma_y0, Pa
    hardening: float  # A, Pa
    exponent: float  # n
    alpha: float  # Pa
    beta: float  # Pa
    rate_normal: float  # eps_s, 1/s: the alpha/beta term acts above it
    rate_high: float  # eps_u, 1/s: the B term acts above it
    high_rate: float  # B, Pa
    room_temperature: float  # K
    reference_temperature: float  # K
    eta: float  # 1/K


class JohnsonCook(NamedTuple):
    """Johnson-Cook flow stress."""

    yield_stress: float  # A, Pa
    hardening: float  # B, Pa
    exponent: float  # n
    rate_factor: float  # C
    softening_exponent: float  # m
    reference_rate: float  # 1/s
    reference_temperature: float  # K
    melting_temperature: float  # K


class LinearHardening(NamedTuple):
    """Flow stress yield + H PEEQ, without rate and temperature."""

    yield_stress: float  # Pa
    modulus: float  # H, Pa


class Elastic(NamedTuple):
    """No yielding at all."""

    unused: float = 0.0
