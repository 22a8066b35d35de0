"""Nodal forces of the cells: stress divergence, shock viscosity, hourglass control.

One-point hexahedra on a uniform grid: a cell's stress acts on its eight nodes through the mean
gradient of the shape functions, B = (+-1, +-1, +-1) / (4 dx), weighted with its volume fraction.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, kernel
from f2s_hpc.kernels.deformed import LEAST_VOLUME, cofactors, gradient, volume_ratios
from f2s_hpc.kernels.scratch import W
from f2s_hpc.kernels.skin import surface_pressure
from f2s_hpc.materials.pressure import pressure, stiffness

RATE, TOTAL, COEFFICIENT, SHOCK, POWER, SPEED, STRESS, LEFT, RIGHT, VOLUME, COFACTOR, GRADIENT, ROWS = (
    0, 1, 2, 3, 4, 5, 6, 15, 19, 23, 24, 33, 42)
"""Scratch rows of a chunk: divergence, pressure plus viscosity, hourglass coefficient, viscous pressure,
hourglass power, wave speed, nine weighted stresses (x, y, z force on the x, y, z faces), forces on four left and four
right corners, volume ratio; of a displaced mesh nine cofactors and nine of the velocity gradient."""


@kernel
def _divergence(pa, pb, pc, pd, qa, qb, qc, qd, ra, rb, rc, rd, scale, s):
    """Velocity divergence (1/s) of a chunk of cells into scratch row RATE: ``scale`` = 1 / (4 dx).

    ``p``, ``q``, ``r``: x, y, z velocity on the four node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1), each one longer
    than the chunk. Differences of equal numbers are exactly zero, so a rigid body feels nothing.
    """
    n = pa.size - 1
    for i in range(n):
        s[RATE * W + i] = (pa[i + 1] - pa[i]) + (pb[i + 1] - pb[i]) + (pc[i + 1] - pc[i]) + (pd[i + 1] - pd[i])
    for i in range(n):
        s[RATE * W + i] += (qb[i] - qa[i]) + (qb[i + 1] - qa[i + 1]) + (qd[i] - qc[i]) + (qd[i + 1] - qc[i + 1])
    for i in range(n):
        s[RATE * W + i] += (rc[i] - ra[i]) + (rc[i + 1] - ra[i + 1]) + (rd[i] - rb[i]) + (rd[i + 1] - rb[i + 1])
    for i in range(n):
        s[RATE * W + i] *= scale


@kernel
def _pressure(mass, fraction, energy, dx, last_dt, bulk, eos, viscosity, hourglass, s):
    """Pressure plus shock viscosity, hourglass coefficient, viscous pressure and wave speed of a chunk of cells."""
    linear, quadratic = viscosity
    shear = 4.0 / 3.0 * bulk.shear_modulus
    for i in range(mass.size):
        x, f, volume = mass[i], fraction[i], s[VOLUME * W + i]
        e = energy[i]
        full = 1.0 if f >= 1.0 else 0.0
        compression = x / volume if f >= 1.0 else 1.0
        p = full * pressure(eos, compression, e)
        density = bulk.density * compression
        sound = math.sqrt((stiffness(eos, compression, e) + shear) / density)
        # a cell that is to close within the step is in the shock of the impact already
        shut = 1.0 if x > volume * (1.0 + last_dt * s[RATE * W + i]) else full
        closing = max(full, shut) * min(s[RATE * W + i], 0.0)
        broadening = linear * sound - quadratic * quadratic * dx * closing
        q = -density * dx * closing * broadening
        s[TOTAL * W + i] = p + q
        s[COEFFICIENT * W + i] = hourglass * bulk.density * x * sound * dx * dx / 64.0
        s[SHOCK * W + i] = q
        s[POWER * W + i] = 0.0
        extra = broadening if closing < 0.0 else 0.0
        fastest = extra + math.sqrt(sound * sound + extra * extra)
        s[SPEED * W + i] = fastest if x > 0.0 else 0.0


@kernel
def _weigh(fraction, xx, yy, zz, xy, yz, xz, area, s):
    """Total stress times volume fraction times a quarter of the face, into nine scratch rows, the shear ones twice."""
    for i in range(fraction.size):
        a = area * fraction[i]
        p = s[TOTAL * W + i]
        s[STRESS * W + i] = a * (xx[i] - p)
        s[(STRESS + 4) * W + i] = a * (yy[i] - p)
        s[(STRESS + 8) * W + i] = a * (zz[i] - p)
        s[(STRESS + 1) * W + i] = s[(STRESS + 3) * W + i] = a * xy[i]
        s[(STRESS + 5) * W + i] = s[(STRESS + 7) * W + i] = a * yz[i]
        s[(STRESS + 2) * W + i] = s[(STRESS + 6) * W + i] = a * xz[i]


@kernel
def _weigh_displaced(fraction, xx, yy, zz, xy, yz, xz, area, s):
    """As :func:`_weigh` on displaced faces: the total stress times their area vectors, sigma cof(F)."""
    for i in range(fraction.size):
        a = area * fraction[i]
        p = s[TOTAL * W + i]
        sxx, syy, szz = a * (xx[i] - p), a * (yy[i] - p), a * (zz[i] - p)
        sxy, syz, sxz = a * xy[i], a * yz[i], a * xz[i]
        for face in range(3):
            x, y, z = (s[(COFACTOR + face) * W + i], s[(COFACTOR + 3 + face) * W + i],
                       s[(COFACTOR + 6 + face) * W + i])
            s[(STRESS + face) * W + i] = sxx * x + sxy * y + sxz * z
            s[(STRESS + 3 + face) * W + i] = sxy * x + syy * y + syz * z
            s[(STRESS + 6 + face) * W + i] = sxz * x + syz * y + szz * z


@kernel
def _rate_displaced(n, s):
    """Velocity divergence (1/s) of ``n`` displaced cells: cof(F) : dv/dX over the volume ratio."""
    for i in range(n):
        rate = 0.0
        for a in range(9):
            rate += s[(COFACTOR + a) * W + i] * s[(GRADIENT + a) * W + i]
        s[RATE * W + i] = rate / max(s[VOLUME * W + i], LEAST_VOLUME)


@kernel
def _corner_forces(p00, p10, p01, p11, sx, sy, sz, s):
    """Forces of a chunk of cells on their eight corners in one component, into eight scratch rows.

    ``p``: that component of velocity on the node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1); ``sx``, ``sy``, ``sz``:
    scratch offsets of the weighted stress on the x, y, z faces. Adds the hourglass dissipation (W) to row POWER.
    """
    for i in range(p00.size - 1):
        s00, d00 = p00[i] + p00[i + 1], p00[i + 1] - p00[i]
        s10, d10 = p10[i] + p10[i + 1], p10[i + 1] - p10[i]
        s01, d01 = p01[i] + p01[i + 1], p01[i + 1] - p01[i]
        s11, d11 = p11[i] + p11[i + 1], p11[i + 1] - p11[i]
        h1 = (s00 - s10) + (s11 - s01)
        h2 = (d01 - d00) + (d11 - d10)
        h3 = (d10 - d00) + (d11 - d01)
        h4 = (d00 - d10) + (d11 - d01)
        k = s[COEFFICIENT * W + i]
        s[POWER * W + i] += k * (h1 * h1 + h2 * h2 + h3 * h3 + h4 * h4)
        h1, h2, h3, h4 = k * h1, k * h2, k * h3, k * h4
        x, y, z = s[sx + i], s[sy + i], s[sz + i]
        s[LEFT * W + i] = (x + y + z) - (h1 + h2 + h3 - h4)
        s[(LEFT + 1) * W + i] = (x - y + z) - (h2 - h1 - h3 + h4)
        s[(LEFT + 2) * W + i] = (x + y - z) - (h3 - h1 - h2 + h4)
        s[(LEFT + 3) * W + i] = (x - y - z) - (h1 - h2 - h3 - h4)
        s[RIGHT * W + i] = (y + z - x) - (h1 - h2 - h3 + h4)
        s[(RIGHT + 1) * W + i] = (z - x - y) - (h3 - h1 - h2 - h4)
        s[(RIGHT + 2) * W + i] = (y - x - z) - (h2 - h1 - h3 - h4)
        s[(RIGHT + 3) * W + i] = -(x + y + z) - (h1 + h2 + h3 + h4)


@kernel
def _add_corners(f, left, right, s):
    """Add the corner forces of a chunk to one node row, right corners first.

    With this order every node of a row takes its two cells' shares in the same sequence wherever the row is cut.
    """
    n = f.size - 1
    for i in range(n):
        f[i + 1] += s[right + i]
    for i in range(n):
        f[i] += s[left + i]


@kernel
def nodal_forces(runs, count, window, owned, shape, dx, last_dt, bulk, eos, viscosity, hourglass, mass, fraction,
                 energy, stress, u, v, w, fx, fy, fz, displaced, x, y, z, gx, gy, gz, shock, hourglass_power, closing,
                 power_quantum, sums):
    """Add every active cell's forces (N) to its nodes; ``fx``, ``fy``, ``fz`` must be zero before.

    Parameters
    ----------
    runs, count : runs (k, j, first, end) of active cells on the local grid.
    window, owned : (k0, k1, j0, j1, i0, i1) of the cells to visit, and of those that count in sums.
    shape : (ny, nx) of a local cell array; node arrays have one row and one column more.
    last_dt : the last time step (s): tells which cells are about to close.
    viscosity : (linear, quadratic) coefficients of the shock viscosity
        q = rho dx |div v| (c_1 c + c_2^2 dx |div v|), under compression, in full cells and those about to close
        (von Neumann and Richtmyer 1950; Landshoff 1955).
    hourglass : share of an hourglass mode removed per sound crossing of a cell (viscous form,
        Flanagan and Belytschko 1981).
    mass, fraction, energy, stress : flat cell arrays; ``stress`` a tuple of six (Pa).
    u, v, w, fx, fy, fz : flat node arrays, velocity (m/s) and force (N).
    displaced, x, y, z, gx, gy, gz : whether the nodes are displaced since the last remap, by how much (in cells), and
        what the low faces of the cells have swept since.
    shock, hourglass_power, closing : flat node-shaped arrays that take, per cell, the viscous pressure (Pa), the power
        of hourglass control (W) and the velocity divergence (1/s), for the heat they become.
    sums : int64[1], power of hourglass control in units of ``power_quantum``.

    Returns the largest effective wave speed (m/s) over the owned cells with material, and its flat cell index.
    """
    ny, nx = shape
    scratch, nothing = np.empty(ROWS * W), np.zeros(W)
    s, mass, fraction, energy = borrowed(scratch), borrowed(mass), borrowed(fraction), borrowed(energy)
    u, v, w, fx, fy, fz = borrowed(u), borrowed(v), borrowed(w), borrowed(fx), borrowed(fy), borrowed(fz)
    stress = (borrowed(stress[0]), borrowed(stress[1]), borrowed(stress[2]), borrowed(stress[3]), borrowed(stress[4]),
              borrowed(stress[5]))
    x, y, z, gx, gy, gz = borrowed(x), borrowed(y), borrowed(z), borrowed(gx), borrowed(gy), borrowed(gz)
    area, per_quantum = 0.25 * dx * dx, 1.0 / power_quantum
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    fastest, where = 0.0, 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        start, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        counts = owned[0] <= k < owned[1] and owned[2] <= j < owned[3]
        for first in range(start, last, W):
            n = min(last - first, W)
            cell = (k * ny + j) * nx + first
            a = k * plane1 + j * row1 + first
            b, c, d, m = a + row1, a + plane1, a + plane1 + row1, n + 1
            if displaced:
                gradient(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], 0.25 / dx, GRADIENT, s)
                gradient(v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m], 0.25 / dx, GRADIENT + 3, s)
                gradient(w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, GRADIENT + 6, s)
                gradient(x[a:a + m], x[b:b + m], x[c:c + m], x[d:d + m], 0.25, COFACTOR, s)
                gradient(y[a:a + m], y[b:b + m], y[c:c + m], y[d:d + m], 0.25, COFACTOR + 3, s)
                gradient(z[a:a + m], z[b:b + m], z[c:c + m], z[d:d + m], 0.25, COFACTOR + 6, s)
                cofactors(n, COFACTOR, s)
                volume_ratios(gx[a:a + n], gx[a + 1:a + n + 1], gy[a:a + n], gy[b:b + n], gz[a:a + n], gz[c:c + n],
                              s[VOLUME * W:VOLUME * W + n])
                _rate_displaced(n, s)
            else:
                _divergence(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], v[a:a + m], v[b:b + m], v[c:c + m],
                            v[d:d + m], w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, s)
                s[VOLUME * W:VOLUME * W + n] = 1.0
            f = fraction[cell:cell + n]
            e = energy[cell:cell + n] if energy.size > 1 else nothing[:n]
            _pressure(mass[cell:cell + n], f, e, dx, last_dt, bulk, eos, viscosity, hourglass, s)
            surface_pressure(mass, f, stress, cell, shape, TOTAL, SHOCK, s)
            if displaced:
                _weigh_displaced(f, stress[0][cell:cell + n], stress[1][cell:cell + n], stress[2][cell:cell + n],
                                 stress[3][cell:cell + n], stress[4][cell:cell + n], stress[5][cell:cell + n], area, s)
            else:
                _weigh(f, stress[0][cell:cell + n], stress[1][cell:cell + n], stress[2][cell:cell + n],
                       stress[3][cell:cell + n], stress[4][cell:cell + n], stress[5][cell:cell + n], area, s)
            for axis in range(3):
                p, g = (u, fx) if axis == 0 else ((v, fy) if axis == 1 else (w, fz))
                row = STRESS + 3 * axis
                _corner_forces(p[a:a + m], p[b:b + m], p[c:c + m], p[d:d + m], row * W, (row + 1) * W, (row + 2) * W, s)
                _add_corners(g[a:a + m], LEFT * W, RIGHT * W, s)
                _add_corners(g[b:b + m], (LEFT + 1) * W, (RIGHT + 1) * W, s)
                _add_corners(g[c:c + m], (LEFT + 2) * W, (RIGHT + 2) * W, s)
                _add_corners(g[d:d + m], (LEFT + 3) * W, (RIGHT + 3) * W, s)
            for i in range(n):
                shock[a + i] = s[SHOCK * W + i]
                hourglass_power[a + i] = s[POWER * W + i]
                closing[a + i] = s[RATE * W + i]
            if counts:
                for i in range(max(owned[4] - first, 0), min(owned[5] - first, n)):
                    sums[0] += np.int64(s[POWER * W + i] * per_quantum)
                    if not s[SPEED * W + i] <= fastest:
                        fastest, where = s[SPEED * W + i], cell + i
    scratch[0] = 0.0  # alive to here
    return fastest, where
