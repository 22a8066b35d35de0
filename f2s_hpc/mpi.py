"""The one module that talks to MPI: the communicator, exact reductions, and the abort hook.

Every reduction that can reach the state of a run is exact (minimum, maximum, integer sum), so the
number of ranks cannot change a bit of the result.
"""

from __future__ import annotations

import functools
import os
import sys
import time
import traceback
from types import TracebackType
from typing import TypeVar

import numpy as np

from f2s_hpc import one_rank, places
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.phases import phase

try:
    from mpi4py import MPI
except ModuleNotFoundError as error:
    if error.name != "mpi4py":  # (it is there, and broken)
        raise
    if one_rank.launched_size() > 1:
        raise InputError(f"mpi4py is not installed, so the {one_rank.launched_size()} processes that a launcher has "
                         "started cannot work together; install it ('f2s doctor' tells how), or start f2s without "
                         "the launcher") from None
    from f2s_hpc.one_rank import MPI

INSTALLED = MPI is not one_rank.MPI
"""Whether mpi4py is there; without it this is one rank, which can measure what a run left, but not run."""

ROOT = 0
PATIENCE_S = 600.0
"""Seconds for which a rank that failed waits for the others."""

DOUBLE = MPI.DOUBLE
REPLACE = MPI.REPLACE
Value = TypeVar("Value")


def world() -> MPI.Intracomm:
    """Return the communicator of the run (all ranks)."""
    return MPI.COMM_WORLD


def rank() -> int:
    """Return this process's rank."""
    return MPI.COMM_WORLD.Get_rank()


def size() -> int:
    """Return the number of ranks."""
    return MPI.COMM_WORLD.Get_size()


def is_root() -> bool:
    """Tell whether this is rank 0, the one that reads, prints and coordinates."""
    return rank() == ROOT


def say(text: str) -> None:
    """Print ``text`` at once, on rank 0 only."""
    if is_root():
        print(text, flush=True)


def barrier() -> None:
    """Wait for all ranks."""
    MPI.COMM_WORLD.Barrier()


@functools.cache
def _meeting() -> MPI.Intracomm:
    """Return a communicator that no other call of those who hang can be on. Collective."""
    return MPI.COMM_WORLD.Dup()


def meet(failure: str | None, exit_code: int) -> None:
    """Wait for all ranks; one with a ``failure`` waits ``PATIENCE_S`` at most, then prints it and ends the job.

    The others then hang in a collective call that it has left, until somebody pays for the wall time of the whole job.
    """
    if size() == 1:
        return
    request, began = _meeting().Ibarrier(), time.monotonic()
    if failure is None:
        request.Wait()
    while not request.Test():
        if time.monotonic() - began > PATIENCE_S:
            sys.stdout.flush()
            sys.stderr.write(f"f2s: [rank {rank()}] {failure}; the other ranks do not come: job aborted\n")
            sys.stderr.flush()
            MPI.COMM_WORLD.Abort(exit_code)
        time.sleep(0.01)


def broadcast(value: Value) -> Value:
    """Return rank 0's ``value`` on every rank (any picklable object)."""
    return MPI.COMM_WORLD.bcast(value, root=ROOT)


def all_gather(value: Value) -> list[Value]:
    """Return the list of every rank's ``value`` on every rank, in rank order."""
    return MPI.COMM_WORLD.allgather(value)


def _reduced(value, operation: MPI.Op):
    local = np.asarray(value, order="C")
    if size() == 1:
        return local.copy() if local.ndim else local[()]
    return _all_reduced(local, operation)


@phase("reductions")
def _all_reduced(local: np.ndarray, operation: MPI.Op):
    total = np.empty_like(local)
    MPI.COMM_WORLD.Allreduce(local, total, op=operation)
    return total if total.ndim else total[()]


def minimum(value):
    """Return the element-wise minimum over the ranks (scalar or array; exact)."""
    return _reduced(value, MPI.MIN)


def maximum(value):
    """Return the element-wise maximum over the ranks (scalar or array; exact)."""
    return _reduced(value, MPI.MAX)


def total(value):
    """Return the element-wise sum over the ranks. Exact, hence rank-independent, for integers only."""
    return _reduced(value, MPI.SUM)


def gather(value: Value) -> list[Value] | None:
    """Return the list of every rank's ``value`` on rank 0, in rank order; None on the others."""
    return MPI.COMM_WORLD.gather(value, root=ROOT)


def scatter(values: list[Value] | None) -> Value:
    """Return to each rank its own of rank 0's ``values``, in rank order; the others' are not looked at."""
    return MPI.COMM_WORLD.scatter(values, root=ROOT)


def exchange_rows(rows: list[np.ndarray]) -> np.ndarray:
    """Send ``rows[r]``, float64 (n, columns), to each rank r; return what came from all ranks, in rank order.

    All have the same number of columns. Collective.
    """
    if size() == 1:
        return rows[0]
    columns = rows[0].shape[1]
    sent = np.array([part.size for part in rows], dtype=np.int32)
    received = np.empty_like(sent)
    MPI.COMM_WORLD.Alltoall(sent, received)
    found = np.empty((int(received.sum(dtype=np.int64)) // columns, columns))
    MPI.COMM_WORLD.Alltoallv([np.ascontiguousarray(np.concatenate(rows), dtype=np.float64), sent, DOUBLE],
                             [found, received, DOUBLE])
    return found


def any_rank(flag: bool) -> bool:
    """Tell every rank whether ``flag`` is true on at least one."""
    return bool(maximum(np.int64(flag)))


def run_together(task, *arguments):
    """Call ``task`` on rank 0 only; return its value, or raise its error, on every rank.

    Used where rank 0 reads input: a bad file then ends all ranks the same way.
    """
    outcome, failure = None, None
    if is_root():
        try:
            outcome = task(*arguments)
        except F2SError as error:
            failure = error
        except (OSError, MemoryError) as error:
            failure = places.refused(error)
    outcome, failure = broadcast((outcome, failure))
    if failure is not None:
        raise failure
    return outcome


def install_abort_hook() -> None:
    """Make an uncaught exception on any rank end the whole job instead of hanging the others.

    ``python -m mpi4py`` does not do this once petsc4py is imported, hence a hook of our own. What the system refuses (a
    place, memory) is one line and the exit code of wrong input, as on one rank. Collective.
    """
    if size() == 1:
        return
    _meeting()  # (while nobody hangs)

    def abort(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        sys.stdout.flush()
        line = places.refused(error) if isinstance(error, (OSError, MemoryError)) else None
        text = "".join(traceback.format_exception(kind, error, trace)) if line is None else f"{line}\n"
        sys.stderr.write(f"[rank {rank()}] {text}")
        sys.stderr.flush()
        MPI.COMM_WORLD.Abort(1 if line is None else line.exit_code)

    sys.excepthook = abort


def library_version() -> str:
    """Return the name and version of the MPI library, one line."""
    return MPI.Get_library_version().split(",")[0].strip("\x00 \n")


def launched_by_mpirun() -> bool:
    """Tell whether a launcher (Open MPI, MPICH, SLURM) started this process."""
    return any(name in os.environ for name in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_PROCID", "PMIX_RANK"))
