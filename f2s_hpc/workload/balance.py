"""Ownership ranges by the expected load: ranks that get more of the deposit get fewer columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import Box
from f2s_hpc.grid.decomposition import Ranges, ownership_ranges, process_grid
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.workload.expected import Growth, column_load, load_and_growth

WORTH_IT = 0.03
"""Uneven ranges must lower the predicted imbalance by more than this; below it lies the chance of where particles fall,
and a uniform spray keeps even ranges."""


@dataclass(frozen=True)
class Balance:
    """The ownership ranges of a run on some ranks, and the imbalance (largest over mean load) to expect.

    ``even``: the imbalance of even ranges; ``weighted``: were uneven ranges worth it?
    """

    ranges: Ranges
    imbalance: float
    even: float
    weighted: bool


def _bounds(counts: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


def imbalance_of(load: np.ndarray, ranges: Ranges) -> float:
    """Return the largest load of a rank over the mean, for a column load [j, i]; ranks along z share evenly."""
    x, y = _bounds(ranges[0])[:-1], _bounds(ranges[1])[:-1]
    parts = np.add.reduceat(np.add.reduceat(load, y, axis=0), x, axis=1)
    return float(parts.max() / parts.mean()) if parts.any() else 1.0


def balanced(scene: Scene, plan: BatchPlan, ranks: int, load: np.ndarray | None = None) -> Balance:
    """Return the ranges that a run of ``scene`` takes on ``ranks`` ranks. Raises ``InputError`` if the box is small.

    ``load``: the column load where it is known already.
    """
    box = Box(scene.domain.cells, scene.domain.cell_size)
    grid = process_grid(box, ranks)
    even = ownership_ranges(box, grid)
    if ranks == 1:
        return Balance(even, 1.0, 1.0, False)
    load = column_load(scene, plan) if load is None else load
    before = imbalance_of(load, even)
    weighted = ownership_ranges(box, grid, (load.sum(axis=0), load.sum(axis=1)))
    after = imbalance_of(load, weighted)
    if before - after > WORTH_IT:
        return Balance(weighted, after, before, True)
    return Balance(even, before, before, False)


def balance_of_run(scene: Scene, plan: BatchPlan) -> Balance:
    """Return the balance of a run on as many ranks as there are; computed once, the same on all. Collective."""
    return mpi.run_together(balanced, scene, plan, mpi.size())


def balance_and_growth(scene: Scene, plan: BatchPlan) -> tuple[Balance, Growth]:
    """Return the balance of a run and how its work will grow, by one forecast, which takes seconds. Collective."""
    def forecast() -> tuple[Balance, Growth]:
        load, growth = load_and_growth(scene, plan)
        return balanced(scene, plan, mpi.size(), load), growth

    return mpi.run_together(forecast)
