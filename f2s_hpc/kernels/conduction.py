"""Heat conduction between cells that hold material; void insulates."""

from __future__ import annotations

from f2s_hpc._jit import kernel


@kernel
def heat_gained(runs, count, window, shape, number, floor, mass, temperature, gained):
    """Temperature change of each owned cell in one explicit conduction step, into ``gained`` (K).

    A face conducts through the smaller of the two cells' masses, so a sliver of material can not be heated
    faster than a full cell and both cells count the same flux: energy is conserved.
    ``number`` = k dt / (rho c_p dx^2), at most 1/6. ``gained`` has the shape of a node array. ``floor``: (plane k of
    cells, share of the flux through its lower faces that counts, share of that through its others), for the two sides
    of what sleeps.
    """
    ny, nx = shape
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell, out = (k * ny + j) * nx, (k * (ny + 1) + j) * (nx + 1)
        below, rest = (floor[1], floor[2]) if k == floor[0] else (1.0, 1.0)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            c = cell + i
            x, t = mass[c], temperature[c]
            total = (
                (min(mass[c - 1], x) * (temperature[c - 1] - t) + min(mass[c + 1], x) * (temperature[c + 1] - t))
                + (min(mass[c - nx], x) * (temperature[c - nx] - t) + min(mass[c + nx], x) * (temperature[c + nx] - t)))
            total = rest * total + (
                below * min(mass[c - nx * ny], x) * (temperature[c - nx * ny] - t)
                + rest * min(mass[c + nx * ny], x) * (temperature[c + nx * ny] - t))
            gained[out + i] = number * total / max(x, 1e-300)


@kernel
def add_heat(runs, count, window, shape, gained, specific_heat, temperature, energy):
    """Add the temperature change of :func:`heat_gained` to the cells of ``window``, and its heat to ``energy`` (J/kg).

    ``energy``: specific internal energy, which the Mie-Grueneisen pressure follows; empty where there is none.
    """
    ny, nx = shape
    carried = energy.size > 1
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell, out = (k * ny + j) * nx, (k * (ny + 1) + j) * (nx + 1)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            temperature[cell + i] += gained[out + i]
            if carried:
                energy[cell + i] += specific_heat * gained[out + i]


@kernel
def heat_through_bottom(runs, count, window, shape, number, gained_share, held_at, mass, temperature, gained):
    """Add to ``gained`` (K) what the lowest plane of cells of the box, ``window[0]``, gains through its lower faces.

    ``gained_share``: conductance of what lies between the cells' centres and what is held at ``held_at`` (K), over
    that of the way from one cell to the next. A cell touches the bottom with a share of its face like its mass's, so
    that mass cancels; void gains nothing.
    """
    ny, nx = shape
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k != window[0] or j < window[2] or j >= window[3]:
            continue
        cell, out = (k * ny + j) * nx, (k * (ny + 1) + j) * (nx + 1)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            if mass[cell + i] > 0.0:
                gained[out + i] += number * gained_share * (held_at - temperature[cell + i])


@kernel
def remember(runs, count, temperature, start, before):
    """Copy the active rows of ``temperature``, ghosts too, to ``start`` and ``before`` (K)."""
    ny, nx = temperature.shape[1:]
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        for i in range(runs[r, 2], runs[r, 3]):
            c = (k * ny + j) * nx + i
            start[c] = before[c] = temperature[k, j, i]


@kernel
def super_stage(runs, count, window, shape, weights, gained, first_gained, start, before, temperature):
    """One stage of a Runge-Kutta-Legendre step of conduction, in place.

    Y_j = mu Y_{j-1} + nu Y_{j-2} + (1 - mu - nu) Y_0 + mu~ M Y_{j-1} + gamma~ M Y_0 (Meyer, Balsara and Aslam 2014,
    eq. 16), with ``weights`` = (mu, nu, mu~, gamma~), ``temperature`` Y_{j-1} and then Y_j, ``before`` Y_{j-2} and then
    Y_{j-1}, ``start`` Y_0 (all K, cells), ``gained`` M Y_{j-1} and ``first_gained`` M Y_0 (K, shaped as nodes, of one
    whole step).
    """
    ny, nx = shape
    mu, nu, mu_gained, first = weights
    rest = 1.0 - mu - nu
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell, out = (k * ny + j) * nx, (k * (ny + 1) + j) * (nx + 1)
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            c, o = cell + i, out + i
            now = temperature[c]
            temperature[c] = (mu * now + nu * before[c]) + (rest * start[c] + (mu_gained * gained[o]
                                                                              + first * first_gained[o]))
            before[c] = now


@kernel
def largest_change(runs, count, window, shape, start, temperature):
    """Return the largest change of temperature against ``start`` (K) among the cells of ``window``."""
    ny, nx = shape
    largest = 0.0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell = (k * ny + j) * nx
        for i in range(max(runs[r, 2], window[4]), min(runs[r, 3], window[5])):
            largest = max(largest, abs(temperature[cell + i] - start[cell + i]))
    return largest
