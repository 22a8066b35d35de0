"""Flattening by both equations: ellipsoids as points and in sections, boundaries by PEEQ, regression and its bands."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from f2s_hpc.analysis.boundaries import basins, section_particles
from f2s_hpc.analysis.flattening import (
    LEAST_POINTS,
    flattening_from_points,
    flattening_from_sizes,
    mean_difference,
    regression,
)
from f2s_hpc.analysis.section_figures import Frame, particle_boundaries
from f2s_hpc.errors import InputError

DX = 1e-6


def ellipsoid(semi_axes: tuple[float, float, float], centre: tuple[float, float, float], n: int = 40) -> np.ndarray:
    """Return evenly spaced points in an ellipsoid, (points, 3)."""
    steps = (np.arange(n) + 0.5) * 2.0 / n - 1.0
    ball = np.stack([a.ravel() for a in np.meshgrid(steps, steps, steps)], axis=1)
    return ball[(ball**2).sum(axis=1) <= 1.0] * semi_axes + centre


def test_ellipsoids_as_points():
    """W = 2 a, H = 2 c, D from the volume. Fails when width and height are swapped, or particles mixed up."""
    oblate, sphere = ellipsoid((20e-6, 20e-6, 5e-6), (1e-4, 2e-4, 3e-5)), ellipsoid((7e-6,) * 3, (0.0, 0.0, 1e-4))
    index = np.concatenate([np.full(len(oblate), 2), np.zeros(len(sphere), dtype=int), [1] * 5])
    points = np.concatenate([oblate, sphere, np.zeros((5, 3))])
    true = np.array([14e-6, 30e-6, 2.0 * np.cbrt(20e-6**2 * 5e-6)])
    order = np.random.Generator(np.random.PCG64(1)).permutation(index.size)
    found = flattening_from_points(index[order], points[order], true)
    assert found.width[[0, 2]] == pytest.approx([14e-6, 40e-6], rel=2e-3)
    assert found.height[[0, 2]] == pytest.approx([14e-6, 10e-6], rel=2e-3)
    assert found.equation_5[[0, 2]] == pytest.approx([1.0, 4.0], rel=3e-3)
    assert found.equation_6[[0, 2]] == pytest.approx([1.0, 4.0 ** (1 / 3)], rel=3e-3)
    assert found.exact_6 == pytest.approx(found.equation_6, rel=3e-3, nan_ok=True)
    assert np.isnan(found.equation_5[1])  # five points are no shape
    assert found.count == 2


def test_as_few_points_as_a_scene_may_ask_for_are_a_shape():
    """Fails when ``count >= LEAST_POINTS`` becomes ``>``: a run with the fewest tracers would measure nothing."""
    ball = np.concatenate([np.zeros((LEAST_POINTS - 6, 3)), np.eye(3), -np.eye(3)]) * 1e-6
    index = np.repeat([0, 1], [LEAST_POINTS, LEAST_POINTS - 1])
    found = flattening_from_points(index, np.concatenate([ball, ball[1:]]), np.full(2, 2e-6))
    assert found.width[0] == pytest.approx(2e-6 * math.sqrt(5.0 * 2.0 / LEAST_POINTS))
    assert np.isnan(found.width[1])


def test_width_of_an_ellipsoid_with_three_axes_is_the_mean_square_one():
    found = flattening_from_points(np.zeros(len(p := ellipsoid((9e-6, 3e-6, 2e-6), (0, 0, 0))), dtype=int), p,
                                   np.array([8e-6]))
    assert found.width[0] == pytest.approx(2.0 * math.sqrt((81 + 9) / 2.0) * 1e-6, rel=2e-3)


@pytest.mark.parametrize(("index", "position", "diameter"), [
    (np.zeros(3, int), np.zeros((2, 3)), np.ones(1)), (np.array([0, 1]), np.zeros((2, 3)), np.ones(1)),
    (np.array([0.0]), np.zeros((1, 3)), np.ones(1)), (np.array([-1]), np.zeros((1, 3)), np.ones(1)),
    (np.zeros(2, int), np.zeros((2, 2)), np.ones(1))])
def test_points_that_do_not_fit_are_refused(index, position, diameter):
    with pytest.raises(InputError, match="flattening"):
        flattening_from_points(index, position, diameter)


def ridged_ellipses() -> tuple[np.ndarray, list[tuple[float, float]]]:
    """Return PEEQ (120, 260), low inside two ellipses and rising to their edges, and their (width, height) in cells."""
    z, x = np.indices((120, 260)) + 0.5
    inner, outer, sizes = np.full(z.shape, np.inf), np.zeros(z.shape), []
    for cx, cz, a, c in ((70.0, 60.0, 50.0, 20.0), (190.0, 70.0, 30.0, 30.0)):
        level = np.hypot((x - cx) / a, (z - cz) / c)
        inner = np.where(level <= 1.0, 0.5 + 2.0 * level**4, inner)
        outer = np.maximum(outer, 2.5 * np.exp(-2.0 * np.maximum(level - 1.0, 0.0)))
        sizes.append((2 * a, 2 * c))
    # beyond the boundaries PEEQ falls away again, so the matrix is a basin of its own, which touches the edges
    return np.minimum(inner, outer), sizes


def test_ellipses_in_a_section():
    """Eqs. (5) and (6) from the basins of PEEQ. Fails when the matrix counts as a particle, or axes are swapped."""
    peeq, sizes = ridged_ellipses()
    found = section_particles(peeq, np.ones_like(peeq), DX, ground=10)
    assert found.width.size == 2
    ratios = flattening_from_sizes(found.width, found.height)
    for n, (width, height) in enumerate(sizes):
        assert found.width[n] == pytest.approx(width * DX, abs=4 * DX)
        assert found.height[n] == pytest.approx(height * DX, abs=4 * DX)
        assert ratios.equation_5[n] == pytest.approx(width / height, rel=0.08)
        assert ratios.equation_6[n] == pytest.approx((width / height) ** (1 / 3), rel=0.03)
    # particles whose centre lies below the substrate top are substrate
    assert section_particles(peeq, np.ones_like(peeq), DX, ground=66).width.size == 1


def test_the_figure_of_a_cut_section_numbers_what_can_be_seen(tmp_path):
    """A long section is cut: fails when a particle beyond the cut is given a place, the mean of nothing."""
    peeq, _ = ridged_ellipses()
    whole = section_particles(peeq, np.ones_like(peeq), DX, ground=10)
    cut = (slice(None), slice(0, 130))  # the second ellipse lies beyond
    found = replace(whole, labels=whole.labels[cut], boundaries=whole.boundaries[cut])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        particle_boundaries(tmp_path / "cut.png", np.ones_like(peeq)[cut], peeq[cut], found,
                            Frame("x", 0.0, -10e-6, DX, 50e-6))
    assert (tmp_path / "cut.png").stat().st_size > 5000


def test_a_particle_on_the_surface_has_no_clear_boundary():
    """Fails when free surface counts as a ridge: the lower particle is closed all round, the upper one is not."""
    peeq, _ = ridged_ellipses()
    fraction = np.ones_like(peeq)
    fraction[78:] = 0.0  # cuts into the second ellipse, which reaches from 40 to 100, and touches the first, 40 to 80
    found = section_particles(peeq, fraction, DX, ground=10)
    assert found.width.size == 1
    assert found.width[0] == pytest.approx(100 * DX, abs=4 * DX)


@pytest.mark.parametrize("turns", range(4))
def test_the_free_share_of_an_outline_counts_all_four_sides(turns):
    """A particle of 12 x 10 cells with void along one side, 12 or 10 of 44 faces: more than a quarter, or less.

    Fails when ``_free_share`` leaves out one of the four directions, or cells less than half full are material.
    """
    for high, wide, measured in ((12, 10, 0), (10, 12, 1)):
        peeq, fraction = np.ones((30, 30)), np.ones((30, 30))
        peeq[8:8 + high, 8:8 + wide] = 5.0
        peeq[9:7 + high, 9:8 + wide] = 0.5
        fraction[8:8 + high, 8 + wide:] = 0.4
        found = section_particles(np.rot90(peeq, turns), np.rot90(fraction, turns), DX, ground=0, smoothing=0.0)
        assert found.width.size == measured


def bricks(rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return PEEQ (81, 121) of a brick wall, bricks 24 x 10 cells with joints of high PEEQ, and each cell's brick."""
    z, x = np.indices((81, 121))
    course = z // 10
    shifted = x + 12 * (course % 2)
    distance = np.minimum(np.minimum(z % 10, 9 - z % 10), np.minimum(shifted % 24, 23 - shifted % 24))
    peeq = 1.0 + 3.0 * np.exp(-distance / 1.2) + noise * rng.standard_normal(z.shape)
    return peeq, course * 100 + shifted // 24


def test_every_brick_is_found(rng):
    """Fails when a ridge between neighbours is lost, or noise splits a brick."""
    peeq, brick = bricks(rng, noise=0.05)
    found = basins(peeq, np.ones(peeq.shape, dtype=bool))
    # the heart of each brick, away from its joints, is of one basin, and of no other brick's
    heart = np.exp(-((peeq - 1.0) / 0.6) ** 2) > 0.3
    whole = [b for b in np.unique(brick) if (brick == b).sum() == 240]
    labels = []
    for b in whole:
        values, counts = np.unique(found[(brick == b) & heart], return_counts=True)
        assert counts.max() > 0.97 * counts.sum()
        labels.append(values[counts.argmax()])
    assert len(set(labels)) == len(whole) > 25
    measured = section_particles(peeq, np.ones(peeq.shape), DX, ground=0)
    assert np.median(measured.width) == pytest.approx(24e-6, abs=2e-6)
    assert np.median(measured.height) == pytest.approx(10e-6, abs=2e-6)
    # what an edge cuts is not measured: fails when ``edge`` leaves out one of the four
    assert (measured.labels[[0, -1]] == 0).all()
    assert (measured.labels[:, [0, -1]] == 0).all()
    # in the substrate nothing is drawn: fails without ``boundaries[:ground] = False``
    above = section_particles(peeq, np.ones(peeq.shape), DX, ground=40).boundaries
    assert not above[:40].any()
    assert (above[40:] == measured.boundaries[40:]).all()


def test_low_ridges_are_no_boundaries(rng):
    """Fails when prominence is taken against the deeper basin, or not at all, or ``PROMINENCE`` is 0.05 or 0.25."""
    peeq, _ = bricks(rng)
    assert basins(peeq, np.ones(peeq.shape, dtype=bool), prominence=0.9).max() == 1
    # a deep basin (0.2) and a shallow one (0.9) beyond a ridge of 1: the ridge hardly rises above the shallow one
    row = np.interp(np.arange(61), [0, 20, 30, 45, 60], [1.0, 0.2, 1.0, 0.9, 1.05])
    section, material = np.tile(row, (12, 1)), np.ones((12, 61), dtype=bool)
    assert basins(section, material, prominence=0.15, smoothing=0.0).max() == 1
    assert basins(section, material, prominence=0.05, smoothing=0.0).max() == 2
    assert basins(section, material, smoothing=0.0).max() == 1
    assert basins(np.where(section == 0.9, 0.8, section), material, smoothing=0.0).max() == 2


def test_a_line_of_strain_one_cell_wide_is_a_boundary():
    """Half of it is left where it is. Fails when ``SMOOTHING`` is 2 cells, that leave a fifth."""
    peeq = np.ones((20, 30))
    peeq[:, 14] = 1.6
    assert basins(peeq, np.ones(peeq.shape, dtype=bool)).max() == 2


def test_a_basin_of_a_few_cells_is_noise():
    """Two rings, one around a single cell; fails when ``own.sum() < least_pixels`` is left out."""
    peeq = np.ones((40, 40))
    for row, column, half in ((8, 8, 0), (25, 25, 4)):
        peeq[row - half - 1:row + half + 2, column - half - 1:column + half + 2] = 5.0
        peeq[row - half:row + half + 1, column - half:column + half + 1] = 0.5
    found = section_particles(peeq, np.ones(peeq.shape), DX, ground=0, smoothing=0.0)
    assert found.width == found.height == pytest.approx([11e-6])
    assert section_particles(peeq, np.ones(peeq.shape), DX, 0, smoothing=0.0, least_pixels=9).width.size == 2


def test_basins_that_became_one_are_as_deep_as_their_deeper_part():
    """A deep basin takes a shallow one, and the next ridge is held to it; fails when ``_merge`` keeps the shallow."""
    row = np.interp(np.arange(91), [0, 15, 30, 45, 60, 75, 90], [1.0, 0.2, 1.0, 0.9, 1.02, 0.3, 1.0])
    section = np.tile(row, (8, 1))
    assert basins(section, np.ones(section.shape, dtype=bool), prominence=0.15, smoothing=0.0).max() == 2


def test_void_does_not_dilute_the_strain_beside_it():
    """Even strain in thin arms and a thick middle; fails when ``_smoothed`` is not divided by the material's weight."""
    material = np.zeros((11, 41), dtype=bool)
    material[5] = True
    material[2:9, 17:24] = True
    assert basins(np.where(material, 0.7, 0.0), material).max() == 1


def test_void_parts_particles_of_equal_strain():
    """Fails when void is filled with the neighbours' PEEQ."""
    material = np.ones((20, 41), dtype=bool)
    material[:, 20] = False
    found = basins(np.full(material.shape, 0.7), material)
    assert (found[:, 20] == 0).all()
    assert {int(found[5, 5]), int(found[5, 35])} == {1, 2}
    assert basins(np.ones((4, 4)), np.zeros((4, 4), dtype=bool)).max() == 0
    with pytest.raises(InputError, match="sections"):
        basins(np.ones((4, 4)), np.ones((4, 5), dtype=bool))


def test_regression_and_its_bands(rng):
    """Against closed forms. Fails when a band has another level, n - 1 degrees of freedom, or the slope no error."""
    x = np.linspace(10e-6, 60e-6, 25)
    y = 1.1 + 6e3 * x + 0.1 * rng.standard_normal(x.size)
    fit = regression(np.append(x, np.nan), np.append(y, 1.0))
    slope, intercept = np.polyfit(x, y, 1)
    assert (fit.slope, fit.intercept, fit.n) == (pytest.approx(slope), pytest.approx(intercept), 25)
    residual = math.sqrt(((y - intercept - slope * x) ** 2).sum() / 23)
    t = stats.t.ppf(0.95, 23)
    assert fit.confidence(x.mean()) == pytest.approx(t * residual / 5.0)
    assert fit.prediction(x.mean()) == pytest.approx(t * residual * math.sqrt(1.04))
    assert fit.confidence(60e-6) > fit.confidence(x.mean())
    assert fit.slope_error == pytest.approx(residual / math.sqrt(((x - x.mean()) ** 2).sum()))
    assert regression(x[:3], y[:3]) is None
    assert regression(np.ones(9), y[:9]) is None


def test_the_bands_cover_as_often_as_they_say(rng):
    """A 90 % band holds the true line in 90 % of the trials. Fails when its half width is one standard error."""
    x, inside, single = np.linspace(0.0, 1.0, 12), 0, 0
    for _ in range(1500):
        fit = regression(x, 2.0 + x + rng.standard_normal(x.size))
        inside += abs(fit.line(0.8) - 2.8) < fit.confidence(0.8)
        single += abs(fit.line(0.8) - 2.8 - rng.standard_normal()) < fit.prediction(0.8)
    assert inside / 1500 == pytest.approx(0.9, abs=0.025)
    assert single / 1500 == pytest.approx(0.9, abs=0.025)


def test_difference_of_means(rng):
    more = mean_difference(rng.normal(1.2, 0.1, 60), rng.normal(1.4, 0.1, 50))
    assert more.decided
    assert more.difference == pytest.approx(0.2, abs=0.05)
    assert more.low < more.difference < more.high
    first, second = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 4.0, 6.0, 8.0])
    a, b = first.var(ddof=1) / 4, second.var(ddof=1) / 4
    half = stats.t.ppf(0.95, (a + b) ** 2 / ((a**2 + b**2) / 3)) * math.sqrt(a + b)
    found = mean_difference(first, second)
    assert (found.low, found.high) == (pytest.approx(2.5 - half), pytest.approx(2.5 + half))
    assert not mean_difference(np.array([1.0, 2.0, np.nan]), np.array([1.1, 1.8])).decided
    assert mean_difference(np.ones(1), np.ones(5)) is None
