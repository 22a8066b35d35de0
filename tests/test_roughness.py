"""The Gaussian filter of ISO 16610-21 and the roughness of sines, known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from f2s_hpc.analysis.roughness import MIRROR, RENORMALISED, areal_roughness, mean_line, profile_roughness
from f2s_hpc.errors import InputError

DX, AMPLITUDE = 1e-6, 3e-6


def sine(wavelength: float, waves: float = 10.0) -> np.ndarray:
    """Return a cosine that a mirror at either end continues: extrema at the sides of the box."""
    n = round(waves * wavelength / DX)
    return AMPLITUDE * np.cos(2.0 * math.pi * (np.arange(n) + 0.5) * DX / wavelength)


@pytest.mark.parametrize(("ratio", "kept"), [(1.0, 0.5), (2.0, 2.0**-0.25), (0.5, 2.0**-4)])
@pytest.mark.parametrize("cutoff", [20e-6, 80e-6])
def test_the_mean_line_keeps_what_the_standard_says(cutoff, ratio, kept):
    """Transmission exp(-pi (alpha lc / l)^2), a half at the cutoff. Fails with another alpha, or sigma for lc."""
    wave = sine(ratio * cutoff)
    line = mean_line(wave, DX, cutoff)
    assert np.ptp(line) / np.ptp(wave) == pytest.approx(kept, rel=2e-3)
    np.testing.assert_allclose(line, kept * wave, atol=2e-3 * AMPLITUDE)


@pytest.mark.parametrize("ends", [MIRROR, RENORMALISED])
def test_a_level_and_the_ends_stay(ends):
    """Fails when the profile is taken as zero beyond its ends: the mean line would dive there."""
    level = np.full(57, 7e-6)
    np.testing.assert_allclose(mean_line(level, DX, 80e-6, ends), level, rtol=1e-12)
    found = profile_roughness(level, DX, 80e-6, ends)
    assert found.Ra < 1e-18
    assert found.length == pytest.approx(57e-6)


def test_roughness_of_a_short_sine():
    """Far below the cutoff all is roughness: Ra = 2 a / pi, Rq = a / sqrt 2. Fails when the two are swapped."""
    found = profile_roughness(np.stack([sine(20e-6, 40)] * 3), DX, 160e-6)
    assert found.Ra == pytest.approx(2.0 * AMPLITUDE / math.pi, rel=5e-3)
    assert found.Rq == pytest.approx(AMPLITUDE / math.sqrt(2.0), rel=1e-3)
    assert found.Pq == pytest.approx(found.Rq, rel=1e-3)
    assert (found.Ra_scatter, found.profiles) == (pytest.approx(0.0, abs=1e-15), 3)
    assert found.standard


def test_at_the_cutoff_half_is_roughness_and_pa_keeps_all():
    found = profile_roughness(sine(80e-6, 4), DX, 80e-6)
    assert found.Ra == pytest.approx(AMPLITUDE / math.pi, rel=5e-3)
    assert found.Pa == pytest.approx(2.0 * AMPLITUDE / math.pi, rel=5e-3)
    assert not found.standard


def test_profiles_of_different_height_scatter_and_have_mean_lines_of_their_own():
    """One twice as rough as the other, and higher: means 3/2, deviations 1/2 of the first, and no step between them.

    Fails when the deviations are of other numbers, or ``primary`` is taken about the mean of all profiles
    (``height.mean()``).
    """
    wave = sine(20e-6, 40)
    found = profile_roughness(np.stack([wave, 2.0 * wave + 40e-6]), DX, 160e-6)
    Ra, Rq = 2.0 * AMPLITUDE / math.pi, AMPLITUDE / math.sqrt(2.0)
    assert (found.Ra, found.Ra_scatter) == pytest.approx((1.5 * Ra, 0.5 * Ra), rel=5e-3)
    assert (found.Rq, found.Rq_scatter) == pytest.approx((1.5 * Rq, 0.5 * Rq), rel=5e-3)
    assert (found.Pa, found.Pq) == pytest.approx((1.5 * Ra, 1.5 * Rq), rel=5e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_each_direction_of_a_surface_has_its_own_ends(axis):
    """A surface that varies along one direction only is as rough as its profile, with the ends of that direction.

    Fails when ``areal_roughness`` filters along y with the ends of x (``ends[0], axis=0``), or ``mean_line``
    renormalises along the last axis always (``shape[-1] = -1``, ``height.shape[-1]``).
    """
    ramp = 0.1 * DX * np.arange(50.0)  # mirrored or not, its ends differ
    surface = np.repeat(np.expand_dims(ramp, 1 - axis), 30, axis=1 - axis)
    wanted = {ends: profile_roughness(ramp, DX, 40e-6, ends) for ends in (MIRROR, RENORMALISED)}
    assert wanted[MIRROR].Ra < 0.8 * wanted[RENORMALISED].Ra
    for own, other in ((MIRROR, RENORMALISED), (RENORMALISED, MIRROR)):
        found = areal_roughness(surface, DX, 40e-6, (own, other) if axis == 1 else (other, own))
        assert (found.Sa, found.Sq) == pytest.approx((wanted[own].Ra, wanted[own].Rq), rel=1e-9, abs=0.0)


def test_areal_roughness_of_an_egg_box():
    """cos x cos y at the cutoff along both: the mean surface keeps 0.5 x 0.5.

    Fails when one direction is left out, or a number without filter is taken of what the filter left.
    """
    wave = sine(40e-6, 5) / AMPLITUDE
    surface = AMPLITUDE * np.outer(wave, wave) + 50e-6
    found = areal_roughness(surface, DX, 40e-6)
    assert found.Sq == pytest.approx(0.75 * AMPLITUDE / 2.0, rel=3e-3)
    assert found.Sq_unfiltered == pytest.approx(AMPLITUDE / 2.0, rel=1e-6)
    assert found.Sa == pytest.approx(0.75 * AMPLITUDE * (2.0 / math.pi) ** 2, rel=6e-3)
    assert found.Sa_unfiltered == pytest.approx(AMPLITUDE * (2.0 / math.pi) ** 2, rel=6e-3)
    assert found.Sz_unfiltered == pytest.approx(2.0 * AMPLITUDE, rel=1e-2)
    # of a product of two sines: no skewness, kurtosis (3/2)^2
    assert (found.Ssk_unfiltered, found.Sku_unfiltered) == pytest.approx((0.0, 2.25), abs=1e-2)


def test_what_cannot_be_filtered_is_refused():
    with pytest.raises(InputError, match="at least 4 cells"):
        mean_line(np.zeros(50), DX, 3e-6)
    with pytest.raises(InputError, match="at least 4 cells"):
        mean_line(np.zeros(50), DX, math.nan)
    with pytest.raises(InputError, match="at most 50,000 cells"):  # (a longer one fills the memory with weights)
        mean_line(np.zeros(50), DX, 1e300)
    with pytest.raises(InputError, match="ends"):
        mean_line(np.zeros(50), DX, 30e-6, "periodic")
    with pytest.raises(InputError, match="three points"):
        profile_roughness(np.zeros(2), DX, 30e-6)
    with pytest.raises(InputError, match="ny, nx"):
        areal_roughness(np.zeros(20), DX, 30e-6)


def test_peaks_on_a_plain_are_skewed_upwards_and_a_plain_has_no_shape():
    """One cell in a hundred stands up: Ssk = 98 / sqrt(99), Sku = 97 + 1/99 + ...; fails if the powers are swapped."""
    surface = np.zeros((20, 20))
    surface[::10, ::10] = 5e-6
    found = areal_roughness(surface, DX, 20.0 * DX)
    share = 0.01
    assert found.Ssk_unfiltered == pytest.approx((1.0 - 2.0 * share) / np.sqrt(share * (1.0 - share)))
    assert found.Sku_unfiltered == pytest.approx((1.0 - 3.0 * share * (1.0 - share)) / (share * (1.0 - share)))
    flat = areal_roughness(np.full((20, 20), 3e-6), DX, 20.0 * DX)
    assert np.isnan(flat.Ssk_unfiltered)
    assert np.isnan(flat.Sku_unfiltered)
