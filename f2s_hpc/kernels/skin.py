"""Cells with material and void: no traction across the void, and no strain of material by its opening or closing.

In a partly filled cell the volume change is void that opens or closes, along a free surface's normal n or between two
bodies that meet. Material there is taken at constant volume, its strain rate  D - tr(D) M , and its pressure is that of
zero normal traction,  p = s : M , with M = n n. In the plane of the surface the material then bears its full flow
stress (with p = 0 a sheet in biaxial tension bore a third of it, and tore). The two belong together: stress power
(s - p) : D is s : (D - tr(D) M), so no energy is made or lost.

M comes from the structure tensor T of the volume fraction, the sum of g g over its gradients g at the cell's corners:
unlike a mean gradient it knows a gap, where one side's cancels the other's. (With the mean gradient's normal the void
in a gap had no direction, and two blocks that met at 100 m/s got a PEEQ of 0.3 in one layer of cells, 40 times that of
the shock.) M = (T / tr T)^4 over its trace is n n where one direction prevails and a third of unity in a pore, where
none does. Where the volume fraction hardly varies M gives way to a third of unity, and p to zero.
"""

from __future__ import annotations

import math

from f2s_hpc._jit import inlined
from f2s_hpc.kernels.scratch import W

STEEP = 0.05
"""Root mean square gradient of the volume fraction (per cell) from which on void has a direction."""

V = W + 8
"""Distance of the six scratch rows of a chunk's tensors: there is one corner more than cells."""


@inlined
def _corner(a0, a1, b0, b1, c0, c1, d0, d1):
    """Return four times the gradient amid eight cells; a: (j, k), b: (j + 1, k), c: (j, k + 1), d: both; 0, 1: i."""
    x = ((a1 - a0) + (b1 - b0)) + ((c1 - c0) + (d1 - d0))
    y = ((b0 - a0) + (b1 - a1)) + ((d0 - c0) + (d1 - c1))
    z = ((c0 - a0) + (c1 - a1)) + ((d0 - b0) + (d1 - b1))
    return x, y, z


@inlined
def _corner_products(a, b, c, d, first, out):
    """Add to (``first``: set) six rows xx, yy, zz, xy, yz, xz the products of the gradients along one row of corners.

    ``a``..``d``: the rows of masses around it, as in :func:`_corner`, each one longer than there are corners.
    """
    for i in range(a.size - 1):
        x, y, z = _corner(min(a[i], 1.0), min(a[i + 1], 1.0), min(b[i], 1.0), min(b[i + 1], 1.0),
                          min(c[i], 1.0), min(c[i + 1], 1.0), min(d[i], 1.0), min(d[i + 1], 1.0))
        out[i] = (0.0 if first else out[i]) + x * x
        out[V + i] = (0.0 if first else out[V + i]) + y * y
        out[2 * V + i] = (0.0 if first else out[2 * V + i]) + z * z
        out[3 * V + i] = (0.0 if first else out[3 * V + i]) + x * y
        out[4 * V + i] = (0.0 if first else out[4 * V + i]) + y * z
        out[5 * V + i] = (0.0 if first else out[5 * V + i]) + x * z


@inlined
def _squared(xx, yy, zz, xy, yz, xz):
    """Return the square of a symmetric tensor over its trace."""
    axx, ayy, azz = xx * xx + (xy * xy + xz * xz), yy * yy + (xy * xy + yz * yz), zz * zz + (xz * xz + yz * yz)
    over = 1.0 / max(axx + ayy + azz, 1e-300)
    return (axx * over, ayy * over, azz * over, (xx * xy + xy * yy + xz * yz) * over,
            (xy * xz + yy * yz + yz * zz) * over, (xx * xz + xy * yz + xz * zz) * over)


@inlined
def _prevailing(n, out):
    """Turn the sums over a chunk's rows of corners into the tensors M of its ``n`` cells, in place."""
    for i in range(n):
        xx, yy, zz = out[i] + out[i + 1], out[V + i] + out[V + i + 1], out[2 * V + i] + out[2 * V + i + 1]
        xy, yz, xz = (out[3 * V + i] + out[3 * V + i + 1], out[4 * V + i] + out[4 * V + i + 1],
                      out[5 * V + i] + out[5 * V + i + 1])
        trace = (xx + yy) + zz
        over = 1.0 / max(trace, 1e-300)
        xx, yy, zz, xy, yz, xz = _squared(xx * over, yy * over, zz * over, xy * over, yz * over, xz * over)
        xx, yy, zz, xy, yz, xz = _squared(xx, yy, zz, xy, yz, xz)
        clear = min(math.sqrt(trace / 128.0) / STEEP, 1.0)  # eight corners, each four times its gradient
        even = (1.0 - clear) / 3.0
        out[i], out[V + i], out[2 * V + i] = clear * xx + even, clear * yy + even, clear * zz + even
        out[3 * V + i], out[4 * V + i], out[5 * V + i] = clear * xy, clear * yz, clear * xz


@inlined
def _any_mixed(fraction):
    """Return whether a chunk has cells with both material and void."""
    mixed = 0
    for i in range(fraction.size):
        mixed += 1 if (fraction[i] < 1.0) & (fraction[i] > 0.0) else 0
    return mixed > 0


@inlined
def _opening_tensors(mass, cell, n, row, plane, out):
    """Tensors M of the ``n`` cells from ``cell`` on, into six rows of ``out``; ``row``, ``plane``: strides of cells."""
    m = n + 2
    for k in range(2):
        for j in range(2):
            a = cell - 1 + (k - 1) * plane + (j - 1) * row
            c = a + plane
            _corner_products(mass[a:a + m], mass[a + row:a + row + m], mass[c:c + m], mass[c + row:c + row + m],
                             k + j == 0, out)
    _prevailing(n, out)


@inlined
def surface_pressure(mass, fraction, xx, yy, zz, xy, yz, xz, cell, shape, total, tensors):
    """Put the pressure of zero normal traction (Pa) into the mixed cells of a scratch row.

    ``mass``: whole flat array, ``fraction`` and stress: of the chunk that starts at ``cell``; ``shape``: (ny, nx) of a
    cell array; ``total``: a scratch row; ``tensors``: seven free ones.
    """
    if not _any_mixed(fraction):
        return
    _opening_tensors(mass, cell, fraction.size, shape[1], shape[0] * shape[1], tensors)
    for i in range(fraction.size):
        normal = (tensors[i] * xx[i] + tensors[V + i] * yy[i]) + tensors[2 * V + i] * zz[i]
        shear = (tensors[3 * V + i] * xy[i] + tensors[4 * V + i] * yz[i]) + tensors[5 * V + i] * xz[i]
        mixed = (fraction[i] < 1.0) & (fraction[i] > 0.0)
        total[i] = normal + 2.0 * shear if mixed else total[i]


@inlined
def surface_strain(mass, fraction, cell, shape, g, tensors):
    """Take the opening of void out of the velocity gradient (nine scratch rows) of the mixed cells of a chunk.

    ``tensors``: seven free scratch rows.
    """
    if not _any_mixed(fraction):
        return
    _opening_tensors(mass, cell, fraction.size, shape[1], shape[0] * shape[1], tensors)
    for i in range(fraction.size):
        trace = g[i] + g[4 * W + i] + g[8 * W + i]
        # (nothing is taken from full cells and from void)
        trace = trace if (fraction[i] < 1.0) & (fraction[i] > 0.0) else 0.0
        xy, yz, xz = trace * tensors[3 * V + i], trace * tensors[4 * V + i], trace * tensors[5 * V + i]
        g[i] -= trace * tensors[i]
        g[W + i] -= xy
        g[2 * W + i] -= xz
        g[3 * W + i] -= xy
        g[4 * W + i] -= trace * tensors[V + i]
        g[5 * W + i] -= yz
        g[6 * W + i] -= xz
        g[7 * W + i] -= yz
        g[8 * W + i] -= trace * tensors[2 * V + i]
