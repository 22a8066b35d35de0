"""Elastic wave packets that meet an absorbing side: what comes back, against the theory of plane waves."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc.cycles import measure
from f2s_hpc.materials.params import Bulk
from f2s_hpc.solver.absorbing import wave_speeds
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import (
    ALL_SYMMETRY,
    NO_SHOCK_VISCOSITY,
    Setup,
    cell_coordinates,
    make_block,
    make_model,
    never_yields,
    node_coordinates,
    warm_up,
)
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import Setting, material

THIN = 3
"""Cells across the directions in which nothing varies."""

_LONGITUDINAL, _SHEAR = "longitudinal", "shear"
FEWEST = 16
"""Cells per wavelength from which on the bars hold."""

_HIGH = "1 m"
"""A depth so large that the springs do not count."""


def _plane(bulk: Bulk, direction: np.ndarray, motion: np.ndarray, speed: float) -> np.ndarray:
    """Return the (z, x) traction's stress (sigma_zz, sigma_xz) of a plane wave of velocity ``motion`` (x, z)."""
    slowness = direction / speed
    strain = -0.5 * (np.outer(motion, slowness) + np.outer(slowness, motion))
    lame = bulk.bulk_modulus - 2.0 / 3.0 * bulk.shear_modulus
    stress = lame * np.trace(strain) * np.eye(2) + 2.0 * bulk.shear_modulus * strain
    return np.array([stress[1, 1], stress[0, 1]])


def reflected(bulk: Bulk, speeds: tuple[float, float], wave: str, angle: float) -> float:
    """Return the root of the share of energy that two dashpots send back of a plane wave; ``angle`` (rad) of incidence.

    The side z = 0 bears sigma_zz = rho c_p v_z, sigma_xz = rho c_s v_x; reflected longitudinal and shear wave follow
    from these two equations (Lysmer and Kuhlemeyer 1969). For shear waves below their critical angle.
    """
    sine = math.sin(angle) / (speeds[0] if wave == _LONGITUDINAL else speeds[1])
    sines = [sine * c for c in speeds]
    cosines = [math.sqrt(1.0 - s * s) for s in sines]
    impedance = bulk.density * np.array(speeds)

    def unbalanced(kind: int, down: float) -> np.ndarray:
        along = np.array([sines[kind], down * cosines[kind]])
        motion = along if kind == 0 else np.array([along[1], -along[0]])
        return _plane(bulk, along, motion, speeds[kind]) - impedance * motion[::-1]

    kind = int(wave == _SHEAR)
    back = np.linalg.solve(np.column_stack([unbalanced(0, 1.0), unbalanced(1, 1.0)]), -unbalanced(kind, -1.0))
    flux = [speeds[n] * cosines[n] for n in (0, 1)]
    return math.sqrt(sum(b * b * f for b, f in zip(back, flux)) / flux[kind])


class Packet:
    """A wave packet that travels down: pairs of plane waves at +-``angle`` between mirrors at x = 0 and x = ``width``.

    Lengths in cells. The ``length`` of the envelope exp(-((z - centre) / length)^2) is one vertical wavelength.
    """

    def __init__(self, wave: str, angle: float, wavelength: float, strain: float) -> None:
        self.wave, self.strain = wave, strain
        self.width = round(0.5 * wavelength / math.sin(angle)) if angle else THIN
        self.across = math.pi / self.width if angle else 0.0
        number = 2.0 * math.pi / wavelength
        self.down = math.sqrt(number * number - self.across * self.across)
        self.angle = math.atan2(self.across, self.down)
        self.length = 2.0 * math.pi / self.down
        self.centre = 3.0 * self.length

    def _potential(self, z: np.ndarray, size: float, ahead: float) -> tuple[np.ndarray, ...]:
        """Return the potential's part in z with its first and second slope, its rate (over k c) and the rate's slope.

        envelope(z + ahead c t) cos(k_z z + k c t) at t = 0; ``ahead``: cosine of the angle of incidence.
        """
        k, wide, off = self.down, self.length, z - self.centre
        number = k / ahead
        envelope = size * np.exp(-(off / wide) ** 2)
        first, second = -2.0 * off / wide**2 * envelope, (4.0 * off**2 / wide**4 - 2.0 / wide**2) * envelope
        sine, cosine = np.sin(k * z), np.cos(k * z)
        slow = ahead / number
        return (envelope * cosine, first * cosine - k * envelope * sine,
                second * cosine - 2.0 * k * first * sine - k * k * envelope * cosine,
                slow * first * cosine - envelope * sine,
                slow * (second * cosine - k * first * sine) - first * sine - k * envelope * cosine)

    def put_into(self, setup: Setup, speed: float) -> None:
        """Set velocity (m/s), stress (Pa) and mass of a block at rest; ``speed``: of the wave (m/s)."""
        state, bulk = setup.state, setup.model.bulk
        number = math.hypot(self.across, self.down)
        size, kx, ahead = self.strain / (number * number), self.across, self.down / number
        motion = number * speed
        x, _, z = node_coordinates(state)
        _, _, _, rate, slope_of_rate = self._potential(z, size, ahead)
        if self.wave == _LONGITUDINAL:
            vx, vz = -kx * np.sin(kx * x) * rate, np.cos(kx * x) * slope_of_rate
        else:
            vx, vz = -np.sin(kx * x) * slope_of_rate, kx * np.cos(kx * x) * rate
        state.views["velocity_x"][...], state.views["velocity_z"][...] = motion * vx, motion * vz
        x, _, z = cell_coordinates(state)
        value, slope, curvature, _, _ = self._potential(z, size, ahead)
        sine, cosine = np.sin(kx * x), np.cos(kx * x)
        if self.wave == _LONGITUDINAL:
            exx, ezz, exz = -kx * kx * cosine * value, cosine * curvature, -kx * sine * slope
        else:
            exx, ezz, exz = -kx * cosine * slope, kx * cosine * slope, -0.5 * sine * (curvature + kx * kx * value)
        volume, shear = exx + ezz, 2.0 * bulk.shear_modulus
        for name, strain in (("xx", exx), ("yy", 0.0 * exx), ("zz", ezz)):
            state.views[f"stress_{name}"][...] = shear * (strain - volume / 3.0)
        state.views["stress_xz"][...] = shear * exz
        state.views["mass"][...] = 1.0 - volume
        state.boundary.hold([state.views[f"velocity_{axis}"] for axis in "xyz"])
        state.exchange(state.ghosted)


def _energy(setup: Setup) -> float:
    energy = measure.measure_balance(setup.state, setup.model, setup.ledger, 0)["energy"]
    return energy["kinetic"] + energy["elastic"]


def come_back(side: str, wave: str, degrees: float, cells: float, dx: float, depth: str, options: Options,
              ) -> tuple[float, float, Setup]:
    """Return the root of the energy share of a packet that an end of kind ``side`` sends back, and what theory gives.

    ``cells`` per wavelength of ``dx`` (m); ``depth``: ``numerics.absorbing_depth``. The box is returned too.
    """
    model = never_yields(make_model(dx, options["material"], overrides=(
        *NO_SHOCK_VISCOSITY, f"numerics.absorbing_depth={depth}", *options.overrides)))
    packet = Packet(wave, math.radians(degrees), cells, options["strain"])
    speeds = wave_speeds(model)
    speed = speeds[wave == _SHEAR]
    # the exact sums of the ledger must resolve a wave this weak
    model = model._replace(energy_quantum=model.energy_quantum * (packet.strain * speed / 600.0) ** 2)
    setup = make_block((packet.width, THIN, round(2.0 * packet.centre)), model, sides=ALL_SYMMETRY | {"z_low": side})
    packet.put_into(setup, speed)
    before = _energy(setup)
    setup.advance_to(2.0 * packet.centre * dx / (speed * math.cos(packet.angle)))
    share = math.sqrt(_energy(setup) / before)
    return share, reflected(model.bulk, speeds, wave, packet.angle) if side == "absorbing" else 1.0, setup


def _run(options: Options) -> Iterator[Measured]:
    choices = [("fixed", _LONGITUDINAL, 0.0, _HIGH), ("absorbing", _LONGITUDINAL, 0.0, _HIGH),
               ("absorbing", _SHEAR, 6.0, _HIGH)]
    choices += [("absorbing", _LONGITUDINAL, angle, _HIGH) for angle in (30.0, 45.0, 60.0)]
    choices += [("absorbing", _SHEAR, 20.0, _HIGH), ("absorbing", _LONGITUDINAL, 0.0, "")]
    warm_up(never_yields(make_model(1e-6, options["material"])))
    for level in options.levels:
        for side, wave, degrees, depth in choices:
            watch, dx, behind = Stopwatch(), options["wavelength"] / level, depth or f"{options['depth']!r} m"
            value, theory, setup = come_back(side, wave, degrees, level, dx, behind, options)
            name = f"{side}, {wave}, {degrees:.0f} deg" + ("" if depth else ", default depth")
            near = side == "absorbing" and degrees <= 6.0
            bar = (0.02 if near else 0.03) if level >= FEWEST else None
            yield Measured(name, level, dx, value, theory, value if near else abs(value - theory),
                           bar, compares=False, **sample.cost(setup.clock, watch))


_TEXT = """Elastic wave packets that meet an absorbing side (dashpots of Lysmer and Kuhlemeyer 1969) or a fixed one
The root of the share of energy that comes back. Reference: plane waves on two dashpots; a fixed side returns all. Near
normal incidence the bar is 2 % of the amplitude. "default depth": with the springs of numerics.absorbing_depth. Bars
from 16 cells per wavelength on."""

CASES = (
    Case("absorbing-side", _TEXT, _run, (8, 12, 16), (12, 16, 24), {
        "wavelength": Setting("32 um", "length"), "strain": Setting("1e-6"), "material": material("copper-ge"),
        "depth": Setting("0.5 mm", "length")}, 4),
)
