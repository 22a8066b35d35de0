"""petsc4py, loaded by what distributes a box and by nothing else: the files of a run are read without it."""

from __future__ import annotations

import functools
import importlib.util
from types import ModuleType


@functools.cache
def load() -> ModuleType:
    """Return ``petsc4py.PETSc``. Raises what the import does where it is missing or does not load."""
    import petsc4py

    # its own handlers would turn a closed pipe or the signal that asks for a checkpoint into an abort
    petsc4py.init(["-no_signal_handler"])
    from petsc4py import PETSc  # (PETSc reads its options at import)

    return PETSc


def lacking() -> str:
    """Return in words which packages, that a box is distributed with, are not installed; empty where all are."""
    from f2s_hpc import mpi  # (the doctor tries PETSc also where MPI does not load)

    names = [name for name, there in (("mpi4py", mpi.INSTALLED), ("petsc4py", importlib.util.find_spec("petsc4py")))
             if not there]
    return " and ".join(names) + (" are" if len(names) > 1 else " is") + " not installed" if names else ""
