"""A deposit as a mesh for other codes: its cells as hexahedra, their outer faces or its height map as triangles.

Points are (x, y, z) from the low corner of the box, in units of a cell; who writes them multiplies by the cell size.
"""

from __future__ import annotations

import numpy as np

from f2s_hpc.errors import InputError

HEXAHEDRON = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
"""Corners (x, y, z) of a hexahedron in the order of VTK and Abaqus: around the bottom, then around the top."""


def hexahedra(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3), float64, and the corners of each kept cell, indices of points (m, 8), int64.

    ``kept``: bool, (nz, ny, nx); cells come in its order (x fastest). Cells side by side share their points.
    """
    place = np.stack(np.nonzero(kept)[::-1], axis=1)
    return _compact(place[:, None, :] + np.array(HEXAHEDRON), kept.shape)


def boundary_triangles(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and triangles (m, 3) of all faces between kept cells and others or the outside of the box.

    Two triangles a face, corners counterclockwise seen from outside. The surface is closed, walls of pores included,
    and encloses the volume of the kept cells; where two of these touch along an edge only, four faces share that edge.
    ``kept``: bool, (nz, ny, nx).
    """
    quads = []
    padded = np.pad(kept, 1)
    for axis in range(3):
        across = 2 - axis  # (axis of the array)
        second, third = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = np.stack([0 * second, second, second + third, third])
        for step in (1, -1):
            beside = np.roll(padded, -step, axis=across)[1:-1, 1:-1, 1:-1]
            place = np.stack(np.nonzero(kept & ~beside)[::-1], axis=1)
            place[:, axis] += step == 1
            quads.append(place[:, None, :] + around[::step])
    points, corners = _compact(np.concatenate(quads), kept.shape)
    return points, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


def height_map_triangles(height: np.ndarray, closed: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and triangles (m, 3) of the surface z = height, normals upwards.

    Points stand above the centres of the columns, level with these above the sides of the box, and in the middle of
    each square of them at their mean: four triangles that favour no diagonal. So what the surface encloses with the
    bottom is the sum of the heights, to round-off. ``closed`` adds the sides and the bottom z = 0.
    ``height``: (ny, nx), in cells. Raises ``InputError`` when ``closed`` and a column is empty, as the surface would
    touch the bottom.
    """
    if closed and not (height > 0.0).all():
        raise InputError(f"{int((height <= 0.0).sum())} columns hold nothing that has landed, so their surface cannot "
                         "be closed; --open leaves sides and bottom out")
    ny, nx = height.shape
    x, y = (np.concatenate([[0.0], np.arange(n) + 0.5, [float(n)]]) for n in (nx, ny))
    grid = np.stack([*np.meshgrid(x, y), np.pad(height, 1, mode="edge")], axis=-1)
    number = np.arange(grid[..., 0].size).reshape(ny + 2, nx + 2)
    around = [part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])]
    points = grid.reshape(-1, 3)
    middle = len(points) + np.arange(len(around[0]))
    triangles = np.concatenate([np.stack([one, two, middle], 1) for one, two in zip(around, np.roll(around, -1, 0))])
    points = np.concatenate([points, np.mean([points[corner] for corner in around], axis=0)])
    if not closed:
        return points, triangles
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])  # (counterclockwise)
    foot = len(points) + np.arange(len(rim))
    next_rim, next_foot, centre = np.roll(rim, -1), np.roll(foot, -1), np.full(len(rim), foot[-1] + 1)
    below = np.concatenate([points[rim] * [1.0, 1.0, 0.0], [[0.5 * nx, 0.5 * ny, 0.0]]])
    sides = [np.stack([foot, next_foot, next_rim], 1), np.stack([foot, next_rim, rim], 1)]
    return (np.concatenate([points, below]),
            np.concatenate([triangles, *sides, np.stack([centre, next_foot, foot], 1)]))


def enclosed_volume(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume inside a closed surface with outward normals, in the cube of the points' unit.

    The sum of the signed volumes of the tetrahedra between each triangle and the origin (divergence theorem).
    """
    a, b, c = (points[triangles[:, n]] for n in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0


def node_means(corners: np.ndarray, values: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return the weighted mean of the cells around each of ``count`` points.

    ``corners``: (m, 8), as of :func:`hexahedra`; ``values``, ``weights`` (above zero): of the m cells.
    """
    flat, share = corners.ravel(), np.repeat(weights, corners.shape[1])
    total = np.bincount(flat, share * np.repeat(values, corners.shape[1]), count)
    return total / np.bincount(flat, share, count)


def _compact(corners: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lattice points that ``corners`` (m, c, 3), integers, name, and the corners as indices of them."""
    nz, ny, nx = (n + 1 for n in shape)
    flat = (corners[..., 2] * ny + corners[..., 1]) * nx + corners[..., 0]
    used = np.zeros(nz * ny * nx, dtype=bool)
    used[flat.ravel()] = True
    index = np.cumsum(used) - 1
    points = np.stack(np.unravel_index(np.flatnonzero(used), (nz, ny, nx))[::-1], axis=1)
    return points.astype(np.float64), index[flat]
