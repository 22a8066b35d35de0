"""Acceleration of the nodes, walls, and what light nodes need."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel

SMALLEST_VELOCITY = 1e-20
"""Velocities below this (m/s) are rest."""

NOTHING = 1e-300
"""What a division by a mass or force that is zero is kept from."""

FAST_STRENGTH = 0.12
"""Strength of the momentum exchange between a node beyond the speed limit and its neighbours."""


LEAST_HEATING = 0.6
"""Nodes below this mass (in full nodes), on a surface or in fragments thinner than a cell, give no heat: their motion
against each other is not resolved, and the little material around them would take it all (lips reached 1,800 degC)."""


@kernel
def clear_nodes(runs, count, shape, fx, fy, fz):
    """Zero the force arrays on every node that an active cell touches."""
    ny, nx = shape
    fx, fy, fz = borrowed(fx), borrowed(fy), borrowed(fz)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        for kk in range(k, k + 2):
            for jj in range(j, j + 2):
                row = (kk * (ny + 1) + jj) * (nx + 1)
                first, end = row + runs[r, 2], row + runs[r, 3] + 1
                fx[first:end] = 0.0
                fy[first:end] = 0.0
                fz[first:end] = 0.0


@kernel
def kinetic_energy(runs, count, window, shape, weights, nodal, u, v, w, quantum, dx, density):
    """Return the kinetic energy of the owned nodes in units of ``quantum`` (J), an exact integer sum.

    ``weights``: per axis, the share of each node plane that lies inside the box (1/2 on a wall).
    """
    ny, nx = shape
    total = np.int64(0)
    full = density * dx * dx * dx
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        plane = 0.5 * full * weights[2][k] * weights[1][j]
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n = row + i
            m = nodal[n]
            e = plane * weights[0][i] * m * (u[n] * u[n] + v[n] * v[n] + w[n] * w[n])
            total += np.int64(e / quantum)
    return total


@kernel
def wall_energy(runs, count, window, shape, weights, mass, u, v, w, quantum, dx, density):
    """Return the kinetic energy of the nodes of a wall, exactly, as :func:`kinetic_energy` does.

    ``window``: one plane of nodes; ``mass`` of the cells (in full ones), valid around it, from which that of the nodes
    follows as in ``remap.nodal_masses``.
    """
    ny, nx = shape
    total = np.int64(0)
    scale = 0.5 * density * dx * dx * dx / quantum
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        below = ((k - 1) * ny + j - 1) * nx - 1
        above = below + ny * nx
        plane = scale * weights[2][k] * weights[1][j]
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n, a, b = row + i, below + i, above + i
            m = 0.125 * ((mass[a] + mass[a + 1] + mass[a + nx] + mass[a + nx + 1])
                         + (mass[b] + mass[b + 1] + mass[b + nx] + mass[b + nx + 1]))
            total += np.int64(plane * weights[0][i] * m * (u[n] * u[n] + v[n] * v[n] + w[n] * w[n]))
    return total


@inlined
def _accelerate_row(dt, uneven, full, floor, plane, weights, holds, free_u, free_v, free_w, nodal, fx, fy, fz, u, v, w,
                    lost, quantum, sums):
    """Advance a row of nodes; see :func:`accelerate`. ``plane``, ``holds``: what its j and k say."""
    hold_u, hold_v, hold_w = holds
    kinetic_before, kinetic_after, worked, withheld = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    alone = np.int64(0)
    for i in range(u.size):
        m = full * nodal[i]
        moves = 1.0 if m > 0.0 else 0.0
        u0, v0, w0 = u[i], v[i], w[i]
        kick = moves * dt / max(m, floor * full)
        # the floor is there for what is driven; braking that it withholds would be energy that nothing gave
        gx, gy, gz = fx[i] * hold_u * free_u[i], fy[i] * hold_v * free_v[i], fz[i] * hold_w * free_w[i]
        stops = -(u0 * gx + v0 * gy + w0 * gz) / max(gx * gx + gy * gy + gz * gz, NOTHING)
        kick = max(kick, min(moves * dt / max(m, NOTHING), stops))
        u1 = (moves * u0 + kick * fx[i]) * hold_u * free_u[i]
        v1 = (moves * v0 + kick * fy[i]) * hold_v * free_v[i]
        w1 = (moves * w0 + kick * fz[i]) * hold_w * free_w[i]
        # far ahead of a wave numbers fall without end; subnormal ones would be a hundred times slower
        # (the test is true for a number only: what is not one must be seen)
        u1 = 0.0 if abs(u1) <= SMALLEST_VELOCITY else u1
        v1 = 0.0 if abs(v1) <= SMALLEST_VELOCITY else v1
        w1 = 0.0 if abs(w1) <= SMALLEST_VELOCITY else w1
        u[i], v[i], w[i] = u1, v1, w1
        share = plane * weights[i]
        before = 0.5 * m * share * (u0 * u0 + v0 * v0 + w0 * w0)
        after = 0.5 * m * share * (u1 * u1 + v1 * v1 + w1 * w1)
        work = 0.5 * dt * share * (fx[i] * (u0 + u1) + fy[i] * (v0 + v1) + fz[i] * (w0 + w1))
        kinetic_before += np.int64(before * quantum)
        kinetic_after += np.int64(after * quantum)
        worked += np.int64(work * quantum)
        withheld += np.int64((work - (after - before)) * quantum)
        taken = 0.25 * uneven * (fx[i] * (u1 - u0) + fy[i] * (v1 - v0) + fz[i] * (w1 - w0))
        alone += np.int64(taken * share * quantum)
        lost[i] += 2.0 / full * taken
    sums[0] += kinetic_before
    sums[1] += kinetic_after
    sums[2] += worked
    sums[3] += withheld
    sums[4] += alone


@kernel
def accelerate(runs, count, window, shape, dt, uneven, dx, density, floor, weights, free, nodal, fx, fy, fz, u, v, w,
               lost, quantum, sums):
    """Advance the owned nodes by one kick, v += dt F / m, and hold the walls.

    A kick from the middle of a step to that of the next works with the mean of both velocities, and cells receive what
    the forces do with the velocity of each step over its half. Where one step is longer by ``uneven`` (s) than the one
    before, the cells receive F . dv ``uneven`` / 4 more than nodes give: for the half kicks around a remap, which has
    no step on its other side, dt^2 F^2 / 8m, of which the remap changes F. Node by node that is entered into ``lost``
    (half full nodes (m/s)^2), unless that is an array of one number.

    ``floor``: least mass (in full nodes) that divides the force; where that is more than the node has, a force against
    its motion is divided by less, down to its mass, until it has taken all motion along it.
    ``free``: per axis and component, 1 where a node plane may move in that component, 0 where the wall holds it, as
    free[axis][component].
    ``sums`` int64[5], in units of ``quantum`` (J): kinetic energy before and after, work of the
    forces, the part of that work that the mass floor withheld, and what uneven steps took.
    """
    ny, nx = shape
    full, per_quantum = density * dx * dx * dx, 1.0 / quantum
    keeps, unkept = lost.size > 1, np.zeros(nx + 1)
    lost = borrowed(lost)
    nodal, fx, fy, fz, u, v, w = (borrowed(nodal), borrowed(fx), borrowed(fy), borrowed(fz), borrowed(u), borrowed(v),
                                  borrowed(w))
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        a = (k * (ny + 1) + j) * (nx + 1) + first
        b = a + last - first
        holds = (free[1, 0, j] * free[2, 0, k], free[1, 1, j] * free[2, 1, k], free[1, 2, j] * free[2, 2, k])
        _accelerate_row(dt, uneven, full, floor, weights[2][k] * weights[1][j], weights[0][first:last], holds,
                        free[0, 0, first:last], free[0, 1, first:last], free[0, 2, first:last], nodal[a:b], fx[a:b],
                        fy[a:b], fz[a:b], u[a:b], v[a:b], w[a:b], lost[a:b] if keeps else unkept[:b - a], per_quantum,
                        sums)


@inlined
def _fastest_of_row(u, v, w):
    """Return the largest squared speed of a row (0 for an empty one; NaN does not count)."""
    most = 0.0
    for i in range(u.size):
        most = max(most, u[i] * u[i] + v[i] * v[i] + w[i] * w[i])
    return most


@kernel
def mark_fast_rows(runs, count, shape, fast, u, v, w, rows):
    """Note in ``rows`` (uint8 [k, j] of the nodes) which active rows hold a node faster than ``fast`` (m/s)."""
    ny, nx = shape
    u, v, w = borrowed(u), borrowed(v), borrowed(w)
    rows[:] = 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        a = (k * (ny + 1) + j) * (nx + 1) + runs[r, 2]
        b = a + runs[r, 3] - runs[r, 2] + 1
        if not _fastest_of_row(u[a:b], v[a:b], w[a:b]) <= fast * fast:
            rows[k, j] = 1


@kernel
def exchange_light(runs, count, window, shape, dt, full, strength, limit, fast, rows, weights, free, nodal, u, v, w,
                   du, dv, dw, lost, paid, quantum, sums):
    """Write into du, dv, dw, which hold the forces of the kick before, the velocity change (m/s) of the exchange.

    A pair of neighbours along an axis shares momentum: along that axis if both are lighter than ``limit`` full nodes
    (with ``strength``), in every direction if one of them is faster than ``fast`` (m/s; with FAST_STRENGTH). The pair's
    lighter mass times the strength times the velocity difference passes from one to the other, so the
    pair keeps its momentum and no pair overshoots (strength < 1/6); and what passes along the axis alone leaves a
    body's turning as it is. Adds to ``lost`` each node's half of the kinetic energy that its pairs lose (half full
    nodes (m/s)^2), unless that is an array of one number. So for what those forces do with the change over the half of
    the step ``dt`` (s) that comes, if that is to be ``paid`` (1.0): cells receive it, though no kick gave it. Its sum
    goes into ``sums`` int64[1], in units of ``quantum`` (J); ``full``: mass of a full node (kg); ``weights``,
    ``free``: as in :func:`accelerate`.
    ``rows``: which rows hold a node beyond ``fast`` (:func:`mark_fast_rows`); elsewhere only light nodes are looked at.
    """
    ny, nx = shape
    strides = (1, nx + 1, (nx + 1) * (ny + 1))
    keeps = lost.size > 1
    nodal, u, v, w, lost = borrowed(nodal), borrowed(u), borrowed(v), borrowed(w), borrowed(lost)
    du, dv, dw = borrowed(du), borrowed(dv), borrowed(dw)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        everywhere = rows[k, j] | rows[k - 1, j] | rows[k + 1, j] | rows[k, j - 1] | rows[k, j + 1]
        plane = weights[2][k] * weights[1][j]
        hold_u, hold_v = free[1, 0, j] * free[2, 0, k], free[1, 1, j] * free[2, 1, k]
        hold_w = free[1, 2, j] * free[2, 2, k]
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n = row + i
            m, fx, fy, fz = nodal[n], du[n], dv[n], dw[n]
            du[n], dv[n], dw[n] = 0.0, 0.0, 0.0
            if m <= 0.0 or (m >= limit and not everywhere):
                continue
            quick = u[n] * u[n] + v[n] * v[n] + w[n] * w[n] > fast * fast
            pairs = 0.0
            for axis in range(3):
                for side in (-1, 1):
                    o = n + side * strides[axis]
                    other = nodal[o]
                    if other <= 0.0:
                        continue
                    along, across = (strength if m < limit and other < limit else 0.0), 0.0
                    if quick or u[o] * u[o] + v[o] * v[o] + w[o] * w[o] > fast * fast:
                        along, across = max(along, FAST_STRENGTH), FAST_STRENGTH
                    along *= min(m, other) / m
                    across *= min(m, other) / m
                    p = along if axis == 0 else across
                    q = along if axis == 1 else across
                    s = along if axis == 2 else across
                    x, y, z = u[o] - u[n], v[o] - v[n], w[o] - w[n]
                    du[n] += p * x
                    dv[n] += q * y
                    dw[n] += s * z
                    pairs += p * x * x + q * y * y + s * z * z
            taken = 0.5 * dt * (fx * du[n] * hold_u * free[0, 0, i] + fy * dv[n] * hold_v * free[0, 1, i]
                                + fz * dw[n] * hold_w * free[0, 2, i])
            sums[0] += np.int64(taken * plane * weights[0][i] / quantum)
            if keeps:
                # sum over pairs of p |du|^2 less sum m |change|^2: what all nodes together lose, in any frame
                lost[n] += m * (pairs - (du[n] * du[n] + dv[n] * dv[n] + dw[n] * dw[n])) + paid * 2.0 / full * taken


@kernel
def specific_losses(runs, count, window, shape, nodal, lost, specific):
    """Turn the kinetic energy that nodes lost into J per kg of their mass, and start counting anew.

    ``lost``: half full nodes (m/s)^2; ``specific`` takes the result, on the nodes of ``window`` and around.
    """
    ny, nx = shape
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        for n in range(row + max(runs[r, 2], window[4]), row + min(runs[r, 3], window[5])):
            m = nodal[n]
            specific[n] = 0.5 * lost[n] / max(m, 1e-300) if (m > LEAST_HEATING) | (lost[n] < 0.0) else 0.0
            lost[n] = 0.0


@kernel
def clear_array(runs, count, shape, array):
    """Zero a node array wherever an active cell has its low corner."""
    ny, nx = shape
    for r in range(count):
        row = (runs[r, 0] * (ny + 1) + runs[r, 1]) * (nx + 1)
        for n in range(row + runs[r, 2], row + runs[r, 3]):
            array[n] = 0.0


@kernel
def sum_lost(runs, count, window, shape, weights, lost, full_mass, quantum):
    """Return the kinetic energy in ``lost`` (half full nodes (m/s)^2) on the owned nodes in quanta (J), exactly.

    ``weights`` as in :func:`kinetic_energy`; ``full_mass``: mass of a full node (kg).
    """
    ny, nx = shape
    total, scale = np.int64(0), 0.5 * full_mass / quantum
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        plane = scale * weights[2][k] * weights[1][j]
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            total += np.int64(math.floor(plane * weights[0][i] * lost[row + i] + 0.5))
    return total


@kernel
def apply_exchange(runs, count, window, shape, limit, cap, weights, density, dx, nodal, u, v, w, du, dv, dw, quantum,
                   mass_quantum, sums):
    """Add the exchange to the nodes, and cap the speed of light ones that still race.

    ``sums`` int64[4]: kinetic energy taken by the exchange and by the cap (units of ``quantum``),
    nodes capped (count), and their mass (units of ``mass_quantum``, kg). A node of at least
    ``limit`` full nodes is never capped. Returns the largest speed (m/s) of light and of heavy nodes.
    """
    ny, nx = shape
    full = density * dx * dx * dx
    fastest_light, fastest_heavy = 0.0, 0.0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        plane = full * weights[2][k] * weights[1][j]
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            n = row + i
            m = nodal[n]
            square = u[n] * u[n] + v[n] * v[n] + w[n] * w[n]
            inside = plane * weights[0][i] * m
            if du[n] != 0.0 or dv[n] != 0.0 or dw[n] != 0.0:
                u[n] += du[n]
                v[n] += dv[n]
                w[n] += dw[n]
                exchanged = u[n] * u[n] + v[n] * v[n] + w[n] * w[n]
                sums[0] += np.int64(0.5 * inside * (square - exchanged) / quantum)
                square = exchanged
            speed = math.sqrt(square)
            if m >= limit:
                if not speed <= fastest_heavy:
                    fastest_heavy = speed
                continue
            if speed > cap:
                u[n] *= cap / speed
                v[n] *= cap / speed
                w[n] *= cap / speed
                sums[1] += np.int64(0.5 * inside * (square - cap * cap) / quantum)
                sums[2] += 1
                sums[3] += np.int64(inside / mass_quantum)
                speed = cap
            if not speed <= fastest_light:
                fastest_light = speed
    return fastest_light, fastest_heavy
