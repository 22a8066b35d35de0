"""What absorbing sides do to the nodes on them and to the cells next to them."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import kernel


@kernel
def _lent_share(lent, mass, first, p, q):
    """Mean of what four cells have lent, each times the material it holds (at most a full cell)."""
    a, b, c, d = first, first + p, first + q, first + p + q
    return 0.25 * ((lent[a] * min(mass[a], 1.0) + lent[b] * min(mass[b], 1.0))
                   + (lent[c] * min(mass[c], 1.0) + lent[d] * min(mass[d], 1.0)))


@kernel
def _add_traction(n, place, inside, before, after, full, floor, rates, spring, inward, free, nodal, lent, mass, shape,
                  force, velocity):
    """Replace the force on node ``n`` by cells' force plus traction; return the traction's work on the outside (J)."""
    m, dt = nodal[n] * full, 0.5 * (before + after)
    if m <= 0.0:
        return 0.0
    ny, nx = shape
    strides = (1, nx, nx * ny)
    sides = 0
    for axis in range(3):
        sides += 1 if inward[axis, place[axis]] != 0.0 else 0
    mirrored, divisor, work = 2.0**sides, max(m, floor * full), 0.0
    for component in range(3):
        if free[0, component, place[0]] * free[1, component, place[1]] * free[2, component, place[2]] == 0.0:
            continue
        rate = 0.0
        for axis in range(3):
            rate += (rates[0] if axis == component else rates[1]) * abs(inward[axis, place[axis]])
        cells = mirrored * force[component][n]
        push = 0.0
        way = inward[component, place[component]]
        if way != 0.0:
            p, q = strides[(component + 1) % 3], strides[(component + 2) % 3]
            cell = place[0] + place[1] * nx + place[2] * nx * ny
            first = cell - p - q - (0 if way > 0.0 else strides[component])
            push = way * spring * _lent_share(lent, mass, first, p, q)
        old = velocity[component][n]
        damped = 0.5 * dt * rate * m / divisor
        new = ((1.0 - damped) * old + dt * (cells + push) / divisor) / (1.0 + damped)
        total = (new - old) * divisor / dt
        # the velocity that the kick will make of it, to the last bit
        new = old + dt / divisor * total
        force[component][n] = total
        work += 0.5 * inside * (cells - total) * (before * old + after * new)
    return work


@kernel
def outgoing_traction(runs, count, window, shape, before, after, dx, density, floor, speeds, stiffness, weights, inward,
                      free, nodal, lent, mass, force, velocity, quantum):
    """Put the traction of an outgoing wave on the nodes of absorbing sides, implicitly over a kick.

    ``before``, ``after``: the steps (s) of which the kick spans half each; the outside receives the work as cells do.
    ``force`` (N) of the cells inside becomes the force that :func:`f2s_hpc.kernels.momentum.accelerate` takes, on a
    node together with its mirror images behind the sides. ``speeds``: (c_p, c_s) in m/s; ``stiffness``: normal
    traction over displacement (Pa/m); ``lent``: mass (in full cells) lent by the cells; ``inward``: [axis, plane], +1
    on an absorbing low side, -1 on a high one, else 0; ``weights``, ``free``, ``floor``: as there.
    Returns the work done on the outside in units of ``quantum`` (J), an exact integer sum over the owned nodes.
    """
    ny, nx = shape
    full, total = density * dx * dx * dx, np.int64(0)
    rates, spring = (2.0 * speeds[0] / dx, 2.0 * speeds[1] / dx), 2.0 * stiffness * dx * dx * dx
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        on_side = inward[2, k] != 0.0 or inward[1, j] != 0.0
        row = (k * (ny + 1) + j) * (nx + 1)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            if on_side or inward[0, i] != 0.0:
                inside = weights[2][k] * weights[1][j] * weights[0][i]
                place = (np.int64(i), np.int64(j), np.int64(k))
                work = _add_traction(row + i, place, inside, before, after, full, floor, rates, spring, inward, free,
                                     nodal, lent, mass, (ny, nx), force, velocity)
                total += np.int64(math.floor(work / quantum + 0.5))
    return total


@kernel
def lend_mass(runs, count, owned, shape, inward, sweeps, mass, fraction, lent, mass_quantum):
    """Make room beside absorbing sides as their nodes moved, without moving anything through them.

    The faces on such sides swept g (in cells, all of a cell's together) while the cell strained to the volume V; from
    here on they stand still and the volume is that without g. A full cell keeps its density: it lends the mass for
    which there is no room, or takes some back. In a mixed cell void makes room. ``inward``: as in
    :func:`outgoing_traction`. Visits all local cells; counts those in ``owned``: returns the mass lent, in
    ``mass_quantum``.
    """
    ny, nx = shape
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    gx, gy, gz = sweeps
    total, along_rows = np.int64(0), np.abs(inward[0]).max() > 0.0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        # 1.0 where the low, the high face of these cells is on an absorbing side
        z0, z1, y0, y1 = max(inward[2, k], 0.0), max(-inward[2, k + 1], 0.0), max(inward[1, j], 0.0), \
            max(-inward[1, j + 1], 0.0)
        counts = owned[0] <= k < owned[1] and owned[2] <= j < owned[3]
        beside = z0 + z1 + y0 + y1 > 0.0
        if not (beside or along_rows):
            continue
        for i in range(runs[r, 2], runs[r, 3]):
            x0, x1 = max(inward[0, i], 0.0), max(-inward[0, i + 1], 0.0)
            c, n = (k * ny + j) * nx + i, k * plane1 + j * row1 + i
            if not (beside or x0 + x1 > 0.0) or mass[c] <= 0.0:
                continue
            volume = 1.0 + (gx[n + 1] - gx[n]) + (gy[n + row1] - gy[n]) + (gz[n + plane1] - gz[n])
            faces = (x1 * gx[n + 1] - x0 * gx[n]) + (y1 * gy[n + row1] - y0 * gy[n]) + (z1 * gz[n + plane1]
                                                                                        - z0 * gz[n])
            ratio = (volume - faces) / volume
            if fraction[c] >= 1.0:
                gone = mass[c] * (1.0 - ratio)
                mass[c] -= gone
                lent[c] += gone
                if counts and owned[4] <= i < owned[5]:
                    total += np.int64(math.floor(gone / mass_quantum + 0.5))
            else:
                fraction[c] = min(fraction[c] / ratio, 1.0)
    return total
