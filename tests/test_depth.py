"""Distributions by depth, on fields whose percentiles are known."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc.analysis.depth import depth_distribution, weighted_percentiles
from f2s_hpc.errors import InputError

DX = 2e-6


def test_a_linear_field():
    """PEEQ = z: the median of a layer is its middle. Fails when layers are not counted from the substrate top."""
    nz = 40
    field = np.broadcast_to(((np.arange(nz) + 0.5) * DX)[:, None, None], (nz, 3, 4))
    found = depth_distribution(field, np.ones_like(field), DX, 20e-6, layer=10e-6)
    assert found.low[found.low >= -1e-12] == pytest.approx(np.arange(0, 60, 10) * 1e-6, abs=1e-12)
    assert found.median == pytest.approx(found.middle + 20e-6)
    assert found.mean == pytest.approx(found.middle + 20e-6)
    assert found.volume == pytest.approx(np.full(8, 5 * 12 * DX**3), rel=1e-6, abs=0.0)
    # five levels of equal weight: 5 and 95 % lie within the outer ones
    assert found.percentiles[:, 0] == pytest.approx(found.low + 20e-6 + 0.5 * DX)
    assert found.percentiles[:, -1] == pytest.approx(found.high + 20e-6 - 0.5 * DX)


def test_a_cell_that_the_substrate_top_crosses_is_substrate():
    """Fails when the bound is rounded to the nearest cell: substrate would count as deposit."""
    field = np.arange(20.0)[:, None, None] * np.ones((1, 2, 2))
    found = depth_distribution(field, np.ones_like(field), DX, 5 * DX, layer=40 * DX)
    assert found.median.tolist() == [2.0, 12.0]
    found = depth_distribution(field, np.ones_like(field), DX, 4.5 * DX, layer=40 * DX)
    assert found.median.tolist() == [2.0, 12.0]
    assert found.low == pytest.approx([-4.5 * DX, 0.5 * DX])


def test_a_linear_field_across_weighs_by_volume():
    """Values 0 to 1 along x, half of the volume missing where they are high. Fails when cells count alike."""
    x = (np.arange(1000) + 0.5) / 1000
    field = np.broadcast_to(x, (5, 2, 1000))
    weight = np.broadcast_to(np.where(x < 0.5, 1.0, 0.5), field.shape)
    found = depth_distribution(field, weight, DX, 0.0, layer=10e-6)
    assert found.median[0] == pytest.approx(0.375, abs=1e-3)
    assert found.mean[0] == pytest.approx((0.5 * 0.25 + 0.25 * 0.75) / 0.75, rel=1e-6)
    assert found.percentiles[0, 1] == pytest.approx(0.1875, abs=1e-3)
    assert found.percentiles[0, 3] == pytest.approx(0.625, abs=1e-3)


def test_layers_without_material_are_not_numbers_or_left_out():
    field = np.ones((20, 2, 2))
    weight = np.zeros_like(field)
    weight[:5] = weight[10:12] = 1.0
    found = depth_distribution(field, weight, DX, 0.0, layer=10e-6)
    assert found.median == pytest.approx([1.0, np.nan, 1.0], nan_ok=True)
    assert found.volume == pytest.approx([20 * DX**3, 0.0, 8 * DX**3], rel=1e-6, abs=0.0)


def test_percentiles_of_equal_weights_are_the_usual_ones(rng):
    values = rng.standard_normal(999)
    shares = (0.05, 0.5, 0.95)
    found = weighted_percentiles(values, np.full(999, 0.3), shares)
    assert found == pytest.approx(np.quantile(values, shares, method="hazen"), abs=1e-12)
    assert np.isnan(weighted_percentiles(values, np.zeros(999), shares)).all()


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="weight"):
        depth_distribution(np.ones((2, 2, 2)), np.ones((2, 2, 3)), DX, 0.0)
    with pytest.raises(InputError, match="thicker"):
        depth_distribution(np.ones((2, 2, 2)), np.ones((2, 2, 2)), DX, 0.0, layer=0.0)
