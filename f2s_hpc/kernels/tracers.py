"""Material points that move with the velocity of the nodes."""

from __future__ import annotations

from f2s_hpc._jit import borrowed, inlined, kernel

FARTHEST = 0.75
"""Cells along an axis that a point may fly in a step: four steps so lead at most three cells into the ghosts."""


@kernel
def _near_material(a, b, c, k, j, i, shape, mass, u, v, w):
    """Velocity in a void cell: that of its nodes, each weighted with its mass and its trilinear weight.

    A node without material keeps the velocity zero, so the plain mean would hold a point back that has come to lie
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
def _blend(a, b, c, q):
    """Trilinear mean of eight corner values; where all agree, it has their very bits."""
    low, high = q[0] + a * (q[1] - q[0]), q[2] + a * (q[3] - q[2])
    below = low + b * (high - low)
    low, high = q[4] + a * (q[5] - q[4]), q[6] + a * (q[7] - q[6])
    above = low + b * (high - low)
    return below + c * (above - below)


@kernel
def move_points(x, y, z, dt, dx, cells, low, high, offset, shape, mass, u, v, w):
    """Move points over a step ``dt`` (s) with the velocity field that the step ended with.

    ``x``, ``y``, ``z``: places (m), changed; ``cells``: of the whole box (x, y, z); ``low``, ``high``: where no point
    may pass (m), the walls, infinite at an open side; ``offset``: global index (i, j, k) of the first local cell;
    ``shape``: (ny, nx) of a local cell array; ``mass``: flat cell array; ``u``, ``v``, ``w``: flat node arrays. Ghosts
    as far as the points have strayed, and one layer more, must be valid.

    A step moves the material with the velocity at its middle and then puts that velocity where the material has
    arrived (remap). So x(end) = x(start) + dt u(x(end)), which two rounds from x(start) solve to third order in dt.
    In a void cell see ``_near_material``. Points outside of the box, which left through an open side, stay where they
    are, and so does one that would fly further than ``FARTHEST``: such a step is unstable, as the solver will say.
    """
    ny, nx = shape
    row, plane = nx + 1, (nx + 1) * (ny + 1)
    mass, u, v, w = borrowed(mass), borrowed(u), borrowed(v), borrowed(w)
    per_cell, step = 1.0 / dx, dt / dx
    none = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for p in range(x.size):
        px, py, pz = x[p] * per_cell, y[p] * per_cell, z[p] * per_cell
        if not (0.0 <= px <= cells[0] and 0.0 <= py <= cells[1] and 0.0 <= pz <= cells[2]):
            continue
        vx, vy, vz = 0.0, 0.0, 0.0
        before, cu, cv, cw = -1, none, none, none
        for _ in range(2):
            ax = min(max(px + step * vx, 0.0), float(cells[0]))
            ay = min(max(py + step * vy, 0.0), float(cells[1]))
            az = min(max(pz + step * vz, 0.0), float(cells[2]))
            # a point on the high side belongs to the last cell
            i, j, k = min(int(ax), cells[0] - 1), min(int(ay), cells[1] - 1), min(int(az), cells[2] - 1)
            a, b, c = ax - i, ay - j, az - k
            i, j, k = i - offset[0], j - offset[1], k - offset[2]
            n = k * plane + j * row + i
            if n != before and mass[(k * ny + j) * nx + i] > 0.0:
                m = n + plane
                cu = (u[n], u[n + 1], u[n + row], u[n + row + 1], u[m], u[m + 1], u[m + row], u[m + row + 1])
                cv = (v[n], v[n + 1], v[n + row], v[n + row + 1], v[m], v[m + 1], v[m + row], v[m + row + 1])
                cw = (w[n], w[n + 1], w[n + row], w[n + row + 1], w[m], w[m + 1], w[m + row], w[m + row + 1])
                before = n
            if n == before:
                vx, vy, vz = _blend(a, b, c, cu), _blend(a, b, c, cv), _blend(a, b, c, cw)
            else:
                vx, vy, vz = _near_material(a, b, c, k, j, i, shape, mass, u, v, w)
            if not (step * abs(vx) <= FARTHEST and step * abs(vy) <= FARTHEST and step * abs(vz) <= FARTHEST):
                vx, vy, vz = 0.0, 0.0, 0.0
                break
        # no node on a wall moves through it, but in a void cell it may be another one that counts
        x[p] = min(max(x[p] + dt * vx, low[0]), high[0])
        y[p] = min(max(y[p] + dt * vy, low[1]), high[1])
        z[p] = min(max(z[p] + dt * vz, low[2]), high[2])
