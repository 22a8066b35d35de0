"""Memory that is real only where it was written, and that can be given back."""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Sequence

import numpy as np

_PRIVATE = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}


_SWAPPED, _EXCLUSIVE = np.uint64(1 << 62), np.uint64(1 << 56)
"""Bits of an entry of /proc/self/pagemap: a page that is swapped out, and one that only this process has."""


def anonymous_pages(count: int) -> mmap.mmap:
    """Return memory of ``count`` float64 numbers, all zero, straight from the operating system."""
    return mmap.mmap(-1, 8 * max(count, 1), **_PRIVATE)


def sparse_zeros(shape: Sequence[int]) -> np.ndarray:
    """Return zeros [...] (float64) that take memory only where they are written, and give it back when dropped.

    ``np.zeros`` does so too, unless the C library has kept memory to lay them in, which it then fills with zeros.
    """
    count = int(np.prod(shape))
    return np.frombuffer(anonymous_pages(count), dtype=float, count=count).reshape(shape)


def give_back(pages: mmap.mmap, start: int, end: int) -> None:
    """Give the whole pages among bytes ``start``..``end`` back: they are zero, and no memory until they are written.

    Where the operating system cannot do that, nothing happens.
    """
    first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    length = end // mmap.PAGESIZE * mmap.PAGESIZE - first
    if length > 0 and hasattr(mmap, "MADV_DONTNEED"):
        pages.madvise(mmap.MADV_DONTNEED, first, length)


def real_bytes(array: np.ndarray) -> int:
    """Return how many bytes of the pages of ``array`` (C order) this process really has, swapped out or not.

    Pages that were only read are not. Linux (``/proc/self/pagemap``); elsewhere all that the array spans.
    """
    first = array.ctypes.data // mmap.PAGESIZE
    count = -(-(array.ctypes.data + array.nbytes) // mmap.PAGESIZE) - first
    try:
        with open("/proc/self/pagemap", "rb", buffering=0) as file:
            entries = np.frombuffer(os.pread(file.fileno(), 8 * count, 8 * first), dtype=np.uint64)
    except OSError:
        return array.nbytes
    own = (entries & (_SWAPPED | _EXCLUSIVE)) != 0
    return int(own.sum()) * mmap.PAGESIZE if entries.size == count else array.nbytes


def trim_heap() -> None:
    """Return freed memory to the operating system, where the C library can (glibc).

    MPI libraries make the C library keep what is freed. Arrays made for a moment would stay beside the fields of the
    next step, and fields would be laid into them, so that the pages of an empty box were real ones.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
