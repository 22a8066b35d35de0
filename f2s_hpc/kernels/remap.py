"""One directional sweep of the remap: any mass-weighted field of cells or nodes.

All updates are written in differences, q += [M_low (q_low - q) - M_high (q_high - q)] / m_new, so a
uniform field stays uniform to the last bit. Fields are updated in place; the mass fluxes of the whole
sweep are known before (:mod:`f2s_hpc.kernels.flux`). Cells move with the mass fluxes through their faces,
nodes with the dual fluxes, the mean of the faces around (Benson 1992, half-index shift).
"""

from __future__ import annotations

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.kernels.flux import limited_slope, pre_volume

LEAST_MASS = 1e-13
"""Below this mass (in full cells or nodes) a quotient of masses is round-off: values are left as they are."""


@kernel
def nodal_masses(runs, count, window, shape, mass, nodal):
    """Mass of each node in full nodes, the mean of its eight cells, for nodes of ``window``."""
    ny, nx = shape
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        a = ((k - 1) * ny + j - 1) * nx
        b = a + nx
        c = a + ny * nx
        d = c + nx
        row = (k * (ny + 1) + j) * (nx + 1)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            nodal[row + i] = 0.125 * (((mass[a + i - 1] + mass[a + i]) + (mass[b + i - 1] + mass[b + i]))
                                      + ((mass[c + i - 1] + mass[c + i]) + (mass[d + i - 1] + mass[d + i])))


@kernel
def dual_fluxes(runs, count, window, shape, axis, mass_flux, dual):
    """Mass (in full nodes) that moves from node n - step to node n along ``axis``, into ``dual[n]``.

    The dual face cuts the four cells between the two nodes in half: each passes the mean of the
    fluxes through its two faces, a quarter of it to this pair of nodes.
    """
    ny, nx = shape
    strides = (1, nx + 1, (nx + 1) * (ny + 1))
    step, p, q = strides[axis], strides[(axis + 1) % 3], strides[(axis + 2) % 3]
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        for n in range(row + max(runs[r, 2], window[4]), row + min(runs[r, 3], window[5])):
            a = n - step
            dual[n] = 0.125 * (
                ((mass_flux[a] + mass_flux[n]) + (mass_flux[a - p] + mass_flux[n - p]))
                + ((mass_flux[a - q] + mass_flux[n - q]) + (mass_flux[a - p - q] + mass_flux[n - p - q])))


@kernel
def _carried(second, moved, up, donor, down, mass_up, mass_donor, mass_down):
    """Value carried through a face: the donor's, plus a limited slope where both neighbours hold material."""
    share = min(abs(moved) / max(mass_donor, 1e-300), 1.0)
    slope = limited_slope(donor - up, down - donor)
    solid = second == 1 and mass_up > 0.0 and mass_down > 0.0
    return donor + (0.5 * (1.0 - share) * slope if solid else 0.0)


@kernel
def sweep_along_rows(runs, count, window, strides, moved_strides, second, memory, fields, masses, moved):
    """Sweep along x the fields that start at ``fields`` (offsets into ``memory``).

    ``strides``, ``moved_strides``: (plane, row) strides of the fields and of the flux array;
    ``masses``: mass before the sweep, ``moved``: mass through the low side of each cell or node.
    """
    width = 0
    for r in range(count):
        width = max(width, runs[r, 3])
    value, inverse = np.empty(width + 1), np.empty(width)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        side = k * moved_strides[0] + j * moved_strides[1]
        here = k * strides[0] + j * strides[1]
        for i in range(first, last):
            new = masses[here + i] + (moved[side + i] - moved[side + i + 1])
            inverse[i] = 1.0 / new if new > LEAST_MASS else 0.0
        for f in range(fields.size):
            base = fields[f] + here
            for i in range(first, last + 1):
                m = moved[side + i]
                d, up, down = (i - 1, i - 2, i) if m > 0.0 else (i, i + 1, i - 1)
                value[i] = _carried(second, m, memory[base + up], memory[base + d], memory[base + down],
                                    masses[here + up], masses[here + d], masses[here + down])
            for i in range(first, last):
                old = memory[base + i]
                memory[base + i] = old + (moved[side + i] * (value[i] - old)
                                          - moved[side + i + 1] * (value[i + 1] - old)) * inverse[i]


@kernel
def sweep_across_rows(columns, count, window, strides, moved_strides, second, memory, fields, masses, moved):
    """Sweep along y or z, walking each column of blocks from row to row.

    ``columns``: (fixed index, first row, end row, i0, i1); ``window``: (fixed low, fixed end, row
    low, row end, i low, i end); ``strides``, ``moved_strides``: (stride of the fixed index, stride
    from row to row). Rows already updated live on in a buffer, so no field needs a second copy.
    """
    width = 0
    for r in range(count):
        width = max(width, columns[r, 4])
    low_value, previous = np.empty((fields.size, width)), np.empty((fields.size, width))
    high_value, inverse = np.empty(width), np.empty(width)
    row, moved_row = strides[1], moved_strides[1]
    for r in range(count):
        fixed = columns[r, 0]
        if fixed < window[0] or fixed >= window[1]:
            continue
        t0, t1 = max(columns[r, 1], window[2]), min(columns[r, 2], window[3])
        i0, i1 = max(columns[r, 3], window[4]), min(columns[r, 4], window[5])
        if t1 <= t0 or i1 <= i0:
            continue
        for t in range(t0 - 1, t1):
            here = fixed * strides[0] + t * row
            low = fixed * moved_strides[0] + t * moved_row
            high = low + moved_row
            for i in range(i0, i1):
                new = masses[here + i] + (moved[low + i] - moved[high + i])
                inverse[i] = 1.0 / new if new > LEAST_MASS and t >= t0 else 0.0
            for f in range(fields.size):
                base = fields[f] + here
                if t < t0:
                    for i in range(i0, i1):
                        previous[f, i] = memory[base - row + i]
                        low_value[f, i] = 0.0
                for i in range(i0, i1):
                    m = moved[high + i]
                    ahead = m > 0.0
                    up = previous[f, i] if ahead else memory[base + 2 * row + i]
                    mass_up = masses[here - row + i] if ahead else masses[here + 2 * row + i]
                    a, b = memory[base + i], memory[base + row + i]
                    mass_a, mass_b = masses[here + i], masses[here + row + i]
                    high_value[i] = _carried(second, m, up, a if ahead else b, b if ahead else a, mass_up,
                                             mass_a if ahead else mass_b, mass_b if ahead else mass_a)
                for i in range(i0, i1):
                    old = memory[base + i]
                    previous[f, i] = old
                    memory[base + i] = old + (moved[low + i] * (low_value[f, i] - old)
                                              - moved[high + i] * (high_value[i] - old)) * inverse[i]
                    low_value[f, i] = high_value[i]


@kernel
def sweep_mass(runs, count, window, shape, axis, done, gx, gy, gz, flux, mass_flux, mass, fraction):
    """Move mass and material volume of the owned cells through their two faces along ``axis``.

    The volume fraction refers to the cell's volume after this sweep.
    """
    ny, nx = shape
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    step = 1 if axis == 0 else (row1 if axis == 1 else plane1)
    bit = 1 << axis
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        face, cell = (k * (ny + 1) + j) * (nx + 1), (k * ny + j) * nx
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n, c = face + i, cell + i
            before = pre_volume(gx, gy, gz, n, axis, done, row1, plane1)
            after = pre_volume(gx, gy, gz, n, axis, done | bit, row1, plane1)
            material = fraction[c] * before + (flux[n] - flux[n + step])
            fraction[c] = min(max(material / after, 0.0), 1.0)
            mass[c] += mass_flux[n] - mass_flux[n + step]


@kernel
def close_cells(runs, count, window, shape, dust, spall, full, eos_pressure, mass, fraction, memory, fields,
                mass_quantum, sums):
    """Finish the remap: settle each cell's volume fraction, and clear what is dust or void.

    A cell that holds its full mass is full; one that was full and bears less tension than ``spall``
    (``eos_pressure``: bulk modulus, Pa) stays full; in all others material is at zero pressure and the
    volume fraction is the mass. A cell with less than ``dust`` (in full cells) is emptied, its mass counted in
    ``sums[0]`` (units of ``mass_quantum``, kg per full cell) and all its fields set to zero.
    """
    ny, nx = shape
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell = (k * ny + j) * nx
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            c = cell + i
            x = mass[c]
            if x >= 1.0:
                fraction[c] = 1.0
            elif x > dust:
                holds = fraction[c] >= full and eos_pressure * (x - 1.0) > -spall
                fraction[c] = 1.0 if holds else x
            else:
                if x != 0.0:
                    sums[0] += np.int64(x / mass_quantum)
                mass[c] = 0.0
                fraction[c] = 0.0
                for f in range(fields.size):
                    memory[fields[f] + c] = 0.0
