"""What crosses the faces in one directional sweep: material volume by geometry, and mass."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.plane import interface_curvature, interface_normal, plane_distance, slab_bulge, slab_volume

FULL = 1.0 - 1e-12
"""A cell at least this full is treated as full: no plane, and tension if the closure allows."""


@inlined
def limited_step(behind, ahead, share):
    """Return the limited third-order step from a cell's mean to the mean over the ``share`` of it next to a face.

    ``behind``, ``ahead``: differences to the neighbours; as :func:`f2s_hpc.kernels.remap._limited_values`.
    """
    step = (1.0 - share) / 6.0 * ((1.0 + share) * behind + (2.0 - share) * ahead)
    most = (1.0 - share) * min(abs(behind), abs(ahead))
    return min(max(step, -most), most) if behind * ahead > 0.0 else 0.0


@inlined
def axes_left(done):
    """Return, as floats 1 or 0, which of the axes x, y, z are not swept yet; ``done`` holds the bits of those that are.

    A cell starts the remap with its deformed volume, 1 + the sum of its three flux differences, and ends with exactly
    one; each sweep takes out its own axis. Weights instead of branches keep the loops straight, and arrays
    out of the arguments of point functions, where each would cost a reference count.
    """
    return 1.0 - (done & 1), 1.0 - ((done >> 1) & 1), 1.0 - ((done >> 2) & 1)


@inlined
def _full_fluxes(swept, low_fraction, high_fraction, low_mass, high_mass, flux):
    """Fluxes of a row of faces whose donor is full: the swept volume. Behind an open side there is no mass."""
    for i in range(swept.size):
        along = swept[i] > 0.0
        fraction = low_fraction[i] if along else high_fraction[i]
        mass = low_mass[i] if along else high_mass[i]
        flux[i] = swept[i] if (fraction >= FULL) & (mass > 0.0) else 0.0


@kernel
def volume_fluxes(runs, count, window, shape, axis, done, gx, gy, gz, mass, fraction, flux):
    """Material volume (in cells) that crosses each low face along ``axis``, signed, into ``flux``.

    Full donors give the whole swept volume; mixed donors give the part of it below their interface
    plane (PLIC). ``done``: bits of the axes already swept. Visits cells of ``window`` as donors and writes
    the low face of each, and the high face of those that are donors there.
    """
    ny, nx = shape
    cell_strides = (1, nx, nx * ny)
    face_strides = (1, nx + 1, (nx + 1) * (ny + 1))
    step = face_strides[axis]
    back = cell_strides[axis]
    g = gx if axis == 0 else (gy if axis == 1 else gz)
    row1, plane1 = nx + 1, (nx + 1) * (ny + 1)
    ax, ay, az = axes_left(done)
    sx, sy, sz = cell_strides[axis], cell_strides[(axis + 1) % 3], cell_strides[(axis + 2) % 3]
    mass, fraction, flux, g = borrowed(mass), borrowed(fraction), borrowed(flux), borrowed(g)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        face, n = (k * (ny + 1) + j) * (nx + 1) + first, last - first
        cell = (k * ny + j) * nx + first
        low = cell - back
        _full_fluxes(g[face:face + n], fraction[low:low + n], fraction[cell:cell + n], mass[low:low + n],
                     mass[cell:cell + n], flux[face:face + n])
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        face = (k * (ny + 1) + j) * (nx + 1)
        cell = (k * ny + j) * nx
        for i in range(first, last):
            f = fraction[cell + i]
            if f >= FULL or mass[cell + i] <= 0.0:
                continue
            n = face + i
            low, high = g[n], g[n + step]
            if low >= 0.0 and high <= 0.0:
                continue
            volume = 1.0 + ax * (gx[n + 1] - gx[n]) + ay * (gy[n + row1] - gy[n]) + az * (gz[n + plane1] - gz[n])
            a, b, c = interface_normal(fraction, cell + i, sx, sy, sz)
            distance = plane_distance(abs(a), abs(b), abs(c), f)
            curvature = interface_curvature(fraction, cell + i, sx, sy, sz)
            # what stays must fit into the rest of the cell, to the last digit: an overfull cell would lose volume
            rest, kept = 1.0, f
            if low < 0.0:
                share = min(-low / volume, 1.0)
                rest -= share
                leaves = (slab_volume(a, b, c, distance, share, False)
                          + slab_bulge(a, b, c, distance, share, False, curvature))
                leaves = min(max(leaves, kept - rest, 0.0), kept, share)
                flux[n] = -volume * leaves
                kept -= leaves
            if high > 0.0:
                share = min(high / volume, rest)
                rest -= share
                leaves = (slab_volume(a, b, c, distance, share, True)
                          + slab_bulge(a, b, c, distance, share, True, curvature))
                leaves = min(max(leaves, kept - rest, 0.0), kept, share)
                flux[n + step] = volume * leaves


@inlined
def _density_row(left, gx0, gx1, gy0, gy1, gz0, gz1, mass, fraction, density):
    """Density (in reference densities) of the material of a row of cells, 0 where there is none."""
    ax, ay, az = left
    for i in range(mass.size):
        volume = 1.0 + ax * (gx1[i] - gx0[i]) + ay * (gy1[i] - gy0[i]) + az * (gz1[i] - gz0[i])
        material = fraction[i] * volume
        density[i] = mass[i] / material if (mass[i] > 0.0) & (material > 0.0) else 0.0


@kernel
def material_densities(runs, count, window, shape, done, gx, gy, gz, mass, fraction, density):
    """Density of the material of the cells of ``window`` in their present volumes; ``density``: node-shaped array."""
    ny, nx = shape
    row1, plane1, left = nx + 1, (nx + 1) * (ny + 1), axes_left(done)
    gx, gy, gz, mass, fraction = borrowed(gx), borrowed(gy), borrowed(gz), borrowed(mass), borrowed(fraction)
    density = borrowed(density)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        a, c, n = (k * (ny + 1) + j) * row1 + first, (k * ny + j) * nx + first, last - first
        _density_row(left, gx[a:a + n], gx[a + 1:a + 1 + n], gy[a:a + n], gy[a + row1:a + row1 + n], gz[a:a + n],
                     gz[a + plane1:a + plane1 + n], mass[c:c + n], fraction[c:c + n], density[a:a + n])


@inlined
def _mass_flux_row(second, flux, m1, m2, f0, f1, f2, f3, d0, d1, d2, d3, mass_flux):
    """Mass fluxes of a row of faces; masses, fractions and densities of the two cells below and the two above each."""
    for i in range(flux.size):
        phi, along = flux[i], flux[i] > 0.0
        donor, fraction = m1[i] if along else m2[i], f1[i] if along else f2[i]
        up_fraction, down_fraction = f0[i] if along else f3[i], f2[i] if along else f1[i]
        up, density, down = d0[i] if along else d3[i], d1[i] if along else d2[i], d2[i] if along else d1[i]
        # the donor's volume is mass over fraction over density
        share = min(abs(phi) * fraction * density / max(donor, 1e-300), 1.0)
        step = second * limited_step(density - up, down - density, share)
        moved = phi * (density + (step if min(fraction, up_fraction, down_fraction) >= FULL else 0.0))
        mass_flux[i] = min(max(moved, -donor), donor) if phi != 0.0 else 0.0


@kernel
def mass_fluxes(runs, count, window, shape, axis, second, density, mass, fraction, flux, mass_flux):
    """Mass (in full cells) that crosses each low face along ``axis``: volume flux times donor density.

    Between full cells the density (:func:`material_densities`) is reconstructed with a limited slope (when ``second``
    is 1.0), next to a mixed or void cell it is the donor's own.
    """
    ny, nx = shape
    back = 1 if axis == 0 else (nx if axis == 1 else nx * ny)
    step = 1 if axis == 0 else (nx + 1 if axis == 1 else (nx + 1) * (ny + 1))
    density, mass, fraction = borrowed(density), borrowed(mass), borrowed(fraction)
    flux, mass_flux = borrowed(flux), borrowed(mass_flux)
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        a, c, n = (k * (ny + 1) + j) * (nx + 1) + first, (k * ny + j) * nx + first, last - first
        _mass_flux_row(second, flux[a:a + n], mass[c - back:c - back + n], mass[c:c + n],
                       fraction[c - 2 * back:c - 2 * back + n], fraction[c - back:c - back + n], fraction[c:c + n],
                       fraction[c + back:c + back + n], density[a - 2 * step:a - 2 * step + n],
                       density[a - step:a - step + n], density[a:a + n], density[a + step:a + step + n],
                       mass_flux[a:a + n])


@inlined
def _strides(shape, axis):
    """Return the strides of a node-shaped array along ``axis`` and along the two others, the lower axis first."""
    strides = (1, shape[1] + 1, (shape[1] + 1) * (shape[0] + 1))
    return strides[axis], strides[0 if axis else 1], strides[1 if axis == 2 else 2]


@kernel
def mass_through_plane(mass_flux, plane, shape, lows, highs, axis, outward, quantum):
    """Return the mass that leaves through one plane of faces normal to ``axis``, in units of ``quantum`` (full cells).

    An exact integer. ``lows``, ``highs``: index bounds of the cells along the two other axes, lower axis first;
    ``outward``: +1 on a high side, -1 on a low one.
    """
    normal, p, q = _strides(shape, axis)
    total = np.int64(0)
    for b in range(lows[1], highs[1]):
        for a in range(lows[0], highs[0]):
            left = outward * mass_flux[plane * normal + a * p + b * q]
            if left != 0.0:
                total += np.int64(math.floor(left / quantum + 0.5))
    return total


@kernel
def energy_through_plane(mass_flux, plane, shape, lows, highs, axis, outward, weights, u, v, w, quantum):
    """Return the kinetic energy that leaves with the nodes' present velocity, in units of ``quantum`` (J, full cells).

    An exact integer. Each node of the plane gives a quarter of what passes the four faces around it. ``lows``,
    ``highs``: index bounds of the nodes along the two other axes, lower axis first; ``weights``: per axis, the share of
    each plane of nodes that lies inside the box; ``outward`` as in :func:`mass_through_plane`.
    """
    normal, p, q = _strides(shape, axis)
    along, across = weights[0 if axis else 1], weights[1 if axis == 2 else 2]
    total = np.int64(0)
    for b in range(lows[1], highs[1]):
        for a in range(lows[0], highs[0]):
            n = plane * normal + a * p + b * q
            left = 0.25 * outward * ((mass_flux[n] + mass_flux[n - p]) + (mass_flux[n - q] + mass_flux[n - p - q]))
            if left != 0.0:
                inside = along[a] * across[b] * left
                total += np.int64(math.floor(0.5 * inside * (u[n] * u[n] + v[n] * v[n] + w[n] * w[n]) / quantum + 0.5))
    return total
