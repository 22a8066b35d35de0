"""What PETSc is here."""

from __future__ import annotations


def petsc_versions() -> tuple[str, str, str]:
    """Return the version of petsc4py, that of PETSc, and its scalar type (it must be ``float64``)."""
    import petsc4py

    petsc4py.init([])
    from petsc4py import PETSc

    return petsc4py.__version__, ".".join(str(part) for part in PETSc.Sys.getVersion()), PETSc.ScalarType.__name__
