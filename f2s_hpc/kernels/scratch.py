"""What the kernels of the Lagrangian step share: the width of their scratch rows, and the largest of a row."""

from __future__ import annotations

import numpy as np

from f2s_hpc._jit import inlined

W = 64
"""Cells of a row are worked on in chunks of this many; all scratch rows of a chunk lie in one array at fixed
distances, so the compiler sees that they do not overlap and vectorises, and they stay in the first cache."""


@inlined
def rank(x):
    """Return an integer that orders numbers >= 0 as they are (NaN last): the largest of many is found in vectors."""
    return np.float64(abs(x)).view(np.int64)


@inlined
def of_rank(number):
    """Return the number of a rank."""
    return np.int64(number).view(np.float64)


@inlined
def place_of_largest(row, above):
    """Return the place of the first largest number (>= 0, or NaN) of a row if it exceeds ``above``, else -1."""
    most, largest = rank(above), rank(above)
    for i in range(row.size):
        largest = max(largest, rank(row[i]))
    if largest == most:
        return -1
    for i in range(row.size):
        if rank(row[i]) == largest:
            return i
    return -1
