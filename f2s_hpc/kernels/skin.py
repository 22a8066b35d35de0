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

from f2s_hpc._jit import kernel
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


@kernel
def surface_pressure(mass, fraction, stress, cell, shape, row_of_pressure, row_of_shock, s):
    """Put the pressure of zero normal traction (Pa), plus the viscous one, into the mixed cells of a scratch row.

    ``mass``: whole flat array, ``fraction``: of the chunk that starts at ``cell``; ``shape``: (ny, nx) of a cell array;
    ``row_of_pressure``, ``row_of_shock``: scratch rows.
    """
    row, plane = shape[1], shape[0] * shape[1]
    for i in range(fraction.size):
        if fraction[i] < 1.0 and fraction[i] > 0.0:
            n = cell + i
            nx, ny, nz, clear = surface_normal(mass, n, row, plane)
            normal = (nx * nx * stress[0][n] + ny * ny * stress[1][n]) + nz * nz * stress[2][n]
            shear = (nx * ny * stress[3][n] + ny * nz * stress[4][n]) + nx * nz * stress[5][n]
            s[row_of_pressure * W + i] = clear * (normal + 2.0 * shear) + s[row_of_shock * W + i]


@kernel
def surface_strain(mass, fraction, cell, shape, s):
    """Take the opening of void out of the velocity gradient (rows 0 to 8) of the mixed cells of a chunk."""
    row, plane = shape[1], shape[0] * shape[1]
    for i in range(fraction.size):
        if fraction[i] < 1.0 and fraction[i] > 0.0:
            nx, ny, nz, clear = surface_normal(mass, cell + i, row, plane)
            trace = s[i] + s[4 * W + i] + s[8 * W + i]
            along, even = clear * trace, (1.0 - clear) * trace / 3.0
            s[i] -= along * nx * nx + even
            s[W + i] -= along * nx * ny
            s[2 * W + i] -= along * nx * nz
            s[3 * W + i] -= along * nx * ny
            s[4 * W + i] -= along * ny * ny + even
            s[5 * W + i] -= along * ny * nz
            s[6 * W + i] -= along * nx * nz
            s[7 * W + i] -= along * ny * nz
            s[8 * W + i] -= along * nz * nz + even
