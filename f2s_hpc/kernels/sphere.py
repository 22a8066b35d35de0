"""Volume fractions of a sphere in the cells of the grid, in closed form.

Everything follows from one number, the volume of the unit ball beyond three axis-normal planes,
V(a, b, c) = vol{x >= a, y >= b, z >= c}. The divergence theorem turns it into the areas of its faces,
V = (S - a A_a - b A_b - c A_c) / 3, and the Gauss-Bonnet theorem gives the spherical face
S = 2 pi - sum of exterior angles - sum of geodesic curvatures. A cell is then the alternating sum over
its eight corners. The error is round-off, about 1e-15 (radius / dx)^3 of a cell.

A corner's value depends on its own grid index only, so a cell gets the same bits in any window of
indices, hence on any rank.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import inlined, kernel

ROUND_OFF = 2e-15  # of the volume radius^3: differences of corner values below this are noise


@inlined
def _cap(a):
    """Volume of the unit ball where x >= a."""
    a = min(max(a, -1.0), 1.0)
    return math.pi * (1.0 - a) * (1.0 - a) * (2.0 + a) / 3.0


@inlined
def _wedge(a, b):
    """Volume of the unit ball where x >= a and y >= b (any sign)."""
    total, sign = 0.0, 1.0
    if a < 0.0:
        total, sign, a = _cap(b), -1.0, -a
    if b < 0.0:
        total, sign, b = total + sign * _cap(a), -sign, -b
    w_squared = 1.0 - a * a - b * b
    if w_squared <= 0.0:
        return total
    w = math.sqrt(w_squared)
    angle = math.atan2(w, a * b)
    arc_a, arc_b = 2.0 * math.atan2(w, b), 2.0 * math.atan2(w, a)
    spherical = 2.0 * angle - a * arc_a - b * arc_b
    face_a = 0.5 * (1.0 - a * a) * arc_a - b * w
    face_b = 0.5 * (1.0 - b * b) * arc_b - a * w
    return total + sign * (spherical - a * face_a - b * face_b) / 3.0


@inlined
def _octant(a, b, c):
    """Volume of the unit ball where x >= a, y >= b and z >= c (any sign)."""
    if a >= 1.0 or b >= 1.0 or c >= 1.0:
        return 0.0
    total, sign = 0.0, 1.0
    if a < 0.0:
        total, sign, a = _wedge(b, c), -1.0, -a
    if b < 0.0:
        total, sign, b = total + sign * _wedge(a, c), -sign, -b
    if c < 0.0:
        total, sign, c = total + sign * _wedge(a, b), -sign, -c
    if a * a + b * b + c * c >= 1.0:
        return total
    w_ab = math.sqrt(max(0.0, 1.0 - a * a - b * b))
    w_bc = math.sqrt(max(0.0, 1.0 - b * b - c * c))
    w_ca = math.sqrt(max(0.0, 1.0 - c * c - a * a))
    arc_a = math.atan2(w_ab, b) - math.atan2(c, w_ca)
    arc_b = math.atan2(w_bc, c) - math.atan2(a, w_ab)
    arc_c = math.atan2(w_ca, a) - math.atan2(b, w_bc)
    angles = math.atan2(w_ab, a * b) + math.atan2(w_bc, b * c) + math.atan2(w_ca, c * a)
    spherical = angles - math.pi - a * arc_a - b * arc_b - c * arc_c
    face_a = 0.5 * ((1.0 - a * a) * arc_a - b * (w_ab - c) - c * (w_ca - b))
    face_b = 0.5 * ((1.0 - b * b) * arc_b - c * (w_bc - a) - a * (w_ab - c))
    face_c = 0.5 * ((1.0 - c * c) * arc_c - a * (w_ca - b) - b * (w_bc - a))
    return total + sign * (spherical - a * face_a - b * face_b - c * face_c) / 3.0


@kernel
def sphere_box_volume(cx, cy, cz, radius, x0, x1, y0, y1, z0, z1):
    """Return the volume (m3) of the sphere inside the box x0..x1, y0..y1, z0..z1 (m); closed form."""
    total = 0.0
    for corner in range(8):
        x = x1 if corner & 1 else x0
        y = y1 if corner & 2 else y0
        z = z1 if corner & 4 else z0
        odd = (corner & 1) + (corner >> 1 & 1) + (corner >> 2 & 1)
        value = _octant((x - cx) / radius, (y - cy) / radius, (z - cz) / radius)
        total += -value if odd & 1 else value
    return min(max(total, 0.0), 4.0 * math.pi / 3.0) * radius**3


@kernel
def sphere_bounds(cx, cy, cz, radius, origin_x, origin_y, origin_z, dx,
                  i_low, i_high, j_low, j_high, k_low, k_high):
    """Return (i0, i1, j0, j1, k0, k1), the half-open cell range that holds the sphere.

    Clipped to the given half-open bounds (a rank's cells, say); an axis without common cells gives i0 == i1.
    Cell (i, j, k) spans origin + i dx .. origin + (i + 1) dx; lengths in metres.
    """
    i0 = max(i_low, int(math.floor((cx - radius - origin_x) / dx)))
    i1 = max(i0, min(i_high, int(math.ceil((cx + radius - origin_x) / dx))))
    j0 = max(j_low, int(math.floor((cy - radius - origin_y) / dx)))
    j1 = max(j0, min(j_high, int(math.ceil((cy + radius - origin_y) / dx))))
    k0 = max(k_low, int(math.floor((cz - radius - origin_z) / dx)))
    k1 = max(k0, min(k_high, int(math.ceil((cz + radius - origin_z) / dx))))
    return i0, i1, j0, j1, k0, k1


@inlined
def _fill_corners(plane, xs, ys, z):
    """Write the corner volumes of one plane of grid corners (unit-ball coordinates)."""
    for j in range(ys.size):
        for i in range(xs.size):
            plane[j, i] = _octant(xs[i], ys[j], z)


@kernel
def sphere_volume_fractions(cx, cy, cz, radius, origin_x, origin_y, origin_z, dx, i0, i1, j0, j1, k0, k1, out):
    """Write the volume fraction (0..1) of each cell inside the sphere into ``out[k-k0, j-j0, i-i0]``.

    Cell (i, j, k) spans origin + i dx .. origin + (i + 1) dx; lengths in metres; the index range is half
    open. Exactly 0 and 1 for cells wholly outside and inside; elsewhere the error is round-off.
    The value of a cell does not depend on the range, bit for bit. ``out`` is (k1-k0, j1-j0, i1-i0) float64.
    """
    nx, ny, nz = i1 - i0, j1 - j0, k1 - k0
    if nx <= 0 or ny <= 0 or nz <= 0:
        return
    xs, ys, zs = np.empty(nx + 1), np.empty(ny + 1), np.empty(nz + 1)
    for i in range(nx + 1):
        xs[i] = (origin_x + (i0 + i) * dx - cx) / radius
    for j in range(ny + 1):
        ys[j] = (origin_y + (j0 + j) * dx - cy) / radius
    for k in range(nz + 1):
        zs[k] = (origin_z + (k0 + k) * dx - cz) / radius
    cells_per_volume = (radius / dx) ** 3
    noise = ROUND_OFF * cells_per_volume
    lower, upper = np.empty((ny + 1, nx + 1)), np.empty((ny + 1, nx + 1))
    _fill_corners(upper, xs, ys, zs[0])
    for k in range(nz):
        lower, upper = upper, lower
        _fill_corners(upper, xs, ys, zs[k + 1])
        near_z = max(zs[k], -zs[k + 1], 0.0)
        far_z = max(-zs[k], zs[k + 1])
        for j in range(ny):
            near_y = max(ys[j], -ys[j + 1], 0.0)
            far_y = max(-ys[j], ys[j + 1])
            for i in range(nx):
                near_x = max(xs[i], -xs[i + 1], 0.0)
                far_x = max(-xs[i], xs[i + 1])
                if near_x * near_x + near_y * near_y + near_z * near_z >= 1.0:
                    out[k, j, i] = 0.0
                elif far_x * far_x + far_y * far_y + far_z * far_z <= 1.0:
                    out[k, j, i] = 1.0
                else:
                    bottom = (lower[j, i] - lower[j, i + 1]) - (lower[j + 1, i] - lower[j + 1, i + 1])
                    top = (upper[j, i] - upper[j, i + 1]) - (upper[j + 1, i] - upper[j + 1, i + 1])
                    fraction = (bottom - top) * cells_per_volume
                    if fraction <= noise:
                        fraction = 0.0
                    elif fraction >= 1.0 - noise:
                        fraction = 1.0
                    out[k, j, i] = fraction
