"""What a scene takes of a measured stream: diameters, speed over the diameter, lateral velocity; back and forth."""

from __future__ import annotations

import json
import math
import pathlib
import re

import numpy as np
import pytest
from conftest import f2s

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.config import describe, dump_scene, load_scene, parse_scene, scene_text
from f2s_hpc.errors import InputError
from f2s_hpc.io import runs
from f2s_hpc.io.compare import compare_runs
from f2s_hpc.particles.plan import make_batches, plan_digest
from f2s_hpc.particles.sizes import MeasuredSizes, RosinRammler

UM, MM = 1e-6, 1e-3

# A whole strip with its axis in the middle, and all laws.
STRIP = """
title = "A whole strip"

[domain]
size = ["6 mm", "0.2 mm", "0.4 mm"]
cell_size = "10 um"
substrate_height = "50 um"
particle_layer_height = "0.3 mm"

[material]
name = "copper-ge"

[particles]
speed = "640 m/s"
speed_curvature = "-6 m/s/mm2"
speed_per_diameter = "-0.8 m/s/um"
speed_diameter = "30 um"
lateral_velocity = "1 m/s"
lateral_slope = "2.5 m/s/mm"
lateral_curvature = "-0.3 m/s/mm2"
direction = [0, 0.6, -0.8]
temperature = "450 degC"

[batches]
count = 1
particles = 3000
distribution = "sech"
jet_width = "1.2 mm"
jet_centre = "3 mm"
seed = 5

[cycles]
count = 1
duration = "25 ns"

[output]
picture = false
frames = "none"
"""
AXIS, CURVATURE, PER_DIAMETER, REFERENCE = 640.0, -6e6, -0.8e6, 30 * UM
LATERAL = (1.0, 2500.0, -0.3e6)


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def one_line(capsys) -> str:
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


@pytest.fixture(scope="module")
def strip():
    """Return the only batch of STRIP."""
    return make_batches(parse_scene(STRIP, "test")).batches[0]


# --- batches ---------------------------------------------------------------------------------------------------------


def test_each_sphere_flies_by_its_place_and_its_size(strip):
    """Fails when the diameter is the radius, the lateral velocity counts from the box, or is scaled to the speed."""
    u, d = strip.x - 3 * MM, 2.0 * strip.r
    along = AXIS + CURVATURE * u**2 + PER_DIAMETER * (d - REFERENCE)
    cut = (strip.x < strip.r) | (strip.x > 6 * MM - strip.r)
    assert cut.any()
    across = np.where(cut, 0.0, LATERAL[0] + LATERAL[1] * u + LATERAL[2] * u**2)
    assert strip.velocity == pytest.approx(np.stack([across, 0.6 * along, -0.8 * along], axis=1), rel=1e-12)
    assert abs(np.corrcoef(d, u**2)[0, 1]) < 0.06
    sizes = RosinRammler.fit(19 * UM, 30 * UM, 52 * UM, 10 * UM, 85 * UM)
    found = MeasuredSizes.of(d)
    for (value, error), wanted in zip(found.percentiles, sizes.volume_percentile((0.1, 0.5, 0.9))):
        assert abs(value - wanted) < 4.0 * error < 0.2 * wanted
    assert abs(found.mean_volume[0] - sizes.mean_particle_volume()) < 4.0 * found.mean_volume[1]


def test_what_a_mirror_cuts_flies_along_it(strip):
    """By symmetry; with open sides it flies by the law. Fails when the sides' conditions are not looked at."""
    plan = make_batches(parse_scene(STRIP, "test", ["domain.faces.x_low=free", "domain.faces.x_high=outflow"]))
    assert (plan.batches[0].velocity[:, 0] != 0.0).all()
    assert np.array_equal(plan.batches[0].velocity[:, 1:], strip.velocity[:, 1:])
    assert any("m/s along x" in message for message in plan.messages)
    half = parse_scene(STRIP, "test", ["batches.jet_centre=0 um", "particles.lateral_velocity=0 m/s"])
    batch = make_batches(half).batches[0]
    assert (batch.velocity[batch.x < batch.r, 0] == 0.0).all()
    assert (batch.velocity[batch.x > batch.r, 0] != 0.0).mean() > 0.99


def test_laws_that_are_zero_leave_every_bit():
    """Fails when the sum over the laws is taken in another order without them, or zeros make velocities of their own.
    """
    track, patch = "track-160", "section4"
    few = ["batches.particles=60"]
    zero = ["particles.speed_per_diameter=0 m/s/um", "particles.speed_diameter=20 um", "particles.lateral_slope=0 1/s"]
    for name in (track, patch):
        with_zero, without = (make_batches(load_scene(name, few + more)) for more in (zero, []))
        assert plan_digest(with_zero, 4) == plan_digest(without, 4)
        assert (without.batches[0].velocity is None) == (name == patch)
        assert "lateral" not in dump_scene(load_scene(name))


def test_the_bounds_hold_for_all_places_and_sizes():
    """Against a fine table. Fails when only ends of the box, or only the median size, are looked at."""
    for centre in ("3 mm", "-1 mm", "5 mm"):
        scene = parse_scene(STRIP, "test", [f"batches.jet_centre={centre}"])
        u = np.linspace(0.0, 6 * MM, 2001)[:, None] - scene.batches.jet_centre
        d = np.linspace(10 * UM, 85 * UM, 76)[None, :]
        along = AXIS + CURVATURE * u**2 + PER_DIAMETER * (d - REFERENCE)
        across = LATERAL[0] + LATERAL[1] * u + LATERAL[2] * u**2
        assert scene.speed_range == pytest.approx((along.min(), along.max()), rel=1e-4)
        assert scene.top_lateral_velocity == pytest.approx(np.abs(across).max(), rel=1e-4)
        assert np.hypot(along, across).max() <= scene.top_speed * (1 + 1e-12)
        assert scene.top_speed == pytest.approx(math.hypot(along.max(), np.abs(across).max()), rel=1e-4)


def test_a_scene_with_the_laws_is_dumped_and_described():
    scene = parse_scene(STRIP, "test")
    assert parse_scene(dump_scene(scene), "again") == scene
    text = describe(scene, 1, [scene.domain.cells])
    assert "542.0 to 656.0 m/s over x and diameter, by the speed law; up to 9.2 m/s along x" in text
    alone = ["particles.speed_curvature=0 m/s/mm2", "particles.speed_per_diameter=0 m/s/um"]
    assert "640 m/s; up to 9.2 m/s along x" in describe(parse_scene(STRIP, "test", alone), 1, [scene.domain.cells])


@pytest.mark.parametrize(("overrides", "words"), [
    (["particles.speed_per_diameter=-20 m/s/um"],
     "particles.speed_per_diameter turns the speed into -514 m/s for a diameter between 10 um and 85 um"),
    (["particles.speed_per_diameter=-0.8 m/s"], "this is a speed, but a speed per diameter is needed"),
    (["particles.speed_per_diameter=-0.8"], 'write for example "-0.6 m/s/um"'),
    (["particles.speed_per_diameter=1e9 m/s/um"], "particles.speed_per_diameter makes"),
    (["particles.speed_curvature=-90 m/s/mm2"], "particles.speed_curvature turns the speed into"),
    (["particles.lateral_slope=300 m/s/mm"],
     "particles.lateral_slope makes 901.7 m/s across the jet, not less than the lowest speed along it (542 m/s)"),
    (["particles.lateral_curvature=1e300 m/s/mm2"], "particles.lateral_curvature makes"),
    (["batches.jet_centre=0 mm"],
     "particles.lateral_velocity must be 0 or left out: the jet's axis lies on the mirror at domain.faces.x_low"),
    (["batches.jet_centre=6 mm"], "at domain.faces.x_high"),
    (["particles.direction=[0.1, 0, -1]"], "particles.lateral_velocity is a velocity along x, across the jet, but"),
    (['batches.mirror_repeats=["x"]', "batches.distribution=uniform", "particles.speed_curvature=0 m/s/mm2"],
     "would move the jet")])
def test_wrong_laws_are_one_line(overrides, words):
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        parse_scene(STRIP, "test", overrides)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("override", "words"), [
    ("particles.speed_per_diameter=-1 m/s/um", "particles.speed_diameter is missing"),
    ("particles.speed_diameter=20 um", "particles.speed_diameter has no effect without speed_per_diameter"),
    ('particles.stream_laws=["diameter"]', "particles.stream_laws has no effect without particles.stream"),
    ("particles.stream_laws=diameter", 'must be a list out of "diameter" and "lateral"')])
def test_laws_without_their_other_half_are_refused(override, words):
    """Fails if the key is read and nothing is made of it."""
    with pytest.raises(InputError, match=re.escape(words)):
        load_scene("section4", [override])


def test_laws_and_files(tmp_path, monkeypatch):
    """Spheres of files fly by the laws unless they bring velocities; fails if a size beyond what was checked passes."""
    monkeypatch.chdir(tmp_path)
    pathlib.Path("a.csv").write_text("x,y,z,r\n0.3,0.04,0.05,0.01\n0.1,0.1,0.05,0.02\n", encoding="ascii")
    pathlib.Path("b.csv").write_text("x,y,z,r,vx,vy,vz\n0.03,0.04,0.05,0.01,1,2,-500\n", encoding="ascii")
    laws = ["particles.speed_per_diameter=-2 m/s/um", "particles.speed_diameter=30 um"]
    batch = make_batches(load_scene("section4", ["batches.files=a.csv", *laws])).batches[0]
    assert batch.velocity[:, 2] == pytest.approx([-635.0, -595.0], rel=1e-12)
    with pytest.raises(InputError, match=r"particles\.speed_per_diameter has no effect where all batches\.files give"):
        make_batches(load_scene("section4", ["batches.files=b.csv", *laws]))
    with pytest.raises(InputError, match=r"a\.csv: row 2: a diameter of 0\.04 mm.*diameter_max \(0\.01 and 0\.035 mm"):
        make_batches(load_scene("section4", ["batches.files=a.csv", *laws, "batches.diameter_max=35 um",
                                             "batches.diameter_d90=33 um"]))
    both = make_batches(load_scene("section4", ['batches.files=["a.csv", "b.csv"]', *laws]))
    assert both.batches[1].velocity.tolist() == [[1.0, 2.0, -500.0]]


# --- there and back --------------------------------------------------------------------------------------------------


def measured(batch, path: pathlib.Path) -> None:
    """Write a batch of STRIP as a measurement: speed along the jet and along x, with scatter, places to 0.1 um."""
    numbers = generator(11)
    along = np.hypot(batch.velocity[:, 1], batch.velocity[:, 2]) + 30.0 * numbers.standard_normal(batch.count)
    across = batch.velocity[:, 0] + 2.0 * numbers.standard_normal(batch.count)
    lines = [f"{2e6 * r:.2f},{v:.3f},{1e3 * x:.4f},{w:.3f}" for r, v, x, w in zip(batch.r, along, batch.x, across)]
    path.write_text("diameter [um],velocity [m/s],lateral position [mm],lateral velocity [m/s]\n" + "\n".join(lines)
                    + "\n", encoding="utf-8")


def test_batches_measured_and_fitted_give_their_law_again(strip, tmp_path, monkeypatch, capsys):
    """Within four standard errors, and a scene takes them.

    Fails when the reference is another than the mean diameter (the axis speed is then 8 m/s off), the slope has
    another sign, or percentiles count particles and not volume.
    """
    monkeypatch.chdir(tmp_path)
    measured(strip, tmp_path / "m.csv")
    assert main(["stream", "m.csv", "--json", "fits.json"]) == 0
    said = capsys.readouterr().out
    assert "no sign" not in said
    assert "particles.lateral_slope = " in said.splitlines()[-2]
    record = json.loads(pathlib.Path("fits.json").read_text(encoding="utf-8"))
    speed, lateral, sizes = (record[part] for part in (
        "velocity_over_lateral_position", "lateral_velocity", "diameter"))
    centre = record["number_over_lateral_position"]["centre_m"]
    powder = RosinRammler.fit(19 * UM, 30 * UM, 52 * UM, 10 * UM, 85 * UM)
    d10, d50, d90 = powder.volume_percentile((0.1, 0.5, 0.9))
    mean = sizes["mean_m"]["value"]
    off = centre["value"] - 3 * MM  # the fits count from the fitted axis
    known = [(speed["axis_m_s"], AXIS + PER_DIAMETER * (mean - REFERENCE) + CURVATURE * off**2),
             (speed["curvature_1_m_s"], CURVATURE), (record["velocity_over_diameter"]["slope_1_s"], PER_DIAMETER),
             (lateral["axis_m_s"], np.polynomial.polynomial.polyval(off, LATERAL)),
             (lateral["slope_1_s"], LATERAL[1] + 2.0 * LATERAL[2] * off), (lateral["curvature_1_m_s"], LATERAL[2]),
             (centre, 3 * MM), (record["number_over_lateral_position"]["width_m"], 1.2 * MM),
             (sizes["d10_m"], d10), (sizes["d50_m"], d50), (sizes["d90_m"], d90),
             (sizes["mean_volume_m3"], powder.mean_particle_volume())]
    for fitted, wanted in known:
        assert abs(fitted["value"] - wanted) < 4.0 * fitted["standard_error"] < abs(wanted) + 0.5
    laws = 'particles.stream_laws=["diameter", "lateral"]'
    scene = load_scene("track-160", ["particles.stream=fits.json", laws, "batches.diameter_max=90 um"])
    particles, batches = scene.particles, scene.batches
    assert (particles.speed, particles.speed_per_diameter, particles.speed_diameter, particles.lateral_slope) == (
        speed["axis_m_s"]["value"], record["velocity_over_diameter"]["slope_1_s"]["value"], mean,
        lateral["slope_1_s"]["value"])
    assert (particles.lateral_velocity, particles.lateral_curvature) == (None, None)  # the odd part only
    assert (batches.diameter_d10, batches.diameter_d50, batches.diameter_d90, batches.diameter_min,
            batches.diameter_max) == (*(sizes[f"{n}_m"]["value"] for n in ("d10", "d50", "d90", "min")), 9e-5)
    assert parse_scene(dump_scene(scene), "again") == scene


def test_a_scene_takes_what_the_paper_takes_unless_asked(tmp_path, monkeypatch, capsys):
    """Diameters too, where particles are generated; fails when the laws come without being asked for."""
    monkeypatch.chdir(tmp_path)
    assert main(["stream", "synthetic", "--json", "fits.json"]) == 0
    sizes = json.loads(pathlib.Path("fits.json").read_text(encoding="utf-8"))["diameter"]
    assert f"D50               {1e6 * sizes['d50_m']['value']:.2f}" in (said := capsys.readouterr().out)
    assert "the lateral velocities have no sign" in said
    scene = load_scene("section4", ["particles.stream=fits.json"])
    assert (scene.particles.speed_per_diameter, scene.particles.lateral) == (None, ())
    assert scene.batches.diameter_d50 == sizes["d50_m"]["value"]
    own = scene_text("section4").replace('speed = "615 m/s"', 'speed = "615 m/s"\nstream = "fits.json"')
    pathlib.Path("own.toml").write_text(own, encoding="utf-8")
    assert load_scene("own.toml").batches.diameter_d50 == 3e-5  # the scene's own word
    sphere = load_scene("splat", ["particles.stream=fits.json"])
    assert sphere.batches.diameter_d50 == load_scene("splat").batches.diameter_d50
    capsys.readouterr()
    assert main(["check", "section4", "--set", "particles.stream=fits.json", "--set",
                 'particles.stream_laws=["lateral"]']) == 2
    assert "fits.json: its lateral velocities have no sign" in one_line(capsys)
    record = json.loads(pathlib.Path("fits.json").read_text(encoding="utf-8"))
    del record["diameter"]
    pathlib.Path("old.json").write_text(json.dumps(record), encoding="utf-8")
    assert main(["check", "section4", "--set", "particles.stream=old.json"]) == 2
    assert "old.json: lacks the fits (diameter); write it anew" in one_line(capsys)
    assert main(["feed", "--stream", "old.json"]) == 2
    assert "old.json: lacks the mean volume" in one_line(capsys)


def test_percentiles_scatter_by_their_standard_errors():
    """Over made samples. Fails when each particle counts once (errors half as large), or an error lacks its half."""
    powder = RosinRammler.fit(19 * UM, 30 * UM, 52 * UM, 10 * UM, 85 * UM)
    found = [MeasuredSizes.of(powder.sample_by_number(1500, generator(seed))) for seed in range(200)]
    values = np.array([[*f.percentiles, f.mean, f.mean_volume] for f in found])
    ratio = np.sqrt(np.square(values[:, :, 1]).mean(axis=0)) / values[:, :, 0].std(axis=0, ddof=1)
    assert np.all((ratio > 0.85) & (ratio < 1.2)), ratio
    wanted = [*powder.volume_percentile((0.1, 0.5, 0.9)), powder.mean_particle_volume()]
    assert values[:, [0, 1, 2, 4], 0].mean(axis=0) == pytest.approx(wanted, rel=0.01, abs=0.0)
    half = MeasuredSizes.of(np.array([40 * UM] + [20 * UM] * 8))  # half of the volume is in the one large particle
    below, above = 7.5 / 16, 12 / 16
    assert half.percentiles[1][0] == pytest.approx((20 + 20 * (0.5 - below) / (above - below)) * UM, rel=1e-12)
    assert (half.mean[0], half.smallest, half.largest) == pytest.approx((200 / 9 * UM, 20 * UM, 40 * UM), rel=1e-12)


@pytest.mark.mpi
def test_the_feed_takes_the_measured_volume(capsys, shared_path):
    """Fails when diameters beside it are passed over without a word."""
    path = str(shared_path / "fits.json")
    assert main(["stream", "synthetic", "--json", path]) == 0
    mpi.barrier()
    volume = json.loads((shared_path / "fits.json").read_text(encoding="utf-8"))["diameter"]["mean_volume_m3"]["value"]
    capsys.readouterr()
    assert main(["feed", "--stream", path, "--json", str(shared_path / "feed.json")]) == 0
    mpi.barrier()
    feed = json.loads((shared_path / "feed.json").read_text(encoding="utf-8"))
    assert feed["mean_particle_volume_m3"] == volume
    wanted = 42.2e-3 / 60 * 0.0206 * 7.3e-3 / 0.160 / 8960 / volume
    assert feed["speeds"][0]["particles"] == pytest.approx(wanted, rel=1e-12)
    assert main(["feed", "--stream", path, "--d50", "31 um"]) == 2
    assert "--d50 has no effect with --stream" in capsys.readouterr().err or not mpi.is_root()


def test_a_run_by_the_laws_has_the_same_bits_on_two_ranks(tmp_path):
    """Spheres that catch up with each other and fly into the mirrors. Fails if a rank gives them other velocities."""
    small = STRIP.replace('["6 mm", "0.2 mm", "0.4 mm"]', '["0.12 mm", "0.06 mm", "0.2 mm"]').replace(
        '"0.3 mm"', '"0.14 mm"').replace("particles = 3000", "particles = 12").replace('"25 ns"', '"0.2 us"').replace(
        '"10 um"', '"6 um"')
    (tmp_path / "s.toml").write_text(small, encoding="utf-8")
    sets = ['particles.lateral_slope=800 m/s/mm', "batches.jet_centre=60 um", "particles.speed_per_diameter=-6 m/s/um"]
    options = [part for text in sets for part in ("--set", text)]
    for ranks in (1, 2):
        f2s("run", "s.toml", "--out", f"on-{ranks}", *options, ranks=ranks, cwd=tmp_path)
    assert compare_runs(tmp_path / "on-1", tmp_path / "on-2").identical
    summary = runs.read_summary(tmp_path / "on-1")
    assert summary["status"] == "complete"
    assert summary["mass_drift_relative"] < 1e-12
