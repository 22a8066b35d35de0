"""Which blocks of cells will be active: the rule of :mod:`f2s_hpc.kernels.activity`, without any field allocated.

``blocks``: uint8 [k, j, block] of the whole box, rows cut into blocks of ``block`` cells as one rank cuts them.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import kernel


@kernel
def mark_row(blocks, k, j, first, last, ghosts, block, cells):
    """Mark what material in cells ``first`` to ``last`` of the row (k, j) makes active: one cell below, two above."""
    nz, ny, _ = blocks.shape
    b0 = (max(first - 1, 0) + ghosts) // block
    b1 = (min(last + 2, cells - 1) + ghosts) // block
    for kk in range(max(k - 1, 0), min(k + 3, nz)):
        for jj in range(max(j - 1, 0), min(j + 3, ny)):
            for b in range(b0, b1 + 1):
                blocks[kk, jj, b] = 1


@kernel
def mark_spheres(blocks, x, y, z, r, flying, ghosts, block, cells):
    """Mark the blocks of the flying spheres (cell units, z from the bottom of the box)."""
    nz, ny, _ = blocks.shape
    for s in range(x.size):
        if not flying[s]:
            continue
        for k in range(max(0, int(math.floor(z[s] - r[s]))), min(nz, int(math.floor(z[s] + r[s])) + 1)):
            dz = max(k - z[s], z[s] - k - 1.0, 0.0)
            for j in range(max(0, int(math.floor(y[s] - r[s]))), min(ny, int(math.floor(y[s] + r[s])) + 1)):
                dy = max(j - y[s], y[s] - j - 1.0, 0.0)
                left = r[s] * r[s] - dy * dy - dz * dz
                if left <= 0.0:
                    continue
                half = math.sqrt(left)
                first, last = max(int(math.floor(x[s] - half)), 0), min(int(math.floor(x[s] + half)), cells - 1)
                if last >= first:
                    mark_row(blocks, k, j, first, last, ghosts, block, cells)


@kernel
def mark_solid(blocks, height, ghosts, block):
    """Mark the blocks below the surface ``height`` (cells, [j, i])."""
    nz, ny, _ = blocks.shape
    cells = height.shape[1]
    for j in range(ny):
        for i in range(cells):
            top = min(int(math.ceil(height[j, i])), nz)
            for jj in range(max(j - 1, 0), min(j + 3, ny)):
                for b in range((max(i - 1, 0) + ghosts) // block, (min(i + 2, cells - 1) + ghosts) // block + 1):
                    for k in range(min(top + 2, nz) - 1, -1, -1):
                        # what is marked here has marked everything below it
                        if top > 0 and blocks[k, jj, b] == 0:
                            blocks[k, jj, b] = 1
                        else:
                            break


@kernel
def _disc(x, y, wide, nx, ny):
    """Return the columns (j, i) whose centres lie within ``wide`` of (x, y): int64 [n, 2], rows in order."""
    a0, a1 = max(int(math.floor(x - wide)), 0), min(int(math.floor(x + wide)) + 1, nx)
    b0, b1 = max(int(math.floor(y - wide)), 0), min(int(math.floor(y + wide)) + 1, ny)
    columns = np.empty((max(b1 - b0, 0) * max(a1 - a0, 0), 2), dtype=np.int64)
    count = 0
    for b in range(b0, b1):
        for a in range(a0, a1):
            if (a + 0.5 - x) ** 2 + (b + 0.5 - y) ** 2 <= wide * wide:
                columns[count, 0], columns[count, 1] = b, a
                count += 1
    return columns[:count]


@kernel
def land(height, x, y, z, r, flying, spread):
    """Let the spheres whose centre is at or below the surface become part of it; return how many did.

    A landed sphere fills the disc below it, ``spread`` times as wide as itself, up to one level: particles leave few
    hollows. What lies beyond the box is the mirror image of what lies inside, as the sides are. Spheres must come in
    rising order of z. ``height``: the surface (cells, [j, i]).
    """
    ny, nx = height.shape
    landed = 0
    for s in range(x.size):
        if not flying[s]:
            continue
        i, j = min(max(int(x[s]), 0), nx - 1), min(max(int(y[s]), 0), ny - 1)
        if z[s] > height[j, i]:
            continue
        flying[s] = False
        landed += 1
        wide = max(spread * r[s], 1.0)
        columns = _disc(x[s], y[s], wide, nx, ny)
        if len(columns) == 0:
            continue
        lowest = math.inf
        for b, a in columns:
            lowest = min(lowest, height[b, a])
        volume = 4.0 / 3.0 * math.pi * r[s] ** 3 * min(len(columns) / (math.pi * wide * wide), 1.0)
        low, high = lowest, lowest + volume
        for _ in range(40):
            level, needed = 0.5 * (low + high), 0.0
            for b, a in columns:
                needed += max(level - height[b, a], 0.0)
            if needed < volume:
                low = level
            else:
                high = level
            if high - low < 1e-3:
                break
        for b, a in columns:
            height[b, a] = max(height[b, a], high)
    return landed


@kernel
def _within_reach(height, x, y, z, wide):
    """Return whether a column of the surface comes within ``wide`` of the point (x, y, z)."""
    ny, nx = height.shape
    for b in range(max(int(math.floor(y - wide)), 0), min(int(math.floor(y + wide)) + 1, ny)):
        for a in range(max(int(math.floor(x - wide)), 0), min(int(math.floor(x + wide)) + 1, nx)):
            across = (a + 0.5 - x) ** 2 + (b + 0.5 - y) ** 2
            below = max(z - height[b, a], 0.0)
            if across + below * below <= wide * wide:
                return True
    return False


@kernel
def near_surface(height, x, y, z, r, reach):
    """Return, for each sphere, whether the surface ``height`` (cells, [j, i]) is within ``reach`` of it, bool [n]."""
    near = np.zeros(x.size, dtype=np.bool_)
    for s in range(x.size):
        near[s] = _within_reach(height, x[s], y[s], z[s], r[s] + reach)
    return near
