"""Batches of a jet: sech over x, speed by place, each sphere painted with its own velocity; the scenes of section 5."""

from __future__ import annotations

import math
import pathlib
import re
import shutil

import numpy as np
import pytest
from conftest import f2s
from scipy.stats import kstest

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.cli.main import main
from f2s_hpc.config import describe, dump_scene, load_scene, parse_scene
from f2s_hpc.cycles.insert import paint_batch, paint_substrate
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, NODE, VELOCITY
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.compare import compare_runs
from f2s_hpc.io.manifest import manifest_path
from f2s_hpc.particles.batch import Batch, clipped_volume, join, read_csv, smallest_gap, write_csv
from f2s_hpc.particles.lateral import SechProfile
from f2s_hpc.particles.packing import pack
from f2s_hpc.particles.plan import make_batches

UM, MM = 1e-6, 1e-3

# 21 x 11 x 25 cells: 2 ranks do not divide them evenly. Cycles so short that the layer is never clear.
TRACK = """
title = "A piece of a track"

[domain]
size = ["126 um", "66 um", "150 um"]
cell_size = "6 um"
substrate_height = "36 um"
particle_layer_height = "114 um"

[material]
name = "copper-ge"

[particles]
speed = "640 m/s"
speed_curvature = "-15000 m/s/mm2"
direction = [0.1, -0.05, -1.0]
temperature = "450 degC"
flight = "eulerian"

[batches]
count = 2
particles = 16
distribution = "sech"
jet_width = "40 um"
jet_centre = "6 um"
seed = 3
diameter_d10 = "20 um"
diameter_d50 = "27 um"
diameter_d90 = "36 um"
diameter_min = "16 um"
diameter_max = "40 um"

[cycles]
count = 3
duration = "25 ns"

[output]
picture = false
frames = "none"
keep_checkpoints = 3
"""


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def law(scene, x: np.ndarray) -> np.ndarray:
    """Return the speed law of TRACK, written out."""
    return 640.0 - 1.5e10 * (x - 6 * UM) ** 2


# --- batches ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def track():
    """Return the plan of track-160."""
    return make_batches(load_scene("track-160"))


def test_packed_batches_follow_the_sech_in_closed_form(track):
    """Fails when ``_generate`` forgets to hand the positions to ``pack``; sizes and places are independent."""
    jet = SechProfile(0.0, 1.4 * MM)
    assert [batch.count for batch in track.batches] == [2559] * 4
    for batch in track.batches:
        assert kstest(batch.x, lambda x: jet.cdf(x, 0.0, 3.548 * MM)).pvalue > 0.05
        assert smallest_gap(batch) >= 1.02 * (1 - 1e-12)
        assert np.all((batch.z >= batch.r) & (batch.z <= 0.304 * MM - batch.r))
        assert np.abs(np.corrcoef(batch.x, batch.r)[0, 1]) < 0.06
    assert sorted(track.order) == [0, 1, 2, 3]


def test_a_crowded_axis_keeps_its_share():
    """At a quarter of the volume on the axis; fails when ``pack`` looks for another x, or mixes up whose it is."""
    numbers, box = generator(5), (1.0 * MM, 0.15 * MM, 0.15 * MM)
    jet = SechProfile(0.0, 0.2 * MM)
    x = jet.sample(450, 0.0, box[0], numbers)
    diameters = 16 * UM + 6 * UM * numbers.random(450)
    packed = pack(diameters, box, 1.02, numbers, 20000, x)
    assert packed.placed == 450
    assert np.array_equal(np.sort(packed.x), np.sort(x))
    assert np.array_equal(packed.x, x[np.argsort(diameters, kind="stable")[::-1]])
    assert packed.reached_gap >= 1.02 * (1 - 1e-12)


def test_more_cycles_than_batches_repeat_a_shuffled_order():
    plan = make_batches(load_scene("track-80", ["batches.particles=50", "batches.seed=2"]))
    assert len(plan.batches) == 4
    assert plan.order[:4] == plan.order[4:]
    assert sorted(plan.order[:4]) == [0, 1, 2, 3] != plan.order[:4]


def test_speeds_follow_the_law_and_batches_their_seed():
    scene = parse_scene(TRACK, "test")
    plan, again = make_batches(scene), make_batches(scene)
    other = make_batches(parse_scene(TRACK, "test", ["batches.seed=4"]))
    direction = np.array([0.1, -0.05, -1.0]) / math.hypot(0.1, 0.05, 1.0)
    for batch, same in zip(plan.batches, again.batches):
        assert np.linalg.norm(batch.velocity, axis=1) == pytest.approx(law(scene, batch.x), rel=1e-13)
        assert batch.velocity == pytest.approx(law(scene, batch.x)[:, None] * direction, rel=1e-12)
        assert all(np.array_equal(a, b) for a, b in zip(batch.columns.values(), same.columns.values()))
    assert not np.array_equal(plan.batches[0].x, other.batches[0].x)
    assert plan.order == again.order
    assert any("particles fly at" in message for message in plan.messages)
    assert any("sech of width 0.04 mm" in message for message in plan.messages)


def test_without_a_law_batches_have_no_velocities_of_their_own():
    plan = make_batches(parse_scene(TRACK, "test", ["particles.speed_curvature=0 m/s/mm2"]))
    assert all(batch.velocity is None for batch in plan.batches)


def test_velocities_go_through_a_file_bit_for_bit(tmp_path):
    """Also where columns come in another order; fails when ``write_csv`` rounds."""
    batch = make_batches(parse_scene(TRACK, "test")).batches[0]
    write_csv(tmp_path / "b.csv", batch)
    again = read_csv(tmp_path / "b.csv")
    assert all(np.array_equal(a, b) for a, b in zip(batch.columns.values(), again.columns.values(), strict=True))
    (tmp_path / "c.csv").write_text("vz,x,vx,y,r,z,vy\n-600,0.03,5,0.04,0.01,0.05,-7\n", encoding="ascii")
    one = read_csv(tmp_path / "c.csv")
    assert one.velocity.tolist() == [[5.0, -7.0, -600.0]]
    assert (one.x[0], one.y[0], one.z[0], one.r[0]) == (3e-5, 4e-5, 5e-5, 1e-5)


def test_files_with_and_without_velocities_make_one_plan(tmp_path):
    """The authors' four columns fly by the law; a sphere beyond the side flies like the side."""
    (tmp_path / "a.csv").write_text("x,y,z,r\n0.03,0.04,0.05,0.01\n-0.005,0.02,0.03,0.01\n", encoding="ascii")
    (tmp_path / "b.csv").write_text("x,y,z,r,vx,vy,vz\n0.03,0.04,0.05,0.01,1,2,-500\n", encoding="ascii")
    files = f'batches.files=["{tmp_path / "a.csv"}", "{tmp_path / "b.csv"}"]'
    (tmp_path / "t.toml").write_text(TRACK, encoding="utf-8")
    scene = load_scene(tmp_path / "t.toml", [files])
    first, second = make_batches(scene).batches
    speeds = np.linalg.norm(first.velocity, axis=1)
    assert speeds == pytest.approx(law(scene, np.array([30 * UM, 0.0])), rel=1e-13)
    assert second.velocity.tolist() == [[1.0, 2.0, -500.0]]
    with pytest.raises(InputError, match=r"b\.csv: row 1: 500\.005 m/s is above the highest speed of the scene, 400"):
        make_batches(load_scene(tmp_path / "t.toml", [files, "particles.speed=400 m/s",
                                                      "particles.speed_curvature=0 m/s/mm2"]))


@pytest.mark.parametrize(("text", "words"), [
    ("x,y,z,r,vz\n1,1,1,1,1\n", "column vz without the others"),
    ("x,y,z,r,vx,vy,vz\n.1,.1,.1,.01,0,0,slow\n", "row 1: vz is 'slow', but must be a number in m/s"),
    ("x,y,z,r,vx,vy,vz\n.1,.1,.1,.01,0,0,inf\n", "row 1: vz is 'inf'"),
    ("x,y,z,r,vx,vy,vz\n.1,.1,.1,.01,0,0\n", "row 1: 6 values, but the header has 7 columns")])
def test_wrong_velocities_in_a_file_are_refused(tmp_path, text, words):
    (tmp_path / "b.csv").write_text(text, encoding="ascii")
    with pytest.raises(InputError, match=re.escape(words)):
        read_csv(tmp_path / "b.csv")


def test_join_keeps_velocities_and_drops_what_is_empty():
    one = Batch(*(np.array([float(n)]) for n in range(1, 5)), np.array([[1.0, 2.0, 3.0]]))
    both = join([one, join([]), None, one])
    assert both.count == 2
    assert both.velocity.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert join([]).count == 0
    assert one.raised(2.0).z[0] == 5.0
    assert both.chosen(np.array([True, False])).velocity.shape == (1, 3)


# --- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "cycles"), [(160, 4), (120, 6), (80, 8)])
def test_track_scenes_are_the_papers(speed, cycles):
    """Cells, particles and times of section 5.2.1; a cycle is what the axis needs to clear the layer."""
    scene = load_scene(f"track-{speed}")
    assert scene.domain.cells == (887, 75, 163)
    assert math.prod(scene.domain.cells) == 10_843_575
    assert (scene.batches.count, scene.batches.particles, scene.cycles.count) == (4, 2559, cycles)
    assert scene.cycles.durations == (0.48e-6,) * (cycles - 1) + (1.5e-6,)
    assert scene.cycles.duration * scene.top_speed == pytest.approx(scene.domain.particle_layer_height, rel=1e-3)
    assert scene.batches.particles * cycles == {160: 10236, 120: 15354, 80: 20472}[speed]
    assert scene.speed_range == pytest.approx((633.0 - 6.0 * 3.548**2, 633.0), rel=1e-12)
    assert "SYNTHETIC" in (pathlib.Path(__file__).parents[1] / f"f2s_hpc/scenes/track-{speed}.toml").read_text()


def test_the_multitrack_scene_is_section_4_at_2_um():
    fine, other = load_scene("multitrack"), load_scene("section4", ["domain.cell_size=2 um"])
    assert math.prod(fine.domain.cells) == 9_187_500
    same = dump_scene(fine).replace("tracers = 200", "tracers = 0")
    assert same.splitlines()[1:] == dump_scene(other).splitlines()[1:]


def test_a_scene_with_a_jet_is_dumped_and_described():
    scene = parse_scene(TRACK, "test")
    assert parse_scene(dump_scene(scene), "again") == scene
    text = describe(scene, 1, [scene.domain.cells], 100.0)
    assert "sech over x of width 40 um about 6 um" in text
    assert "424.0 to 640.0 m/s over x" in text


@pytest.mark.parametrize(("override", "words"), [
    ("particles.speed_curvature=-1e5 m/s/mm2", "particles.speed_curvature turns the speed into -800 m/s"),
    ("particles.speed_curvature=-6 m/s", "this is a speed, but a speed curvature is needed"),
    ('batches.distribution="normal"', "must be 'uniform' or 'sech'"), ("batches.jet_width=0 um", "must be above 0")])
def test_wrong_jets_are_one_line(override, words):
    with pytest.raises(InputError, match=re.escape(words)):
        parse_scene(TRACK, "test", [override])


def test_a_sech_needs_its_width():
    with pytest.raises(InputError, match=r"batches\.jet_width is missing"):
        parse_scene(TRACK.replace('jet_width = "40 um"', ""), "test")
    with pytest.raises(InputError, match="no particle flies"):
        make_batches(parse_scene(TRACK, "test", ["batches.jet_centre=9 m", "particles.speed_curvature=0 m/s/mm2"]))


# --- painting --------------------------------------------------------------------------------------------------------


class Box:
    """The box of TRACK with its substrate (collective)."""

    def __init__(self) -> None:
        self.scene = parse_scene(TRACK, "test")
        self.model, self.state = build_model(self.scene), build_state(self.scene)
        self.ledger = build_ledger(self.model)
        paint_substrate(self.state, 16 * UM, 298.15)

    def put(self, batch: Batch, velocity=(0.0, 0.0, 0.0)):
        return paint_batch(self.state, self.model, batch, 0.0, velocity, 700.0, self.ledger, 1)

    def whole(self, name: str) -> np.ndarray:
        """Return the global array [k, j, i] of a field, on every rank."""
        part = self.state.part
        out = np.full(part.box.node_shape if BY_NAME[name].location == NODE else part.box.shape, np.nan)
        for start, block in mpi.all_gather((part.start, self.state.owned(name).copy())):
            out[tuple(slice(s, s + n) for s, n in zip(start[::-1], block.shape))] = block
        return out

    def momentum(self) -> np.ndarray:
        """Return the momentum (full cells m/s) of the nodes, each with an eighth of the mass of its cells."""
        mass = self.whole("mass")
        nodal = np.zeros([n + 1 for n in mass.shape])
        for corner in np.ndindex(2, 2, 2):
            nodal[tuple(slice(c, c + n) for c, n in zip(corner, mass.shape))] += mass / 8.0
        return np.array([(nodal * self.whole(name)).sum() for name in VELOCITY])


def batch_of(*spheres: tuple[float, ...]) -> Batch:
    """Return a batch of (x, y, z, r in um, vx, vy, vz in m/s)."""
    table = np.array(spheres, dtype=float)
    return Batch(*(np.ascontiguousarray(column) * UM for column in table[:, :4].T), table[:, 4:].copy())


@pytest.mark.mpi
def test_one_velocity_for_all_paints_the_very_bits_of_the_scenes_velocity():
    """Also cut by walls, in contact, and into the substrate's surface layer.

    Fails when a node averages its cells as sum(m v) / sum(m), which rounds.
    """
    speed = (60.1, -80.3, -600.7)
    spheres = [(2, 30, 60, 11), (63, 33, 40, 14), (63, 33, 69, 15), (126, 60, 100, 12), (90, 20, 29, 12.5)]
    own, common = Box(), Box()
    batch = batch_of(*[(*sphere, *speed) for sphere in spheres])
    assert own.put(batch).moved == common.put(batch.without_velocity(), speed).moved
    for name in own.state.saved:
        assert np.array_equal(own.whole(name), common.whole(name)), name
    assert own.ledger.totals() == common.ledger.totals()


@pytest.mark.mpi
def test_each_sphere_brings_its_own_mass_momentum_and_energy():
    """Spheres apart, in contact and one that touches the substrate, whose nodes they share by mass.

    Fails when a shared node takes the last sphere's velocity: drop ``old * (nu - cu[n])`` in ``merge_moving_nodes``.
    """
    box, scene = Box(), parse_scene(TRACK, "test")
    batch = batch_of((30, 30, 60, 12, 10, 20, -600), (53.5, 33, 60, 11, -40, 5, -450), (95, 30, 90, 14, 0, -30, -550),
                     (95, 33, 30, 13, 30, 0, -300))
    assert box.put(batch).moved == 0
    volume = np.array([clipped_volume(batch.chosen(slice(n, n + 1)), *scene.domain.extents)
                       for n in range(4)]) / (6 * UM) ** 3
    assert box.momentum() == pytest.approx(volume @ batch.velocity, rel=1e-11)
    painted = box.ledger.totals()["mass_painted"] * box.model.mass_quantum
    assert painted == pytest.approx(volume.sum(), rel=1e-11)
    centre = tuple(round(v / 6) for v in (90, 30, 95))  # a node inside the third sphere
    assert [box.whole(name)[centre] for name in VELOCITY] == [0.0, -30.0, -550.0]
    lone = Box()
    lone.put(batch_of((40, 30, 60, 12, 10, 20, -600), (95, 33, 90, 14, 0, -30, -550)))
    brought = lone.ledger.totals()["brought_in"] * lone.model.energy_quantum
    energies = [0.5 * 8960 * 4 / 3 * math.pi * (r * UM) ** 3 * speed for r, speed in
                ((12, 10**2 + 20**2 + 600**2), (14, 30**2 + 550**2))]
    assert brought == pytest.approx(sum(energies), rel=1e-9)


@pytest.mark.mpi
def test_spheres_that_wait_keep_their_velocities():
    """Fails when ``report.deferred`` is made of places and radii only."""
    box = Box()
    paint_substrate(box.state, 150 * UM, 298.15)
    batch = batch_of((30, 30, 60, 12, 10, 20, -600), (95, 30, 90, 14, 0, -30, -550))
    report = box.put(batch)
    assert report.spheres == 0
    assert np.array_equal(report.deferred.velocity, batch.velocity)


# --- a run -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def one_rank(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the folder of a small track's run on one rank."""
    folder = tmp_path_factory.mktemp("track")
    (folder / "track.toml").write_text(TRACK, encoding="utf-8")
    f2s("run", "track.toml", "--out", "on-1", cwd=folder)
    return folder / "on-1"


def test_a_small_track_has_the_same_bits_on_two_ranks(one_rank):
    """Fails if the ghosts of the velocities stay empty behind a wall that only one rank has (``insert``)."""
    summary = runs.read_summary(one_rank)
    assert summary["status"] == "complete"
    assert summary["particles_waiting"] > 0
    assert summary["particles_moved"] > 0
    assert summary["peeq_max"] > 0.05
    assert summary["mass_drift_relative"] < 1e-12
    f2s("run", "track.toml", "--out", "on-2", ranks=2, cwd=one_rank.parent)
    assert compare_runs(one_rank, one_rank.parent / "on-2").identical


def test_a_resumed_track_paints_the_waiting_spheres_with_their_velocities(one_rank):
    """Resumed from after cycle 2, when spheres waited; fails when the checkpoint forgets their velocities."""
    copy = one_rank.parent / "resumed"
    shutil.copytree(one_rank, copy)
    last = list_checkpoints(copy / layout.CHECKPOINTS)[-1]
    manifest_path(last).unlink()
    last.unlink()
    f2s("resume", "resumed", ranks=2, cwd=one_rank.parent)
    assert compare_runs(one_rank, copy).identical


def test_particles_writes_velocities_and_a_picture(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("track.toml").write_text(TRACK, encoding="utf-8")
    assert main(["particles", "track.toml", "--out", "batches"]) == 0
    said, folder = capsys.readouterr().out, tmp_path / "batches"
    assert sorted(path.name for path in folder.iterdir()) == ["batch-01.csv", "batch-02.csv", "batches.png"]
    assert (folder / "batches.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (folder / "batch-01.csv").read_text().startswith("x,y,z,r,vx,vy,vz\n")
    assert "picture batches/batches.png" in said
