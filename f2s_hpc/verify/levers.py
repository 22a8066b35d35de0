"""What leaving out saves: each lever alone, and all together, against the full computation of the same scene."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.analysis.table import aligned
from f2s_hpc.config.load import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import Setup
from f2s_hpc.verify.case import Stopwatch
from f2s_hpc.verify.scenes import prepare, run_cycles

SCENE = "quickstart"
QUICK = ("domain.size=[\"0.06 mm\", \"0.06 mm\", \"0.21 mm\"]", "domain.substrate_height=0.096 mm",
         "domain.particle_layer_height=0.06 mm", "batches.count=1", "batches.particles=6", "batches.diameter_max=40 um",
         "cycles.count=1", "cycles.last_duration=0.3 us")
"""The small scene: one batch of six particles on a patch of 10 x 10 cells, deep enough to sleep under them."""


@dataclass(frozen=True)
class Lever:
    """Something that may be left out: the settings that leave it out, and those of the full computation.

    ``halves_substrate``: and half of the substrate goes with it.
    """

    name: str
    saving: tuple[str, ...]
    full: tuple[str, ...]
    halves_substrate: bool = False

    def settings(self, scene: Scene) -> tuple[str, ...]:
        """Return the settings that leave it out of ``scene``."""
        if not self.halves_substrate:
            return self.saving
        x, y, z = scene.domain.size
        less = (round(scene.domain.substrate_height / scene.domain.cell_size) // 2) * scene.domain.cell_size
        return (*self.saving, f"domain.size=[\"{x!r} m\", \"{y!r} m\", \"{z - less!r} m\"]",
                f"domain.substrate_height={scene.domain.substrate_height - less!r} m")


LEVERS: tuple[Lever, ...] = (
    Lever("ballistic flight", ("particles.flight=ballistic",), ("particles.flight=eulerian",)),
    Lever("active rows", ("numerics.active_rows=true",), ("numerics.active_rows=false",)),
    Lever("no conduction", ("numerics.conduction=false",), ("numerics.conduction=true",)),
    Lever("fewer remaps", ("numerics.steps_per_remap=8",), ("numerics.steps_per_remap=1",)),
    Lever("remap of order 1", ("numerics.remap_order=1",), ("numerics.remap_order=2",)),
    Lever("sleeping depth", ("numerics.sleeping_depth=0.048 mm",), ("numerics.sleeping_depth=0 m",)),
    Lever("half substrate, absorbing", ("domain.faces.z_low=absorbing",), ("domain.faces.z_low=fixed",), True),
    Lever("losses do not heat", ("numerics.loss_heating=false",), ("numerics.loss_heating=true",)),
)
"""One line per lever; the full computation uses the ``full`` settings of all."""


@dataclass(frozen=True)
class Saving:
    """What a lever saves and what it changes against the full computation, the same scene.

    ``memory_bytes``: of the fields, pages that are real at the end. ``time``, ``memory``: over those of the full
    computation. Changes of heights (m) and PEEQ are absolute, of
    temperatures in K; None where nothing has landed. ``fraction_change``: sum over all cells of how much the volume
    fraction changed, over the sum of the volume fraction; None where the boxes differ.
    """

    lever: str
    wall_s: float
    memory_bytes: int
    steps: int
    cell_steps: int
    time: float
    memory: float
    height_mean_m: float
    height_p95_m: float
    peeq_p50: float | None
    peeq_p95: float | None
    temperature_p50: float | None
    temperature_p95: float | None
    fraction_change: float | None


@dataclass
class _Measured:
    wall: float
    memory: int
    setup: Setup
    row: dict
    fraction: np.ndarray


def _compute(scene: Scene) -> _Measured:
    """Run a scene to its end without looking at it. Collective."""
    gc.collect()
    stopwatch = Stopwatch()
    setup, plan = prepare(scene)
    run_cycles(scene, plan, setup, setup.advance_to)
    mpi.barrier()
    wall = float(mpi.broadcast(stopwatch.read()))
    memory = sum(mpi.all_gather(setup.state.pool.real_bytes()))
    row = measure.measure_material(setup.state, setup.model, scene.domain.substrate_height, scene.top_speed)
    return _Measured(wall, memory, setup, row, setup.state.owned("volume_fraction").copy())


def _compared(name: str, run: _Measured, full: _Measured) -> Saving:
    def change(key: str) -> float | None:
        here, there = run.row[key], full.row[key]
        return None if here is None or there is None else here - there

    alike = run.setup.state.part.box.cells == full.setup.state.part.box.cells
    moved = sum(mpi.all_gather(float(np.abs(run.fraction - full.fraction).sum()))) if alike else None
    whole = sum(mpi.all_gather(float(full.fraction.sum())))
    clock = run.setup.clock
    return Saving(
        name, run.wall, run.memory, clock.steps, sample.cell_steps(clock),
        run.wall / full.wall, run.memory / max(full.memory, 1), change("height_mean_m"), change("height_p95_m"),
        change("peeq_p50"), change("peeq_p95"), change("temperature_p50_degC"), change("temperature_p95_degC"),
        moved / whole if alike else None)


def run(full: bool = False, overrides: Sequence[str] = (), levers: Sequence[Lever] = LEVERS,
        report: Callable[[Saving], None] = lambda saving: None) -> list[Saving]:
    """Return the full computation, then every lever alone, then all of them; the same on every rank but for time.

    ``full``: the scene "quickstart" itself, else a small patch of it; ``overrides`` ("key.path=value") change the scene
    of all runs; ``report`` is called with every row as it comes. Collective; raises ``InputError``.
    """
    common = (*(() if full else QUICK), *overrides)
    everything = tuple(setting for lever in levers for setting in lever.full)
    # kernels are loaded and pages of code made real before anything is timed
    saving = tuple(setting for lever in levers for setting in lever.saving)
    for settings in ((), saving):
        _compute(load_scene(SCENE, (*QUICK, *overrides, *everything, *settings, "cycles.last_duration=5 ns")))
    scene = load_scene(SCENE, (*common, *everything))
    reference = _compute(scene)
    rows = [_compared("everything", reference, reference)]
    report(rows[0])
    choices = [(lever.name, lever.settings(scene)) for lever in levers]
    choices.append(("all levers", tuple(setting for _, settings in choices for setting in settings)))
    for name, settings in choices:
        rows.append(_compared(name, _compute(load_scene(SCENE, (*common, *everything, *settings))), reference))
        report(rows[-1])
    return rows


COLUMNS = (("lever", "lever", 1, "{}"), ("wall_s", "wall s", 1, "{:.2f}"), ("time", "time", 1, "{:.3f}"),
           ("memory_bytes", "MB", 1e-6, "{:.1f}"), ("memory", "memory", 1, "{:.3f}"), ("steps", "steps", 1, "{}"),
           ("cell_steps", "cell-steps", 1, "{}"), ("height_mean_m", "mean height um", 1e6, "{:+.3f}"),
           ("height_p95_m", "p95 height um", 1e6, "{:+.3f}"), ("peeq_p50", "PEEQ p50", 1, "{:+.4f}"),
           ("peeq_p95", "PEEQ p95", 1, "{:+.4f}"), ("temperature_p50", "T p50 K", 1, "{:+.2f}"),
           ("temperature_p95", "T p95 K", 1, "{:+.2f}"), ("fraction_change", "VF L1", 1, "{:.2e}"))


def table(savings: list[Saving]) -> str:
    """Return the rows as a table: time and memory over those of the full computation, then the changes."""
    def text(saving: Saving, name: str, scale: float, form: str) -> str:
        value = getattr(saving, name)
        return "-" if value is None else form.format(value if isinstance(value, str) or scale == 1 else value * scale)

    lines = [[head for _, head, _, _ in COLUMNS]]
    lines += [[text(s, name, scale, form) for name, _, scale, form in COLUMNS] for s in savings]
    return "\n".join(aligned(lines, left=range(len(COLUMNS))))
