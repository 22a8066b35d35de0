"""Nodal forces of the cells: stress divergence, shock viscosity, hourglass control.

One-point hexahedra on a uniform grid: a cell's stress acts on its eight nodes through the mean
gradient of the shape functions, B = (+-1, +-1, +-1) / (4 dx), weighted with its volume fraction.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.materials.pressure import pressure, stiffness


@kernel
def row_divergence(pa, pb, pc, pd, qa, qb, qc, qd, ra, rb, rc, rd, scale, out):
    """Velocity divergence (1/s) of a run of cells: ``scale`` = 1 / (4 dx).

    ``p``, ``q``, ``r``: x, y, z velocity on the four node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1), each one longer
    than the run. Differences of equal numbers are exactly zero, so a rigid body feels nothing.
    """
    for i in range(out.size):
        du = (pa[i + 1] - pa[i]) + (pb[i + 1] - pb[i]) + (pc[i + 1] - pc[i]) + (pd[i + 1] - pd[i])
        dv = (qb[i] - qa[i]) + (qb[i + 1] - qa[i + 1]) + (qd[i] - qc[i]) + (qd[i + 1] - qc[i + 1])
        dw = (rc[i] - ra[i]) + (rc[i + 1] - ra[i + 1]) + (rd[i] - rb[i]) + (rd[i + 1] - rb[i + 1])
        out[i] = scale * (du + dv + dw)


@kernel
def _row_pressure(mass, fraction, energy, rate, dx, bulk, eos, viscosity, hourglass, total, coefficient, viscous,
                  speed):
    """Pressure plus shock viscosity, hourglass coefficient, viscous power and wave speed of a run of cells."""
    linear, quadratic = viscosity
    shear = 4.0 / 3.0 * bulk.shear_modulus
    carried = energy.size > 1
    for i in range(total.size):
        x = mass[i]
        e = energy[i] if carried else 0.0
        full = 1.0 if fraction[i] >= 1.0 else 0.0
        compression = x if fraction[i] >= 1.0 else 1.0
        p = full * pressure(eos, compression, e)
        density = bulk.density * compression
        sound = math.sqrt((stiffness(eos, compression, e) + shear) / density)
        closing = full * min(rate[i], 0.0)
        broadening = linear * sound - quadratic * quadratic * dx * closing
        q = -density * dx * closing * broadening
        total[i] = p + q
        coefficient[i] = hourglass * bulk.density * x * sound * dx * dx / 64.0
        viscous[i] = -fraction[i] * q * closing * dx * dx * dx
        extra = broadening if closing < 0.0 else 0.0
        fastest = extra + math.sqrt(sound * sound + extra * extra)
        speed[i] = fastest if x > 0.0 else 0.0


@kernel
def _weighted(fraction, stress, total, area, out):
    """Stress times volume fraction and a quarter of the face; ``total`` is taken off where its size is not one."""
    if total.size == 1:
        for i in range(out.size):
            out[i] = area * fraction[i] * stress[i]
    else:
        for i in range(out.size):
            out[i] = area * fraction[i] * (stress[i] - total[i])


@kernel
def _row_component(p00, p10, p01, p11, f00, f10, f01, f11, sx, sy, sz, coefficient, right, power):
    """Add one component's forces of a run of cells to the four node rows around it.

    ``p``: that component of velocity, ``f``: of force, on the node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1), one
    longer than the run. ``sx``, ``sy``, ``sz``: weighted stress on the x, y, z faces in this component. ``power``
    collects the hourglass dissipation (W). The forces on the right-hand nodes wait in ``right``
    and are added in loops of their own, so that all loops vectorise.
    """
    n = coefficient.size
    for i in range(n):
        s00, d00 = p00[i] + p00[i + 1], p00[i + 1] - p00[i]
        s10, d10 = p10[i] + p10[i + 1], p10[i + 1] - p10[i]
        s01, d01 = p01[i] + p01[i + 1], p01[i + 1] - p01[i]
        s11, d11 = p11[i] + p11[i + 1], p11[i + 1] - p11[i]
        h1 = (s00 - s10) + (s11 - s01)
        h2 = (d01 - d00) + (d11 - d10)
        h3 = (d10 - d00) + (d11 - d01)
        h4 = (d00 - d10) + (d11 - d01)
        k = coefficient[i]
        power[i] += k * (h1 * h1 + h2 * h2 + h3 * h3 + h4 * h4)
        h1, h2, h3, h4 = k * h1, k * h2, k * h3, k * h4
        x, y, z = sx[i], sy[i], sz[i]
        f00[i] += (x + y + z) - (h1 + h2 + h3 - h4)
        f10[i] += (x - y + z) - (h2 - h1 - h3 + h4)
        f01[i] += (x + y - z) - (h3 - h1 - h2 + h4)
        f11[i] += (x - y - z) - (h1 - h2 - h3 - h4)
        right[0, i] = (y + z - x) - (h1 - h2 - h3 + h4)
        right[1, i] = (z - x - y) - (h3 - h1 - h2 - h4)
        right[2, i] = (y - x - z) - (h2 - h1 - h3 - h4)
        right[3, i] = -(x + y + z) - (h1 + h2 + h3 + h4)
    for i in range(n):
        f00[i + 1] += right[0, i]
    for i in range(n):
        f10[i + 1] += right[1, i]
    for i in range(n):
        f01[i + 1] += right[2, i]
    for i in range(n):
        f11[i + 1] += right[3, i]


@kernel
def nodal_forces(runs, count, window, owned, shape, dx, bulk, eos, viscosity, hourglass, mass, fraction, energy,
                 stress, u, v, w, fx, fy, fz, power_quantum, sums):
    """Add every active cell's forces (N) to its nodes; ``fx``, ``fy``, ``fz`` must be zero before.

    Parameters
    ----------
    runs, count : runs (k, j, first, end) of active cells on the local grid.
    window, owned : (k0, k1, j0, j1, i0, i1) of the cells to visit, and of those that count in sums.
    shape : (ny, nx) of a local cell array; node arrays have one row and one column more.
    viscosity : (linear, quadratic) coefficients of the shock viscosity
        q = rho dx |div v| (c_1 c + c_2^2 dx |div v|), in full cells under compression only
        (von Neumann and Richtmyer 1950; Landshoff 1955).
    hourglass : share of an hourglass mode removed per sound crossing of a cell (viscous form,
        Flanagan and Belytschko 1981).
    mass, fraction, energy, stress : flat cell arrays; ``stress`` a tuple of six (Pa).
    u, v, w, fx, fy, fz : flat node arrays, velocity (m/s) and force (N).
    sums : int64[2], power of shock viscosity and of hourglass control in units of ``power_quantum``.

    Returns the largest effective wave speed (m/s) over the owned cells with material, and its flat cell index.
    """
    ny, nx = shape
    width = 0
    for r in range(count):
        width = max(width, runs[r, 3] - runs[r, 2])
    weighted, right, rows = np.empty((6, width)), np.empty((4, width)), np.empty((6, width))
    area, nothing = 0.25 * dx * dx, np.zeros(1)
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    fastest, where = 0.0, 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        n = last - first
        cell = (k * ny + j) * nx + first
        a = k * plane1 + j * row1 + first
        b, c, d, m = a + row1, a + plane1, a + plane1 + row1, n + 1
        rate, total, coefficient, viscous, power, speed = (rows[0, :n], rows[1, :n], rows[2, :n], rows[3, :n],
                                                           rows[4, :n], rows[5, :n])
        f = fraction[cell:cell + n]
        row_divergence(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m],
                       w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, rate)
        e = energy[cell:cell + n] if energy.size > 1 else energy
        _row_pressure(mass[cell:cell + n], f, e, rate, dx, bulk, eos, viscosity, hourglass, total, coefficient,
                      viscous, speed)
        for s in range(6):
            _weighted(f, stress[s][cell:cell + n], total if s < 3 else nothing, area, weighted[s, :n])
        power[:] = 0.0
        for axis in range(3):
            p, g = (u, fx) if axis == 0 else ((v, fy) if axis == 1 else (w, fz))
            x, y, z = (0, 3, 5) if axis == 0 else ((3, 1, 4) if axis == 1 else (5, 4, 2))
            _row_component(p[a:a + m], p[b:b + m], p[c:c + m], p[d:d + m], g[a:a + m], g[b:b + m], g[c:c + m],
                           g[d:d + m], weighted[x, :n], weighted[y, :n], weighted[z, :n], coefficient, right, power)
        if k < owned[0] or k >= owned[1] or j < owned[2] or j >= owned[3]:
            continue
        for i in range(max(owned[4] - first, 0), min(owned[5] - first, n)):
            sums[0] += np.int64(viscous[i] / power_quantum)
            sums[1] += np.int64(power[i] / power_quantum)
            if not speed[i] <= fastest:
                fastest, where = speed[i], cell + i
    return fastest, where
