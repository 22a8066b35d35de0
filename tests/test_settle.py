"""Which spheres of a list keep their places: the volume that two share, and who must go elsewhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from f2s_hpc.particles.packing import settle_in_order, shared_volume


def test_the_volume_that_two_spheres_share_is_that_of_two_caps():
    """Each cap is pi h^2 (3 R - h) / 3; fails when the difference of the radii is left out of ``shared_volume``."""
    for distance, a, b in ((8.0, 8.0, 8.0), (15.9, 8.0, 8.0), (2.5, 2.0, 1.0), (1.2, 1.0, 2.0)):
        plane = (distance**2 + a**2 - b**2) / (2.0 * distance)
        caps = [math.pi * h**2 * (3.0 * r - h) / 3.0 for h, r in ((a - plane, a), (b - distance + plane, b))]
        assert shared_volume(distance, a, b) == pytest.approx(sum(caps), rel=1e-12)
    for distance, a, b in ((0.0, 2.0, 2.0), (0.5, 2.0, 5.0), (3.0, 5.0, 2.0)):
        assert shared_volume(distance, a, b) == pytest.approx(4.0 / 3.0 * math.pi * 8.0, rel=1e-12)
    assert shared_volume(16.0, 8.0, 8.0) == 0.0


def test_spheres_settle_in_their_order_as_all_pairs_tell():
    """Against a loop over all pairs; fails when ``_settle`` walks along x by the radius of the sphere alone."""
    x, y, z, r = np.random.Generator(np.random.PCG64(9)).random((4, 600))
    r, allowed = 0.005 + 0.04 * r, 0.002**3
    settled, crowded = np.zeros((2, 600), dtype=np.bool_)
    crowded[::7] = True
    expected = np.zeros(600, dtype=np.bool_)
    for s in np.flatnonzero(~crowded):
        distance = np.sqrt((x - x[s])**2 + (y - y[s])**2 + (z - z[s])**2)
        shared = [shared_volume(distance[o], r[o], r[s]) for o in np.flatnonzero(expected)]
        expected[s] = sum(shared) <= allowed
    settle_in_order(x, y, z, r, allowed, settled, crowded)
    assert 100 < expected.sum() < 500
    assert np.array_equal(settled, expected)
    assert np.array_equal(crowded, ~expected)
