"""One directional sweep of the remap: any mass-weighted field of cells or nodes.

All updates are written in differences, q += [M_low (q_low - q) - M_high (q_high - q)] / m_new, so a
uniform field stays uniform to the last bit. Fields are updated in place; the mass fluxes of the whole
sweep are known before (:mod:`f2s_hpc.kernels.flux`). Cells move with the mass fluxes through their faces,
nodes with the dual fluxes, the mean of the faces around (Benson 1992, half-index shift).
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.flux import axes_left
from f2s_hpc.materials.pressure import pressure, unloaded

LEAST_MASS = 1e-13
"""Below this mass (in full cells or nodes) a quotient of masses is round-off: values are left as they are."""

LEAST_SLOPED = 1e-6
"""Cells and nodes lighter than this (in full ones) are void to the slopes of their neighbours."""


@inlined
def _mean_of_corners(a, b, c, d, out):
    """Mean of eight values around each point of a row; ``a``..``d``: the four rows around it, each one longer."""
    for i in range(out.size):
        out[i] = 0.125 * (((a[i] + a[i + 1]) + (b[i] + b[i + 1])) + ((c[i] + c[i + 1]) + (d[i] + d[i + 1])))


@kernel
def nodal_masses(runs, count, window, shape, mass, nodal):
    """Mass of each node in full nodes, the mean of its eight cells, for nodes of ``window``."""
    ny, nx = shape
    mass, nodal = borrowed(mass), borrowed(nodal)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, n = max(runs[r, 2], window[4]), min(runs[r, 3], window[5]) - max(runs[r, 2], window[4])
        if n <= 0:
            continue
        a = ((k - 1) * ny + j - 1) * nx + first - 1
        b, c, d = a + nx, a + ny * nx, a + ny * nx + nx
        row = (k * (ny + 1) + j) * (nx + 1) + first
        _mean_of_corners(mass[a:a + n + 1], mass[b:b + n + 1], mass[c:c + n + 1], mass[d:d + n + 1],
                         nodal[row:row + n])


@inlined
def _mean_of_faces(a0, a1, a2, a3, b0, b1, b2, b3, out):
    """Mean of eight rows."""
    for i in range(out.size):
        out[i] = 0.125 * (((a0[i] + b0[i]) + (a1[i] + b1[i])) + ((a2[i] + b2[i]) + (a3[i] + b3[i])))


@kernel
def dual_fluxes(runs, count, window, shape, axis, mass_flux, dual):
    """Mass (in full nodes) that moves from node n - step to node n along ``axis``, into ``dual[n]``.

    The dual face cuts the four cells between the two nodes in half: each passes the mean of the
    fluxes through its two faces, a quarter of it to this pair of nodes.
    """
    ny, nx = shape
    strides = (1, nx + 1, (nx + 1) * (ny + 1))
    step, p, q = strides[axis], strides[(axis + 1) % 3], strides[(axis + 2) % 3]
    mass_flux, dual = borrowed(mass_flux), borrowed(dual)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        b = (k * (ny + 1) + j) * (nx + 1) + first
        a, n = b - step, last - first
        _mean_of_faces(mass_flux[a:a + n], mass_flux[a - p:a - p + n], mass_flux[a - q:a - q + n],
                       mass_flux[a - p - q:a - p - q + n], mass_flux[b:b + n], mass_flux[b - p:b - p + n],
                       mass_flux[b - q:b - q + n], mass_flux[b - p - q:b - p - q + n], dual[b:b + n])


@inlined
def _ordered(along, a, b, c, d, e, f):
    """Return two up, up, donor, down, two down of a face from the six values around it, as the flow runs."""
    return a if along else f, b if along else e, c if along else d, d if along else c, e if along else b


@inlined
def _face_weights(smooth, second, moved, m0, m1, m2, m3, m4, m5, w_behind, w_ahead, w_far_behind, w_far_ahead):
    """Weights of the four differences around the donor at each face of a row.

    The face carries the mean over the share n of the donor that moves, of the polynomial with the cell means around it:
    third order on three cells, fifth order on five where ``smooth`` asks for it and no wider neighbour is void
    (the upstream interpolations of Leonard 1991, Comput. Methods Appl. Mech. Eng. 88, 17).
    Zero in first order and where the donor or a neighbour is void: void has no slope. ``m0``..``m5``: masses of the
    three rows below and the three above the faces.
    """
    for i in range(moved.size):
        up2, up, donor, down, down2 = _ordered(moved[i] > 0.0, m0[i], m1[i], m2[i], m3[i], m4[i], m5[i])
        n = min(abs(moved[i]) / max(donor, 1e-300), 1.0)
        solid = second * (1.0 if min(up, down) > LEAST_SLOPED else 0.0)
        wide = smooth * solid * (1.0 if min(up2, down2) > LEAST_SLOPED else 0.0)
        narrow = (solid - wide) * (1.0 - n) / 6.0
        behind = 11.0 / 60.0 + n * (1.0 / 24.0 - n * (5.0 / 24.0 + n * (1.0 / 24.0 - n / 40.0)))
        ahead = 0.4 - n * (7.0 / 12.0 - n * (0.125 + n * (1.0 / 12.0 - n / 40.0)))
        w_behind[i] = narrow * (1.0 + n) + wide * behind
        w_ahead[i] = narrow * (2.0 - n) + wide * ahead
        w_far_behind[i] = wide * (n * n * (1.0 / 24.0 - n * n / 120.0) - 1.0 / 30.0)
        w_far_ahead[i] = wide * (n * (1.0 / 24.0 + n * (1.0 / 24.0 - n * (1.0 / 24.0 - n / 120.0))) - 0.05)


@inlined
def _limited_values(moved, w_behind, w_ahead, q1, q2, q3, q4, value):
    """Value that each face of a row carries, at third order, limited.

    The step from the donor's value stays below twice the smaller difference's and vanishes at an extremum, so
    mass-weighted fields cannot overshoot.
    """
    for i in range(moved.size):
        along = moved[i] > 0.0
        a, b, c, d = q1[i], q2[i], q3[i], q4[i]
        up, donor, down = a if along else d, b if along else c, c if along else b
        behind, ahead = donor - up, down - donor
        most = 2.0 * (w_behind[i] + w_ahead[i]) * min(abs(behind), abs(ahead))
        step = min(max(w_behind[i] * behind + w_ahead[i] * ahead, -most), most)
        value[i] = donor + (step if behind * ahead > 0.0 else 0.0)


@inlined
def _smooth_values(moved, w_behind, w_ahead, w_far_behind, w_far_ahead, q0, q1, q2, q3, q4, q5, value):
    """Velocity that each face of a row carries, at fifth order, not limited.

    A limiter flattens every extremum, and with it the kinetic energy of a particle a few cells wide: with van Leer's
    the remap lost two and a half times as much, with the bounds of Suresh and Huynh (1997) twice. At a jump the
    velocity rings a little instead; what kinetic energy that makes is taken out of the heat, as losses are put in.
    """
    for i in range(moved.size):
        up2, up, donor, down, down2 = _ordered(moved[i] > 0.0, q0[i], q1[i], q2[i], q3[i], q4[i], q5[i])
        value[i] = donor + ((w_behind[i] * (donor - up) + w_ahead[i] * (down - donor))
                            + (w_far_behind[i] * (up - up2) + w_far_ahead[i] * (down2 - down)))


@inlined
def _blend_row(field, low_moved, high_moved, low_value, high_value, inverse):
    """Update a row of a field in place, in differences."""
    for i in range(field.size):
        old = field[i]
        field[i] = old + (low_moved[i] * (low_value[i] - old) - high_moved[i] * (high_value[i] - old)) * inverse[i]


@inlined
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


@inlined
def _inverse_masses(masses, low_moved, high_moved, inverse):
    """One over the mass after the sweep, 0 where that is round-off."""
    for i in range(masses.size):
        new = masses[i] + (low_moved[i] - high_moved[i])
        inverse[i] = 1.0 / new if new > LEAST_MASS else 0.0


@kernel
def _longest(list_, count, first, end):
    """Return the largest extent of the listed runs or columns; ``first``, ``end``: where their bounds stand."""
    width = 0
    for r in range(count):
        width = max(width, list_[r, end] - list_[r, first])
    return width


@kernel
def sweep_along_rows(runs, count, window, strides, moved_strides, second, memory, fields, masses, moved, lost):
    """Sweep along x the fields that start at ``fields`` (offsets into ``memory``).

    ``strides``, ``moved_strides``: (plane, row) strides of the fields and of the flux array; ``second``: 1.0 for
    slopes, 0.0 for first order; ``masses``: mass before the sweep, ``moved``: mass through the low side of each
    cell or node. ``lost``: the nodes' lost kinetic energy, if the fields are velocities (fifth order, not limited);
    None for cells (third order, limited).
    """
    width = _longest(runs, count, 2, 3) + 1
    scratch = np.empty(6 * width)
    # (flat rows, each of known unit stride: of a slice of a matrix the compiler does not know that)
    value, inverse = borrowed(scratch[:width]), borrowed(scratch[width:2 * width])
    w0, w1 = borrowed(scratch[2 * width:3 * width]), borrowed(scratch[3 * width:4 * width])
    w2, w3 = borrowed(scratch[4 * width:5 * width]), borrowed(scratch[5 * width:])
    memory, masses, moved = borrowed(memory), borrowed(masses), borrowed(moved)
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
        m = masses[here - 3:here + n + 3]
        _inverse_masses(m[3:n + 3], flow[:n], flow[1:], inverse[:n])
        _face_weights(0.0 if lost is None else 1.0, second, flow, m[:n + 1], m[1:n + 2], m[2:n + 3], m[3:n + 4],
                      m[4:n + 5], m[5:], w0, w1, w2, w3)
        for f in range(fields.size):
            q = memory[fields[f] + here - 3:fields[f] + here + n + 3]
            if lost is not None:
                _smooth_values(flow, w0, w1, w2, w3, q[:n + 1], q[1:n + 2], q[2:n + 3], q[3:n + 4], q[4:n + 5], q[5:],
                               value)
                _blend_velocity(q[3:n + 3], m[3:n + 3], flow[:n], flow[1:], value[:n], value[1:n + 1], inverse,
                                lost[here:here + n])
            else:
                _limited_values(flow, w0, w1, q[1:n + 2], q[2:n + 3], q[3:n + 4], q[4:n + 5], value)
                _blend_row(q[3:n + 3], flow[:n], flow[1:], value[:n], value[1:n + 1], inverse)
    scratch[0] = 0.0  # alive to here


@kernel
def sweep_across_rows(columns, count, window, strides, moved_strides, second, memory, fields, masses, moved, lost):
    """Sweep along y or z, walking each column of blocks from row to row.

    ``columns``: (fixed index, first row, end row, i0, i1); ``window``: (fixed low, fixed end, row
    low, row end, i low, i end); ``strides``, ``moved_strides``: (stride of the fixed index, stride
    from row to row). Rows already updated live on in a buffer, so no field needs a second copy; the rest as in
    :func:`sweep_along_rows`.
    """
    width = _longest(columns, count, 3, 4)
    scratch = np.empty((5 + 5 * fields.size) * width)
    w0, w1 = borrowed(scratch[:width]), borrowed(scratch[width:2 * width])
    w2, w3 = borrowed(scratch[2 * width:3 * width]), borrowed(scratch[3 * width:4 * width])
    inverse, buffer = borrowed(scratch[4 * width:5 * width]), borrowed(scratch[5 * width:])
    between = fields.size * width
    memory, masses, moved = borrowed(memory), borrowed(masses), borrowed(moved)
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
        for t in range(t0 - 1, t1):
            here = fixed * strides[0] + t * row + i0
            side = fixed * moved_strides[0] + t * moved_row + i0
            low, high = moved[side:side + n], moved[side + moved_row:side + moved_row + n]
            m = masses[here:here + n]
            _face_weights(0.0 if lost is None else 1.0, second, high, masses[here - 2 * row:here - 2 * row + n],
                          masses[here - row:here - row + n], m, masses[here + row:here + row + n],
                          masses[here + 2 * row:here + 2 * row + n], masses[here + 3 * row:here + 3 * row + n],
                          w0, w1, w2, w3)
            _inverse_masses(m, low, high, inverse)
            new, old = (t % 2) * between, ((t + 1) % 2) * between
            now, last, last2 = (2 + t % 3) * between, (2 + (t - 1) % 3) * between, (2 + (t - 2) % 3) * between
            for f in range(fields.size):
                a, o = fields[f] + here, f * width
                field = memory[a:a + n]
                # below the first row nothing was updated: its old values still stand
                below = buffer[last + o:last + o + n] if t >= t0 else memory[a - row:a - row + n]
                above, above2 = memory[a + row:a + row + n], memory[a + 2 * row:a + 2 * row + n]
                entering, leaving = buffer[old + o:old + o + n], buffer[new + o:new + o + n]
                if lost is not None:
                    below2 = buffer[last2 + o:last2 + o + n] if t > t0 else memory[a - 2 * row:a - 2 * row + n]
                    _smooth_values(high, w0, w1, w2, w3, below2, below, field, above, above2,
                                   memory[a + 3 * row:a + 3 * row + n], leaving)
                else:
                    _limited_values(high, w0, w1, below, field, above, above2, leaving)
                buffer[now + o:now + o + n] = field
                if t < t0:
                    continue
                if lost is not None:
                    _blend_velocity(field, m, low, high, entering, leaving, inverse, lost[here:here + n])
                else:
                    _blend_row(field, low, high, entering, leaving, inverse)
    scratch[0] = 0.0  # alive to here


@inlined
def _move_mass(left_x, left_y, left_z, gx0, gx1, gy0, gy1, gz0, gz1, volume_in, volume_out, mass_in, mass_out, mass,
               fraction):
    """Update a row of :func:`sweep_mass`; ``left``: per axis, its weight before and after the sweep."""
    for i in range(mass.size):
        dx, dy, dz = gx1[i] - gx0[i], gy1[i] - gy0[i], gz1[i] - gz0[i]
        before = 1.0 + left_x[0] * dx + left_y[0] * dy + left_z[0] * dz
        after = 1.0 + left_x[1] * dx + left_y[1] * dy + left_z[1] * dz
        material = fraction[i] * before + (volume_in[i] - volume_out[i])
        fraction[i] = min(max(material / after, 0.0), 1.0)
        mass[i] += mass_in[i] - mass_out[i]


@kernel
def sweep_mass(runs, count, window, shape, axis, done, gx, gy, gz, flux, mass_flux, mass, fraction):
    """Move mass and material volume of the owned cells through their two faces along ``axis``.

    The volume fraction refers to the cell's volume after this sweep.
    """
    ny, nx = shape
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    step = 1 if axis == 0 else (row1 if axis == 1 else plane1)
    before, after = axes_left(done), axes_left(done | (1 << axis))
    left_x, left_y, left_z = (before[0], after[0]), (before[1], after[1]), (before[2], after[2])
    gx, gy, gz, flux, mass_flux = borrowed(gx), borrowed(gy), borrowed(gz), borrowed(flux), borrowed(mass_flux)
    mass, fraction = borrowed(mass), borrowed(fraction)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        a, c, n = (k * (ny + 1) + j) * (nx + 1) + first, (k * ny + j) * nx + first, last - first
        _move_mass(left_x, left_y, left_z, gx[a:a + n], gx[a + 1:a + 1 + n], gy[a:a + n], gy[a + row1:a + row1 + n],
                   gz[a:a + n], gz[a + plane1:a + plane1 + n], flux[a:a + n], flux[a + step:a + step + n],
                   mass_flux[a:a + n], mass_flux[a + step:a + step + n], mass[c:c + n], fraction[c:c + n])


@kernel
def close_cells(runs, count, window, shape, dust, spall, full, eos, energy, mass, fraction, memory, fields,
                mass_quantum, sums):
    """Finish the remap: settle each cell's volume fraction, and clear what is dust or void.

    A cell that holds the mass of a full one at zero pressure is full; one that was full and bears less tension than
    ``spall`` (Pa) stays full; in all others material is at zero pressure. That is one full cell's mass of cold
    material, less of hot (``energy``, J/kg, a field of one number where the pressure does not depend on it). A cell
    with less than ``dust`` (in full cells) is emptied, its mass counted in ``sums[0]`` (units of ``mass_quantum``, kg
    per full cell) and all its fields set to zero.
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
            e = energy[c] if energy.size > 1 else 0.0
            free = unloaded(eos, e)
            if x >= free:
                fraction[c] = 1.0
            elif x > dust:
                holds = fraction[c] >= full and pressure(eos, x, e) > -spall
                fraction[c] = 1.0 if holds else x / free
            else:
                if x != 0.0:
                    sums[0] += np.int64(math.floor(x / mass_quantum + 0.5))
                mass[c] = 0.0
                fraction[c] = 0.0
                for f in range(fields.size):
                    memory[fields[f] + c] = 0.0
