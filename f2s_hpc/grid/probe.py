"""What PETSc is here."""

from __future__ import annotations

from f2s_hpc.grid import petsc


def petsc_versions() -> tuple[str, str, str]:
    """Return the version of petsc4py, that of PETSc, and its scalar type (it must be ``float64``)."""
    PETSc = petsc.load()
    import petsc4py

    return petsc4py.__version__, ".".join(str(part) for part in PETSc.Sys.getVersion()), PETSc.ScalarType.__name__
