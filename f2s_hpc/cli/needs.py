"""What computing needs and measuring does not: MPI and PETSc. Told in one line before anything else is done."""

from __future__ import annotations

from f2s_hpc import mpi, one_rank
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


def ranks_together(command: str) -> None:
    """Raise ``InputError`` where a launcher started several processes, but MPI tells each that it is alone.

    Its ``mpirun`` is another MPI's than mpi4py's, or ``srun`` speaks another protocol: each would do the whole work,
    and all but one find a folder that is in use.
    """
    launched = one_rank.launched_size()
    if launched > 1 and mpi.size() == 1:
        raise InputError(f"f2s {command}: {launched} processes were started together, but MPI tells each that it is "
                         "alone: take the mpirun of the MPI that mpi4py was built with ('f2s doctor' names it), "
                         "under SLURM also srun --mpi=pmix")
