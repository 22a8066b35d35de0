"""The mesh between two remaps: displaced nodes, what the faces have swept, and gradients on the deformed cells.

With d the displacement of the nodes since the last remap (in cells), X the place in the undisplaced mesh and
F = 1 + dd/dX, a face has the area vector A = cof(F) A_0, sweeps v . A per time, and a cell's velocity gradient is
L = (dv/dX) F^-1. The volume ratio J of a cell is one and what its faces have swept, so that strain, pressure and remap
agree on it; a rotation of the displaced mesh sweeps nothing.
"""

from __future__ import annotations

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.scratch import W

LEAST_VOLUME = 0.2
"""Cells squeezed below this share of their volume keep the gradients of the undisplaced mesh: hardly filled ones."""


@inlined
def gradient(p00, p10, p01, p11, scale, out):
    """Mean gradient of a node field over a chunk of cells into the first three scratch rows of ``out``.

    ``p``: the field on the node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1), each one longer than the chunk; ``scale``:
    0.25 over the width of a cell.
    """
    for i in range(p00.size - 1):
        a0, a1, b0, b1 = p00[i], p00[i + 1], p10[i], p10[i + 1]
        c0, c1, d0, d1 = p01[i], p01[i + 1], p11[i], p11[i + 1]
        out[i] = scale * ((a1 - a0) + (b1 - b0) + (c1 - c0) + (d1 - d0))
        out[W + i] = scale * ((b0 - a0) + (b1 - a1) + (d0 - c0) + (d1 - c1))
        out[2 * W + i] = scale * ((c0 - a0) + (c1 - a1) + (d0 - b0) + (d1 - b1))


@inlined
def volume_ratios(gx0, gx1, gy0, gy1, gz0, gz1, out):
    """Volume ratio J of a row of cells; ``g``: swept volumes of their low and high faces."""
    for i in range(out.size):
        out[i] = 1.0 + ((gx1[i] - gx0[i]) + (gy1[i] - gy0[i]) + (gz1[i] - gz0[i]))


@inlined
def _cofactors_of(xx, xy, xz, yx, yy, yz, zx, zy, zz):
    """Return the nine cofactors of a matrix, row by row."""
    return (yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx, xz * zy - xy * zz, xx * zz - xz * zx,
            xy * zx - xx * zy, xy * yz - xz * yy, xz * yx - xx * yz, xx * yy - xy * yx)


@inlined
def cofactors(n, d):
    """Replace dd/dX in nine scratch rows by the cofactors of F = 1 + dd/dX, for ``n`` cells."""
    for i in range(n):
        (d[i], d[W + i], d[2 * W + i], d[3 * W + i], d[4 * W + i], d[5 * W + i], d[6 * W + i], d[7 * W + i],
         d[8 * W + i]) = _cofactors_of(
            1.0 + d[i], d[W + i], d[2 * W + i], d[3 * W + i], 1.0 + d[4 * W + i], d[5 * W + i],
            d[6 * W + i], d[7 * W + i], 1.0 + d[8 * W + i])


@inlined
def to_deformed(n, g, d, volume):
    """Turn dv/dX in nine scratch rows ``g`` into L = (dv/dX) F^-1, with dd/dX in the nine of ``d``.

    F^-1 is the transpose of the cofactors over the volume ratio in ``volume``: with the volume that the
    faces have swept, not det F of the mean gradient, stress times L times volume is what the forces do on the nodes.
    """
    for i in range(n):
        xx, xy, xz, yx, yy, yz, zx, zy, zz = _cofactors_of(
            1.0 + d[i], d[W + i], d[2 * W + i], d[3 * W + i], 1.0 + d[4 * W + i], d[5 * W + i],
            d[6 * W + i], d[7 * W + i], 1.0 + d[8 * W + i])
        ratio = volume[i]
        sound = ratio > LEAST_VOLUME
        share = 1.0 / ratio if sound else 1.0
        a, b, c = g[i], g[W + i], g[2 * W + i]
        g[i] = share * (a * xx + b * xy + c * xz) if sound else a
        g[W + i] = share * (a * yx + b * yy + c * yz) if sound else b
        g[2 * W + i] = share * (a * zx + b * zy + c * zz) if sound else c
        a, b, c = g[3 * W + i], g[4 * W + i], g[5 * W + i]
        g[3 * W + i] = share * (a * xx + b * xy + c * xz) if sound else a
        g[4 * W + i] = share * (a * yx + b * yy + c * yz) if sound else b
        g[5 * W + i] = share * (a * zx + b * zy + c * zz) if sound else c
        a, b, c = g[6 * W + i], g[7 * W + i], g[8 * W + i]
        g[6 * W + i] = share * (a * xx + b * xy + c * xz) if sound else a
        g[7 * W + i] = share * (a * yx + b * yy + c * yz) if sound else b
        g[8 * W + i] = share * (a * zx + b * zy + c * zz) if sound else c


@inlined
def _swept_row(u0, u1, u2, u3, v0, v1, v2, v3, w0, w1, w2, w3, x0, x1, x2, x3, y0, y1, y2, y3, z0, z1, z2, z3,
               first, second, keep, half, scale, out):
    """Add the volume that a row of displaced faces sweeps: mean velocity of the four nodes times the area vector.

    The area is that in the middle of the step, ``half`` (a step over twice the cell width) times the velocity further.
    ``keep``: 1, or 0 to forget displacement and volume from before the step.
    Nodes 0 and 3, 1 and 2 lie across from each other; ``first``: diagonal from 0 to 3 of the undisplaced face,
    ``second``: from 1 to 2. Half of their cross product is the area vector of the quadrilateral, also of a bent one.
    """
    px, py, pz = first
    qx, qy, qz = second
    for i in range(out.size):
        ax = px + (keep * (x3[i] - x0[i]) + half * (u3[i] - u0[i]))
        ay = py + (keep * (y3[i] - y0[i]) + half * (v3[i] - v0[i]))
        az = pz + (keep * (z3[i] - z0[i]) + half * (w3[i] - w0[i]))
        bx = qx + (keep * (x2[i] - x1[i]) + half * (u2[i] - u1[i]))
        by = qy + (keep * (y2[i] - y1[i]) + half * (v2[i] - v1[i]))
        bz = qz + (keep * (z2[i] - z1[i]) + half * (w2[i] - w1[i]))
        u, v = (u0[i] + u3[i]) + (u1[i] + u2[i]), (v0[i] + v3[i]) + (v1[i] + v2[i])
        w = (w0[i] + w3[i]) + (w1[i] + w2[i])
        out[i] = keep * out[i] + scale * (u * (ay * bz - az * by) + v * (az * bx - ax * bz) + w * (ax * by - ay * bx))


@kernel
def sweep_faces(runs, count, window, shape, displaced, dt_over_dx, u, v, w, x, y, z, gx, gy, gz, before):
    """Add to ``gx``, ``gy``, ``gz`` the volume (in cells) that each low face of a cell sweeps in a step.

    ``gx[k, j, i]`` belongs to the face between cells i - 1 and i; node and face arrays have the same shape. The nodes
    are displaced by ``x``, ``y``, ``z`` (in cells), and ``before`` takes the volume ratios before the step; if not
    ``displaced`` this is the first step after a remap, and none of them is read.
    """
    ny, nx = shape
    keep = 1.0 if displaced else 0.0
    scale = 0.125 * dt_over_dx
    up, over = (nx + 1) * (ny + 1), nx + 1
    u, v, w, x, y, z = borrowed(u), borrowed(v), borrowed(w), borrowed(x), borrowed(y), borrowed(z)
    gx, gy, gz, before = borrowed(gx), borrowed(gy), borrowed(gz), borrowed(before)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        start, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= start:
            continue
        a, n = (k * (ny + 1) + j) * (nx + 1) + start, last - start
        # (runs come in rising order: the high faces are still those of before)
        if displaced:
            volume_ratios(gx[a:a + n], gx[a + 1:a + n + 1], gy[a:a + n], gy[a + over:a + over + n], gz[a:a + n],
                          gz[a + up:a + up + n], before[a:a + n])
        for axis in range(3):
            g = gx if axis == 0 else (gy if axis == 1 else gz)
            # seen along the axis, the two others in cyclic order
            p, q = (over, up) if axis == 0 else ((up, 1) if axis == 1 else (1, over))
            b, c, d = a + p, a + q, a + p + q
            first = (0.0, 1.0, 1.0) if axis == 0 else ((1.0, 0.0, 1.0) if axis == 1 else (1.0, 1.0, 0.0))
            second = (0.0, -1.0, 1.0) if axis == 0 else ((1.0, 0.0, -1.0) if axis == 1 else (-1.0, 1.0, 0.0))
            _swept_row(u[a:a + n], u[b:b + n], u[c:c + n], u[d:d + n], v[a:a + n], v[b:b + n], v[c:c + n], v[d:d + n],
                       w[a:a + n], w[b:b + n], w[c:c + n], w[d:d + n], x[a:a + n], x[b:b + n], x[c:c + n], x[d:d + n],
                       y[a:a + n], y[b:b + n], y[c:c + n], y[d:d + n], z[a:a + n], z[b:b + n], z[c:c + n], z[d:d + n],
                       first, second, keep, 0.5 * dt_over_dx, scale, g[a:a + n])


@inlined
def _move_row(first, dt_over_dx, velocity, place):
    """Add a step's way to the displacement of a row; ``first``: the row was not displaced before."""
    for i in range(place.size):
        place[i] = dt_over_dx * velocity[i] if first else place[i] + dt_over_dx * velocity[i]


@kernel
def move_nodes(runs, count, shape, first, dt_over_dx, u, v, w, x, y, z):
    """Displace the nodes (in cells) of the active rows, ghosts included; ``first``: forget where they were before.

    The nodes at the far ends of the active rows are left out: only void has them.
    """
    ny, nx = shape
    u, v, w, x, y, z = borrowed(u), borrowed(v), borrowed(w), borrowed(x), borrowed(y), borrowed(z)
    for r in range(count):
        row = (runs[r, 0] * (ny + 1) + runs[r, 1]) * (nx + 1)
        a, b = row + runs[r, 2], row + runs[r, 3]
        _move_row(first, dt_over_dx, u[a:b], x[a:b])
        _move_row(first, dt_over_dx, v[a:b], y[a:b])
        _move_row(first, dt_over_dx, w[a:b], z[a:b])
