"""Sweeps of a tag: which share of each cell's mass is of one kind. Its interface is moved as a plane, and stays sharp.

As any other field a tag would spread over four cells. So each cell's material is taken for a unit cube of mass that a
plane parts in two (PLIC, as the volume fraction has it against void), and a face takes the tagged part of the slab that
leaves through it.
"""

from __future__ import annotations

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.plane import interface_normal, plane_distance, slab_volume
from f2s_hpc.kernels.remap import LEAST_MASS, LEAST_SLOPED

PURE = 1e-9
"""A cell of which less than this is tagged, or less than this is not, has no interface."""


@inlined
def _pure_fluxes(moved, low, high, out):
    """Tagged mass through a row of faces, each donor taken as even."""
    for i in range(moved.size):
        out[i] = moved[i] * (low[i] if moved[i] > 0.0 else high[i])


@kernel
def _tags_around(tag, mass, n, row, plane, around):
    """Copy the tags of the 27 cells around ``n``; in void there is none, and that of ``n`` stands for it."""
    for c in range(3):
        for b in range(3):
            for a in range(3):
                m = n + (a - 1) + (b - 1) * row + (c - 1) * plane
                around[9 * c + 3 * b + a] = tag[m] if mass[m] > LEAST_SLOPED else tag[n]


@kernel
def tag_fluxes(runs, count, window, shape, axis, moved, mass, tag, flux):
    """Tagged mass (in full cells) that crosses each low face along ``axis``, signed, into ``flux``.

    ``moved``: mass through the low faces; ``mass``, ``tag``: of the cells before the sweep, ghosts valid one layer
    around ``window``. Visits its cells as donors and writes the low face of each, and the high face where they give.
    """
    ny, nx = shape
    cell_strides, face_strides = (1, nx, nx * ny), (1, nx + 1, (nx + 1) * (ny + 1))
    back, step = cell_strides[axis], face_strides[axis]
    local = (1, 3, 9)
    sx, sy, sz = local[axis], local[(axis + 1) % 3], local[(axis + 2) % 3]
    around = np.empty(27)
    moved, mass, tag, flux = borrowed(moved), borrowed(mass), borrowed(tag), borrowed(flux)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, n = max(runs[r, 2], window[4]), min(runs[r, 3], window[5]) - max(runs[r, 2], window[4])
        if n <= 0:
            continue
        face, cell = (k * (ny + 1) + j) * (nx + 1) + first, (k * ny + j) * nx + first
        _pure_fluxes(moved[face:face + n], tag[cell - back:cell - back + n], tag[cell:cell + n], flux[face:face + n])
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        face, cell = (k * (ny + 1) + j) * (nx + 1), (k * ny + j) * nx
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            tagged, held = tag[cell + i], mass[cell + i]
            low, high = moved[face + i], moved[face + i + step]
            if not PURE < tagged < 1.0 - PURE or held <= LEAST_MASS or (low >= 0.0 and high <= 0.0):
                continue
            _tags_around(tag, mass, cell + i, nx, nx * ny, around)
            a, b, c = interface_normal(around, 13, sx, sy, sz)
            distance = plane_distance(abs(a), abs(b), abs(c), tagged)
            # what stays of either kind must fit into what stays
            rest, kept = 1.0, tagged
            if low < 0.0:
                share = min(-low / held, 1.0)
                rest -= share
                leaves = min(max(slab_volume(a, b, c, distance, share, False), kept - rest, 0.0), kept, share)
                flux[face + i] = -held * leaves
                kept -= leaves
            if high > 0.0:
                share = min(high / held, rest)
                rest -= share
                leaves = min(max(slab_volume(a, b, c, distance, share, True), kept - rest, 0.0), kept, share)
                flux[face + i + step] = held * leaves


@inlined
def _update_row(tag, mass, mass_in, mass_out, tagged_in, tagged_out):
    """Update the tags of a row in place, in differences: what is even stays even to the last bit."""
    for i in range(tag.size):
        old, after = tag[i], mass[i] + (mass_in[i] - mass_out[i])
        change = (tagged_in[i] - mass_in[i] * old) - (tagged_out[i] - mass_out[i] * old)
        # (beyond 0 and 1 by round-off at most)
        tag[i] = min(max(old + change / after, 0.0), 1.0) if after > LEAST_MASS else old


@kernel
def sweep_tag(runs, count, window, shape, axis, moved, flux, mass, tag):
    """Move the tag of the owned cells through their two faces along ``axis``; ``mass``: still that before the sweep."""
    ny, nx = shape
    step = (1, nx + 1, (nx + 1) * (ny + 1))[axis]
    moved, flux, mass, tag = borrowed(moved), borrowed(flux), borrowed(mass), borrowed(tag)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, n = max(runs[r, 2], window[4]), min(runs[r, 3], window[5]) - max(runs[r, 2], window[4])
        if n <= 0:
            continue
        a, c = (k * (ny + 1) + j) * (nx + 1) + first, (k * ny + j) * nx + first
        _update_row(tag[c:c + n], mass[c:c + n], moved[a:a + n], moved[a + step:a + step + n], flux[a:a + n],
                    flux[a + step:a + step + n])
