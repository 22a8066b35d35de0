"""Pressure and sound speed from the compression, for both pressure models."""

from __future__ import annotations

from numba import types
from numba.extending import overload

from f2s_hpc._jit import POINT_OPTIONS
from f2s_hpc.materials.params import LinearPressure


def _logarithm(x):
    """ln(x) by the series of 2 artanh((x - 1)/(x + 1)): only arithmetic, so loops vectorise.

    Relative error below 1e-12 for 0.9 < x < 1.1 and below 1e-6 up to x = 2, far beyond the
    compression of any impact here.
    """
    z = (x - 1.0) / (x + 1.0)
    y = z * z
    return 2.0 * z * (1.0 + y * (1.0 / 3 + y * (1.0 / 5 + y * (1.0 / 7 + y * (1.0 / 9 + y * (1.0 / 11 + y / 13))))))


def _linear_pressure(eos, x, energy):
    return eos.bulk_modulus * _logarithm(x)


def _linear_stiffness(eos, x, energy):
    return eos.bulk_modulus + 0.0 * x


def _linear_energy(eos, x):
    return eos.bulk_modulus * (1.0 - (1.0 + _logarithm(x)) / x)


def _grueneisen_pressure(eos, x, energy):
    mu = x - 1.0
    cold = eos.density * eos.sound_speed * eos.sound_speed
    softer = 1.0 - (eos.slope - 1.0) * max(mu, 0.0)
    hugoniot = cold * mu if mu < 0.0 else cold * mu * (1.0 + mu) / (softer * softer)
    return hugoniot * (1.0 - 0.5 * eos.gamma * mu / x) + eos.gamma * eos.density * energy


def _grueneisen_stiffness(eos, x, energy):
    mu = x - 1.0
    cold = eos.density * eos.sound_speed * eos.sound_speed
    up = max(mu, 0.0)
    softer = 1.0 - (eos.slope - 1.0) * up
    hugoniot = cold * up * (1.0 + up) / (softer * softer)
    slope = cold * (1.0 + 2.0 * up + (eos.slope - 1.0) * up) / (softer * softer * softer)
    cold_share = 1.0 - 0.5 * eos.gamma * up / (1.0 + up)
    pressure = hugoniot * cold_share + eos.gamma * eos.density * energy
    less = 0.5 * eos.gamma * hugoniot / ((1.0 + up) * (1.0 + up))
    return x * (slope * cold_share - less) + eos.gamma * max(pressure, 0.0) / x


def _grueneisen_energy(eos, x):
    return 0.0 * x


def _linear_unloaded(eos, energy):
    return 1.0


def _grueneisen_unloaded(eos, energy):
    q = min(max(eos.gamma * energy / (eos.sound_speed * eos.sound_speed), -0.1), 0.2)
    return 1.0 - q * (1.0 - 0.5 * eos.gamma * q)


def unloaded(eos, energy):
    """Return rho / rho_0 at zero pressure: hot material has expanded where its heat makes pressure.

    Mie-Grueneisen in tension: mu (1 - Gamma mu / 2x) + q = 0 with q = Gamma e / c^2, to third order in q: for copper
    within 1.3e-4 at an energy of c_p 1000 K, 1e-3 at c_p 2000 K.
    """
    return (_linear_unloaded if isinstance(eos, LinearPressure) else _grueneisen_unloaded)(eos, energy)


def pressure(eos, x, energy):
    """Return the pressure (Pa).

    ``x`` = rho / rho_0; ``energy`` specific internal energy (J/kg; Mie-Grueneisen only). Linear:
    p = K ln x, a constant bulk modulus in logarithmic strain. Mie-Grueneisen: with mu = x - 1,
    p = p_H (1 - Gamma mu / 2x) + Gamma rho_0 e and p_H = rho_0 c^2 mu (1 + mu) / (1 - (s - 1) mu)^2
    in compression, rho_0 c^2 mu in tension.
    """
    return (_linear_pressure if isinstance(eos, LinearPressure) else _grueneisen_pressure)(eos, x, energy)


def stiffness(eos, x, energy):
    """Return rho dp/drho at constant entropy (Pa); with 4G/3 added and over rho, the sound speed squared."""
    return (_linear_stiffness if isinstance(eos, LinearPressure) else _grueneisen_stiffness)(eos, x, energy)


def stored_energy(eos, x):
    """Return the energy stored by the pressure per reference volume (J/m3); 0 where it is carried as a field.

    Linear: integral of K ln(x) d(-1/x) = K [1 - (1 + ln x) / x].
    """
    return (_linear_energy if isinstance(eos, LinearPressure) else _grueneisen_energy)(eos, x)


def _choose(eos, linear, grueneisen):
    if isinstance(eos, types.BaseNamedTuple):
        return linear if eos.instance_class is LinearPressure else grueneisen
    return None


@overload(_logarithm, jit_options=POINT_OPTIONS)
def _logarithm_overload(x):
    return _logarithm


@overload(unloaded, jit_options=POINT_OPTIONS)
def _unloaded_overload(eos, energy):
    return _choose(eos, _linear_unloaded, _grueneisen_unloaded)


@overload(pressure, jit_options=POINT_OPTIONS)
def _pressure_overload(eos, x, energy):
    return _choose(eos, _linear_pressure, _grueneisen_pressure)


@overload(stiffness, jit_options=POINT_OPTIONS)
def _stiffness_overload(eos, x, energy):
    return _choose(eos, _linear_stiffness, _grueneisen_stiffness)


@overload(stored_energy, jit_options=POINT_OPTIONS)
def _stored_energy_overload(eos, x):
    return _choose(eos, _linear_energy, _grueneisen_energy)


