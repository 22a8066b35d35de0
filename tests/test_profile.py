"""Heights and profiles across a track, on triangles and steps whose sizes are known."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc.analysis.profile import Profile, heights, mean_profile, mirrored, overlap, profile_size
from f2s_hpc.errors import InputError
from f2s_hpc.report.experiment import read_profile

DX = 2e-6


def triangle(centre: float, half: float, top: float, points: int = 401, reach: float = 400e-6) -> Profile:
    x = np.linspace(-reach, reach, points)
    return Profile(x, np.maximum(0.0, top * (1.0 - np.abs(x - centre) / half)))


def test_heights_of_a_stepped_surface():
    """Fails when a height counts from the bottom of the box, or percentile and maximum are mixed up."""
    surface = np.full((10, 10), 30e-6)
    surface[0, :5] = 70e-6
    found = heights(surface, 11e-6, 10e-6)
    assert found == pytest.approx({"dense": 11e-6, "mean": 22e-6, "median": 20e-6, "p95": 22e-6, "maximum": 60e-6},
                                  rel=1e-6)


@pytest.mark.parametrize(("along", "cells"), [("y", 4), ("x", 3)])
def test_the_profile_is_the_mean_along_the_track(along, cells):
    """Fails when the two directions are swapped."""
    surface = np.add.outer(10.0 * np.arange(3), np.arange(4)) * DX
    profile = mean_profile(surface, DX, 0.0, along)
    assert profile.x == pytest.approx((np.arange(cells) + 0.5) * DX)
    expected = 10.0 + np.arange(4) if along == "y" else 10.0 * np.arange(3) + 1.5
    assert profile.height == pytest.approx(expected * DX)


def test_size_of_a_triangle():
    """Fails when the width is taken at another level, or the area counts what lies below the substrate."""
    size = profile_size(triangle(0.0, 200e-6, 100e-6))
    assert size.maximum == pytest.approx(100e-6)
    assert size.width == pytest.approx(0.95 * 400e-6, rel=1e-9)
    assert size.area == pytest.approx(200e-6 * 100e-6, rel=1e-4)


def test_a_patch_that_is_covered_everywhere_is_as_wide_as_its_box():
    surface = np.full((5, 20), 50e-6)
    size = profile_size(mean_profile(surface, DX, 10e-6))
    assert (size.width, size.area) == pytest.approx((20 * DX, 20 * DX * 40e-6))


def test_overlap_of_two_shifted_triangles():
    """Two equal triangles of half width b, d apart: common area b h (1 - d / 2 b)^2. Fails with another ratio."""
    one, two = triangle(0.0, 200e-6, 100e-6), triangle(100e-6, 200e-6, 100e-6)
    common = (1.0 - 100.0 / 400.0) ** 2
    found = overlap(one, two)
    assert found.over_second == pytest.approx(common, rel=1e-4)
    assert found.over_union == pytest.approx(common / (2.0 - common), rel=1e-4)
    aligned = overlap(one, two, align=True)
    assert aligned.shift == pytest.approx(100e-6, rel=1e-9)
    assert aligned.over_union > 0.995


def test_overlap_of_a_higher_profile_counts_its_excess():
    """Twice as high: the common area is all of the lower one. Fails when the ratio forgives what is too high."""
    found = overlap(triangle(0.0, 200e-6, 200e-6), triangle(0.0, 200e-6, 100e-6))
    assert found.over_second == pytest.approx(1.0)
    assert found.over_union == pytest.approx(0.5)


def test_what_lies_below_the_substrate_top_has_no_area():
    """A moat beside the track; fails when ``np.maximum(..., 0.0)`` is left out of ``profile_size`` or ``overlap``."""
    track = triangle(0.0, 200e-6, 100e-6)
    moat = Profile(track.x, np.where(np.abs(track.x) > 250e-6, -30e-6, track.height))
    assert profile_size(moat) == profile_size(track)
    for one, two in ((moat, track), (track, moat), (moat, moat)):
        found = overlap(one, two, align=True)
        assert (found.over_union, found.over_second, found.shift) == pytest.approx((1.0, 1.0, 0.0), abs=1e-9)


def test_points_of_a_scan_count_by_their_distance():
    """A scan three times as fine on one side; fails when ``_centroid`` weighs every point alike."""
    track = triangle(0.0, 200e-6, 100e-6)
    x = np.concatenate([np.linspace(-400e-6, 0.0, 600, endpoint=False), np.linspace(0.0, 400e-6, 201)])
    found = overlap(track, Profile(x, np.interp(x, track.x, track.height)), align=True)
    assert abs(found.shift) < 0.1e-6


@pytest.mark.parametrize("height", [2e-6, -2e-6])
def test_a_scan_that_shows_more_of_the_substrate_on_one_side_is_aligned(height, rng):
    """A track of 2 mm in the middle of a scan from -2 to 6 mm, whose zero is 2 um off, with noise of 2 um.

    Fails when ``_centroid`` takes all that is above zero: the track would be moved by 0.2 mm, which costs a fifth of
    the overlap.
    """
    track = triangle(0.0, 1e-3, 100e-6, reach=1.5e-3)
    x = np.arange(-2e-3, 6e-3, 10e-6)
    scan = np.interp(x, track.x, track.height) + height + 2e-6 * rng.standard_normal(x.size)
    found = overlap(track, Profile(x + 0.3e-3, scan), align=True)
    assert found.shift == pytest.approx(0.3e-3, abs=10e-6)
    assert found.over_union > 0.93


def test_half_a_track_is_mirrored():
    whole = mirrored(Profile(np.array([1.0, 3.0]), np.array([7.0, 5.0])))
    assert whole.x.tolist() == [-3.0, -1.0, 1.0, 3.0]
    assert whole.height.tolist() == [5.0, 7.0, 7.0, 5.0]


def test_the_width_ends_where_the_profile_crosses_the_level_between_its_points():
    """The level is 5 um: half way on the left, three quarters on the right. Fails when an end is that of a point."""
    size = profile_size(Profile(np.arange(5.0) * 10e-6, np.array([1.0, 9.0, 100.0, 20.0, 0.0]) * 1e-6))
    assert size.width == pytest.approx(37.5e-6 - 5e-6, rel=1e-9)


def test_profiles_without_anything_in_common_are_refused():
    with pytest.raises(InputError, match="nothing in common"):
        overlap(Profile(np.array([0.0, 1.0]), np.ones(2)), Profile(np.array([2.0, 3.0]), np.ones(2)))
    with pytest.raises(InputError, match="without any height"):
        overlap(Profile(np.array([0.0, 1.0]), np.ones(2)), Profile(np.array([0.0, 3.0]), np.zeros(2)))
    with pytest.raises(InputError, match="track can run"):
        mean_profile(np.zeros((2, 2)), DX, 0.0, "z")


@pytest.mark.parametrize(("unit", "factor"), [("um", 1e-6), ("mm", 1e-3)])
def test_a_profile_is_read_in_its_unit(tmp_path, unit, factor):
    """Fails when the unit of the first line is ignored, or points are not sorted."""
    path = tmp_path / "scan.csv"
    path.write_text(f"height_{unit},x_{unit}\n2,3\n1,1\n\n4,2\n", encoding="utf-8")
    profile = read_profile(path)
    assert profile.x == pytest.approx(np.array([1, 2, 3]) * factor)
    assert profile.height == pytest.approx(np.array([1, 4, 2]) * factor)


@pytest.mark.parametrize(("text", "said"), [
    ("x,height\n1,2\n", "first line"), ("x_um,height_um\n1,2\n2,oops\n3,4\n", "row 2: height_um is 'oops'"),
    ("x_um,height_um\n1,2\n2,3\n", "at least three"), ("x_um,height_um\n1,2\n1,3\n2,3\n", "x of its own"),
    ("x_um;height_um\n1,5;2\n2;3 um\n3;4\n", "row 2: height_um is '3 um'"),
    ('x_um,height_um\n1,"' + 200000 * "2", "quote left open"),
    ("", "first line"), ("x_um,height_um\n1,2\n2\n3,4\n", "row 2"), ("x_um,height_um\n1,nan\n2,1\n3,4\n", "row 1")])
def test_a_wrong_profile_is_one_clear_line(tmp_path, text, said):
    path = tmp_path / "scan.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said) as error:
        read_profile(path)
    assert str(path) in str(error.value)
    with pytest.raises(InputError, match="No such file"):
        read_profile(tmp_path / "none.csv")


def test_a_profile_of_one_cell_is_as_wide_as_the_cell():
    """A box one cell wide (plane strain); fails with a ValueError if the stretch is ``np.gradient`` of one place."""
    one = mean_profile(np.array([[30e-6], [50e-6]]), DX, 10e-6)
    size = profile_size(one)
    assert (size.maximum, size.width, size.area) == pytest.approx((30e-6, DX, 30e-6 * DX))
    assert profile_size(mirrored(one)).area == pytest.approx(60e-6 * DX)
    with pytest.raises(InputError, match="one cell wide"):
        overlap(one, triangle(0.0, 1e-4, 1e-5), align=True)
