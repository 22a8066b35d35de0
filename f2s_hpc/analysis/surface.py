"""The surface of a deposit: height per column, and the height of the same material without pores."""

from __future__ import annotations

import numpy as np

HALF_FULL = 0.5
"""A cell with at least this volume fraction is material; the interface lies where it is reached."""

LANDED = 1.0 / 3.0
"""Material slower than this share of the particles' speed (``batch.flight_speed``) has landed if it is attached.

Above what light cells of a resting surface ring with (up to 0.2 with 4 cells per diameter) and rims still rise with;
below what cells cut by the surface of a sphere in flight have (0.5: half of their nodes are at rest).
"""

LABELLED_AT_ONCE = 2**22
"""Cells of a slab in which what hangs together is looked for, whose labels take 4 bytes each."""


def landed_surface(volume_fraction: np.ndarray, landed: np.ndarray, dx: float) -> np.ndarray:
    """Return the height (m, above the bottom of the box) of the landed material in each column, (ny, nx).

    The highest cell k with VF >= 0.5 that has landed carries the surface; its height is (k + VF_k + VF_k+1) dx. The
    cell above counts as long as it is less than half full and has landed itself, so material in flight never counts. A
    column without landed material has height 0. ``landed``: bool, as ``volume_fraction``, (nz, ny, nx); ``dx`` in m.
    """
    solid = landed & (volume_fraction >= HALF_FULL)
    nz = solid.shape[0]
    top = nz - 1 - np.argmax(solid[::-1], axis=0)
    over = np.minimum(top + 1, nz - 1)
    row, column = np.indices(top.shape)
    fill, above = (np.clip(volume_fraction[k, row, column].astype(np.float64), 0.0, 1.0) for k in (top, over))
    resting = (over > top) & landed[over, row, column] & (above < HALF_FULL)
    height = (top + fill + np.where(resting, above, 0.0)) * dx
    return np.where(solid.any(axis=0), height, 0.0)


def grounded_cells(solid: np.ndarray) -> np.ndarray:
    """Return which of the ``solid`` cells (bool, (nz, ny, nx)) are connected through faces to the lowest layer.

    Labelled slab by slab, each as often as the ones next to it reach into what is not found yet: labels of a whole box
    take four times the memory of all else here.
    """
    from scipy import ndimage  # (20 MB, on rank 0 of a run only)

    nz = solid.shape[0]
    thick = max(1, LABELLED_AT_ONCE // max(1, solid[0].size))
    found = np.zeros(solid.shape, dtype=bool)  # (what stays void is never written, and no memory)
    found[0] = solid[0]
    waiting = {0}
    while waiting:
        first = min(waiting)
        waiting.remove(first)
        last = min(first + thick, nz)
        labels, count = ndimage.label(solid[first:last])
        grounded = np.zeros(count + 1, dtype=bool)
        for inside, outside in ((0, max(first - 1, 0)), (-1, min(last, nz - 1))):
            grounded[labels[inside][found[outside]]] = True
        grounded[0] = False
        for k in range(first, last):  # (an index is made 8 bytes wide)
            found[k] = grounded[labels[k - first]]
        for inside, outside in ((first, first - 1), (last - 1, last)):
            if 0 <= outside < nz and (found[inside] & solid[outside] & ~found[outside]).any():
                waiting.add(outside // thick * thick)
    return found


def with_skin(firm: np.ndarray, volume_fraction: np.ndarray, slow: np.ndarray) -> np.ndarray:
    """Return ``firm`` and the slow cells less than half full that touch one of them, also by an edge or a corner."""
    near = firm
    for axis in range(3):
        wider, line = near.copy(), np.moveaxis(near, axis, 0)
        np.moveaxis(wider, axis, 0)[1:] |= line[:-1]
        np.moveaxis(wider, axis, 0)[:-1] |= line[1:]
        near = wider
    return firm | (near & slow & (volume_fraction < HALF_FULL))


def attached_material(volume_fraction: np.ndarray, slow: np.ndarray) -> np.ndarray:
    """Return which cells belong to the deposit or the substrate, bool (nz, ny, nx): slow and attached to the bottom.

    A fragment that was splashed up and is just turning round in the air is slow, too, but no surface. Cells that are at
    least half full and connected through faces to the lowest layer of the box are attached, and so are less full cells
    that touch one of them (also by an edge or a corner). ``volume_fraction``, ``slow`` (bool): cells, (nz, ny, nx).
    """
    return with_skin(grounded_cells(slow & (volume_fraction >= HALF_FULL)), volume_fraction, slow)


def dense_height(volume_fraction: np.ndarray, dx: float, substrate_height: float) -> float:
    """Return the height (m) above the substrate top that all material in the box would have without pores.

    H = dx sum(VF) / (nx ny) - H_s. Material in flight counts, and an eroded substrate makes it negative.
    ``volume_fraction``: cells, (nz, ny, nx); ``dx``, ``substrate_height`` in m.
    """
    _, ny, nx = volume_fraction.shape
    return float(volume_fraction.sum(dtype=np.float64)) * dx / (nx * ny) - substrate_height
