"""The numbers of the feed: how many particles hit the strip."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import erf

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.particles.feed import TABLE_4, Feed, count_particles
from f2s_hpc.particles.sizes import RosinRammler

UM, MM = 1e-6, 1e-3


def powder() -> RosinRammler:
    return RosinRammler.fit(19 * UM, 30 * UM, 52 * UM, 10 * UM, 85 * UM)


def test_mean_particle_volume_in_closed_form():
    """With an exponent of 6 the integral is an error function; fails when ``power`` is 3 / exponent, unsigned."""
    sizes = RosinRammler(40 * UM, 6.0, 20 * UM, 60 * UM)
    start, end = (20 / 40) ** 6, (60 / 40) ** 6
    above = math.sqrt(math.pi) * (erf(math.sqrt(end)) - erf(math.sqrt(start)))
    wanted = math.pi / 6 * (40 * UM) ** 3 * (math.exp(-start) - math.exp(-end)) / above
    assert sizes.mean_particle_volume() == pytest.approx(wanted, rel=1e-10, abs=0.0)
    d = powder().sample_by_number(200000, np.random.Generator(np.random.PCG64(3)))
    assert np.mean(math.pi / 6 * d**3) == pytest.approx(powder().mean_particle_volume(), rel=0.01, abs=0.0)


@pytest.mark.parametrize(("percentiles", "ends"), [
    ((28, 30, 32), (10, 85)), ((26, 30, 34), (10, 85)), ((24, 30, 36), (5, 150)), ((20, 30, 42), (1, 1000)),
    ((19, 30, 52), (10, 85))])
def test_the_mean_volume_of_narrow_powders(percentiles, ends):
    """Against a fine table in log d; fails when the peak, as narrow as the exponent is large, is stepped over."""
    sizes = RosinRammler.fit(*(value * UM for value in percentiles), *(value * UM for value in ends))
    d = np.geomspace(sizes.minimum, sizes.maximum, 2_000_001)
    power = np.exp(sizes.exponent * np.log(d / sizes.scale))
    by_volume = power * np.exp(power[0] - power)
    wanted = math.pi / 6 * trapezoid(by_volume, np.log(d)) / trapezoid(by_volume / d**3, np.log(d))
    assert sizes.mean_particle_volume() == pytest.approx(wanted, rel=1e-6, abs=0.0)


@pytest.mark.parametrize(("minimum", "percentiles"), [(10, (11, 16, 40)), (15, (16, 20, 35)), (20, (21, 25, 38))])
def test_a_powder_that_falls_from_its_smallest_diameter_on(minimum, percentiles):
    """Its scale is below all diameters. Fails while the fit keeps the scale above the smallest: D50 7 to 13 % off."""
    wanted = [value * UM for value in percentiles]
    sizes = RosinRammler.fit(*wanted, minimum * UM, 85 * UM)
    assert sizes.scale < minimum * UM
    assert max(map(abs, sizes.misfit(*wanted))) < 0.03


def test_feed_numbers_against_the_closed_form_and_table_4():
    """The law by hand; whole batches are table 4, all rows; fails when they are rounded to the nearest (120 mm/s)."""
    feed = Feed(42.2e-3 / 60, 0.0206, 7.3 * MM, 8960.0, powder().mean_particle_volume())
    for speed, paper in TABLE_4.items():
        count = count_particles(feed, speed)
        wanted = 42.2e-3 / 60 * 0.0206 * 7.3e-3 / speed / 8960 / powder().mean_particle_volume()
        assert count.particles == pytest.approx(wanted, rel=1e-12)
        assert count.time == pytest.approx(7.3e-3 / speed, rel=1e-12)
        assert count.mass == pytest.approx(42.2e-3 / 60 * 0.0206 * 7.3e-3 / speed, rel=1e-12)
        assert count.whole_particles == count.paper == paper
        assert count.paper_law == pytest.approx(10236 * 0.160 / speed, rel=1e-12)
        assert count.particles == pytest.approx(count.paper_law, rel=0.03)
    assert round(count_particles(feed, 0.120).paper_law) == 13648
    assert count_particles(feed, 0.1).paper is None
    assert count_particles(feed, 0.160, per_batch=100).whole_batches == 100
    assert feed.share * feed.path == pytest.approx(0.3 * MM / 2, rel=0.003)  # the mass balance of a half strip


def test_round_off_takes_no_further_batch():
    """What makes whole batches to round-off is as many. Fails when ``count_particles`` rounds up as it is."""
    for batches in range(1, 200):
        volume = 7e-4 * 0.02 * 7.3 * MM / (0.16 * 8960.0 * 2559 * batches)
        assert count_particles(Feed(7e-4, 0.02, 7.3 * MM, 8960.0, volume), 0.16).whole_batches == batches


@pytest.mark.mpi
def test_feed_prints_the_law_beside_table_4(capsys, shared_path):
    assert main(["feed", "--json", str(shared_path / "feed.json")]) == 0
    out, err = capsys.readouterr()
    assert not err
    mpi.barrier()
    record = json.loads((shared_path / "feed.json").read_text(encoding="utf-8"))
    assert [row["whole_particles"] for row in record["speeds"]] == [10236, 15354, 20472]
    assert record["mean_particle_volume_m3"] == pytest.approx(powder().mean_particle_volume(), rel=1e-6, abs=0.0)
    if mpi.is_root():
        for text in ("4 = 10,236", "6 = 15,354", "8 = 20,472", "13,648", "9,954", "13,272", "19,908"):
            assert text in out
    assert main(["feed", "--scan-speed", "0.32 m/s", "--feed-rate", "84.4 g/min", "--density", "4.48 g/cm3"]) == 0
    if mpi.is_root():
        assert "19,908" in capsys.readouterr().out


@pytest.mark.mpi
@pytest.mark.parametrize(("arguments", "words"), [
    (["--scan-speed", "160"], '--scan-speed "160": a speed needs a unit'), (["--feed-rate", "3 mm"], "a mass flow is"),
    (["--share", "0.02"], '--share "0.02": write a percentage'), (["--share", "120 %"], "up to 100"),
    (["--density", "-1 kg/m3"], '--density "-1 kg/m3": must be positive'), (["--d10", "40 um"], "diameter_d10"),
    (["--per-batch", "0"], "0 particles per batch")])
def test_wrong_feed_input_is_one_line(capsys, arguments, words):
    assert main(["feed", *arguments]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == (1 if mpi.is_root() else 0)
    assert words in err or not mpi.is_root()
