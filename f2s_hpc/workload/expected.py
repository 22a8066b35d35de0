"""The load of a run before it is run: which cells will be active when, from the substrate, the batches and the cycles.

Spheres fly straight, each until its lowest point meets the surface below it; there it becomes deposit, spread over a
disc. Nothing of the solver is run and no field is allocated, so this takes seconds for a hundred thousand particles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import GHOST
from f2s_hpc.kernels.activity import BLOCK
from f2s_hpc.particles.batch import Batch, BatchPlan
from f2s_hpc.workload import marks

SPREAD = 1.4
"""Width of a landed particle over its diameter: what splats of copper at 500 to 700 m/s have (see ``f2s verify``)."""

SAMPLES = 4
"""Looks per cycle."""


@dataclass(frozen=True)
class Moment:
    """The load at one time: ``weight`` is the share of the run it stands for, ``cycle`` counts from 0.

    ``blocks``: uint8 [k, j, block], active blocks of the whole box; ``flying_cells``: volume in flight (cells).
    """

    cycle: int
    weight: float
    blocks: np.ndarray
    flying_cells: float


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
            for (x, y, z, r), flying in air:
                for place, speed in zip((x, y, z), velocity):
                    place += speed * step
                marks.land(height, x, y, z, r, flying, SPREAD)
            air = [(s, flying) for s, flying in air if flying.any()]
            blocks = np.zeros(shape, dtype=np.uint8)
            marks.mark_solid(blocks, height, GHOST, BLOCK)
            volume = 0.0
            for (x, y, z, r), flying in air:
                marks.mark_spheres(blocks, x, y, z, r, flying, GHOST, BLOCK, nx)
                volume += 4.0 / 3.0 * np.pi * float((r[flying] ** 3).sum())
            yield Moment(cycle, duration / looks / scene.cycles.total_time, blocks, volume)
        for (x, y, z, _), _ in air:
            for place, speed in zip((x, y, z), velocity):
                place += speed * 0.5 * duration / looks


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


def column_load(scene: Scene, plan: BatchPlan) -> np.ndarray:
    """Return the mean number of active cells in each column of the box over the run, float64 [j, i]."""
    nx, ny, _ = scene.domain.cells
    load = np.zeros((ny, block_count(nx)))
    for moment in moments(scene, plan):
        load += moment.weight * moment.blocks.sum(axis=0, dtype=np.int64)
    return load[:, (np.arange(nx) + GHOST) // BLOCK]
