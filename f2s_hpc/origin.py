"""Where results come from: version, commit and sources of this code, versions of the libraries it stands on."""

from __future__ import annotations

import functools
import importlib.metadata
import pathlib
import platform
import sys

import f2s_hpc
from f2s_hpc._cache import package_hash

LIBRARIES = ("numpy", "numba", "h5py", "mpi4py", "petsc4py")


def _repository(root: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Return where git keeps the head of the tree at ``root``, and where its branches: not the same in a worktree."""
    own = root / ".git"
    if own.is_file():
        own = root / own.read_text(encoding="utf-8").strip().removeprefix("gitdir: ")
    common = own / "commondir"
    return own, own / common.read_text(encoding="utf-8").strip() if common.is_file() else own


def commit_of(root: pathlib.Path) -> str | None:
    """Return the commit that is checked out in the folder ``root``, None where that is no repository.

    Read from git's files: a program started by a rank of a large job is not to be trusted.
    """
    try:
        own, common = _repository(root)
        head = (own / "HEAD").read_text(encoding="ascii").strip()
        name = head.removeprefix("ref: ")
        if name == head:
            return head
        if (common / name).is_file():
            return (common / name).read_text(encoding="ascii").strip()
        packed = (common / "packed-refs").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)


@functools.cache
def commit() -> str | None:
    """Return the commit that is checked out where the package lies, None where that is no repository."""
    return commit_of(pathlib.Path(f2s_hpc.__file__).resolve().parents[1])


@functools.cache
def sources() -> str:
    """Return a hash of the package as it lies here: it tells edits that no commit holds."""
    return package_hash()


def version_text() -> str:
    """Return version, commit where it is known, and the hash of the sources."""
    known = f"commit {commit()[:12]}, " if commit() else ""
    return f"{f2s_hpc.__version__} ({known}sources {sources()})"


@functools.cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # (as the MPI build of h5py on Debian, which tells nobody)
            found[name] = getattr(sys.modules.get(name), "__version__", "unknown")
    return found


def versions() -> dict:
    """Return what a file should say of the code that wrote it, besides its version.

    That is commit, hash of the sources, and libraries. Reads all of the package once: call on rank 0 alone.
    """
    return {"commit": commit(), "sources": sources(), "libraries": _libraries()}
