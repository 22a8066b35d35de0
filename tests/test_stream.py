"""The particle stream: measured particles and their fits, the synthetic sample, the command."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import kstest, linregress

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.config import dump_scene, load_scene, parse_scene, scene_text
from f2s_hpc.errors import InputError
from f2s_hpc.particles import synthetic
from f2s_hpc.particles.lateral import SechProfile
from f2s_hpc.particles.measurement import Measurement, read_measurement, synthetic_text
from f2s_hpc.particles.stream import as_record, fit_number, fit_polynomial, fit_stream

UM, MM = 1e-6, 1e-3
HEAD = "diameter [um],velocity [m/s],lateral position [mm],lateral velocity [m/s]\n"
SAMPLES, SIZE = 120, 900


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def rows(count: int = 30) -> str:
    numbers = generator(4)
    return "".join(f"{d:.2f},{v:.2f},{x:.4f},{w:.3f}\n" for d, v, x, w in zip(
        10 + 60 * numbers.random(count), 600 + 50 * numbers.random(count), numbers.normal(0, 1, count),
        5 * numbers.random(count)))


# --- the sech distribution -------------------------------------------------------------------------------------------


def test_sech_has_the_integral_of_sech_and_its_inverse():
    """Fails when ``gudermannian`` loses a factor of two, or ``quantile`` the clip or the centre."""
    jet = SechProfile(0.3 * MM, 1.4 * MM)
    low, high = -1.0 * MM, 3.5 * MM

    def density(x: float) -> float:
        return 1.0 / math.cosh((x - jet.centre) / jet.width)

    whole = quad(density, low, high, epsabs=0.0, epsrel=1e-12)[0]
    for x in (-0.9, 0.0, 0.3, 2.0, 3.4):
        part = quad(density, low, x * MM, epsabs=0.0, epsrel=1e-12)[0]
        assert jet.cdf(x * MM, low, high) == pytest.approx(part / whole, rel=1e-11)
    assert jet.share(low, high) == pytest.approx(whole / (math.pi * jet.width), rel=1e-11)
    q = np.linspace(0.0, 1.0, 101)
    assert jet.cdf(jet.quantile(q, low, high), low, high) == pytest.approx(q, abs=1e-12)
    assert (float(jet.quantile(0.0, low, high)), float(jet.quantile(1.0, low, high))) == pytest.approx((low, high))


def test_sampled_positions_follow_the_closed_form(seed):
    """Kolmogorov-Smirnov; fails when ``sample`` draws from a normal distribution of the same spread."""
    jet = SechProfile(0.2 * MM, 0.8 * MM)
    x = jet.sample(20000, 0.0, 3.5 * MM, generator(seed))
    assert x.min() >= 0.0
    assert x.max() <= 3.5 * MM
    assert kstest(x, lambda t: jet.cdf(t, 0.0, 3.5 * MM)).pvalue > 0.05
    narrower = SechProfile(0.2 * MM, 0.76 * MM)
    assert kstest(x, lambda t: narrower.cdf(t, 0.0, 3.5 * MM)).pvalue < 1e-3
    assert np.array_equal(x, jet.sample(20000, 0.0, 3.5 * MM, generator(seed)))
    with pytest.raises(InputError, match="width of 0 mm"):
        SechProfile(0.0, 0.0)
    with pytest.raises(InputError, match="no particle flies"):
        jet.sample(5, 90 * MM, 91 * MM, generator(1))


# --- fits ------------------------------------------------------------------------------------------------------------


def test_the_line_and_its_band_are_those_of_linear_regression():
    """Against scipy's linregress and the textbook band; fails when the band leaves out the 1 of a further particle."""
    numbers = generator(2)
    x = (10 + 60 * numbers.random(40)) * UM
    y = 631.0 - 0.6e6 * x + 30.0 * numbers.standard_normal(40)
    fit, other = fit_polynomial(x, y, 1, "test"), linregress(x, y)
    assert fit.coefficients == pytest.approx([other.intercept, other.slope], rel=1e-10)
    assert fit.errors == pytest.approx([other.intercept_stderr, other.stderr], rel=1e-10)
    assert fit.r2 == pytest.approx(other.rvalue**2, rel=1e-10)
    at = 75 * UM
    spread = np.sqrt(np.square(y - fit.at(x)).sum() / 38)
    leverage = 1 + 1 / 40 + (at - x.mean()) ** 2 / np.square(x - x.mean()).sum()
    assert float(fit.band(at)) == pytest.approx(1.685954 * spread * math.sqrt(leverage), rel=1e-6)  # t of 38, 0.95


def test_exact_data_give_exact_coefficients():
    x = np.linspace(-3.5 * MM, 3.2 * MM, 50)
    fit = fit_polynomial(x, 640.0 + 2000.0 * x - 6e6 * x**2, 2, "test")
    assert fit.coefficients == pytest.approx([640.0, 2000.0, -6e6], rel=1e-9)
    assert fit.r2 == pytest.approx(1.0, abs=1e-12)
    jet = SechProfile(0.1 * MM, 0.9 * MM)
    places = jet.quantile((np.arange(200000) + 0.5) / 200000, -3 * MM, 2 * MM)
    number = fit_number(places, "test", bins=25)
    assert (number.centre, number.width) == pytest.approx((jet.centre, jet.width), rel=2e-4)
    peak = 200000 / (math.pi * jet.width * float(jet.share(-3 * MM, 2 * MM)))
    assert number.peak == pytest.approx(peak, rel=2e-4)
    assert number.r2 > 0.999999
    assert number.dispersion == 1.0


@pytest.fixture(scope="module")
def pulls() -> tuple[np.ndarray, np.ndarray]:
    """Return, for many made samples, (fitted - true) / standard error of six numbers, and the shares in the bands."""
    jet, axis, curvature, slope = SechProfile(0.15 * MM, 1.2 * MM), 640.0, -6e6, 900.0
    found, inside = [], []
    for number in range(SAMPLES):
        numbers = generator(1000 + number)
        x = jet.sample(numbers.poisson(SIZE), -3.5 * MM, 3.5 * MM, numbers)
        speed = axis + slope * x + curvature * x**2 + 30.0 * numbers.standard_normal(x.size)
        speeds, counts = fit_polynomial(x, speed, 2, "test"), fit_number(x, "test", bins=20)
        peak = SIZE / (math.pi * jet.width * float(jet.share(-3.5 * MM, 3.5 * MM)))
        found.append([*(speeds.coefficients - [axis, slope, curvature]) / speeds.errors,
                      *(np.array([counts.peak, counts.centre, counts.width]) - [peak, jet.centre, jet.width])
                      / counts.errors])
        new = jet.sample(numbers.poisson(SIZE), -3.5 * MM, 3.5 * MM, numbers)
        further = axis + slope * new + curvature * new**2 + 30.0 * numbers.standard_normal(new.size)
        middle = 0.5 * (counts.edges[1:] + counts.edges[:-1])
        again = np.histogram(new, counts.edges)[0]
        inside.append([np.mean(np.abs(further - speeds.at(new)) < speeds.band(new)),
                       np.mean(np.abs(again - counts.at(middle)) < counts.band(middle))])
    return np.array(found), np.array(inside)


def test_fits_recover_known_coefficients_within_their_standard_errors(pulls):
    """Over made samples the error is the stated one in size, and none is biased.

    Fails when ``fit_number`` takes least squares of plain counts (width 10 % off its error), or a standard error
    lacks the spread.
    """
    found, _ = pulls
    sizes, bias = np.sqrt(np.square(found).mean(axis=0)), found.mean(axis=0)
    assert np.all((sizes > 0.80) & (sizes < 1.22)), sizes  # three standard errors of a standard deviation of 120
    assert np.all(np.abs(bias) < 3.2 / math.sqrt(SAMPLES)), bias


def test_bands_hold_nine_tenths_of_further_particles_and_counts(pulls):
    """Fails when ``band`` uses the 0.90 quantile in place of 0.95 (80 %), or leaves out the count's own scatter."""
    speeds, counts = pulls[1].mean(axis=0)
    assert speeds == pytest.approx(0.90, abs=0.004)
    assert counts == pytest.approx(0.90, abs=0.02)  # counts are whole numbers


def test_the_fits_of_a_stream_without_lateral_velocity():
    sample = read_measurement("synthetic")
    fit = fit_stream(Measurement("three columns", sample.diameter, sample.velocity, sample.lateral_position))
    assert fit.lateral is None
    assert fit.lateral_mean is None
    assert "lateral_velocity" not in as_record(fit)
    with pytest.raises(InputError, match=r"three columns: every lateral position is 1 mm"):
        fit_stream(Measurement("three columns", sample.diameter, sample.velocity, np.full(sample.count, 1 * MM)))
    with pytest.raises(InputError, match="diameter: 1 different values"):
        fit_stream(Measurement("one size", np.full(sample.count, 1 * UM), sample.velocity, sample.lateral_position))
    flat = np.linspace(-1 * MM, 1 * MM, sample.count)
    with pytest.raises(InputError, match="no peak"):
        fit_stream(Measurement("flat", sample.diameter, sample.velocity, flat))


def test_the_zero_of_the_measuring_device_does_not_matter():
    """Places 2 mm off: the same curves about the jet's axis.

    Fails when ``fit_stream`` counts places from the device's zero, or ``lateral_mean_error`` is the spread.
    """
    sample = read_measurement("synthetic")
    moved = dataclasses.replace(sample, lateral_position=sample.lateral_position + 2 * MM)
    fit, other = fit_stream(sample), fit_stream(moved)
    assert other.number.centre - fit.number.centre == pytest.approx(2 * MM, rel=1e-4)
    for one, two in ((fit.speed, other.speed), (fit.lateral, other.lateral)):
        assert two.coefficients == pytest.approx(one.coefficients, rel=1e-3, abs=0.05 * one.errors[1])
    drift = sample.lateral_velocity
    assert fit.lateral_spread == pytest.approx(drift.std(ddof=1), rel=1e-12)
    assert fit.lateral_mean_error == pytest.approx(drift.std(ddof=1) / math.sqrt(drift.size), rel=1e-12)


def test_the_mixing_of_place_and_size_is_that_of_the_squared_distance():
    """Large particles at the edge. Fails when ``fit_stream`` takes the distance: on both sides that makes nothing."""
    sample = read_measurement("synthetic")
    distance = sample.lateral_position - fit_stream(sample).number.centre
    assert abs(fit_stream(sample).mixing) < 0.05
    sorted_out = dataclasses.replace(sample, diameter=20 * UM + 4.0 * distance**2)
    assert fit_stream(sorted_out).mixing == pytest.approx(1.0, abs=1e-9)


def test_counts_that_scatter_more_than_chance_widen_errors_and_bands():
    """Every particle four times: the same curve, a dispersion of four times as much, and bands by Student's t.

    Fails when ``dispersion`` is 1 always, or ``band`` takes the normal quantile with it.
    """
    x = SechProfile(0.0, 1.2 * MM).sample(900, -3.5 * MM, 3.5 * MM, generator(6))
    once, four = fit_number(x, "test", bins=20), fit_number(np.repeat(x, 4), "test", bins=20)
    middle = 0.5 * (once.edges[1:] + once.edges[:-1])
    scatter = float((np.square(once.counts - once.at(middle)) / once.at(middle)).sum())
    assert once.dispersion == 1.0
    assert four.dispersion == pytest.approx(4.0 * scatter / 17, rel=1e-4)
    assert (four.centre, four.width) == pytest.approx((once.centre, once.width), rel=1e-4)
    assert four.errors[1:] == pytest.approx(0.5 * math.sqrt(four.dispersion) * once.errors[1:], rel=1e-3)
    slopes = []
    for name in ("peak", "centre", "width"):
        step = 1e-4 * abs(four.width if name != "peak" else four.peak)
        high, low = (dataclasses.replace(four, **{name: getattr(four, name) + s}).at(1 * MM) for s in (step, -step))
        slopes.append((high - low) / (2.0 * step))
    own = float(np.array(slopes) @ four.covariance @ np.array(slopes))
    t = 1.739607  # 0.95 quantile of Student's t with 17 degrees of freedom
    assert float(four.band(1 * MM)) == pytest.approx(t * math.sqrt(four.dispersion * four.at(1 * MM) + own), rel=1e-5)


def test_far_tails_are_no_scatter():
    """Samples of a pure sech as wide as they come: more than by chance is found as often as it says, once in twenty.

    And one stray particle far out spoils no standard error. Fails when ``_dispersion`` does not pool its bins.
    """
    profile = SechProfile(0.0, 1.4 * MM)
    found = [fit_number(profile.sample(3000, -60 * MM, 60 * MM, generator(seed)), "test") for seed in range(100)]
    assert sum(fit.dispersion > 1.0 for fit in found) <= 12
    inner = profile.sample(3000, -3.5 * MM, 3.5 * MM, generator(1))
    fit = fit_number(np.append(inner, 50 * MM), "test")
    assert np.isfinite(fit.errors).all()
    assert abs(fit.centre) < 3.0 * fit.errors[1] < 0.9 * MM  # (in bins of 1.8 mm)


def test_the_record_has_each_number_under_its_name():
    """Fails when values and errors of a fit are paired in another order, or a band is not that of the middle."""
    fit = fit_stream(read_measurement("synthetic"))
    record = as_record(fit)
    number, size = record["number_over_lateral_position"], record["velocity_over_diameter"]
    for name, value, error in zip(("peak_per_m", "centre_m", "width_m"),
                                  (fit.number.peak, fit.number.centre, fit.number.width), fit.number.errors):
        assert number[name] == {"value": value, "standard_error": error}
    assert number["bins"] == 29  # Rice's rule for 3000 particles
    assert size["slope_1_s"] == {"value": fit.size.coefficients[1], "standard_error": fit.size.errors[1]}
    middle = 0.5 * (fit.measurement.diameter.min() + fit.measurement.diameter.max())
    assert size["prediction_half_width_mid_m_s"] == pytest.approx(float(fit.size.band(middle)), rel=1e-12)
    assert size["prediction_half_width_mid_m_s"] < float(fit.size.band(0.0))


# --- the synthetic sample --------------------------------------------------------------------------------------------


def test_the_packaged_sample_is_made_again_bit_for_bit_and_says_what_it_is():
    """Fails when a constant of ``synthetic.py`` is changed and the file is not written anew."""
    text = synthetic_text()
    assert text == synthetic.csv_text()
    assert text.startswith("# SYNTHETIC sample, not a measurement")
    assert f"seed {synthetic.SEED}" in text


def test_the_sample_has_the_properties_that_the_paper_states():
    sample = read_measurement("synthetic")
    assert sample.count == synthetic.COUNT
    assert sample.diameter.min() >= 10 * UM
    assert sample.diameter.max() <= 85 * UM
    assert np.mean((sample.velocity > 550.0) & (sample.velocity < 750.0)) > 0.95
    fit = fit_stream(sample)
    for diameter, speed in ((10 * UM, 625.0), (85 * UM, 580.0)):
        assert float(fit.size.at(diameter)) == pytest.approx(speed, abs=3.0)
    assert fit.number.width == pytest.approx(1.4 * MM, abs=2.0 * fit.number.errors[2])
    assert fit.speed.coefficients[2] == pytest.approx(-6e6, abs=2.0 * fit.speed.errors[2])
    assert fit.number.r2 > 0.95
    edge = np.array([-3.5, 0.0, 3.5]) * MM
    assert np.all(fit.lateral.at(edge) < 10.0)
    assert fit.lateral_mean < 10.0


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_stream_prints_the_fits_and_writes_json_and_picture(capsys, shared_path):
    """Two pictures of one input are the same bytes; fails when a rank other than 0 prints."""
    for name in ("a", "b"):
        out = str(shared_path / name)
        assert main(["stream", "synthetic", "--json", f"{out}.json", "--out", out]) == 0
    out, err = capsys.readouterr()
    assert not err
    assert mpi.is_root() or not out
    mpi.barrier()
    first, second = ((shared_path / name / "stream.png").read_bytes() for name in ("a", "b"))
    assert first == second
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
    record = json.loads((shared_path / "a.json").read_text(encoding="utf-8"))
    fit = fit_stream(read_measurement("synthetic"))
    assert record == json.loads(json.dumps(as_record(fit)))
    if mpi.is_root():
        assert f"{1e3 * fit.number.width:.4f}" in out
        assert "90 % prediction bands" in out
        assert "625.4 m/s at 10.0 um" in out
        # per um: fails when the slope over the diameter has another scale
        line = next(text for text in out.splitlines() if text.endswith("m/s/um"))
        assert f"{1e-6 * fit.size.coefficients[1]:.5g}" in line


def test_a_scene_takes_the_fits(tmp_path, monkeypatch):
    """The scene holds the numbers, not the file; what is said nearer to the run wins.

    Fails when ``take_stream`` lets a scene's own keys win over a file named on the command line.
    """
    monkeypatch.chdir(tmp_path)
    assert main(["stream", "synthetic", "--json", "fits.json"]) == 0
    fit = fit_stream(read_measurement("synthetic"))
    scene = load_scene("section4", ["particles.stream=fits.json", "particles.speed=600 m/s"])
    assert scene.particles.speed == 600.0
    assert scene.particles.speed_curvature == fit.speed.coefficients[2]
    assert scene.batches.distribution == "sech"
    assert scene.batches.jet_width == fit.number.width
    assert scene.batches.jet_centre == 0.0
    assert load_scene("track-160", ["particles.stream=fits.json"]).particles.speed == fit.speed.coefficients[0]
    (tmp_path / "own.toml").write_text(scene_text("section4").replace(
        'speed = "615 m/s"', 'speed = "615 m/s"\nstream = "fits.json"'), encoding="utf-8")
    scene = load_scene("own.toml")
    assert (scene.particles.speed, scene.batches.jet_width) == (615.0, fit.number.width)
    assert parse_scene(dump_scene(scene), "again") == scene
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    for name, words in (("other.json", "not a file that"), ("none.json", "cannot be read")):
        with pytest.raises(InputError, match=words):
            load_scene("section4", [f"particles.stream={name}"])
    (tmp_path / "half.json").write_text('{"format": "f2s stream 1"}', encoding="utf-8")
    with pytest.raises(InputError, match="lacks the fits"):
        load_scene("section4", ["particles.stream=half.json"])
    with pytest.raises(InputError, match="name of a file"):
        load_scene("section4", ["particles.stream=3"])


BAD = {
    "empty": ("", "no header"),
    "only comments": ("# nothing\n", "no header"),
    "unknown column": (HEAD.replace("diameter", "diametre") + rows(), 'did you mean "diameter"?'),
    "strange header": ("a,b,c\n1,2,3\n", 'unknown column "a"; the header must be like diameter [um]'),
    "no unit": (HEAD.replace(" [um]", "") + rows(), 'column "diameter" needs its unit, as in diameter [um]'),
    "wrong unit": (HEAD.replace("um", "m/s") + rows(), "this is a speed, but a length is needed"),
    "unknown unit": (HEAD.replace("um", "inch") + rows(), 'unknown unit "inch"'),
    "missing column": ("diameter [um],velocity [m/s]\n20,600\n", '"lateral position [mm]" is missing'),
    "column twice": ("diameter [um],diameter [mm]\n20,600\n", "is there twice"),
    "no number": (HEAD + rows() + "20,fast,1,2\n", "row 31: velocity is 'fast', but must be a number"),
    "infinite": (HEAD + "20,600,inf,2\n" + rows(), "row 1: lateral position is 'inf'"),
    "negative": (HEAD + rows(2) + "\n# a remark\n-3,600,1,2\n", "row 3: diameter is -3, but must be positive"),
    "standing": (HEAD + rows(2) + "3,0,1,2\n", "row 3: velocity is 0, but must be positive"),
    "semicolons": (HEAD.replace(",", ";") + "20;600;0,1;2\n", "1 particles; at least 20 are needed"),
    "decimal commas": (HEAD + rows(2) + "20,1,600,2,0,1,2,0\n", "row 3: 8 values, but the header has 4 columns; do"),
    "short row": (HEAD + rows(4) + "20,600,1\n", "row 5: 3 values, but the header has 4 columns"),
    "too few": (HEAD + rows(19), "19 particles; at least 20 are needed"),
}


@pytest.mark.mpi
@pytest.mark.parametrize("wrong", list(BAD))
def test_a_malformed_measurement_is_one_line_with_file_and_row(capsys, shared_path, wrong):
    text, words = BAD[wrong]
    path = shared_path / "bad.csv"
    if mpi.is_root():
        path.write_text(text, encoding="utf-8")
    mpi.barrier()
    assert main(["stream", str(path)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == (1 if mpi.is_root() else 0)
    if mpi.is_root():
        assert err.startswith(f"{path}: ")
        assert words in err


def test_units_and_order_of_the_columns_are_free(tmp_path):
    """Fails when the factor of a column's unit is not applied, or columns are taken by their place."""
    path = tmp_path / "m.csv"
    path.write_text("\ufeffLateral_Position (um), VELOCITY [mm/s] ,diameter [mm]\n" +
                    "".join(f"{100 * n},{600e3 + n},0.0{20 + n}\n" for n in range(20)), encoding="utf-8")
    sample = read_measurement(path)
    assert sample.lateral_velocity is None
    assert sample.lateral_position == pytest.approx(np.arange(20) * 100 * UM, rel=1e-14)
    assert sample.velocity == pytest.approx(600.0 + 1e-3 * np.arange(20), rel=1e-14)
    assert sample.diameter == pytest.approx((20 + np.arange(20)) * UM, rel=1e-14)
    with pytest.raises(InputError, match="cannot be read"):
        read_measurement(tmp_path / "absent.csv")


def test_places_that_cannot_be_written_are_one_line(capsys, tmp_path):
    (tmp_path / "file").write_text("", encoding="ascii")
    assert main(["stream", "synthetic", "--out", str(tmp_path / "file" / "below")]) == 2
    assert main(["stream", "synthetic", "--json", str(tmp_path / "no" / "fits.json")]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 2
    assert "cannot be made" in err[0]
    assert "cannot be written" in err[1]
