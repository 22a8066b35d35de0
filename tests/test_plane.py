"""Planes in a cell: volumes against exact rational arithmetic, their inverse, slabs, and interface normals."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from f2s_hpc.kernels.paint import add_spheres
from f2s_hpc.kernels.plane import (
    interface_curvature,
    interface_normal,
    plane_distance,
    section_area,
    slab_bulge,
    slab_volume,
    volume_below,
)
from f2s_hpc.kernels.sphere import sphere_box_volume

SIZES = (5, 5, 5)
CENTRE = 2 * 25 + 2 * 5 + 2
STRIDES = (1, 5, 25)


def exact_volume(a, b, c, distance):
    """Return the volume of the unit cube where a x + b y + c z < distance, all > 0, rounded once.

    Inclusion and exclusion over the cube's corners: sum of (-1)^|s| <d - n.s>^3 / (6 a b c), in exact fractions.
    """
    n, d = [Fraction(q) for q in (a, b, c)], Fraction(distance)
    total = Fraction(0)
    for corner in product((0, 1), repeat=3):
        height = d - sum(q * s for q, s in zip(n, corner))
        if height > 0:
            total += (-1) ** sum(corner) * height**3
    return float(total / (6 * n[0] * n[1] * n[2]))


def random_normals(rng, count, least=-6.0):
    """Return unit-sum normals > 0 with components spread over ``-least`` decades, largest first in no fixed place."""
    normals = 10.0 ** rng.uniform(least, 0.0, (count, 3))
    normals[: count // 3] = rng.random((count // 3, 3)) + 1e-3
    normals[count // 3: count // 3 + 8] = [[1, 1, 1], [1, 1, 2], [2, 1, 1], [1, 1e-6, 1], [1, 3, 2], [1, 2, 1],
                                           [1e-6, 1e-6, 1], [1, 1e-5, 1e-5]]
    return normals / normals.sum(axis=1)[:, None]


def test_volume_below_is_exact(rng):
    """3,000 random planes, components down to 1e-6; fails when ``m12 <= m3`` is turned round, or a 6.0 becomes 3.0."""
    normals = random_normals(rng, 3000)
    for (a, b, c), distance in zip(normals, rng.random(3000)):
        thinnest = min(a, b, c)
        assert volume_below(a, b, c, distance) == pytest.approx(exact_volume(a, b, c, distance),
                                                                abs=1e-14 + 1e-15 / thinnest)


def test_volume_below_needs_no_unit_sum(rng):
    """The plane n . x < d is that of any multiple of (n, d); fails when ``distance / total`` becomes ``distance``."""
    for (a, b, c), distance in zip(random_normals(rng, 200, -2.0), rng.random(200)):
        scaled = volume_below(3.7 * a, 3.7 * b, 3.7 * c, 3.7 * distance)
        assert scaled == pytest.approx(volume_below(a, b, c, distance), abs=1e-13)


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_volume_below_a_plane_along_the_faces_is_its_height(normal):
    """To the width of the thinnest wedge (1e-7), and 0 and 1 beyond; fails when ``_SMALLEST`` becomes 1e-3."""
    for height in np.linspace(0.01, 0.99, 50):
        assert volume_below(*normal, height) == pytest.approx(height, abs=2e-7)
    assert volume_below(*normal, 0.0) == 0.0
    assert volume_below(*normal, 1.0) == 1.0


def test_plane_distance_inverts_the_volume(rng):
    """To 1e-10 over random normals and volumes from 1e-12 to 1 - 1e-12, tiny components and zeros included.

    Fails when ``+ m12`` of the cubic branch of ``plane_distance`` becomes ``+ m2``.
    """
    normals = random_normals(rng, 6000, -8.0)
    normals[-3:] = [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.3, 0.7]]
    volumes = rng.random(6000)
    volumes[::3] = 10.0 ** rng.uniform(-12, -1, 2000)
    volumes[1::6] = 1.0 - 10.0 ** rng.uniform(-12, -1, 1000)
    for (a, b, c), volume in zip(normals, volumes):
        assert volume_below(a, b, c, plane_distance(a, b, c, volume)) == pytest.approx(volume, abs=1e-10)


def signed_normals(rng, count):
    return random_normals(rng, count, -4.0) * rng.choice([-1.0, 1.0], (count, 3))


def test_two_slabs_add_up_to_the_whole(rng):
    """Low slab plus high slab is the volume of the cell, each in [0, its thickness]; signs as they come.

    Fails when ``near = (nx >= 0.0) != high`` loses its ``!= high``, or ``start`` its ``- share``.
    """
    for (a, b, c), share, volume in zip(signed_normals(rng, 2000), rng.random(2000), rng.random(2000)):
        distance = plane_distance(abs(a), abs(b), abs(c), volume)
        low, high = slab_volume(a, b, c, distance, share, False), slab_volume(a, b, c, distance, 1.0 - share, True)
        assert low + high == pytest.approx(volume, abs=1e-10)
        assert 0.0 <= low <= share * (1.0 + 1e-15)
        assert 0.0 <= high <= (1.0 - share) * (1.0 + 1e-15)


def test_slab_volume_matches_counted_points(rng):
    """Against 40 planes of a 60^3 grid of points; fails when ``nx >= 0.0`` is negated."""
    s = (np.arange(60) + 0.5) / 60
    x, y, z = s[None, None, :], s[None, :, None], s[:, None, None]
    for (a, b, c), share, volume in zip(signed_normals(rng, 40), rng.uniform(0.1, 0.9, 40), rng.random(40)):
        distance = plane_distance(abs(a), abs(b), abs(c), volume)
        below = a * x + b * y + c * z < distance - sum(max(-q, 0.0) for q in (a, b, c))
        for high in (False, True):
            slab = (x > 1.0 - share) if high else (x < share)
            counted = np.count_nonzero(below & slab) / s.size**3
            assert slab_volume(a, b, c, distance, share, high) == pytest.approx(counted, abs=0.03)


def fractions_of(normal, distance):
    """Return the volume fractions of 5 x 5 x 5 cells around the origin below n . x = distance (cells)."""
    f = np.empty(SIZES)
    for k, j, i in product(range(5), repeat=3):
        low = np.array([i, j, k]) - 2.5
        # reflected so that all components are positive, as volume_below wants them
        start = sum(q * (p if q > 0.0 else p + 1.0) for q, p in zip(normal, low))
        f[k, j, i] = volume_below(*np.abs(normal), distance - start)
    return f.reshape(-1)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_normal_of_a_plane_along_an_axis_is_exact(axis, sign):
    """Any fill of the middle cell; fails when ``along >= 0.0`` becomes ``along <= 0.0``."""
    normal = sign * np.eye(3)[axis]
    for distance in (-0.49, -0.2, 0.0, 0.31, 0.49):
        f = (np.indices(SIZES)[2 - axis] - 2.0) * sign
        f = np.clip(distance - f + 0.5, 0.0, 1.0).reshape(-1)
        assert np.abs(np.array(interface_normal(f, CENTRE, *STRIDES)) - normal).max() < 1e-15


def test_normal_of_a_gently_sloped_plane_is_exact(rng):
    """Where the plane leaves the nine columns of three cells through their sides only, heights give it exactly.

    Fails when the first 0.5 of the column heights becomes 0.4.
    """
    for _ in range(100):
        axis, slopes = rng.integers(3), rng.uniform(-0.45, 0.45, 2)
        normal = np.roll(np.array([rng.choice([-1.0, 1.0]), *slopes]), axis)
        normal /= np.abs(normal).sum()
        found = interface_normal(fractions_of(normal, 0.0), CENTRE, *STRIDES)
        assert np.abs(np.array(found) - normal).max() < 1e-6


def test_normal_of_any_plane_is_close(rng):
    """Random directions and fills: 0.3 degrees in the mean, 2 at worst; unit sum; every axis is treated alike.

    Fails when ``best > max(...)`` in ``interface_normal`` is turned round.
    """
    angles = []
    for direction, distance in zip(rng.normal(size=(300, 3)), rng.uniform(-0.3, 0.3, 300)):
        normal = direction / np.abs(direction).sum()
        f = fractions_of(normal, distance)
        if not 1e-3 < f[CENTRE] < 1.0 - 1e-3:
            continue
        found = np.array(interface_normal(f, CENTRE, *STRIDES))
        assert np.abs(found).sum() == pytest.approx(1.0, abs=1e-14)
        cosine = found @ normal / np.linalg.norm(found) / np.linalg.norm(normal)
        angles.append(np.degrees(np.arccos(min(cosine, 1.0))))
        cycled = np.ascontiguousarray(f.reshape(SIZES).transpose(1, 2, 0)).reshape(-1)
        turned = interface_normal(cycled, CENTRE, *STRIDES)
        assert np.abs(np.array(turned) - found[[2, 0, 1]]).max() < 1e-12
    assert len(angles) > 200
    assert np.mean(angles) < 0.3
    assert max(angles) < 2.0


def test_the_area_of_a_section_is_the_slope_of_the_volume(rng):
    """2,000 random planes against differences; fails when ``m12 <= m3`` is turned round or a factor of 2.0 dropped."""
    step = 1e-6
    for (a, b, c), distance in zip(random_normals(rng, 2000, -2.0), rng.uniform(0.01, 0.99, 2000)):
        slope = (volume_below(a, b, c, distance + step) - volume_below(a, b, c, distance - step)) / (2.0 * step)
        assert section_area(a, b, c, distance) == pytest.approx(slope * np.hypot(np.hypot(a, b), c), abs=2e-4)


def painted_sphere(centre, radius):
    """Return exact volume fractions (12 cells a side) of a sphere."""
    fractions = np.zeros((12, 12, 12))
    x, y, z, r = (np.array([value]) for value in (*centre, radius))
    add_spheres(x, y, z, r, (0, 0, 0), 1.0, fractions)
    return fractions


def mixed_cells(fractions):
    return [tuple(cell) for cell in np.argwhere((fractions > 0.02) & (fractions < 0.98))]


@pytest.mark.parametrize("radius", [2.5, 4.0])
def test_the_curvature_of_a_sphere(radius, rng):
    """One over the radius within a quarter in the mean, and the opposite of it in a hole of that shape.

    Fails when the mixed derivatives of :func:`interface_curvature` lose their factor of two, or its sign turns.
    """
    sphere = painted_sphere(6.0 + rng.uniform(-0.5, 0.5, 3), radius)
    for fractions, sign in ((sphere, 1.0), (1.0 - sphere, -1.0)):
        flat = fractions.reshape(-1)
        found = [interface_curvature(flat, (k * 12 + j) * 12 + i, 1, 12, 144) for k, j, i in mixed_cells(fractions)]
        assert sign * radius * np.mean(found) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("high", [False, True])
@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_slabs_of_a_sphere_are_those_of_a_curved_surface(high, share, rng):
    """Slabs of all mixed cells of exact spheres: planes take too much, curved surfaces less than a tenth of that.

    That excess is what carries bodies ahead of their velocity. Fails when ``near`` of :func:`slab_bulge` is turned, or
    its sign, or ``TAPER`` is one.
    """
    of_planes, of_curved = 0.0, 0.0
    for _ in range(12):
        radius, centre = 2.5, 6.0 + rng.uniform(-0.5, 0.5, 3)
        fractions = painted_sphere(centre, radius)
        flat = fractions.reshape(-1)
        for k, j, i in mixed_cells(fractions):
            n = (k * 12 + j) * 12 + i
            a, b, c = interface_normal(flat, n, 1, 12, 144)
            distance = plane_distance(abs(a), abs(b), abs(c), flat[n])
            low, end = (i + 1.0 - share, i + 1.0) if high else (float(i), i + share)
            exact = sphere_box_volume(*centre, radius, low, end, float(j), j + 1.0, float(k), k + 1.0)
            plane = slab_volume(a, b, c, distance, share, high)
            curvature = interface_curvature(flat, n, 1, 12, 144)
            of_planes += plane - exact
            of_curved += plane + slab_bulge(a, b, c, distance, share, high, curvature) - exact
    assert of_planes > 0.05 * 12
    assert abs(of_curved) < 0.1 * of_planes
