"""Material points that move with the nodes."""

from __future__ import annotations

import math

from f2s_hpc._jit import borrowed, inlined, kernel

FARTHEST = 0.75
"""Cells along an axis that a point may move from remap to remap: four times so lead three cells into the ghosts."""

HOLDS_VOID = 0.98
"""A cell with less mass holds void; one with more may be full and in tension, which the spall cutoff bounds."""


@kernel
def _near_material(a, b, c, k, j, i, shape, mass, u, v, w):
    """Mean of a node field in a void cell: each node counts with its mass times its trilinear weight.

    A node without material stays at rest, so the plain mean would hold a point back that has come to lie
    just outside of the material. Where none of the nodes has any, there is nothing to move with: zero.
    """
    ny, nx = shape
    x, y, z, whole = 0.0, 0.0, 0.0, 0.0
    for kk in range(k, k + 2):
        for jj in range(j, j + 2):
            for ii in range(i, i + 2):
                m = 0.0
                for d in range(2):
                    for e in range(2):
                        n = ((kk - d) * ny + jj - e) * nx + ii
                        m += mass[n - 1] + mass[n]
                weight = m * (c if kk > k else 1.0 - c) * (b if jj > j else 1.0 - b) * (a if ii > i else 1.0 - a)
                n = (kk * (ny + 1) + jj) * (nx + 1) + ii
                whole += weight
                x += weight * u[n]
                y += weight * v[n]
                z += weight * w[n]
    if whole <= 0.0:
        return 0.0, 0.0, 0.0
    return x / whole, y / whole, z / whole


@inlined
def _blend(a, b, c, n, row, plane, q):
    """Trilinear mean of the corner values of cell n; where all agree, it has their very bits."""
    m = n + plane
    low, high = q[n] + a * (q[n + 1] - q[n]), q[n + row] + a * (q[n + row + 1] - q[n + row])
    below = low + b * (high - low)
    low, high = q[m] + a * (q[m + 1] - q[m]), q[m + row] + a * (q[m + row + 1] - q[m + row])
    above = low + b * (high - low)
    return below + c * (above - below)


@inlined
def _opening(n, row, plane, u, v, w):
    """Mean divergence of a node field in the cell whose first corner is n, times the cell's width."""
    m = n + row
    x = (u[n + 1] - u[n]) + (u[m + 1] - u[m])
    y = (v[m] - v[n]) + (v[m + 1] - v[n + 1])
    n, m = n + plane, m + plane
    x += (u[n + 1] - u[n]) + (u[m + 1] - u[m])
    y += (v[m] - v[n]) + (v[m + 1] - v[n + 1])
    z = (w[n] - w[n - plane]) + (w[n + 1] - w[n + 1 - plane])
    return 0.25 * (x + y + (z + (w[m] - w[m - plane]) + (w[m + 1] - w[m + 1 - plane])))


@kernel
def _surface_normal(mass, n, row, plane):
    """Return the normal of the surface in cell ``n``, towards the material.

    27-cell gradient of min(mass, 1), which is the volume fraction wherever there is void (Youngs 1982). ``mass``: flat
    cell array; ``row``, ``plane``: its strides.
    """
    gx, gy, gz = 0.0, 0.0, 0.0
    for c in range(-1, 2):
        for b in range(-1, 2):
            weight = (2 - abs(b)) * (2 - abs(c)) / 32.0
            m = n + b * row + c * plane
            gx += weight * (min(mass[m + 1], 1.0) - min(mass[m - 1], 1.0))
            m = n + b + c * plane
            gy += weight * (min(mass[m + row], 1.0) - min(mass[m - row], 1.0))
            m = n + b + c * row
            gz += weight * (min(mass[m + plane], 1.0) - min(mass[m - plane], 1.0))
    size = math.sqrt((gx * gx + gy * gy) + gz * gz)
    scale = 1.0 / max(size, 1e-300)
    return gx * scale, gy * scale, gz * scale


@kernel
def _beside_void(a, b, c, opened, mass, cell, row, plane):
    """Further way of a point in a cell that a free surface crosses, whose volume grows by ``opened`` (all in cells).

    There void opens or closes, not the material (:mod:`f2s_hpc.kernels.skin`), as the remap has it too. So along the
    normal n the way changes by - ``opened`` n per length, from where the normal through the point enters the cell on
    the side of the material: the points keep their volume, and agree with those of the full cells. Without it the
    points of a splat of ten cells per diameter end 0.4 cells below its surface, and their height is 5 % too small; in
    a deposit small particles shrink to half their diameter. Only where the cell is backed by material and faces void:
    in a gap between two bodies the normal means nothing.
    """
    gx, gy, gz = _surface_normal(mass, cell, row, plane)
    depth = min((1.0 - a if gx > 0.0 else a) / max(abs(gx), 1e-6), (1.0 - b if gy > 0.0 else b) / max(abs(gy), 1e-6),
                (1.0 - c if gz > 0.0 else c) / max(abs(gz), 1e-6))
    across, along = (row, gy) if abs(gy) >= abs(gz) else (plane, gz)
    if abs(gx) >= abs(along):
        across, along = 1, gx
    inner, outer = (cell + across, cell - across) if along > 0.0 else (cell - across, cell + across)
    free = min(max(2.0 * (min(mass[inner], 1.0) - mass[outer]) - 1.0, 0.0), 1.0)
    # a point outside of the material must not be driven further
    way = 0.0 if opened < 0.0 and depth > mass[cell] else free * opened * depth
    return way * gx, way * gy, way * gz


@kernel
def move_points(x, y, z, step, dx, cells, low, high, offset, shape, mass, u, v, w, displaced, p, q, r):
    """Move points with the nodes from one remap to the next; call before the remap.

    ``x``, ``y``, ``z``: places (m) right after the last remap, changed; ``step``: the last Lagrangian step over the
    cell width ``dx`` (s/m); ``cells``: of the whole box (x, y, z); ``low``, ``high``: where no point may pass (m), the
    walls, infinite at an open side; ``offset``: global index (i, j, k) of the first local cell; ``shape``: (ny, nx) of
    a local cell array; ``mass``: flat cell array; ``u``, ``v``, ``w``: velocity in the last step, flat node arrays;
    ``p``, ``q``, ``r``: where the steps before it displaced the nodes (in cells), if they did (``displaced``). Ghosts
    as far as the points have strayed, and one layer more, must be valid.

    Between two remaps a cell is the trilinear image of a cube, so a point moves by the trilinear mean of what its
    cell's nodes have moved: exactly with the mesh of the solver, to second order in the step. In a cell that holds void
    see ``_beside_void``, in one without material ``_near_material``. Points outside of the box, which left through an
    open side, stay where they are, and so does one that would move further than ``FARTHEST``: such a step is unstable,
    as the solver will say.
    """
    ny, nx = shape
    row, plane = nx + 1, (nx + 1) * (ny + 1)
    mass, u, v, w, p, q, r = (borrowed(mass), borrowed(u), borrowed(v), borrowed(w), borrowed(p), borrowed(q),
                              borrowed(r))
    per_cell = 1.0 / dx
    for n in range(x.size):
        a, b, c = x[n] * per_cell, y[n] * per_cell, z[n] * per_cell
        if not (0.0 <= a <= cells[0] and 0.0 <= b <= cells[1] and 0.0 <= c <= cells[2]):
            continue
        # a point on the high side belongs to the last cell
        i, j, k = min(int(a), cells[0] - 1), min(int(b), cells[1] - 1), min(int(c), cells[2] - 1)
        a, b, c = a - i, b - j, c - k
        i, j, k = i - offset[0], j - offset[1], k - offset[2]
        ex, ey, ez = 0.0, 0.0, 0.0
        cell = (k * ny + j) * nx + i
        held = mass[cell]
        if held > 0.0:
            at = k * plane + j * row + i
            mx, my, mz = _blend(a, b, c, at, row, plane, u), _blend(a, b, c, at, row, plane, v), _blend(
                a, b, c, at, row, plane, w)
            if displaced:
                ex, ey, ez = _blend(a, b, c, at, row, plane, p), _blend(a, b, c, at, row, plane, q), _blend(
                    a, b, c, at, row, plane, r)
            if held < HOLDS_VOID:
                opened = step * _opening(at, row, plane, u, v, w)
                if displaced:
                    opened += _opening(at, row, plane, p, q, r)
                sx, sy, sz = _beside_void(a, b, c, opened, mass, cell, nx, nx * ny)
                ex, ey, ez = ex + sx, ey + sy, ez + sz
        else:
            mx, my, mz = _near_material(a, b, c, k, j, i, shape, mass, u, v, w)
            if displaced:
                ex, ey, ez = _near_material(a, b, c, k, j, i, shape, mass, p, q, r)
        ex, ey, ez = ex + step * mx, ey + step * my, ez + step * mz
        if abs(ex) <= FARTHEST and abs(ey) <= FARTHEST and abs(ez) <= FARTHEST:
            # no node on a wall moves through it, but in a void cell it may be another one that counts
            x[n] = min(max(x[n] + dx * ex, low[0]), high[0])
            y[n] = min(max(y[n] + dx * ey, low[1]), high[1])
            z[n] = min(max(z[n] + dx * ez, low[2]), high[2])
