"""Elastic-plastic piston: a block that runs into a mirror, against the exact two-wave solution."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from f2s_hpc.errors import InputError
from f2s_hpc.kernels.derived import cell_pressure
from f2s_hpc.materials.params import LinearHardening, MieGrueneisen
from f2s_hpc.solver.model import Model
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import (
    ALL_SYMMETRY,
    Setup,
    cell_coordinates,
    make_block,
    make_model,
    node_coordinates,
    warm_up,
)
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import Setting, material

THIN, VOID = 3, 4
"""Cells across, and cells of void behind the block."""

PUBLISHED_CELLS = 300
"""Cells of the published runs on this length; the bars hold from there on."""

OVERSHOOTS = ("overshoot of stress (Pa)", "overshoot at half time and end (Pa)")
"""Of the whole run, with a bar, and what is left of it later, which is less."""


@dataclass(frozen=True)
class Wave:
    """State behind a wave, and its speed in the frame of the material at rest ahead of both waves (SI)."""

    speed: float
    velocity: float
    density: float
    energy: float
    stress: float  # compressive normal stress


def two_waves(model: Model, piston: float) -> tuple[Wave, Wave]:
    """Return elastic precursor and plastic wave of a perfectly plastic, hypoelastic, Mie-Grueneisen material.

    Udaykumar et al. 2003, J. Comput. Phys. 186, 136-177: behind the precursor rho = rho_0 exp(Y / 2G) and the axial
    deviator is -2Y/3; across each wave mass, momentum and energy are conserved; behind the plastic wave the
    velocity is the piston's. Raises ``InputError`` where the two waves do not exist: the piston too slow to yield the
    material, or the plastic wave faster than the precursor.
    """
    eos, yielding, shear = model.eos, model.flow.yield_stress, model.bulk.shear_modulus
    ahead = Wave(0.0, 0.0, eos.density, 0.0, 0.0)
    precursor = _behind(eos, ahead, eos.density * math.exp(0.5 * yielding / shear), 2.0 / 3.0 * yielding)
    if precursor.velocity >= piston:
        raise InputError(f"speed: the piston must be faster than {precursor.velocity:.4g} m/s, or nothing yields")
    low, high = precursor.density * (1.0 + 1e-12), precursor.density * 1.6
    while high - low > 1e-14 * high:
        middle = 0.5 * (low + high)
        if _behind(eos, precursor, middle, 2.0 / 3.0 * yielding).velocity < piston:
            low = middle
        else:
            high = middle
        if middle in (low, high) and 0.5 * (low + high) == middle:
            break
    plastic = _behind(eos, precursor, 0.5 * (low + high), 2.0 / 3.0 * yielding)
    if plastic.speed >= precursor.speed:
        raise InputError(f"speed: at {piston:g} m/s the plastic wave overtakes the elastic one")
    return precursor, plastic


def _behind(eos: MieGrueneisen, ahead: Wave, density: float, deviator: float) -> Wave:
    """Return the state of ``density`` behind a jump from ``ahead``; ``deviator``: compressive axial deviator (Pa)."""
    mu = density / eos.density - 1.0
    hugoniot = eos.density * eos.sound_speed**2 * mu * (1.0 + mu) / (1.0 - (eos.slope - 1.0) * mu) ** 2
    cold, per_energy = hugoniot * (1.0 - 0.5 * eos.gamma * mu / (1.0 + mu)), eos.gamma * eos.density
    # energy jump e - e_a = (s + s_a) (1/rho_a - 1/rho) / 2 with s = cold + per_energy e + deviator, linear in e
    half = 0.5 * (1.0 / ahead.density - 1.0 / density)
    energy = (ahead.energy + half * (cold + deviator + ahead.stress)) / (1.0 - half * per_energy)
    stress = cold + per_energy * energy + deviator
    jump = math.sqrt((stress - ahead.stress) * (density - ahead.density) / (density * ahead.density))
    speed = ahead.velocity + jump * density / (density - ahead.density)
    return Wave(speed, ahead.velocity + jump, density, energy, stress)


def _profiles(setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return along x the compressive normal stress (Pa, cells) and the velocity (m/s, nodes)."""
    state = setup.state
    pressure = np.zeros(state.part.cell_shape)
    cell_pressure(setup.model.eos, state.flat["mass"], state.flat["volume_fraction"], state.energy,
                  pressure.reshape(-1))
    stress = pressure[state.part.owned_cells] - state.owned("stress_xx")
    # the high nodes belong to the last rank: all ranks show as many nodes as cells
    velocity = state.owned("velocity_x")[:, :, :state.part.count[0]]
    return sample.along_x(state, stress), sample.along_x(state, velocity)


def _front(place: np.ndarray, profile: np.ndarray, level: float) -> float:
    """Return where ``profile``, seen from the far end, first rises above ``level`` (linear between points).

    NaN where there is no front: nothing is above, or even the far end is.
    """
    above = np.flatnonzero(profile >= level)
    if not above.size or above[-1] == profile.size - 1:
        return math.nan
    i = int(above[-1])
    share = (profile[i] - level) / (profile[i] - profile[i + 1])
    return float(place[i] + share * (place[i + 1] - place[i]))


def _mean_between(place: np.ndarray, profile: np.ndarray, low: float, high: float) -> float:
    """Return the mean over the middle 40 % of (low, high)."""
    inside = (place >= low + 0.3 * (high - low)) & (place <= low + 0.7 * (high - low))
    return float(profile[inside].mean()) if inside.any() else math.nan


def block(cells: int, model: Model, piston: float) -> Setup:
    """Return a block that flies towards the mirror at x = 0, void behind it so that nothing pulls at its far end."""
    setup = make_block((cells + VOID, THIN, THIN), model, sides=ALL_SYMMETRY)
    state = setup.state
    beyond = np.broadcast_to(cell_coordinates(state)[0] > cells, state.part.cell_shape)
    for name in ("mass", "volume_fraction", "temperature"):
        state.views[name][beyond] = 0.0
    inside = np.broadcast_to(node_coordinates(state)[0] <= cells, state.part.node_shape)
    state.views["velocity_x"][inside] = -piston
    state.boundary.hold([state.views["velocity_x"]])
    state.exchange(state.ghosted)
    setup.activate()
    return setup


def _largest_stress_until(setup: Setup, end: float, cells: int) -> float:
    """Step to the time ``end`` (s); return the largest stress (Pa) in the block after any remap on the way."""
    clock, largest = setup.clock, 0.0
    while clock.in_cycle < end * (1.0 - 1e-12):
        setup.step(end)
        largest = max(largest, float(_profiles(setup)[0][:cells].max()))
    return largest


def _run_level(cells: int, model: Model, piston: float, waves: tuple[Wave, Wave],
               end: float) -> tuple[list[tuple[str, float, float]], tuple[float, float], Setup]:
    """Run one resolution; return (quantity, value, reference), the largest stresses, and the setup.

    The largest of the whole run, which is that of the first moments at the wall, and that at half time and at the end.
    """
    setup = block(cells, model, piston)
    nodes = np.arange(cells) * model.dx
    centres = nodes + 0.5 * model.dx
    precursor, plastic = waves
    fronts, largest, late = [], 0.0, 0.0
    for share in (0.5, 1.0):
        largest = max(largest, _largest_stress_until(setup, share * end, cells))
        stress, velocity = (profile[:cells] for profile in _profiles(setup))
        late = max(late, float(stress.max()))
        # in the frame of the material ahead; what has left the far end does not count
        velocity = np.where(nodes < cells * model.dx - 1.1 * piston * end, velocity + piston, 0.0)
        levels = (0.5 * precursor.velocity, 0.5 * (precursor.velocity + plastic.velocity))
        fronts.append([_front(nodes, velocity, level) for level in levels])
    between = [(fronts[1][n] - fronts[0][n]) / (0.5 * end) + piston for n in range(2)]
    x_plastic, x_elastic = (plastic.speed - piston) * end, (precursor.speed - piston) * end
    found = [
        ("plateau stress (Pa)", _mean_between(centres, stress, 0.0, x_plastic), plastic.stress),
        ("plateau velocity (m/s)", _mean_between(nodes, velocity, 0.0, x_plastic), plastic.velocity),
        ("plastic wave speed (m/s)", between[1], plastic.speed),
        ("precursor stress (Pa)", _mean_between(centres, stress, x_plastic, x_elastic), precursor.stress),
        ("precursor velocity (m/s)", _mean_between(nodes, velocity, x_plastic, x_elastic), precursor.velocity),
        ("precursor wave speed (m/s)", between[0], precursor.speed),
    ]
    return found, (largest, late), setup


def _solved(options: Options, dx: float) -> tuple[Model, tuple[Wave, Wave]]:
    """Return the model with cells of ``dx`` (m) and its exact waves. Raises ``InputError`` where there are none."""
    model = make_model(dx, options["material"], options["speed"], options.overrides)
    if not (isinstance(model.eos, MieGrueneisen) and isinstance(model.flow, LinearHardening)
            and model.flow.modulus == 0.0):
        raise InputError(f"material={options['material']}: the exact solution needs Mie-Grueneisen pressure and "
                         "linear hardening with hardening_modulus 0, as copper-piston has")
    return model, two_waves(model, options["speed"])


def _check(options: Options) -> None:
    _solved(options, 1e-6)


def _run(options: Options) -> Iterator[Measured]:
    piston = options["speed"]
    for level in options.levels:
        cells = round(level)
        model, waves = _solved(options, options["length"] / cells)
        # the precursor stays inside the block, and short of the release from its far end
        end = min(options["time"], 0.95 * options["length"] / waves[0].speed)
        warm_up(model)
        watch = Stopwatch()
        found, largest, setup = _run_level(cells, model, piston, waves, end)
        spent = sample.cost(setup.clock, watch)
        asked = cells >= PUBLISHED_CELLS
        for quantity, value, reference in found:
            error = abs(value / reference - 1.0) if math.isfinite(value) else math.inf
            yield Measured(quantity, level, model.dx, value, reference, error, 5e-3 if asked else None, **spent)
        for name, stress, bar in zip(OVERSHOOTS, largest, (5e-2, None)):
            over = max(0.0, stress / waves[1].stress - 1.0)
            yield Measured(name, level, model.dx, stress, waves[1].stress, over, bar if asked else None,
                           compares=False, **spent)


def _case(name: str, speed: str, more: str) -> Case:
    return Case(
        name, f"""Elastic-plastic piston at {speed}{more} against the exact two-wave solution
A block of copper runs into a mirror (the piston in the frame of the piston; speeds are given in the frame of the
material ahead). Relative errors of the means over the middle of each plateau at the end, of the front speeds
between half time and end, and the largest stress over the plateau: after any remap of the run (bar), and at half time
and end. Bars from 300 cells on, as published: Udaykumar et al. 2003, J. Comput. Phys. 186, 136-177.""",
        _run, (75, 150, 300), (150, 300, 600, 1200),
        {"speed": Setting(speed, "speed"), "length": Setting("15 mm", "length"), "time": Setting("2.9 us", "time"),
         "material": material("copper-piston")}, 10, whole=True, check=_check)


CASES = (_case("piston", "20 m/s", ""), _case("piston-100", "100 m/s", ""), _case("piston-300", "300 m/s", ""))
