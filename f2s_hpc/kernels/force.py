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
def mean_divergence(u, v, w, a, b, c, d, i):
    """Return 4 dx times the velocity divergence of cell ``i``.

    ``a``, ``b``, ``c``, ``d``: flat starts of the four node rows (j, k), (j+1, k), (j, k+1),
    (j+1, k+1). Differences of equal numbers are exactly zero, so a rigid body feels nothing.
    """
    du = (u[a + i + 1] - u[a + i]) + (u[b + i + 1] - u[b + i]) + (u[c + i + 1] - u[c + i]) + (u[d + i + 1] - u[d + i])
    dv = (v[b + i] - v[a + i]) + (v[b + i + 1] - v[a + i + 1]) + (v[d + i] - v[c + i]) + (v[d + i + 1] - v[c + i + 1])
    dw = (w[c + i] - w[a + i]) + (w[c + i + 1] - w[a + i + 1]) + (w[d + i] - w[b + i]) + (w[d + i + 1] - w[b + i + 1])
    return du + dv + dw


@kernel
def _row_stress(mass, fraction, energy, stress, u, v, w, cell, rows, first, last, dx, bulk, eos, viscosity, hourglass,
                weighted, coefficient, viscous, speed):
    """Fill the row buffers of one run: weighted stress, hourglass coefficient, viscous power, wave speed."""
    a, b, c, d = rows
    linear, quadratic = viscosity
    area = 0.25 * dx * dx
    for i in range(first, last):
        n = i - first
        f = fraction[cell + i]
        x = mass[cell + i]
        e = energy[cell + i] if energy.size > 1 else 0.0
        full = 1.0 if f >= 1.0 else 0.0
        compression = x if f >= 1.0 else 1.0
        p = full * pressure(eos, compression, e)
        density = bulk.density * compression
        sound = math.sqrt((stiffness(eos, compression, e) + 4.0 / 3.0 * bulk.shear_modulus) / density)
        rate = mean_divergence(u, v, w, a, b, c, d, i) / (4.0 * dx)
        closing = full * min(rate, 0.0)
        broadening = linear * sound - quadratic * quadratic * dx * closing
        q = -density * dx * closing * broadening
        weighted[0, n] = area * f * (stress[0][cell + i] - p - q)
        weighted[1, n] = area * f * (stress[1][cell + i] - p - q)
        weighted[2, n] = area * f * (stress[2][cell + i] - p - q)
        weighted[3, n] = area * f * stress[3][cell + i]
        weighted[4, n] = area * f * stress[4][cell + i]
        weighted[5, n] = area * f * stress[5][cell + i]
        coefficient[n] = hourglass * bulk.density * x * sound * dx * dx / 64.0
        viscous[n] = -f * q * closing * dx * dx * dx
        extra = broadening if closing < 0.0 else 0.0
        speed[n] = extra + math.sqrt(sound * sound + extra * extra) if x > 0.0 else 0.0


@kernel
def _row_component(p, force, rows, first, last, sx, sy, sz, coefficient, right, power):
    """Add one component's forces of a run of cells to the four node rows around it.

    ``sx``, ``sy``, ``sz``: weighted stress on the x, y, z faces in this component. ``power``
    collects the hourglass dissipation (W). The forces on the right-hand nodes wait in ``right``
    and are added in a second loop, so that both loops vectorise.
    """
    a, b, c, d = rows
    for i in range(first, last):
        n = i - first
        s00 = p[a + i] + p[a + i + 1]
        d00 = p[a + i + 1] - p[a + i]
        s10 = p[b + i] + p[b + i + 1]
        d10 = p[b + i + 1] - p[b + i]
        s01 = p[c + i] + p[c + i + 1]
        d01 = p[c + i + 1] - p[c + i]
        s11 = p[d + i] + p[d + i + 1]
        d11 = p[d + i + 1] - p[d + i]
        h1 = (s00 - s10) + (s11 - s01)
        h2 = (d01 - d00) + (d11 - d10)
        h3 = (d10 - d00) + (d11 - d01)
        h4 = (d00 - d10) + (d11 - d01)
        k = coefficient[n]
        power[n] += k * (h1 * h1 + h2 * h2 + h3 * h3 + h4 * h4)
        h1, h2, h3, h4 = k * h1, k * h2, k * h3, k * h4
        x, y, z = sx[n], sy[n], sz[n]
        force[a + i] += (x + y + z) - (h1 + h2 + h3 - h4)
        right[0, n] = (y + z - x) - (h1 - h2 - h3 + h4)
        force[b + i] += (x - y + z) - (h2 - h1 - h3 + h4)
        right[1, n] = (z - x - y) - (h3 - h1 - h2 - h4)
        force[c + i] += (x + y - z) - (h3 - h1 - h2 + h4)
        right[2, n] = (y - x - z) - (h2 - h1 - h3 - h4)
        force[d + i] += (x - y - z) - (h1 - h2 - h3 - h4)
        right[3, n] = -(x + y + z) - (h1 + h2 + h3 + h4)
    for row in range(4):
        start = rows[row]
        for i in range(first, last):
            force[start + i + 1] += right[row, i - first]


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
    weighted, right = np.empty((6, width)), np.empty((4, width))
    coefficient, viscous, power, speed = np.empty(width), np.empty(width), np.empty(width), np.empty(width)
    fastest, where = 0.0, 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        cell = (k * ny + j) * nx
        a = (k * (ny + 1) + j) * (nx + 1)
        rows = (a, a + nx + 1, a + (ny + 1) * (nx + 1), a + (ny + 2) * (nx + 1))
        _row_stress(mass, fraction, energy, stress, u, v, w, cell, rows, first, last, dx, bulk, eos, viscosity,
                    hourglass, weighted, coefficient, viscous, speed)
        power[:last - first] = 0.0
        _row_component(u, fx, rows, first, last, weighted[0], weighted[3], weighted[5], coefficient, right, power)
        _row_component(v, fy, rows, first, last, weighted[3], weighted[1], weighted[4], coefficient, right, power)
        _row_component(w, fz, rows, first, last, weighted[5], weighted[4], weighted[2], coefficient, right, power)
        if k < owned[0] or k >= owned[1] or j < owned[2] or j >= owned[3]:
            continue
        for i in range(max(first, owned[4]), min(last, owned[5])):
            sums[0] += np.int64(viscous[i - first] / power_quantum)
            sums[1] += np.int64(power[i - first] / power_quantum)
            if not speed[i - first] <= fastest:
                fastest, where = speed[i - first], cell + i
    return fastest, where
