"""One rank without an MPI library: what ``f2s_hpc.mpi`` stands on where mpi4py is not installed.

So runs are measured, compared and inspected, and scenes checked, on any laptop; computing needs mpi4py. Where a
launcher has started several processes nothing may stand in: each would do the whole work, and write the same files.
"""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import TypeVar

Value = TypeVar("Value")

# Open MPI; MPICH, Intel MPI and Microsoft MPI; MVAPICH; SLURM, whose SLURM_NTASKS a batch script knows too
_LAUNCHERS = (("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"), ("PMI_SIZE", "PMI_RANK"),
              ("MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_RANK"), ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID"))


def _told(name: str) -> int:
    text = os.environ.get(name, "")
    return int(text) if text.isdecimal() else 0


def launched_size() -> int:
    """Return how many processes a launcher says it started together with this one; 1 where none says so."""
    return max(1, *(_told(size) for size, _ in _LAUNCHERS))


def launched_rank() -> int:
    """Return the rank that the launcher gave to this process; 0 where none did."""
    return next((_told(rank) for size, rank in _LAUNCHERS if _told(size) > 1), 0)


class OneRank:
    """The calls of an mpi4py communicator that f2s_hpc makes on one rank, for this process alone."""

    def Get_rank(self) -> int:
        """Return the only rank."""
        return 0

    def Get_size(self) -> int:
        """Return the number of ranks."""
        return 1

    def Barrier(self) -> None:
        """Wait for nobody."""

    def bcast(self, value: Value, root: int = 0) -> Value:
        """Return ``value``."""
        return value

    def allgather(self, value: Value) -> list[Value]:
        """Return the list of this rank's ``value``."""
        return [value]

    def gather(self, value: Value, root: int = 0) -> list[Value]:
        """Return the list of this rank's ``value``."""
        return [value]

    def scatter(self, values: list[Value], root: int = 0) -> Value:
        """Return the only one of ``values``."""
        return values[0]


MPI = SimpleNamespace(COMM_WORLD=OneRank(), MIN=None, MAX=None, SUM=None, DOUBLE=None, REPLACE=None)
"""In the place of ``mpi4py.MPI``. On one rank no operation and no data type is looked at."""
