"""What computing needs and measuring does not: MPI and PETSc. Told in one line before anything else is done."""

from __future__ import annotations

from f2s_hpc import mpi
from f2s_hpc.errors import InputError
from f2s_hpc.grid import petsc


def solver(command: str) -> None:
    """Raise ``InputError`` on all ranks where ``f2s COMMAND`` could not distribute a box. Collective."""
    failure = next(filter(None, mpi.all_gather(_failure())), "")
    if failure:
        raise InputError(f"f2s {command}: {failure}; run scripts/setup (Debian), or see 'Other ways to install' in "
                         "README.md; f2s analyse, report, compare, inspect and export work without")


def _failure() -> str:
    lacking = petsc.lacking()
    if lacking:
        return lacking
    try:
        petsc.load()
    except (ImportError, OSError, RuntimeError) as error:
        return f"petsc4py does not load ({' '.join(str(error).split()) or type(error).__name__})"
    return ""
