"""One directional sweep of the remap: any mass-weighted field of cells or nodes.

All updates are written in differences, q += [M_low (q_low - q) - M_high (q_high - q)] / m_new, so a
uniform field stays uniform to the last bit. Fields are updated in place; the mass fluxes of the whole
sweep are known before (:mod:`f2s_hpc.kernels.flux`). Cells move with the mass fluxes through their faces,
nodes with the dual fluxes, the mean of the faces around (Benson 1992, half-index shift).
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import inlined, kernel
from f2s_hpc.kernels.flux import axes_left

LEAST_MASS = 1e-13
"""Below this mass (in full cells or nodes) a quotient of masses is round-off: values are left as they are."""

LEAST_SLOPED = 1e-6
"""Cells and nodes lighter than this (in full ones) are void to the slopes of their neighbours."""


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


@inlined
def _ordered(along, a, b, c, d, e, f):
    """Return two up, up, donor, down, two down of a face from the six values around it, as the flow runs."""
    return a if along else f, b if along else e, c if along else d, d if along else c, e if along else b


@kernel
def _face_weights(smooth, second, moved, m0, m1, m2, m3, m4, m5, weights):
    """Weights of the four differences around the donor at each face of a row, into ``weights`` [4, n].

    The face carries the mean over the share n of the donor that moves, of the polynomial with the cell means around it:
    third order on three cells, fifth order on five where ``smooth`` asks for it and no wider neighbour is void
    (the upstream interpolations of Leonard 1991, Comput. Methods Appl. Mech. Eng. 88, 17).
    Rows: behind, ahead, far behind, far ahead. Zero in first order and where the donor or a neighbour is void:
    void has no slope. ``m0``..``m5``: masses of the three rows below and the three above the faces.
    """
    for i in range(moved.size):
        up2, up, donor, down, down2 = _ordered(moved[i] > 0.0, m0[i], m1[i], m2[i], m3[i], m4[i], m5[i])
        n = min(abs(moved[i]) / max(donor, 1e-300), 1.0)
        solid = second * (1.0 if min(up, down) > LEAST_SLOPED else 0.0)
        wide = smooth * solid * (1.0 if min(up2, down2) > LEAST_SLOPED else 0.0)
        narrow = (solid - wide) * (1.0 - n) / 6.0
        behind = 11.0 / 60.0 + n * (1.0 / 24.0 - n * (5.0 / 24.0 + n * (1.0 / 24.0 - n / 40.0)))
        ahead = 0.4 - n * (7.0 / 12.0 - n * (0.125 + n * (1.0 / 12.0 - n / 40.0)))
        weights[0, i] = narrow * (1.0 + n) + wide * behind
        weights[1, i] = narrow * (2.0 - n) + wide * ahead
        weights[2, i] = wide * (n * n * (1.0 / 24.0 - n * n / 120.0) - 1.0 / 30.0)
        weights[3, i] = wide * (n * (1.0 / 24.0 + n * (1.0 / 24.0 - n * (1.0 / 24.0 - n / 120.0))) - 0.05)


@kernel
def _limited_values(moved, weights, q1, q2, q3, q4, value):
    """Value that each face of a row carries, at third order, limited.

    The step from the donor's value stays below twice the smaller difference's and vanishes at an extremum, so
    mass-weighted fields cannot overshoot.
    """
    w_behind, w_ahead = weights[0], weights[1]
    for i in range(moved.size):
        along = moved[i] > 0.0
        a, b, c, d = q1[i], q2[i], q3[i], q4[i]
        up, donor, down = a if along else d, b if along else c, c if along else b
        behind, ahead = donor - up, down - donor
        most = 2.0 * (w_behind[i] + w_ahead[i]) * min(abs(behind), abs(ahead))
        step = min(max(w_behind[i] * behind + w_ahead[i] * ahead, -most), most)
        value[i] = donor + (step if behind * ahead > 0.0 else 0.0)


@kernel
def _smooth_values(moved, weights, q0, q1, q2, q3, q4, q5, value):
    """Velocity that each face of a row carries, at fifth order, not limited.

    A limiter flattens every extremum, and with it the kinetic energy of a particle a few cells wide: with van Leer's
    the remap lost two and a half times as much, with the bounds of Suresh and Huynh (1997) twice. At a jump the
    velocity rings a little instead; what kinetic energy that makes is taken out of the heat, as losses are put in.
    """
    w_behind, w_ahead, w_far_behind, w_far_ahead = weights[0], weights[1], weights[2], weights[3]
    for i in range(moved.size):
        up2, up, donor, down, down2 = _ordered(moved[i] > 0.0, q0[i], q1[i], q2[i], q3[i], q4[i], q5[i])
        value[i] = donor + ((w_behind[i] * (donor - up) + w_ahead[i] * (down - donor))
                            + (w_far_behind[i] * (up - up2) + w_far_ahead[i] * (down2 - down)))


@kernel
def _blend_row(field, low_moved, high_moved, low_value, high_value, inverse):
    """Update a row of a field in place, in differences."""
    for i in range(field.size):
        old = field[i]
        field[i] = old + (low_moved[i] * (low_value[i] - old) - high_moved[i] * (high_value[i] - old)) * inverse[i]


@kernel
def _blend_velocity(field, mass, low_moved, high_moved, low_value, high_value, inverse, lost):
    """Update a row of a velocity component in place, and add to ``lost`` the kinetic energy that the mixing took.

    Parts of mass m_i and velocity u_i merge to u: sum m_i (u_i - u)^2 / 2 is lost, exactly, whatever frame it is
    seen from (DeBar 1974, UCID-19683). In units of half full nodes (m/s)^2.
    """
    for i in range(field.size):
        old, low_in, high_in = field[i], low_moved[i], -high_moved[i]
        # in differences from the largest part, so that what flies in company keeps its velocity to the last bit
        most = low_value[i] if low_in >= high_in else high_value[i]
        base = old if mass[i] >= max(low_in, high_in) else most
        parts = mass[i] * (old - base) + low_in * (low_value[i] - base) + high_in * (high_value[i] - base)
        new = base + parts * inverse[i]
        low, high, kept = low_value[i] - new, high_value[i] - new, old - new
        field[i] = new
        lost[i] += mass[i] * kept * kept + (low_moved[i] * low * low - high_moved[i] * high * high)


@kernel
def _inverse_masses(masses, low_moved, high_moved, inverse):
    """One over the mass after the sweep, 0 where that is round-off."""
    for i in range(masses.size):
        new = masses[i] + (low_moved[i] - high_moved[i])
        inverse[i] = 1.0 / new if new > LEAST_MASS else 0.0


@kernel
def sweep_along_rows(runs, count, window, strides, moved_strides, second, memory, fields, masses, moved, lost):
    """Sweep along x the fields that start at ``fields`` (offsets into ``memory``).

    ``strides``, ``moved_strides``: (plane, row) strides of the fields and of the flux array; ``second``: 1.0 for
    slopes, 0.0 for first order; ``masses``: mass before the sweep, ``moved``: mass through the low side of each
    cell or node. ``lost``: array of the nodes' lost kinetic energy, which tells that the fields are velocities
    (fifth order, not limited); an array of one number for cells (third order, limited).
    """
    width = 0
    for r in range(count):
        width = max(width, runs[r, 3] - runs[r, 2] + 1)
    all_values, all_weights, all_inverses = np.empty(width), np.empty((4, width)), np.empty(width)
    velocities = lost.size > 1
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        n = last - first
        side = k * moved_strides[0] + j * moved_strides[1] + first
        here = k * strides[0] + j * strides[1] + first
        flow = moved[side:side + n + 1]
        value, weights, inverse = all_values[:n + 1], all_weights[:, :n + 1], all_inverses[:n]
        m = masses[here - 3:here + n + 3]
        _inverse_masses(m[3:n + 3], flow[:n], flow[1:], inverse)
        _face_weights(1.0 if velocities else 0.0, second, flow, m[:n + 1], m[1:n + 2], m[2:n + 3], m[3:n + 4],
                      m[4:n + 5], m[5:], weights)
        for f in range(fields.size):
            q = memory[fields[f] + here - 3:fields[f] + here + n + 3]
            if velocities:
                _smooth_values(flow, weights, q[:n + 1], q[1:n + 2], q[2:n + 3], q[3:n + 4], q[4:n + 5], q[5:], value)
                _blend_velocity(q[3:n + 3], m[3:n + 3], flow[:n], flow[1:], value[:n], value[1:], inverse,
                                lost[here:here + n])
            else:
                _limited_values(flow, weights, q[1:n + 2], q[2:n + 3], q[3:n + 4], q[4:n + 5], value)
                _blend_row(q[3:n + 3], flow[:n], flow[1:], value[:n], value[1:], inverse)


@kernel
def sweep_across_rows(columns, count, window, strides, moved_strides, second, memory, fields, masses, moved, lost):
    """Sweep along y or z, walking each column of blocks from row to row.

    ``columns``: (fixed index, first row, end row, i0, i1); ``window``: (fixed low, fixed end, row
    low, row end, i low, i end); ``strides``, ``moved_strides``: (stride of the fixed index, stride
    from row to row). Rows already updated live on in a buffer, so no field needs a second copy; the rest as in
    :func:`sweep_along_rows`.
    """
    width = 0
    for r in range(count):
        width = max(width, columns[r, 4] - columns[r, 3])
    values = np.empty((2, fields.size, width))
    previous = np.empty((3, fields.size, width))
    all_weights, all_inverses = np.empty((4, width)), np.empty(width)
    velocities = lost.size > 1
    row, moved_row = strides[1], moved_strides[1]
    for r in range(count):
        fixed = columns[r, 0]
        if fixed < window[0] or fixed >= window[1]:
            continue
        t0, t1 = max(columns[r, 1], window[2]), min(columns[r, 2], window[3])
        i0, i1 = max(columns[r, 3], window[4]), min(columns[r, 4], window[5])
        if t1 <= t0 or i1 <= i0:
            continue
        n = i1 - i0
        weights, inverse = all_weights[:, :n], all_inverses[:n]
        for t in range(t0 - 1, t1):
            here = fixed * strides[0] + t * row + i0
            side = fixed * moved_strides[0] + t * moved_row + i0
            low, high = moved[side:side + n], moved[side + moved_row:side + moved_row + n]
            _face_weights(1.0 if velocities else 0.0, second, high, masses[here - 2 * row:here - 2 * row + n],
                          masses[here - row:here - row + n], masses[here:here + n],
                          masses[here + row:here + row + n], masses[here + 2 * row:here + 2 * row + n],
                          masses[here + 3 * row:here + 3 * row + n], weights)
            _inverse_masses(masses[here:here + n], low, high, inverse)
            new, old = t % 2, (t + 1) % 2
            for f in range(fields.size):
                a = fields[f] + here
                field = memory[a:a + n]
                # below the first row nothing was updated: its old values still stand
                below = previous[(t - 1) % 3, f, :n] if t >= t0 else memory[a - row:a - row + n]
                above, above2 = memory[a + row:a + row + n], memory[a + 2 * row:a + 2 * row + n]
                if velocities:
                    below2 = previous[(t - 2) % 3, f, :n] if t > t0 else memory[a - 2 * row:a - 2 * row + n]
                    _smooth_values(high, weights, below2, below, field, above, above2,
                                   memory[a + 3 * row:a + 3 * row + n], values[new, f, :n])
                else:
                    _limited_values(high, weights, below, field, above, above2, values[new, f, :n])
                previous[t % 3, f, :n] = field
                if t >= t0 and velocities:
                    _blend_velocity(field, masses[here:here + n], low, high, values[old, f, :n], values[new, f, :n],
                                    inverse, lost[here:here + n])
                elif t >= t0:
                    _blend_row(field, low, high, values[old, f, :n], values[new, f, :n], inverse)


@kernel
def sweep_mass(runs, count, window, shape, axis, done, gx, gy, gz, flux, mass_flux, mass, fraction):
    """Move mass and material volume of the owned cells through their two faces along ``axis``.

    The volume fraction refers to the cell's volume after this sweep.
    """
    ny, nx = shape
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    step = 1 if axis == 0 else (row1 if axis == 1 else plane1)
    ax, ay, az = axes_left(done)
    bx, by, bz = axes_left(done | (1 << axis))
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        face, cell = (k * (ny + 1) + j) * (nx + 1), (k * ny + j) * nx
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n, c = face + i, cell + i
            dx, dy, dz = gx[n + 1] - gx[n], gy[n + row1] - gy[n], gz[n + plane1] - gz[n]
            before = 1.0 + ax * dx + ay * dy + az * dz
            after = 1.0 + bx * dx + by * dy + bz * dz
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
                    sums[0] += np.int64(math.floor(x / mass_quantum + 0.5))
                mass[c] = 0.0
                fraction[c] = 0.0
                for f in range(fields.size):
                    memory[fields[f] + c] = 0.0
