"""Numbers from distributed fields, the same on every rank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.solver.step import Clock
from f2s_hpc.state import State
from f2s_hpc.verify.case import Stopwatch


def sums(values: Sequence[float]) -> np.ndarray:
    """Return the sums over all ranks of this rank's ``values``, added in the order of the ranks."""
    return np.sum(np.array(mpi.all_gather([float(v) for v in values])), axis=0)


def largest(values: Sequence[float] | float) -> np.ndarray:
    """Return the largest of this rank's ``values``, element by element, over all ranks; NaN wherever one has it.

    (A maximum of MPI, like Python's ``max``, may drop what is no number.)
    """
    return np.max(np.array(mpi.all_gather(values), dtype=float), axis=0)


def gathered(rows: np.ndarray) -> np.ndarray:
    """Return the ``rows`` (n, ...) of all ranks, one below the other in the order of the ranks."""
    return np.concatenate(mpi.all_gather(rows))


def along_x(state: State, values: np.ndarray) -> np.ndarray:
    """Return on every rank the row of a field along x in the middle of the box (y and z).

    ``values``: owned cells or nodes of this rank [k, j, i].
    """
    part = state.part
    middle = [n // 2 for n in part.box.cells]
    j, k = middle[1] - part.start[1], middle[2] - part.start[2]
    inside = 0 <= j < part.count[1] and 0 <= k < part.count[2]
    mine = (part.start[0], values[k, j, :].tolist()) if inside else None
    pieces = sorted(piece for piece in mpi.all_gather(mine) if piece is not None)
    return np.array([value for _, piece in pieces for value in piece])


def cell_steps(clock: Clock) -> int:
    """Return the active cells of all steps and all ranks."""
    return int(mpi.total(np.int64(clock.active_cell_steps)))


def cost(clock: Clock, watch: Stopwatch) -> dict:
    """Return steps, active cell-steps of all ranks and wall time (s) so far, named as in ``Measured``. Collective."""
    return {"steps": clock.steps, "cell_steps": cell_steps(clock), "wall_s": watch.read()}
