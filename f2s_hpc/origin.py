"""Where results come from: version and commit of this code, versions of the libraries it stands on."""

from __future__ import annotations

import functools
import importlib.metadata
import pathlib
import platform

import f2s_hpc

LIBRARIES = ("numpy", "numba", "h5py", "mpi4py", "petsc4py")


@functools.cache
def commit() -> str | None:
    """Return the commit that is checked out where the package lies, None where that is no repository.

    Read from git's files: a program started by a rank of a large job is not to be trusted.
    """
    root = pathlib.Path(f2s_hpc.__file__).resolve().parents[1] / ".git"
    try:
        head = (root / "HEAD").read_text(encoding="ascii").strip()
        name = head.removeprefix("ref: ")
        if name == head:
            return head
        if (root / name).is_file():
            return (root / name).read_text(encoding="ascii").strip()
        packed = (root / "packed-refs").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)


def version_text() -> str:
    """Return version and, where it is known, commit."""
    return f2s_hpc.__version__ + (f" (commit {commit()[:12]})" if commit() else "")


@functools.cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


def versions() -> dict:
    """Return what a file should say of the code that wrote it, besides its version: commit and libraries."""
    return {"commit": commit(), "libraries": _libraries()}
