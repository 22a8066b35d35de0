"""The load of a run before it is run: which cells will be active when, from the substrate, the batches and the cycles.

Spheres fly straight, each until its lowest point meets the surface below it; there it becomes deposit, spread over a
disc. In ballistic flight only those close to the surface make cells active. Nothing of the solver is run and no field
is allocated, so this takes seconds for a hundred thousand particles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.decomposition import Ranges
from f2s_hpc.kernels.activity import BLOCK
from f2s_hpc.particles.batch import Batch, BatchPlan
from f2s_hpc.workload import marks

SPREAD = 1.4
"""Width of a landed particle over its diameter: what splats of copper at 500 to 700 m/s have (see ``f2s verify``)."""

BUSY_PACE = 1.75
"""Steps per time while particles land, over those at rest: shock viscosity, speed and strain shorten them (measured:
1.6, 1.75 and 2.05 in section4 at 6 and 3 um and in wide-100k)."""

SAMPLES = 4
"""Looks per cycle."""


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


def _in_cells(batch: Batch, scene: Scene) -> list[np.ndarray]:
    """Return x, y, z, r of a batch in cells, z from the bottom of the box, in rising order of z."""
    dx = scene.domain.cell_size
    order = np.argsort(batch.z - batch.r, kind="stable")
    return [a[order] / dx for a in (batch.x, batch.y, batch.z + scene.domain.layer_bottom, batch.r)]


def moments(scene: Scene, plan: BatchPlan, samples: int = SAMPLES) -> Iterator[Moment]:
    """Yield the load at ``samples`` times of each cycle, in order."""
    nx, ny, nz = scene.domain.cells
    shape = (nz, ny, block_count(nx))
    dx = scene.domain.cell_size
    height = np.full((ny, nx), scene.domain.substrate_height / dx)
    velocity = np.array(scene.particles.velocity) / dx
    air: list[tuple[list[np.ndarray], np.ndarray]] = []
    for cycle, duration in enumerate(scene.cycles.durations):
        spheres = _in_cells(plan.batches[plan.order[cycle]], scene)
        air.append((spheres, np.ones(spheres[3].size, dtype=np.bool_)))
        # long cycles need more looks, or particles would be seen far above and then far below the surface
        looks = max(samples, int(np.ceil(duration * abs(velocity[2]) / (0.05 * nz))))
        for look in range(looks):
            step = duration / looks * (0.5 if look == 0 else 1.0)
            aloft = sum(int(flying.sum()) for _, flying in air)
            for (x, y, z, r), flying in air:
                for place, speed in zip((x, y, z), velocity):
                    place += speed * step
                marks.land(height, x, y, z, r, flying, SPREAD)
            landing = sum(int(flying.sum()) for _, flying in air) < aloft
            air = [(s, flying) for s, flying in air if flying.any()]
            blocks = np.zeros(shape, dtype=np.uint8)
            marks.mark_solid(blocks, height, GHOST, BLOCK)
            solid = blocks.copy()
            for (x, y, z, r), flying in air:
                seen = flying & _close_to(height, x, y, z, r) if scene.ballistic else flying
                marks.mark_spheres(blocks, x, y, z, r, seen, GHOST, BLOCK, nx)
            share, pace = duration / looks / scene.cycles.total_time, BUSY_PACE if landing else 1.0
            yield Moment(cycle, share, pace, blocks, solid)
        for (x, y, z, _), _ in air:
            for place, speed in zip((x, y, z), velocity):
                place += speed * 0.5 * duration / looks


def _close_to(height: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Tell which spheres are so low that they are on the grid in ballistic flight: called down by what has landed.

    Within one diameter of the surface below, the mean one by volume.
    """
    ny, nx = height.shape
    below = height[np.clip(y.astype(np.int64), 0, ny - 1), np.clip(x.astype(np.int64), 0, nx - 1)]
    return z - r < below + 2.0 * (r**4).sum() / max((r**3).sum(), 1e-300)


def block_count(cells: int) -> int:
    """Return how many blocks cut a row of ``cells`` cells with its ghosts."""
    return -(-(cells + 2 * GHOST) // BLOCK)


def block_shares(cells: int, starts: Sequence[int], ends: Sequence[int]) -> np.ndarray:
    """Return how many cells of each block lie in each half-open range of cells, int64 [block, range].

    Ranges may reach beyond the box by the ghosts; what lies there is the mirror image of what lies inside.
    """
    shares = np.zeros((block_count(cells), len(starts)), dtype=np.int64)
    for number, (start, end) in enumerate(zip(starts, ends)):
        place = np.arange(start, end)
        place = np.where(place < 0, -1 - place, np.where(place >= cells, 2 * cells - 1 - place, place))
        np.add.at(shares[:, number], (np.clip(place, 0, cells - 1) + GHOST) // BLOCK, 1)
    return shares


def part_cells(blocks: np.ndarray, cells: int, ranges: Ranges, width: int) -> np.ndarray:
    """Return how many active cells each rank holds, int64 [z, y, x] of the process grid.

    ``cells``: cells of a row; ``width``: ghost layers counted in (0: owned cells only), mirrored beyond the box.
    """
    bounds = [np.concatenate([[0], np.cumsum(counts)]) for counts in ranges]
    x, y, z = ((b[:-1] - width, b[1:] + width) for b in bounds)
    padded = np.pad(blocks, ((width, width), (width, width), (0, 0)), mode="symmetric") if width else blocks
    shares = block_shares(cells, *x)
    found = np.zeros(tuple(len(b) - 1 for b in bounds[::-1]), dtype=np.int64)
    for c, (k0, k1) in enumerate(zip(*z)):
        plane = padded[k0 + width:k1 + width].sum(axis=0, dtype=np.int64)
        rows = np.array([plane[j0 + width:j1 + width].sum(axis=0) for j0, j1 in zip(*y)])
        found[c] = rows @ shares
    return found


def column_load(scene: Scene, plan: BatchPlan) -> np.ndarray:
    """Return the mean number of active cells in each column of the box over the run, float64 [j, i]."""
    return summed_load(moments(scene, plan), scene.domain.cells[0])


def summed_load(history: Iterable[Moment], cells: int) -> np.ndarray:
    """Return :func:`column_load` from the moments of a run; ``cells``: cells of a row."""
    load = sum(moment.weight * moment.blocks.sum(axis=0, dtype=np.int64) for moment in history)
    return load[:, (np.arange(cells) + GHOST) // BLOCK]
