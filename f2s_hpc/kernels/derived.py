"""Quantities that are shown but not stored: pressure, von Mises stress, speed."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.materials.pressure import pressure, stored_energy


@kernel
def cell_pressure(eos, mass, fraction, energy, out):
    """Write the pressure (Pa) of each full cell into ``out``, zero before. All arrays flat."""
    for c in range(mass.size):
        if fraction[c] >= 1.0 and mass[c] > 0.0:
            out[c] = pressure(eos, mass[c], energy[c] if energy.size > 1 else 0.0)


@kernel
def cell_von_mises(stress, out):
    """Write the von Mises stress (Pa) of each cell into ``out``, zero before: six deviatoric components (flat arrays).
    """
    for c in range(out.size):
        normal = stress[0][c] ** 2 + stress[1][c] ** 2 + stress[2][c] ** 2
        shear = stress[3][c] ** 2 + stress[4][c] ** 2 + stress[5][c] ** 2
        if not normal + 2.0 * shear == 0.0:  # what is not written takes no memory; what is not finite is seen
            out[c] = math.sqrt(1.5 * (normal + 2.0 * shear))


@kernel
def cell_speed(shape, mass, u, v, w, out):
    """Write the speed (m/s) of each cell that holds material into ``out``, zero before.

    It is the norm of the mean velocity of its eight nodes. ``shape``: (nz, ny, nx) of the cell array, ghosts included;
    the outermost layer is left at zero.
    """
    nz, ny, nx = shape
    row, plane = nx + 1, (nx + 1) * (ny + 1)
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                c = (k * ny + j) * nx + i
                if mass[c] <= 0.0:
                    continue
                n = (k * (ny + 1) + j) * (nx + 1) + i
                square = 0.0
                for p in (u, v, w):
                    mean = 0.125 * (((p[n] + p[n + 1]) + (p[n + row] + p[n + row + 1]))
                                    + ((p[n + plane] + p[n + plane + 1])
                                       + (p[n + plane + row] + p[n + plane + row + 1])))
                    square += mean * mean
                out[c] = math.sqrt(square)


@kernel
def elastic_energy(runs, count, window, shape, bulk, eos, mass, fraction, stress, volume, quantum):
    """Return the elastic energy of the owned cells in units of ``quantum`` (J), an exact integer sum.

    Shape: VF s:s / 4G; volume: the energy stored by the pressure in full cells. ``volume``: of a cell (m3).
    """
    ny, nx = shape
    total = np.int64(0)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell = (k * ny + j) * nx
        for c in range(cell + max(runs[r, 2], window[4]), cell + min(runs[r, 3], window[5])):
            if mass[c] <= 0.0:
                continue
            shear = stress[3][c] ** 2 + stress[4][c] ** 2 + stress[5][c] ** 2
            shape_energy = stress[0][c] ** 2 + stress[1][c] ** 2 + stress[2][c] ** 2 + 2.0 * shear
            energy = fraction[c] * shape_energy / (4.0 * bulk.shear_modulus)
            if fraction[c] >= 1.0:
                energy += mass[c] * stored_energy(eos, mass[c])
            total += np.int64(energy * volume / quantum)
    return total
