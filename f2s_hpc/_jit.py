"""The one decorator of the compiled kernels.

The disk cache lives in a folder named by a hash of every kernel source: numba does not notice an
edit in a callee's file, and two configurations that share a cache can pick up each other's code.
``error_model="numpy"`` removes the zero-division test that blocks vectorisation (same bits, 2.6
times faster on a stencil); ``fastmath`` stays off, so results do not depend on vector width.
"""

from __future__ import annotations

import hashlib
import os
import pathlib
import tempfile

PACKAGE = pathlib.Path(__file__).parent


def source_hash(*folders: str) -> str:
    """Return a hash of the sources in ``folders`` of the package, and of this file."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((PACKAGE / folder).glob("*.py")):
            digest.update(path.read_bytes())
    digest.update(pathlib.Path(__file__).read_bytes())
    return digest.hexdigest()[:16]


def cache_directory() -> str:
    """Return the folder of compiled kernels: ``F2S_CACHE_DIR``, else the user's cache folder."""
    base = os.environ.get("F2S_CACHE_DIR")
    if base is None:
        home = pathlib.Path(os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache"))
        base = str(home / "f2s_hpc")
        if not os.access(home if home.exists() else home.parent, os.W_OK):
            own = f"-{os.getuid()}" if hasattr(os, "getuid") else ""  # (Windows: each user's folder is his own)
            base = os.path.join(tempfile.gettempdir(), f"f2s_hpc{own}")
    return os.path.join(base, source_hash("kernels", "materials"))


def kernels_are_compiled() -> bool:
    """Tell whether there are compiled kernels of this version at all."""
    return any(pathlib.Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi"))


os.environ.setdefault("NUMBA_CACHE_DIR", cache_directory())
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import llvmlite.binding  # noqa: E402
import numba  # noqa: E402  (the cache folder must be known first)
from numba.extending import intrinsic  # noqa: E402

# Row kernels work on a dozen arrays; by default LLVM gives up vectorising beyond eight tests that they do not overlap.
llvmlite.binding.set_option("f2s_hpc", "-runtime-memory-check-threshold=64")


def kernel(function):
    """Compile a kernel: arrays and numbers in, arrays out; cached on disk, no fast-math."""
    return numba.njit(cache=True, error_model="numpy", fastmath=False, nogil=True)(function)


POINT_OPTIONS = {"error_model": "numpy", "fastmath": False, "forceinline": True}
"""Compiler options of point functions (also of those chosen by the type of a parameter tuple)."""


def inlined(function):
    """Compile a point function of a few numbers, always pasted into its callers, so that their loops vectorise.

    Give it numbers, not arrays: in a call every array is seven arguments and a reference count.
    """
    return numba.njit(cache=True, **POINT_OPTIONS)(function)


@intrinsic
def _borrowed(context, array):
    def generate(target, builder, signature, arguments):
        make = target.make_array(array)
        copy = make(target, builder, value=arguments[0])
        copy.meminfo = target.get_constant_null(numba.types.MemInfoPointer(array.dtype))
        copy.parent = target.get_constant_null(numba.types.pyobject)
        return copy._getvalue()

    return array(array), generate


@numba.njit(**POINT_OPTIONS)
def borrowed(array):
    """Return ``array`` without its reference count, for use inside a kernel.

    A slice of a counted array costs two atomic operations, as much as ten cells of a row; slices of a borrowed one
    are free. The array itself must outlive them: arguments do; what a kernel allocates must be touched at its end.
    """
    return _borrowed(array)


if numba.config.DISABLE_JIT:  # kernels run as plain Python

    def borrowed(array):
        """Return ``array``: plain Python counts its own references."""
        return array
