"""Deposits of many particles: the impact energy that no physical term received; heat that must not hang on the mesh."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.config.load import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.units import ZERO_CELSIUS
from f2s_hpc.verify import energy, sample
from f2s_hpc.verify.box import Setup
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.scenes import prepare, run_cycles
from f2s_hpc.verify.setting import WHOLE, Setting

LENGTH = 30e-6
"""Characteristic length (m), the paper's D50: resolutions 5, 7.5 and 10 are cells of 6, 4 and 3 um."""

RESOLVED = 5.0
"""Cells per 30 um from which on there are bars; coarser meshes show the way there."""

_SECTION4_FOOTPRINT = 0.35e-3
_SECTION4_PARTICLES = 500
_QUICKSTART_FOOTPRINT = 0.12e-3
_QUICKSTART_PARTICLES = 36
_LOSS_BARS = ((3e-6, 0.12), (4e-6, 0.20), (6e-6, 0.30))


def deposit_temperature(setup: Setup, scene: Scene) -> float:
    """Return the mean temperature (degC), weighted by mass, of what has landed above the substrate's top.

    Landed is what has in the cycle table, in cells at least half full; NaN where nothing has.
    """
    state = setup.state
    landed = measure.landed_cells(state, setup.model, scene.top_speed)
    deposit = measure.deposit_cells(state, landed, scene.domain.substrate_height)
    mass = state.owned("mass")[deposit]
    local = np.array([mass.sum(), mass @ state.owned("temperature")[deposit]])
    whole, heat = sum(mpi.all_gather(local))
    return float(heat / whole) - ZERO_CELSIUS if whole > 0.0 else math.nan


def footprint_of(options: Options) -> float:
    """Return the edge of the square patch (m): as given, or that of the size of the run."""
    given = options["footprint"]
    return (_QUICKSTART_FOOTPRINT if options.full else 60e-6) if given == "default" else given


def patch_scene(options: Options, dx: float) -> Scene:
    """Return the scene "quickstart" on a square patch, as many particles per area, without its files."""
    footprint = footprint_of(options)
    particles = round(_QUICKSTART_PARTICLES * (footprint / _QUICKSTART_FOOTPRINT) ** 2)
    return load_scene("quickstart", [
        f"domain.cell_size={dx!r} m", f'domain.size=["{footprint!r} m", "{footprint!r} m", "0.3 mm"]',
        f"batches.particles={particles}", f"cycles.count={options['cycles']}",
        f"particles.speed={options['speed']!r} m/s", f"particles.temperature={options['temperature']!r} K",
        f"batches.seed={options['seed']}", *options.overrides])


def section4_scene(options: Options, dx: float) -> Scene:
    """Return the scene "section4", or for quick sizes a corner: two cycles, a lower box, no particle above 60 um."""
    cycles = (10 if options.full else 2) if options["cycles"] == "default" else options["cycles"]
    overrides = [f"domain.cell_size={dx!r} m", f"cycles.count={cycles}"]
    if not options.full:
        footprint = 72e-6  # whole cells of 8, 6, 4 and 3 um
        particles = round(_SECTION4_PARTICLES * (footprint / _SECTION4_FOOTPRINT) ** 2)
        overrides += [f'domain.size=["{footprint!r} m", "{footprint!r} m", "0.4 mm"]', f"batches.particles={particles}",
                      "batches.diameter_max=60 um"]
    return load_scene("section4", [*overrides, *options.overrides])


def _deposited(scene: Scene) -> tuple[Setup, int]:
    """Return the box of a scene after all its cycles, and the substrate's mass in quanta."""
    setup, plan = prepare(scene)
    substrate_quanta = measure.material_quanta(setup.state, setup.model)
    run_cycles(scene, plan, setup, setup.advance_to)
    return setup, substrate_quanta


def _check(scene_of: Callable[[Options, float], Scene], options: Options) -> None:
    """Raise ``InputError`` if the scene of ``scene_of`` is not possible with one of the cells."""
    for level in options.levels:
        mpi.run_together(scene_of, options, LENGTH / level)


def run_patch(options: Options) -> Iterator[Measured]:
    """Yield the mean temperature of the deposit on each mesh, and its spread over them."""
    found: list[float] = []
    for level in options.levels:
        watch, dx = Stopwatch(), LENGTH / level
        scene = mpi.run_together(patch_scene, options, dx)
        setup, substrate_quanta = _deposited(scene)
        found.append(deposit_temperature(setup, scene))
        balance = measure.measure_balance(setup.state, setup.model, setup.ledger, substrate_quanta)
        cost = sample.cost(setup.clock, watch)
        # (the bar is that there is a deposit at all)
        yield Measured("mean deposit temperature, degC", level, dx, found[-1], None, 0.0,
                       None if math.isfinite(found[-1]) else 0.0, compares=False, **cost)
        terms = balance["energy"]
        for quantity, value in (("numerical loss", balance["numerical_loss_fraction"]),
                                ("heat / impact energy", terms["heat"] / terms["brought_in"])):
            yield Measured(quantity, level, dx, value, None, 0.0, compares=False, **cost)
        yield energy.row([balance], level, dx, cost | {"compares": False},
                         bar=energy.BAR if level >= RESOLVED else None)
    fine = [value for value, level in zip(found, options.levels) if level >= RESOLVED]
    if len(fine) > 1:
        spread = float(np.ptp(fine) / np.mean(fine))
        yield Measured("spread of the mean temperature", level, dx, spread, 0.0, spread, 0.03, compares=False, **cost)


def run_section4(options: Options) -> Iterator[Measured]:
    """Yield the numerical loss, the remainder and the mass drift of section 4, per mesh."""
    for level in options.levels:
        watch, dx = Stopwatch(), LENGTH / level
        scene = mpi.run_together(section4_scene, options, dx)
        setup, substrate_quanta = _deposited(scene)
        balance = measure.measure_balance(setup.state, setup.model, setup.ledger, substrate_quanta)
        loss = balance["numerical_loss_fraction"]
        cost = sample.cost(setup.clock, watch)
        bar = next((bar for largest, bar in _LOSS_BARS if dx <= largest * (1.0 + 1e-9)), None)
        yield Measured("numerical loss", level, dx, loss, 0.0, loss, bar, **cost)
        unheated = balance["numerical_loss_unheated_fraction"]
        yield Measured("not come back as heat", level, dx, unheated, 0.0, unheated, compares=False, **cost)
        yield energy.row([balance], level, dx, cost, bar=energy.BAR if level >= RESOLVED else None)
        drift = abs(balance["mass_drift_relative"])
        yield Measured("mass drift", level, dx, drift, 0.0, drift, 1e-10, compares=False, **cost)


CASES = (
    Case("section4",
         "Section 4 of Free2Spray (quick: two cycles on 72 x 72 um): share of the impact energy that no physical term "
         "received, error of the explicit step with the unexplained remainder, mass drift; resolutions are cells per "
         "30 um (3.75: 8 um, 5: 6 um, 7.5: 4 um, 10: 3 um).",
         run_section4, (3.75, 5.0, 7.5), (5.0, 7.5, 10.0),
         {"cycles": Setting("default", kind=WHOLE, least=1, words=("default",))}, 2,
         check=functools.partial(_check, section4_scene)),
    Case("deposit-temperature",
         "Patch of the scene quickstart, 0.12 x 0.12 mm (quick: 60 x 60 um), three batches: mean deposit temperature "
         "in degC must not hang on the mesh; (largest - smallest) / mean over the meshes from 6 um on; resolutions "
         "are cells per 30 um.",
         run_patch, (4.0, 5.0, 7.5), (5.0, 7.5, 10.0),
         {"cycles": Setting("3", kind=WHOLE, least=1),
          "footprint": Setting("default", "length", least=24e-6, words=("default",)),
          "speed": Setting("615 m/s", "speed"), "temperature": Setting("450 degC", "temperature"),
          "seed": Setting("1", kind=WHOLE, least=0)},
         2, check=functools.partial(_check, patch_scene)),
)
