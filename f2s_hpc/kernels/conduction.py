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


