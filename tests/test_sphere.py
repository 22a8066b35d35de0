"""Sphere-in-cell volume fractions against brute force, exact totals, and independence of the index window."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc.kernels.sphere import sphere_bounds, sphere_box_volume, sphere_volume_fractions

COLUMNS_PER_EDGE = 400
WIDE = (-1000, 1000, -1000, 1000, -1000, 1000)


def paint(centre, radius, dx, window, origin=(0.0, 0.0, 0.0)):
    """Return the fractions of the half-open window (i0, i1, j0, j1, k0, k1)."""
    i0, i1, j0, j1, k0, k1 = window
    out = np.full((k1 - k0, j1 - j0, i1 - i0), np.nan)
    sphere_volume_fractions(*centre, radius, *origin, dx, *window, out)
    return out


def brute_force(centre, radius, dx, window, origin):
    """Return the fractions from 400 x 400 columns per cell, each cut at its exact heights."""
    i0, i1, j0, j1, k0, k1 = window
    sub = (np.arange(COLUMNS_PER_EDGE) + 0.5) / COLUMNS_PER_EDGE
    out = np.empty((k1 - k0, j1 - j0, i1 - i0))
    for j in range(j0, j1):
        for i in range(i0, i1):
            x = origin[0] + (i + sub[None, :]) * dx - centre[0]
            y = origin[1] + (j + sub[:, None]) * dx - centre[1]
            half = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0.0))
            for k in range(k0, k1):
                bottom = origin[2] + k * dx - centre[2]
                length = np.minimum(half, bottom + dx) - np.maximum(-half, bottom)
                out[k - k0, j - j0, i - i0] = np.maximum(length, 0.0).mean() / dx
    return out


@pytest.mark.parametrize("cells_per_radius", [0.3, 0.7, 1.0, 1.9, 3.3])
def test_fractions_match_brute_force(cells_per_radius):
    """Random spheres, within the error of the reference (2e-5 of a cell; it falls with the number of columns).

    Fails when ``- c * face_c`` is dropped from the last line of ``_octant``, or when ``2.0 * math.atan2(w, b)``
    in ``_wedge`` loses its factor.
    """
    generator = np.random.Generator(np.random.PCG64(int(10 * cells_per_radius)))
    dx, origin = 3.0e-6, (1.1e-6, -2.0e-6, 0.4e-6)
    for _ in range(3):
        centre, radius = 20e-6 * generator.random(3), cells_per_radius * dx
        window = sphere_bounds(*centre, radius, *origin, dx, *WIDE)
        fractions = paint(centre, radius, dx, window, origin)
        assert np.abs(fractions - brute_force(centre, radius, dx, window, origin)).max() < 2e-5


def test_sphere_centred_on_a_corner_is_eight_equal_octants():
    """It fills pi/6 (r/dx)^3 of each cell; fails when ``- math.pi`` is dropped from ``spherical`` in ``_octant``."""
    fractions = paint((5.0, 5.0, 5.0), 0.8, 1.0, (4, 6, 4, 6, 4, 6))
    assert np.abs(fractions - np.pi / 6 * 0.8**3).max() < 1e-14


@pytest.mark.parametrize("cells_per_radius", [2.0, 4.2, 13.0])
def test_painted_volume_is_the_volume_of_the_sphere(cells_per_radius):
    """Total volume to 1e-12; fails when ``sphere_bounds`` uses floor for the upper index."""
    generator = np.random.Generator(np.random.PCG64(5))
    for _ in range(10):
        centre, dx = 1e-4 * generator.random(3), 3e-6
        radius = cells_per_radius * dx
        window = sphere_bounds(*centre, radius, 0.0, 0.0, 0.0, dx, *WIDE)
        total = paint(centre, radius, dx, window).sum() * dx**3
        assert total / (4 / 3 * np.pi * radius**3) == pytest.approx(1.0, rel=1e-12)


def test_cells_wholly_inside_and_outside_are_exactly_one_and_zero():
    """Fails when the far-corner test asks for <= 0.0 and ``noise`` is 0: full cells then miss 1 by the last digits."""
    centre, radius = np.array([10.37, 9.81, 10.13]), 6.4
    window = (0, 20, 0, 20, 0, 20)
    fractions = paint(centre, radius, 1.0, window)
    index = np.indices(fractions.shape)[::-1].reshape(3, -1).T
    near = np.maximum(np.maximum(index - centre, centre - index - 1), 0)
    far = np.maximum(abs(index - centre), abs(index + 1 - centre))
    near, far = (np.linalg.norm(corner, axis=1).reshape(fractions.shape) for corner in (near, far))
    assert np.all(fractions[far < radius - 1e-9] == 1.0)
    assert np.all(fractions[near > radius + 1e-9] == 0.0)
    cut = (far > radius + 1e-3) & (near < radius - 1e-1)
    assert np.all((fractions[cut] > 0.0) & (fractions[cut] < 1.0))
    assert cut.sum() > 100


def test_value_of_a_cell_does_not_depend_on_the_window():
    """Bitwise, for every way to cut the window in two; fails when corners are computed as xs[0] + i * dx / radius."""
    centre, radius, dx, origin = (3.1e-5, 2.2e-5, 2.7e-5), 1.37e-5, 3e-6, (1e-6, 0.0, -1e-6)
    window = sphere_bounds(*centre, radius, *origin, dx, *WIDE)
    whole = paint(centre, radius, dx, window, origin)
    for axis in range(3):
        low, high = window[2 * axis], window[2 * axis + 1]
        for cut in range(low + 1, high):
            first, second = list(window), list(window)
            first[2 * axis + 1] = second[2 * axis] = cut
            parts = [paint(centre, radius, dx, tuple(part), origin) for part in (first, second)]
            assert np.array_equal(np.concatenate(parts, axis=2 - axis), whole)


def test_bounds_are_clipped_to_the_rank_and_empty_without_common_cells():
    """Fails when the ``max(i0, ...)`` of the upper index is dropped: the range of a far sphere then runs backwards."""
    assert sphere_bounds(5.0, 5.0, 5.0, 1.5, 0.0, 0.0, 0.0, 1.0, 0, 10, 0, 5, 5, 10) == (3, 7, 3, 5, 5, 7)
    i0, i1, *_ = sphere_bounds(5.0, 5.0, 5.0, 1.5, 0.0, 0.0, 0.0, 1.0, 8, 10, 0, 10, 0, 10)
    assert i0 == i1
    i0, i1, *_ = sphere_bounds(5.0, 5.0, 5.0, 1.5, 0.0, 0.0, 0.0, 1.0, 0, 2, 0, 10, 0, 10)
    assert i0 == i1
    out = np.full((2, 2, 0), np.nan)
    sphere_volume_fractions(5.0, 5.0, 5.0, 1.5, 0.0, 0.0, 0.0, 1.0, 3, 3, 4, 6, 4, 6, out)


def test_box_volume_of_cut_spheres():
    """One plane and two perpendicular planes, against the cap formula and a quadrature.

    Fails when ``2.0 + a`` becomes ``2.0 - a`` in ``_cap``.
    """
    inf = 10.0
    height = 0.35
    cap = np.pi * height**2 * (3 * 1.0 - height) / 3
    assert sphere_box_volume(0.0, 0.0, 0.0, 1.0, 1 - height, inf, -inf, inf, -inf, inf) == pytest.approx(cap, rel=1e-13)
    angle, weight = np.polynomial.legendre.leggauss(60)
    a, b, radius = 0.2, -0.3, 1.3
    reference, kink = 0.0, np.sqrt(radius**2 - b**2)
    theta = np.pi / 2 * angle  # x = middle + half sin(theta) removes the square-root ends
    for lower, upper in ((a, kink), (kink, radius)):
        x = (lower + upper) / 2 + (upper - lower) / 2 * np.sin(theta)
        rho = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
        inside = np.clip(-b / rho, -1, 1)  # disc of radius rho beyond y = b
        area = rho**2 * (np.pi - np.arccos(inside) + inside * np.sqrt(1 - inside**2))
        reference += np.sum(weight * np.pi / 2 * (upper - lower) / 2 * np.cos(theta) * area)
    assert sphere_box_volume(0.0, 0.0, 0.0, radius, a, inf, b, inf, -inf, inf) == pytest.approx(reference, rel=1e-10)
