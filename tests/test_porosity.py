"""Porosity three ways, on packed spheres, a tunnel and a bubble."""

from __future__ import annotations

import math

import numpy as np
import pytest

from f2s_hpc.analysis.porosity import (
    bulk_share,
    bulk_top,
    exact_porosity,
    image_porosity,
    section_porosity,
    split_pores,
)
from f2s_hpc.errors import InputError
from f2s_hpc.kernels.paint import add_spheres

DX = 1e-6


def packed(edge: int, radius: float, number: int = 3) -> np.ndarray:
    """Return the volume fractions of a simple cubic packing, ``number`` spheres along each edge of ``edge`` cells."""
    place = (np.arange(number) + 0.5) * edge * DX
    z, y, x = (a.ravel() for a in np.meshgrid(place, place, place, indexing="ij"))
    fraction = np.zeros((number * edge,) * 3)
    add_spheres(x, y, z, np.full(x.size, radius), (0, 0, 0), DX, fraction)
    return fraction


def test_exact_porosity_of_a_cubic_packing():
    """1 - pi/6 to round-off on coarse cells. Fails when cells are thresholded, or part of the box is left out."""
    fraction = packed(8, 4e-6)
    share = bulk_share(fraction.shape, DX, 0.0, 24e-6)
    assert exact_porosity(fraction, share) == pytest.approx(1.0 - math.pi / 6.0, abs=1e-7)
    # the lower half of each sphere, from a bulk whose top lies inside a cell layer
    half = packed(9, 4.5e-6, 1)
    assert exact_porosity(half, bulk_share(half.shape, DX, 0.0, 4.5e-6)) == pytest.approx(1.0 - math.pi / 6.0, abs=1e-7)


def test_image_porosity_of_a_section_through_the_centres():
    """1 - pi/4 on a fine section, and 1 through the touching planes. Fails when rows of the section are lost."""
    fraction = packed(40, 20e-6, 2)
    bulk = np.ones(fraction.shape[1:], dtype=bool)
    assert image_porosity(fraction[:, 20, :], bulk)[0] == pytest.approx(1.0 - math.pi / 4.0, abs=5e-3)
    share = np.ones(fraction.shape, dtype=np.float32)
    found = section_porosity(fraction, share, sections=80)
    assert found.sections == 160
    assert found.mean == pytest.approx(1.0 - math.pi / 6.0, abs=5e-3)
    assert found.scatter > 0.1


def test_pores_of_a_few_pixels_are_noise():
    fraction = np.ones((20, 20))
    fraction[3, 3:6] = 0.2
    fraction[10:12, 10:12] = 0.2
    bulk = np.ones_like(fraction, dtype=bool)
    assert image_porosity(fraction, bulk)[0] == pytest.approx(4 / 400)
    assert image_porosity(fraction, bulk, smallest=1)[0] == pytest.approx(7 / 400)
    bulk[10:] = False
    assert image_porosity(fraction, bulk)[0] == 0.0


def test_a_tunnel_is_open_and_a_bubble_closed():
    """Fails when open pores are told by the side of the box, or thin gaps are lost from the sum.

    The free space above is one layer, the last: fails, too, when a pore is open only above that (``k > top``).
    """
    fraction = np.ones((27, 20, 20), dtype=np.float32)
    fraction[26:] = 0.0
    fraction[10:26, 5, 5] = 0.0  # from the surface down, then sideways under material
    fraction[10, 5, 5:12] = 0.0
    fraction[15:18, 12:15, 14:18] = 0.0  # 36 cells inside
    fraction[12, :3, 0] = 0.1  # at the side of the box, which is a mirror
    fraction[20, 17, :] = 0.75
    surface = np.full((20, 20), 26.0 * DX)
    share = bulk_share(fraction.shape, DX, 4e-6, np.full((20, 20), 20e-6))
    found = split_pores(fraction, share, surface, DX)
    whole = 16 * 400
    assert found.open == pytest.approx((10 + 6) / whole, rel=1e-5)
    assert found.closed == pytest.approx((36 + 2.7) / whole, rel=1e-5)
    assert found.pores == 2
    assert found.largest == pytest.approx(36 * DX**3, rel=1e-5, abs=0.0)
    assert found.open + found.closed + found.thin == pytest.approx(exact_porosity(fraction, share), rel=1e-5)
    thin = split_pores(fraction, bulk_share(fraction.shape, DX, 4e-6, 24e-6), surface, DX).thin
    assert thin == pytest.approx(20 * 0.25 / (20 * 400), rel=1e-5)


def test_the_largest_pore_is_the_largest_closed_one():
    """Fails when ``volumes`` of all pores stand for those of the ``closed`` ones: the open pore here is larger."""
    fraction = np.ones((20, 10, 10), dtype=np.float32)
    fraction[18:] = 0.0
    fraction[8:18, 2:4, 2:4] = 0.0
    fraction[5:7, 7, 7] = 0.0
    found = split_pores(fraction, bulk_share(fraction.shape, DX, 0.0, 18e-6), np.full((10, 10), 18e-6), DX)
    assert found.pores == 1
    assert found.largest == pytest.approx(2 * DX**3, rel=1e-5, abs=0.0)
    assert (found.open, found.closed) == pytest.approx((40 / 1800, 2 / 1800), rel=1e-5)


def test_a_cell_that_the_substrate_top_crosses_is_no_bulk_and_one_that_the_zone_crosses_is_in_part():
    """Fails when ``first`` of ``bulk_share`` is rounded down, or any bulk makes a pixel count (``> 0.0``)."""
    share = bulk_share((6, 1, 4), DX, 1.5e-6, np.array([[4.4e-6, 4.4e-6, 4.6e-6, 4.6e-6]]))
    assert share[:, 0, 0] == pytest.approx([0.0, 0.0, 1.0, 1.0, 0.4, 0.0])
    fraction = np.ones((6, 1, 4))
    fraction[4] = 0.0  # every pixel of the crossed layer is void: in two columns it counts
    section = section_porosity(fraction, share, sections=1, smallest=1)
    assert section.values == pytest.approx([2 / 10, 1 / 3])


def test_a_single_section_is_the_middle_one():
    """Fails when the planes begin at the side of the box (``np.arange(sections) / sections``)."""
    fraction = np.ones((8, 11, 11))
    fraction[2:6, 5, :] = 0.0
    fraction[2:6, :, 5] = 0.0
    found = section_porosity(fraction, np.ones(fraction.shape), sections=1)
    assert found.sections == 2
    assert found.values == pytest.approx([0.5, 0.5])


def test_the_surface_zone_follows_valleys_and_walls():
    """A point of the bulk is the zone away from all free space. Fails when only the depth in its column counts."""
    surface = np.full((21, 21), 30e-6)
    surface[10, 10] = 12e-6
    top = bulk_top(surface, DX, 5e-6)
    assert top[10, 10] == pytest.approx(7e-6)
    assert top[10, 13] == pytest.approx(12e-6 - 4e-6)
    assert top[10, 15] == pytest.approx(12e-6)
    assert top[10, 16] == pytest.approx(25e-6)
    assert top[0, 0] == pytest.approx(25e-6)
    assert bulk_top(surface, DX, 0.5e-6)[0, 0] == pytest.approx(29.5e-6)


def test_without_bulk_there_is_no_porosity():
    fraction = np.ones((4, 3, 3))
    share = bulk_share(fraction.shape, DX, 3e-6, 2e-6)
    for call in (lambda: exact_porosity(fraction, share), lambda: section_porosity(fraction, share),
                 lambda: split_pores(fraction, share, np.full((3, 3), 4e-6), DX)):
        with pytest.raises(InputError, match="bulk"):
            call()


def test_a_zone_wider_than_the_box_erodes_as_far_as_the_box(rng):
    """Fails if the ball is cut one column too short; with a ball as wide as its zone, if a zone of 1 km ends at all."""
    surface = 1e-3 + 20e-6 * rng.random((5, 3))
    zone, place = 30e-6, np.indices(surface.shape)
    away = sum((axis[:, :, None, None] - axis) ** 2 for axis in place) * DX**2
    assert bulk_top(surface, DX, zone) == pytest.approx((surface - np.sqrt(zone**2 - away)).min(axis=(2, 3)), rel=1e-12)
    for zone in (surface.max() - 5e-6, 1e3, 1e300):
        with pytest.raises(InputError, match="no bulk is left"):
            bulk_top(surface, DX, zone, 5e-6)
