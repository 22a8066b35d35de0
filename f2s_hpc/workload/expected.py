"""The load of a run before it is run: which cells will be active when, from the substrate, the batches and the cycles.

Spheres fly straight, each until its centre meets the surface below it; there it becomes deposit, spread over a disc.
In ballistic flight only those close to the surface, or about to touch another, make cells active. Nothing of the solver
is run and no field is allocated, so this takes seconds for a hundred thousand particles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.decomposition import Ranges
from f2s_hpc.kernels.activity import BLOCK, block_count
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.meeting import waits
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.workload import marks

SPREAD = 1.4
"""Width of a landed particle over its diameter: what splats of copper at 500 to 700 m/s have (see ``f2s verify``)."""

CALM, ON_GRID = 4.0, 10.0
"""Distance to the surface (in cells) below which flying particles are on the grid, while none lands and while some do.
By the rule of ballistic flight it is always the first, but of what splashes and of particles that are being stopped the
surface here knows nothing. Measured: the cell-steps of section4 at 6 and 3 um, wide-100k and track-160 at 8 and 4 um
are met within 5 %."""

BUSY_PACE, BY_CELLS, BY_NUMBER, BY_DENSITY = 1.53, 0.2, 0.2, 0.3
"""Steps per time while particles land, over those at rest, for what is ``USUAL`` (shock viscosity, speed and strain
shorten them); and what is added for twice as many cells per diameter, for ten times as many that land at once, since
the fastest of all counts, and for ten times as many on a square millimetre. Measured: 1.58 and 1.74 in section4 at 6
and 3 um, 1.42 and 1.58 in track-160 at 8 and 4 um, 1.71 in wide-100k, 1.26 in the quick start; met within 4 %."""

USUAL = (3.6, 54.0, 445.0)
"""Cells per mean diameter (by number), spheres that land at once and their number on a square millimetre: those of
section4 at 6 um."""

SAMPLES, MOST_SAMPLES = 4, 400
"""Looks per cycle, and the most of a long one: the fastest particle crosses the box twenty times meanwhile."""


@dataclass(frozen=True)
class Moment:
    """The load at one time: ``weight`` is the share of the run it stands for, ``cycle`` counts from 0.

    ``pace``: its steps per time over those of material at rest.
    ``blocks``: uint8 [k, j, block], active blocks of the whole box; ``solid``: those of them that substrate and
    deposit make active.
    """

    cycle: int
    weight: float
    pace: float
    blocks: np.ndarray
    solid: np.ndarray


@dataclass(frozen=True)
class Growth:
    """How the work of a run grows with its time: ``share`` of all its active cell-steps that is done at ``times`` (s).

    Both rise from 0, ``share`` to 1.
    """

    times: tuple[float, ...]
    share: tuple[float, ...]

    def at(self, time: float) -> float:
        """Return the share that is done at ``time`` (s)."""
        return float(np.interp(time, self.times, self.share))


class Air:
    """All spheres in flight, in cells and seconds, z from the bottom of the box; lowest first."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.dx = scene, scene.domain.cell_size
        self.places, self.velocity = np.empty((0, 3)), np.empty((0, 3))
        self.r, self.waits = np.empty(0), np.empty(0)

    def launch(self, batch: Batch) -> None:
        """Add a batch, z from the bottom of the layer."""
        bottom, own = self.scene.domain.layer_bottom, batch.velocities(self.scene.particles.velocity)
        places = np.stack([batch.x, batch.y, batch.z + bottom], axis=1)
        self.places = np.concatenate([self.places, places / self.dx])
        self.velocity = np.concatenate([self.velocity, own / self.dx])
        self.r = np.concatenate([self.r, batch.r / self.dx])
        if self.scene.ballistic:
            self.waits = waits(Batch(*self.places.T, self.r, self.velocity), 1.0)
        else:
            self.waits = np.zeros(self.r.size)

    def fly(self, time: float) -> None:
        """Let all fly on for ``time`` (s)."""
        self.places += self.velocity * time
        self.waits -= time

    def land(self, height: np.ndarray) -> int:
        """Make what has arrived part of the surface ``height`` (cells, [j, i]); return how many did."""
        order = np.argsort(self.places[:, 2] - self.r, kind="stable")
        self._keep(order)
        flying = np.ones(self.r.size, dtype=np.bool_)
        landed = marks.land(height, *self.places.T.copy(), self.r, flying, SPREAD)
        self._keep(flying)
        return landed

    def _keep(self, rows: np.ndarray) -> None:
        self.places, self.velocity = self.places[rows], self.velocity[rows]
        self.r, self.waits = self.r[rows], self.waits[rows]

    def mark(self, blocks: np.ndarray, height: np.ndarray, cells: int, reach: float) -> None:
        """Mark the blocks of what is on the grid: within ``reach`` of the surface, or about to touch another sphere."""
        x, y, z = self.places.T.copy()
        seen = self.waits <= 0.0
        if self.scene.ballistic:
            seen |= marks.near_surface(height, x, y, z, self.r, reach)
        marks.mark_spheres(blocks, x, y, z, self.r, seen, GHOST, BLOCK, cells)


def moments(scene: Scene, plan: BatchPlan, samples: int = SAMPLES) -> Iterator[Moment]:
    """Yield the load at ``samples`` times of each cycle, in order."""
    nx, ny, nz = scene.domain.cells
    height = np.full((ny, nx), scene.domain.substrate_height / scene.domain.cell_size)
    fastest, air = scene.top_speed / scene.domain.cell_size, Air(scene)
    for cycle, duration in enumerate(scene.cycles.durations):
        batch = plan.batches[plan.order[cycle]]
        air.launch(batch)
        # long cycles need more looks, or particles would be seen far above and then far below the surface
        looks = int(np.ceil(max(samples, min(duration * fastest / (0.05 * nz), MOST_SAMPLES))))
        step = duration / looks
        for look in range(looks):
            air.fly(step * (0.5 if look == 0 else 1.0))
            landed = air.land(height)
            # when all have landed nothing changes any more
            left = looks - look if not (landed or air.r.size) else 1
            blocks = np.zeros((nz, ny, block_count(nx + 2 * GHOST)), dtype=np.uint8)
            marks.mark_solid(blocks, height, GHOST, BLOCK)
            solid = blocks.copy()
            air.mark(blocks, height, nx, ON_GRID if landed else CALM)
            yield Moment(cycle, left * step / scene.cycles.total_time, _pace(scene, batch, landed, step), blocks, solid)
            if left > 1:
                break
        air.fly(0.5 * step)


def _pace(scene: Scene, batch: Batch, landed: int, time: float) -> float:
    """Return the steps per time over those at rest while ``landed`` spheres land in ``time`` (s).

    A time in which only few of those land that would in a steady spray is partly one at rest.
    """
    width, depth, _ = scene.domain.extents
    diameter = 2.0 * float(batch.r.mean())
    at_once = batch.count / scene.cycles.durations[0] * diameter / scene.top_speed
    cells, number, density = (value / usual for value, usual in zip(
        (diameter / scene.domain.cell_size, at_once, at_once / (1e6 * width * depth)), USUAL))
    busy = BUSY_PACE + BY_CELLS * np.log2(cells) + BY_NUMBER * np.log10(number) + BY_DENSITY * np.log10(density)
    steady = batch.count * time / scene.cycles.durations[0]
    return 1.0 + max(busy - 1.0, 0.0) * min(2.0 * landed / max(steady, 1e-300), 1.0)


def block_shares(cells: int, starts: Sequence[int], ends: Sequence[int]) -> np.ndarray:
    """Return how many cells of each block lie in each half-open range of cells, int64 [block, range].

    Ranges may reach beyond the box by the ghosts; what lies there is the mirror image of what lies inside.
    """
    shares = np.zeros((block_count(cells + 2 * GHOST), len(starts)), dtype=np.int64)
    for number, (start, end) in enumerate(zip(starts, ends)):
        place = np.arange(start, end)
        place = np.where(place < 0, -1 - place, np.where(place >= cells, 2 * cells - 1 - place, place))
        np.add.at(shares[:, number], (np.clip(place, 0, cells - 1) + GHOST) // BLOCK, 1)
    return shares


def part_cells(blocks: np.ndarray, cells: int, ranges: Ranges, widths: tuple[int, int, int]) -> np.ndarray:
    """Return how many active cells each rank holds, int64 [z, y, x] of the process grid.

    ``cells``: cells of a row; ``widths``: ghost layers counted in along x, y and z, mirrored beyond the box.
    """
    bounds = [np.concatenate([[0], np.cumsum(counts)]) for counts in ranges]
    x, y, z = ((b[:-1] - width, b[1:] + width) for b, width in zip(bounds, widths))
    _, wy, wz = widths
    padded = np.pad(blocks, ((wz, wz), (wy, wy), (0, 0)), mode="symmetric") if wy or wz else blocks
    shares = block_shares(cells, *x)
    found = np.zeros(tuple(len(b) - 1 for b in bounds[::-1]), dtype=np.int64)
    for c, (k0, k1) in enumerate(zip(*z)):
        plane = padded[k0 + wz:k1 + wz].sum(axis=0, dtype=np.int64)
        rows = np.array([plane[j0 + wy:j1 + wy].sum(axis=0) for j0, j1 in zip(*y)])
        found[c] = rows @ shares
    return found


def column_load(scene: Scene, plan: BatchPlan) -> np.ndarray:
    """Return the mean number of active cells in each column of the box over the run, float64 [j, i]."""
    return summed_load(moments(scene, plan), scene.domain.cells[0])


def load_and_growth(scene: Scene, plan: BatchPlan) -> tuple[np.ndarray, Growth]:
    """Return :func:`column_load` and how the work of the run grows, by one look at its moments."""
    weights, work = [], []

    def noted() -> Iterator[Moment]:
        for moment in moments(scene, plan):
            weights.append(moment.weight)
            # (a step over nothing takes its time too)
            work.append(moment.weight * moment.pace * (1 + int(moment.blocks.sum(dtype=np.int64))))
            yield moment

    load = summed_load(noted(), scene.domain.cells[0])
    times, share = (sums / sums[-1] for sums in (np.cumsum([0.0, *part]) for part in (weights, work)))
    return load, Growth(tuple(scene.cycles.total_time * times), tuple(share))


def summed_load(history: Iterable[Moment], cells: int) -> np.ndarray:
    """Return :func:`column_load` from the moments of a run; ``cells``: cells of a row."""
    load = sum(moment.weight * moment.blocks.sum(axis=0, dtype=np.int64) for moment in history)
    return load[:, (np.arange(cells) + GHOST) // BLOCK]
