"""Putting spheres into the fields of a rank."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.kernels.sphere import sphere_bounds, sphere_volume_fractions


@kernel
def sphere_overlaps(x, y, z, r, chosen, offset, dx, window, mass, added, overlap):
    """Largest mass that a cell of ``window`` would hold with ``added`` in it, of those that a chosen sphere is in.

    ``x, y, z, r``: spheres (m); ``offset``: global index (i, j, k) of local cell 0; ``window``:
    (k0, k1, j0, j1, i0, i1) local; ``mass``, ``added``: 3-D local arrays; ``overlap[s]`` is raised to the result, in
    full cells.
    Cells without material do not count, so a sphere in free space has overlap 0.
    """
    k0, k1, j0, j1, i0, i1 = window
    for s in range(x.size):
        if not chosen[s]:
            continue
        a0, a1, b0, b1, c0, c1 = sphere_bounds(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, i0 + offset[0],
                                               i1 + offset[0], j0 + offset[1], j1 + offset[1], k0 + offset[2],
                                               k1 + offset[2])
        if a1 <= a0 or b1 <= b0 or c1 <= c0:
            continue
        share = np.empty((c1 - c0, b1 - b0, a1 - a0))
        sphere_volume_fractions(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, a0, a1, b0, b1, c0, c1, share)
        for k in range(c0, c1):
            for j in range(b0, b1):
                for i in range(a0, a1):
                    cell = (k - offset[2], j - offset[1], i - offset[0])
                    if mass[cell] > 0.0 and share[k - c0, j - b0, i - a0] > 0.0:
                        overlap[s] = max(overlap[s], mass[cell] + added[cell])


@kernel
def _flies_along(k, j, i, u, v, w, velocity, s, slack):
    """Tell whether all eight nodes of a cell move with sphere ``s``, to within ``slack`` (m/s)."""
    for c in range(2):
        for b in range(2):
            for a in range(2):
                x = u[k + c, j + b, i + a] - velocity[s, 0]
                y = v[k + c, j + b, i + a] - velocity[s, 1]
                z = w[k + c, j + b, i + a] - velocity[s, 2]
                if not x * x + y * y + z * z <= slack * slack:
                    return False
    return True


@kernel
def spheres_near_material(x, y, z, reach, velocity, same, offset, dx, window, mass, u, v, w, near):
    """Set ``near[s]`` to 1 where the centre of a cell of ``window`` with material is within ``reach[s]`` of sphere s.

    Material that flies along with the sphere does not count: all nodes of its cell have the sphere's ``velocity``
    (spheres, 3) to within the share ``same`` of its speed. ``x, y, z``: centres (m); ``offset``, ``window``, ``mass``
    as in :func:`sphere_overlaps`; ``u, v, w``: 3-D local node arrays (m/s).
    """
    k0, k1, j0, j1, i0, i1 = window
    for s in range(x.size):
        a0, a1, b0, b1, c0, c1 = sphere_bounds(x[s], y[s], z[s], reach[s], 0.0, 0.0, 0.0, dx, i0 + offset[0],
                                               i1 + offset[0], j0 + offset[1], j1 + offset[1], k0 + offset[2],
                                               k1 + offset[2])
        slack = same * math.sqrt(velocity[s, 0] ** 2 + velocity[s, 1] ** 2 + velocity[s, 2] ** 2)
        for k in range(c0, c1):
            for j in range(b0, b1):
                if near[s] > 0.0:
                    break
                dy, dz = (j + 0.5) * dx - y[s], (k + 0.5) * dx - z[s]
                left = reach[s] * reach[s] - dy * dy - dz * dz
                for i in range(a0, a1):
                    away = (i + 0.5) * dx - x[s]
                    c, b, a = k - offset[2], j - offset[1], i - offset[0]
                    if away * away <= left and mass[c, b, a] > 0.0:
                        if not _flies_along(c, b, a, u, v, w, velocity, s, slack):
                            near[s] = 1.0
                            break


@kernel
def spheres_meet(x, y, z, r, chosen, others_x, others_y, others_z, others_r, meet):
    """Set ``meet[s]`` (bool) where the chosen sphere s overlaps one of the others; places and radii in one unit."""
    for s in range(x.size):
        if not chosen[s]:
            continue
        for o in range(others_x.size):
            a, b, c = others_x[o] - x[s], others_y[o] - y[s], others_z[o] - z[s]
            both = others_r[o] + r[s]
            if a * a + b * b + c * c < both * both:
                meet[s] = True
                break


@kernel
def add_spheres(x, y, z, r, offset, dx, added):
    """Add the volume fractions of all spheres to ``added``, a local array [k, j, i] with ghosts.

    ``offset``: global index (i, j, k) of local cell 0. Spheres are added in their order, so the sum in a
    cell that two of them share has the same bits on every rank.
    """
    nz, ny, nx = added.shape
    for s in range(x.size):
        i0, i1, j0, j1, k0, k1 = sphere_bounds(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, offset[0], offset[0] + nx,
                                               offset[1], offset[1] + ny, offset[2], offset[2] + nz)
        if i1 <= i0 or j1 <= j0 or k1 <= k0:
            continue
        share = np.empty((k1 - k0, j1 - j0, i1 - i0))
        sphere_volume_fractions(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, i0, i1, j0, j1, k0, k1, share)
        for k in range(k0, k1):
            for j in range(j0, j1):
                for i in range(i0, i1):
                    added[k - offset[2], j - offset[1], i - offset[0]] += share[k - k0, j - j0, i - i0]


@kernel
def add_different_spheres(x, y, z, r, values, offset, dx, added, means):
    """Add spheres as :func:`add_spheres` does, and set each of ``means`` to the value of what each cell was given.

    ``values``: (spheres, n), such as velocities and temperatures; ``means``: n arrays like ``added``. In a cell that
    spheres share it is their mean by volume, merged in their order, so that its momentum or heat is theirs; in all
    other cells it has the very bits of the sphere's value.
    """
    nz, ny, nx = added.shape
    for s in range(x.size):
        i0, i1, j0, j1, k0, k1 = sphere_bounds(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, offset[0], offset[0] + nx,
                                               offset[1], offset[1] + ny, offset[2], offset[2] + nz)
        if i1 <= i0 or j1 <= j0 or k1 <= k0:
            continue
        share = np.empty((k1 - k0, j1 - j0, i1 - i0))
        sphere_volume_fractions(x[s], y[s], z[s], r[s], 0.0, 0.0, 0.0, dx, i0, i1, j0, j1, k0, k1, share)
        for k in range(k0, k1):
            for j in range(j0, j1):
                for i in range(i0, i1):
                    new = share[k - k0, j - j0, i - i0]
                    if new > 0.0:
                        c = (k - offset[2], j - offset[1], i - offset[0])
                        old = added[c]
                        added[c] = old + new
                        old /= old + new
                        for n in range(len(means)):
                            means[n][c] = values[s, n] + old * (means[n][c] - values[s, n])


@kernel
def merge_cells(added, mass, fraction, temperature, new_temperature, memory, diluted):
    """Add new material at ``new_temperature`` (K), stress-free and unstrained, to the cells.

    ``added``, ``mass``, ``fraction``, ``temperature``: flat cell arrays; ``new_temperature``: one for each cell, or an
    array of one for all; ``diluted``: offsets into ``memory`` of the mass-weighted fields that the new material brings
    as zero (stress, PEEQ, ...).
    """
    own = new_temperature.size > 1
    for c in range(added.size):
        new = added[c]
        if new == 0.0:
            continue
        old = mass[c]
        whole = old + new
        t = new_temperature[c if own else 0]
        temperature[c] = t if old == 0.0 else temperature[c] + new / whole * (t - temperature[c])
        for f in range(diluted.size):
            memory[diluted[f] + c] *= old / whole
        mass[c] = whole
        fraction[c] = 1.0 if whole >= 1.0 or fraction[c] >= 1.0 else whole


@kernel
def merge_nodes(shape, planes, added, mass, velocity, u, v, w):
    """Give the nodes the momentum of material moving at ``velocity`` (m/s) that was added to their cells.

    ``mass`` is the mass after the addition; call on cell arrays with ghosts, node arrays one larger. ``planes``: first
    and end plane of cells that were given something.
    """
    nz, ny, nx = shape
    for k in range(max(planes[0], 1), min(planes[1] + 1, nz)):
        for j in range(1, ny):
            for i in range(1, nx):
                new, whole = 0.0, 0.0
                for c in range(2):
                    for b in range(2):
                        for a in range(2):
                            n = ((k - c) * ny + j - b) * nx + i - a
                            new += added[n]
                            whole += mass[n]
                if new == 0.0:
                    continue
                share = new / whole
                n = (k * (ny + 1) + j) * (nx + 1) + i
                # from the new velocity: a node of new material alone gets its very bits
                old = 1.0 - share
                u[n] = velocity[0] + old * (u[n] - velocity[0])
                v[n] = velocity[1] + old * (v[n] - velocity[1])
                w[n] = velocity[2] + old * (w[n] - velocity[2])


@kernel
def merge_moving_nodes(shape, planes, added, mass, velocity, u, v, w):
    """Give the nodes the momentum of added material as :func:`merge_nodes` does, each cell's at its own ``velocity``.

    ``velocity``: three flat cell arrays (m/s). Cells of one velocity give their node its very bits.
    """
    nz, ny, nx = shape
    cu, cv, cw = velocity
    for k in range(max(planes[0], 1), min(planes[1] + 1, nz)):
        for j in range(1, ny):
            for i in range(1, nx):
                new, whole, nu, nv, nw = 0.0, 0.0, 0.0, 0.0, 0.0
                for c in range(2):
                    for b in range(2):
                        for a in range(2):
                            n = ((k - c) * ny + j - b) * nx + i - a
                            whole += mass[n]
                            if added[n] > 0.0:
                                old = new / (new + added[n])
                                new += added[n]
                                nu = cu[n] + old * (nu - cu[n])
                                nv = cv[n] + old * (nv - cv[n])
                                nw = cw[n] + old * (nw - cw[n])
                if new == 0.0:
                    continue
                n = (k * (ny + 1) + j) * (nx + 1) + i
                old = 1.0 - new / whole
                u[n] = nu + old * (u[n] - nu)
                v[n] = nv + old * (v[n] - nv)
                w[n] = nw + old * (w[n] - nw)
