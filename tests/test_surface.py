"""The surface of a deposit, on columns whose height is known."""

import numpy as np
import pytest
from scipy import ndimage

from f2s_hpc.analysis import surface
from f2s_hpc.analysis.surface import attached_material, dense_height, grounded_cells, landed_surface

DX = 2e-6


def height_of_column(*fill, flying=()):
    """Return the height of a box of one column, from the bottom up; all but the cells ``flying`` has landed."""
    fraction = np.array(fill, dtype=float).reshape(-1, 1, 1)
    landed = np.ones(fraction.shape, dtype=bool)
    landed[list(flying)] = False
    return landed_surface(fraction, landed, DX)[0, 0]


@pytest.mark.parametrize(("fill", "cells"), [
    ((1.0, 1.0, 0.0, 0.0), 2.0),
    ((1.0, 1.0, 0.3, 0.0), 2.3),
    ((1.0, 0.7, 0.0, 0.0), 1.7),
    ((1.0, 0.7, 0.2, 0.4), 1.9),
    ((1.0, 0.0, 0.0, 0.8), 3.8),
    ((1.0, 1.0, 1.0, 1.0), 4.0),
    ((0.5, 0.0, 0.0, 0.0), 0.5),
    ((0.4, 0.0, 0.0, 0.0), 0.0),
])
def test_height_of_a_column_at_rest(fill, cells):
    """Fails when the fill of the cell above is left out, or the top is sought from below."""
    assert height_of_column(*fill) == pytest.approx(cells * DX, abs=1e-18)


def test_a_particle_in_flight_does_not_count():
    """Fails when ``solid`` leaves out ``landed``."""
    fill = (1.0, 0.8, 0.0, 0.4, 1.0, 0.6)
    assert height_of_column(*fill, flying=(3, 4, 5)) == pytest.approx(1.8 * DX)
    assert height_of_column(*fill) == pytest.approx(5.6 * DX)


@pytest.mark.parametrize("fill_above", [0.3, 0.9])
def test_a_particle_just_above_the_surface_adds_nothing(fill_above):
    """Fails when ``resting`` counts material in flight, or a cell that is half full or more."""
    assert height_of_column(1.0, 1.0, fill_above, 0.0, flying=(2,)) == pytest.approx(2.0 * DX)


def test_columns_are_independent_and_the_map_is_y_by_x():
    """Fails when the map is transposed."""
    nz, ny, nx = 6, 3, 4
    cells = np.arange(ny * nx).reshape(ny, nx) % 5 + 0.25
    fraction = np.clip(cells - np.arange(nz)[:, None, None], 0.0, 1.0).astype(np.float32)
    height = landed_surface(fraction, np.ones(fraction.shape, dtype=bool), DX)
    expected = np.where(cells >= 0.5, cells, 0.0) * DX
    assert height.shape == (ny, nx)
    np.testing.assert_allclose(height, expected, atol=1e-12)


def test_dense_height_is_volume_over_area():
    """Fails when pores are counted as material, the substrate is not taken off, or the area is that of a square."""
    fraction = np.zeros((10, 2, 3), dtype=np.float32)
    fraction[:3] = 1.0
    fraction[5, 0, 0], fraction[6, 1, 1] = 1.0, 0.5
    assert dense_height(fraction, DX, 3 * DX) == pytest.approx(1.5 / 6 * DX, rel=1e-12, abs=0.0)
    assert dense_height(fraction[:2], DX, 3 * DX) == pytest.approx(-DX)


def test_a_fragment_in_the_air_is_not_attached():
    """Fails when slow alone counts, when a corner attaches, or thin material on the surface is lost."""
    fraction = np.zeros((8, 3, 6))
    fraction[:3] = 1.0
    fraction[3, :, 1] = 0.3
    fraction[5, 1, 2:4] = fraction[6, 1, 3] = 0.9
    fraction[3, 1, 5], fraction[4, 1, 4] = 1.0, 1.0  # the second touches the first by an edge only
    slow = np.ones(fraction.shape, dtype=bool)
    slow[2, 0, 0] = False
    found = attached_material(fraction, slow)
    assert found[:2].all()
    assert not found[2, 0, 0]
    assert found[3, :, 1].all()
    assert found[3, 1, 5]
    assert not found[4, 1, 4]
    assert not found[5:].any()
    height = landed_surface(fraction, found, DX)
    assert height[1, 3] == pytest.approx(3 * DX)
    assert height[1, 1] == pytest.approx(3.3 * DX)
    assert not attached_material(np.zeros((2, 2, 2)), np.ones((2, 2, 2), dtype=bool)).any()


def test_slow_thin_cells_on_all_sides_of_a_firm_one_are_attached():
    """A firm cell on a stalk, thin ones all around. Fails when ``with_skin`` misses a side, or takes fast cells."""
    fraction, slow = np.zeros((7, 5, 5)), np.ones((7, 5, 5), dtype=bool)
    fraction[2:5, 1:4, 1:4], fraction[5:] = 0.3, 0.2
    fraction[:4, 2, 2] = 1.0
    found = attached_material(fraction, slow)
    assert found[2:5, 1:4, 1:4].all()
    assert not found[5:].any()
    slow[4, 1:3, 1:3] = False
    assert np.array_equal(attached_material(fraction, slow), found & slow)


@pytest.mark.parametrize("at_once", [1, 40, 100, 2**22])
def test_what_is_grounded_does_not_depend_on_the_slabs(at_once, rng, monkeypatch):
    """A pipe that winds up and down through all slabs, and rubble: as labels of the whole box have it.

    Fails when slabs are not looked at again from above (leave ``first - 1`` out of the places that wait).
    """
    monkeypatch.setattr(surface, "LABELLED_AT_ONCE", at_once)
    pipe = np.zeros((12, 1, 15), dtype=bool)
    pipe[:, 0, ::2] = True
    pipe[0, 0, 1:] = False
    pipe[11, 0, 1::4] = pipe[1, 0, 3::4] = True
    assert (grounded_cells(pipe) == pipe).all()
    pipe[11, 0, 1] = False
    assert grounded_cells(pipe).sum() == 12
    for _ in range(20):
        solid = rng.random((9, 6, 7)) < 0.4
        labels, _ = ndimage.label(solid)
        assert np.array_equal(grounded_cells(solid), solid & np.isin(labels, labels[0]))
