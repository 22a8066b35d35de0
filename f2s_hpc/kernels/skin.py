"""Cells that a free surface crosses: no traction along its normal, and no strain of material by the opening of void.

In a partly filled cell part of the volume change is void that opens or closes along the surface normal n. Material
there is taken at constant volume, its strain rate  D - tr(D) n n , and its pressure is that of zero normal traction,
p = n.s.n . In the plane of the surface the material then bears its full flow stress (with p = 0 a sheet in biaxial
tension bore a third of it, and tore). The two belong together: stress power (s - p) : D is s : (D - tr(D) n n), so no
energy is made or lost. Where the volume fraction hardly varies, the void is inside and has no direction: n n gives way
to a third of unity, and p to zero.
"""

from __future__ import annotations

import math

from f2s_hpc._jit import inlined, kernel
from f2s_hpc.kernels.scratch import W

STEEP = 0.25
"""Gradient of the volume fraction (per cell) from which a cell counts as one that a surface crosses."""


@kernel
def surface_normal(mass, n, row, plane):
    """Return the normal of the surface in cell ``n`` and how clearly it is one, 0 to 1.

    27-cell gradient of min(mass, 1), which is the volume fraction wherever there is void (Youngs 1982). ``mass``: flat
    cell array; ``row``, ``plane``: its strides. The sign of the normal is of no account.
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
    return gx * scale, gy * scale, gz * scale, min(size / STEEP, 1.0)


@inlined
def _differences(row, i):
    """Return difference and weighted sum of min(m, 1) over three neighbours of a row, the middle one at i + 1."""
    low, high = min(row[i], 1.0), min(row[i + 2], 1.0)
    middle = min(row[i + 1], 1.0)
    return high - low, (low + high) + (middle + middle)


@inlined
def _normals(r00, r01, r02, r10, r11, r12, r20, r21, r22, out):
    """As :func:`surface_normal` for a chunk of cells, into four scratch rows: x, y, z, how clearly it is one.

    ``r``: nine rows of masses, plane by plane (z, then y), each from one cell before the chunk to one behind it.
    """
    for i in range(r00.size - 2):
        d00, s00 = _differences(r00, i)
        d01, s01 = _differences(r01, i)
        d02, s02 = _differences(r02, i)
        d10, s10 = _differences(r10, i)
        d11, _ = _differences(r11, i)
        d12, s12 = _differences(r12, i)
        d20, s20 = _differences(r20, i)
        d21, s21 = _differences(r21, i)
        d22, s22 = _differences(r22, i)
        gx = ((d00 + d02) + (d20 + d22) + 2.0 * ((d01 + d21) + (d10 + d12)) + 4.0 * d11) / 32.0
        gy = ((s02 - s00) + (s22 - s20) + 2.0 * (s12 - s10)) / 32.0
        gz = ((s20 - s00) + (s22 - s02) + 2.0 * (s21 - s01)) / 32.0
        size = math.sqrt((gx * gx + gy * gy) + gz * gz)
        scale = 1.0 / max(size, 1e-300)
        out[i], out[W + i], out[2 * W + i], out[3 * W + i] = gx * scale, gy * scale, gz * scale, min(size / STEEP, 1.0)


@inlined
def _any_mixed(fraction):
    """Return whether a chunk has cells with both material and void."""
    mixed = 0
    for i in range(fraction.size):
        mixed += 1 if (fraction[i] < 1.0) & (fraction[i] > 0.0) else 0
    return mixed > 0


@inlined
def _chunk_normals(mass, cell, n, row, plane, out):
    """Normals of the ``n`` cells from ``cell`` on, into four scratch rows of ``out``."""
    a, m = cell - plane - row - 1, n + 2
    b, c = a + plane, a + 2 * plane
    _normals(mass[a:a + m], mass[a + row:a + row + m], mass[a + 2 * row:a + 2 * row + m],
             mass[b:b + m], mass[b + row:b + row + m], mass[b + 2 * row:b + 2 * row + m],
             mass[c:c + m], mass[c + row:c + row + m], mass[c + 2 * row:c + 2 * row + m], out)


@inlined
def surface_pressure(mass, fraction, xx, yy, zz, xy, yz, xz, cell, shape, total, normals):
    """Put the pressure of zero normal traction (Pa) into the mixed cells of a scratch row.

    ``mass``: whole flat array, ``fraction`` and stress: of the chunk that starts at ``cell``; ``shape``: (ny, nx) of a
    cell array; ``total``: a scratch row; ``normals``: four free ones.
    """
    if not _any_mixed(fraction):
        return
    _chunk_normals(mass, cell, fraction.size, shape[1], shape[0] * shape[1], normals)
    for i in range(fraction.size):
        nx, ny, nz, clear = normals[i], normals[W + i], normals[2 * W + i], normals[3 * W + i]
        normal = (nx * nx * xx[i] + ny * ny * yy[i]) + nz * nz * zz[i]
        shear = (nx * ny * xy[i] + ny * nz * yz[i]) + nx * nz * xz[i]
        mixed = (fraction[i] < 1.0) & (fraction[i] > 0.0)
        total[i] = clear * (normal + 2.0 * shear) if mixed else total[i]


@inlined
def surface_strain(mass, fraction, cell, shape, g, normals):
    """Take the opening of void out of the velocity gradient (nine scratch rows) of the mixed cells of a chunk.

    ``normals``: four free scratch rows.
    """
    if not _any_mixed(fraction):
        return
    _chunk_normals(mass, cell, fraction.size, shape[1], shape[0] * shape[1], normals)
    for i in range(fraction.size):
        nx, ny, nz, clear = normals[i], normals[W + i], normals[2 * W + i], normals[3 * W + i]
        trace = g[i] + g[4 * W + i] + g[8 * W + i]
        # (nothing is taken from full cells and from void)
        trace = trace if (fraction[i] < 1.0) & (fraction[i] > 0.0) else 0.0
        along, even = clear * trace, (1.0 - clear) * trace / 3.0
        g[i] -= along * nx * nx + even
        g[W + i] -= along * nx * ny
        g[2 * W + i] -= along * nx * nz
        g[3 * W + i] -= along * nx * ny
        g[4 * W + i] -= along * ny * ny + even
        g[5 * W + i] -= along * ny * nz
        g[6 * W + i] -= along * nx * nz
        g[7 * W + i] -= along * ny * nz
        g[8 * W + i] -= along * nz * nz + even
