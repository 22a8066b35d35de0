"""The one decorator of the compiled kernels.

The disk cache lives in a folder named by a hash of every kernel source (``f2s_hpc/_cache.py``).
``error_model="numpy"`` removes the zero-division test that blocks vectorisation (same bits, 2.6
times faster on a stencil); ``fastmath`` stays off, so results do not depend on vector width.
"""

from __future__ import annotations

import os
import pathlib

from f2s_hpc import _cache

CACHE = _cache.use()
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import llvmlite.binding  # noqa: E402
import numba  # noqa: E402  (the cache folder must be known first)
from numba.extending import intrinsic  # noqa: E402

numba.config.CACHE_DIR = CACHE  # (it may have been imported before)

# Row kernels work on a dozen arrays; by default LLVM gives up vectorising beyond eight tests that they do not overlap.
llvmlite.binding.set_option("f2s_hpc", "-runtime-memory-check-threshold=64")


def is_compiled(function) -> bool:
    """Tell whether a kernel has been compiled before, from this copy of the package, or need not be at all."""
    place = getattr(getattr(function, "_cache", None), "cache_path", None)
    return place is None or any(pathlib.Path(place).glob(f"*.{function.__name__}-*.nbi"))


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
