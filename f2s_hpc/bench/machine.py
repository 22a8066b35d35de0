"""What the machine can do, measured by kernels of the same compiler: memory bandwidth and fused multiply-adds."""

from __future__ import annotations

import time

import numba
import numpy as np

TRIAD_BYTES = 32
"""Per element of a = b + s c: two loads, a store, and the load of the line that is stored to."""

_CHAIN = 16


@numba.njit(cache=True, error_model="numpy")
def _triad(a, b, c, scale):
    for i in range(a.size):
        a[i] = b[i] + scale * c[i]


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _multiply_add(x, factor, summand, rounds):
    """Run ``rounds`` chains of 16 fused multiply-adds on each element of ``x``, which stays in the first cache.

    Short chains: the processor must find enough of them at once to hide that each step waits for the one before.
    """
    for _ in range(rounds):
        for i in range(x.size):
            y = x[i]
            for _ in range(_CHAIN):
                y = y * factor + summand
            x[i] = y


def triad_bandwidth(array_bytes: int = 96 * 2**20, repeats: int = 5) -> float:
    """Return the bandwidth (bytes/s, 32 bytes per element) of the STREAM triad on three arrays of ``array_bytes``.

    Source: McCalpin, STREAM; the best of ``repeats``, by the CPU time of this thread.
    """
    a, b, c = (np.full(array_bytes // 8, value) for value in (0.0, 1.0, 2.0))
    _triad(a[:8], b[:8], c[:8], 3.0)
    best = np.inf
    for _ in range(repeats):
        start = time.thread_time()
        _triad(a, b, c, 3.0)
        best = min(best, time.thread_time() - start)
    return TRIAD_BYTES * a.size / best


def multiply_add_peak(repeats: int = 5) -> float:
    """Return the best rate (operations/s, two per fused multiply-add) that this compiler reaches on one core."""
    x = np.linspace(0.5, 1.0, 256)
    _multiply_add(x, 0.999, 1e-3, 1)
    rounds, best = 8000, np.inf
    for _ in range(repeats):
        start = time.thread_time()
        _multiply_add(x, 0.999, 1e-3, rounds)
        best = min(best, time.thread_time() - start)
    return 2.0 * _CHAIN * x.size * rounds / best
