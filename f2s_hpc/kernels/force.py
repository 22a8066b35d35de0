"""Nodal forces of the cells: stress divergence, shock viscosity, hourglass control.

One-point hexahedra on a uniform grid: a cell's stress acts on its eight nodes through the mean
gradient of the shape functions, B = (+-1, +-1, +-1) / (4 dx), weighted with its volume fraction.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.deformed import LEAST_VOLUME, cofactors, gradient, volume_ratios
from f2s_hpc.kernels.scratch import W, place_of_largest
from f2s_hpc.kernels.skin import surface_pressure
from f2s_hpc.materials.pressure import pressure, stiffness, unloaded

RATE, TOTAL, COEFFICIENT, SHOCK, POWER, SPEED, STRESS, CORNERS, VOLUME, COFACTOR, GRADIENT, ROWS = (
    0, 1, 2, 3, 4, 5, 6, 15, 23, 24, 33, 42)
"""Scratch rows of a chunk: divergence, pressure (then plus viscosity), hourglass coefficient, viscous pressure,
hourglass power, wave speed, nine weighted stresses (x, y, z force on the x, y, z faces), forces on four left and four
right corners, volume ratio; of a displaced mesh nine cofactors and nine of the velocity gradient."""


@inlined
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


@inlined
def _pressure(mass, fraction, energy, dx, last_dt, bulk, eos, viscosity, hourglass, s):
    """Pressure, hourglass coefficient, viscous pressure and wave speed of a chunk of cells."""
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
        shut = 1.0 if x > unloaded(eos, e) * volume * (1.0 + last_dt * s[RATE * W + i]) else full
        closing = shut * min(s[RATE * W + i], 0.0)
        broadening = linear * sound - quadratic * quadratic * dx * closing
        q = -density * dx * closing * broadening
        s[TOTAL * W + i] = p
        s[COEFFICIENT * W + i] = hourglass * bulk.density * x * sound * dx * dx / 64.0
        s[SHOCK * W + i] = q
        s[POWER * W + i] = 0.0
        # also of a full cell that does not close: a step that changes whenever one does puts energy in
        extra = shut * broadening
        fastest = extra + math.sqrt(sound * sound + extra * extra)
        s[SPEED * W + i] = fastest if x > 0.0 else 0.0


@inlined
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


@inlined
def _on_face(sxx, syy, szz, sxy, syz, sxz, x, y, z):
    """Return the force of a stress on a face with area vector (x, y, z)."""
    return sxx * x + sxy * y + sxz * z, sxy * x + syy * y + syz * z, sxz * x + syz * y + szz * z


@inlined
def _weigh_displaced(fraction, xx, yy, zz, xy, yz, xz, area, s):
    """As :func:`_weigh` on displaced faces: the total stress times their area vectors, sigma cof(F)."""
    for i in range(fraction.size):
        a = area * fraction[i]
        p = s[TOTAL * W + i]
        sxx, syy, szz = a * (xx[i] - p), a * (yy[i] - p), a * (zz[i] - p)
        sxy, syz, sxz = a * xy[i], a * yz[i], a * xz[i]
        s[STRESS * W + i], s[(STRESS + 3) * W + i], s[(STRESS + 6) * W + i] = _on_face(
            sxx, syy, szz, sxy, syz, sxz, s[COFACTOR * W + i], s[(COFACTOR + 3) * W + i], s[(COFACTOR + 6) * W + i])
        s[(STRESS + 1) * W + i], s[(STRESS + 4) * W + i], s[(STRESS + 7) * W + i] = _on_face(
            sxx, syy, szz, sxy, syz, sxz, s[(COFACTOR + 1) * W + i], s[(COFACTOR + 4) * W + i],
            s[(COFACTOR + 7) * W + i])
        s[(STRESS + 2) * W + i], s[(STRESS + 5) * W + i], s[(STRESS + 8) * W + i] = _on_face(
            sxx, syy, szz, sxy, syz, sxz, s[(COFACTOR + 2) * W + i], s[(COFACTOR + 5) * W + i],
            s[(COFACTOR + 8) * W + i])


@inlined
def _rate_displaced(n, c, g, volume, rate):
    """Velocity divergence (1/s) of ``n`` displaced cells: cof(F) : dv/dX (nine scratch rows each) over volume ratio."""
    for i in range(n):
        power = (c[i] * g[i] + c[W + i] * g[W + i] + c[2 * W + i] * g[2 * W + i]) + (
            c[3 * W + i] * g[3 * W + i] + c[4 * W + i] * g[4 * W + i] + c[5 * W + i] * g[5 * W + i]) + (
            c[6 * W + i] * g[6 * W + i] + c[7 * W + i] * g[7 * W + i] + c[8 * W + i] * g[8 * W + i])
        rate[i] = power / max(volume[i], LEAST_VOLUME)


@inlined
def _corner_forces(p00, p10, p01, p11, coefficient, stress, power, corners):
    """Forces of a chunk of cells on their eight corners in one component, into the scratch rows ``corners``.

    First the four left ones, then the four right ones. ``p``: that component of velocity on the node rows (j, k),
    (j+1, k), (j, k+1), (j+1, k+1); ``stress``: three scratch rows, the weighted stress on the x, y, z faces.
    Adds the hourglass dissipation (W) to row ``power``.
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
        k = coefficient[i]
        power[i] += k * (h1 * h1 + h2 * h2 + h3 * h3 + h4 * h4)
        h1, h2, h3, h4 = k * h1, k * h2, k * h3, k * h4
        x, y, z = stress[i], stress[W + i], stress[2 * W + i]
        corners[i] = (x + y + z) - (h1 + h2 + h3 - h4)
        corners[W + i] = (x - y + z) - (h2 - h1 - h3 + h4)
        corners[2 * W + i] = (x + y - z) - (h3 - h1 - h2 + h4)
        corners[3 * W + i] = (x - y - z) - (h1 - h2 - h3 - h4)
        corners[4 * W + i] = (y + z - x) - (h1 - h2 - h3 + h4)
        corners[5 * W + i] = (z - x - y) - (h3 - h1 - h2 - h4)
        corners[6 * W + i] = (y - x - z) - (h2 - h1 - h3 - h4)
        corners[7 * W + i] = -(x + y + z) - (h1 + h2 + h3 + h4)


@inlined
def _add_corners(f, left, right):
    """Add the corner forces of a chunk to one node row, right corners first.

    With this order every node of a row takes its two cells' shares in the same sequence wherever the row is cut.
    """
    n = f.size - 1
    f[n] += right[n - 1]
    for i in range(n - 1):
        f[i + 1] = (f[i + 1] + right[i]) + left[i + 1]
    f[0] += left[0]


@kernel
def nodal_forces(runs, count, window, owned, shape, dx, last_dt, bulk, eos, viscosity, hourglass, again,
                 mass, fraction, energy, stress, u, v, w, fx, fy, fz, displaced, way, x, y, z, gx, gy, gz, shock,
                 hourglass_power, closing, power_quantum, sums):
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
    again : forces at the end of a step: take the viscous pressure from ``shock``, where those at its start left it.
    mass, fraction, energy, stress : flat cell arrays; ``stress`` a tuple of six (Pa).
    u, v, w, fx, fy, fz : flat node arrays, velocity (m/s) and force (N).
    displaced, way, x, y, z, gx, gy, gz : whether the nodes are displaced since the last remap, by ``way`` times how
        much (in cells), and what the low faces of the cells have swept since.
    shock, hourglass_power, closing : flat node-shaped arrays that take, per cell, the viscous pressure (Pa), the power
        of hourglass control (W) and the velocity divergence (1/s), for the heat they become.
    sums : int64[1], power of hourglass control in units of ``power_quantum``.

    Returns the largest effective wave speed (m/s) over the owned cells with material, and its flat cell index.
    """
    ny, nx = shape
    scratch, nothing = np.empty(ROWS * W), np.zeros(W)
    s, mass, fraction, energy = borrowed(scratch), borrowed(mass), borrowed(fraction), borrowed(energy)
    corners, cof, g = s[CORNERS * W:], s[COFACTOR * W:], s[GRADIENT * W:]
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
                gradient(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], 0.25 / dx, g)
                gradient(v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m], 0.25 / dx, g[3 * W:])
                gradient(w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, g[6 * W:])
                gradient(x[a:a + m], x[b:b + m], x[c:c + m], x[d:d + m], 0.25 * way, cof)
                gradient(y[a:a + m], y[b:b + m], y[c:c + m], y[d:d + m], 0.25 * way, cof[3 * W:])
                gradient(z[a:a + m], z[b:b + m], z[c:c + m], z[d:d + m], 0.25 * way, cof[6 * W:])
                cofactors(n, cof)
                volume_ratios(gx[a:a + n], gx[a + 1:a + n + 1], gy[a:a + n], gy[b:b + n], gz[a:a + n], gz[c:c + n],
                              s[VOLUME * W:VOLUME * W + n])
                _rate_displaced(n, cof, g, s[VOLUME * W:], s[RATE * W:])
            else:
                _divergence(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], v[a:a + m], v[b:b + m], v[c:c + m],
                            v[d:d + m], w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, s)
                s[VOLUME * W:VOLUME * W + n] = 1.0
            f, end = fraction[cell:cell + n], cell + n
            e = energy[cell:end] if energy.size > 1 else nothing[:n]
            xx, yy, zz = stress[0][cell:end], stress[1][cell:end], stress[2][cell:end]
            xy, yz, xz = stress[3][cell:end], stress[4][cell:end], stress[5][cell:end]
            _pressure(mass[cell:end], f, e, dx, last_dt, bulk, eos, viscosity, hourglass, s)
            if again:
                s[SHOCK * W:SHOCK * W + n] = shock[a:a + n]
            surface_pressure(mass, f, xx, yy, zz, xy, yz, xz, cell, shape, s[TOTAL * W:], corners)
            for i in range(n):
                s[TOTAL * W + i] += s[SHOCK * W + i]
            if displaced:
                _weigh_displaced(f, xx, yy, zz, xy, yz, xz, area, s)
            else:
                _weigh(f, xx, yy, zz, xy, yz, xz, area, s)
            for axis in range(3):
                p, q = (u, fx) if axis == 0 else ((v, fy) if axis == 1 else (w, fz))
                row = STRESS + 3 * axis
                _corner_forces(p[a:a + m], p[b:b + m], p[c:c + m], p[d:d + m], s[COEFFICIENT * W:], s[row * W:],
                               s[POWER * W:], corners)
                _add_corners(q[a:a + m], corners, corners[4 * W:])
                _add_corners(q[b:b + m], corners[W:], corners[5 * W:])
                _add_corners(q[c:c + m], corners[2 * W:], corners[6 * W:])
                _add_corners(q[d:d + m], corners[3 * W:], corners[7 * W:])
            shock[a:a + n] = s[SHOCK * W:SHOCK * W + n]
            hourglass_power[a:a + n] = s[POWER * W:POWER * W + n]
            closing[a:a + n] = s[RATE * W:RATE * W + n]
            low, high = max(owned[4] - first, 0), min(owned[5] - first, n)
            if counts and high > low:
                for i in range(low, high):
                    sums[0] += np.int64(s[POWER * W + i] * per_quantum)
                at = place_of_largest(s[SPEED * W + low:SPEED * W + high], fastest)
                if at >= 0:
                    fastest, where = s[SPEED * W + low + at], cell + low + at
    scratch[0] = 0.0  # alive to here
    return fastest, where
