"""Tracers in runs: same bits on any rank count and after a stop; their files; what analyse makes of them."""

from __future__ import annotations

import csv
import dataclasses
import json
import pathlib
import shutil

import h5py
import numpy as np
import pytest
from conftest import f2s

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.cycles.tracers import PLACES
from f2s_hpc.errors import F2SError
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.manifest import read_manifest
from f2s_hpc.io.tracers import ParticleTable, TracerCloud, read_tracers, tracer_path, write_tracers
from f2s_hpc.particles.cloud import unit_ball
from f2s_hpc.report.deposit import load_deposit
from f2s_hpc.report.measure import Settings, measure
from f2s_hpc.report.page import build_page
from f2s_hpc.report.quantities import quantities
from f2s_hpc.report.traced import APART, CUT, FEW, MEASURED, trace

SCENE = """
title = "Impacts in a small box"

[domain]
size = ["90 um", "102 um", "216 um"]
cell_size = "6 um"
substrate_height = "36 um"
particle_layer_height = "144 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"
direction = [0.1, -0.05, -1.0]

[batches]
count = 2
particles = 12
seed = 3
diameter_d10 = "20 um"
diameter_d50 = "30 um"
diameter_d90 = "42 um"
diameter_min = "14 um"
diameter_max = "48 um"

[cycles]
count = 2
duration = "0.1 us"
last_duration = "0.25 us"

[output]
picture = false
tracers = 40
"""


# --- files ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def one_rank(tmp_path_factory) -> pathlib.Path:
    """Return the folder of the run on one rank; the scene file lies beside it."""
    folder = tmp_path_factory.mktemp("tracers")
    (folder / "impacts.toml").write_text(SCENE, encoding="utf-8")
    f2s("run", "impacts.toml", "--out", "on-1", cwd=folder)
    return folder / "on-1"


def same_points(first: pathlib.Path, second: pathlib.Path) -> None:
    for cycle in (1, 2):
        one, two = read_tracers(first, cycle), read_tracers(second, cycle)
        for name in ("particle", "position", "fraction", "peeq", "temperature", "time"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
        for name in ("diameter", "centre", "time", "cut"):
            np.testing.assert_array_equal(getattr(one.particles, name), getattr(two.particles, name), err_msg=name)


@pytest.mark.parametrize("ranks", [2, 4])  # (3: the next test)
def test_any_number_of_ranks_gives_the_same_points(one_rank, ranks):
    """Fails if points are not handed over: leave ``self.migrate()`` out of ``Tracers.move``."""
    f2s("run", "impacts.toml", "--out", f"on-{ranks}", ranks=ranks, cwd=one_rank.parent)
    other = one_rank.parent / f"on-{ranks}"
    assert "identical in every saved bit" in f2s("compare", one_rank, other, "--exact", cwd=one_rank.parent).stdout
    assert set(PLACES) <= set(read_manifest(list_checkpoints(other / layout.CHECKPOINTS)[-1]).fields)
    same_points(one_rank, other)


def test_stopped_and_resumed_on_other_ranks_points_end_in_the_same_place(one_rank, tmp_path):
    """Fails if ``restore`` forgets what was seeded, or reads the numbers of another rank."""
    scene, run = one_rank.parent / "impacts.toml", tmp_path / "run"
    f2s("run", scene, "--out", run, "--set", "run.wall_time=1 ms", ranks=2, cwd=tmp_path, code=75)
    assert runs.read_summary(run)["cycles"] == 0
    said = f2s("resume", run, "--set", "output.tracers=20", cwd=tmp_path, code=2).stderr
    assert len(said.splitlines()) == 1
    assert "output.tracers: this run follows 40 points" in said
    f2s("resume", run, "--set", "run.wall_time=1 h", ranks=3, cwd=tmp_path)
    assert "identical in every saved bit" in f2s("compare", one_rank, run, "--exact", cwd=tmp_path).stdout
    same_points(one_rank, run)


def test_a_scene_without_tracers_has_none(one_rank, tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("tracers were made")

    monkeypatch.setattr("f2s_hpc.cycles.simulation.Tracers", refuse)
    assert main(["run", str(one_rank.parent / "impacts.toml"), "--out", str(tmp_path / "run"), "--set",
                 "output.tracers=0", "--set", "cycles.count=1", "--set", "cycles.last_duration=2 ns"]) == 0
    assert not (tmp_path / "run" / layout.TRACERS).exists()
    (path,) = list_checkpoints(tmp_path / "run" / layout.CHECKPOINTS)
    assert not any("tracer" in name for name in read_manifest(path).fields)
    assert not any("tracers" in row for row in runs.read_cycle_table(tmp_path / "run"))
    assert trace(load_deposit(tmp_path / "run")) is None


@pytest.mark.parametrize(("value", "said"), [("5", "at least 10"), ("-1", "0"), ("20.5", "whole number"),
                                             ("200000", "100000"), ('"many"', "whole number")])
def test_a_wrong_number_of_tracers_is_one_line(capsys, value, said):
    assert main(["check", "quickstart", "--set", f"output.tracers={value}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "output.tracers" in line
    assert said in line


def test_check_tells_what_tracers_take(capsys):
    assert main(["check", "quickstart", "--set", "output.tracers=200"]) == 0
    (line,) = [text for text in capsys.readouterr().out.splitlines() if text.startswith("# tracers")]
    assert "28,800" in line  # 4 x 36 particles
    assert main(["check", "quickstart"]) == 0
    assert "# tracers" not in capsys.readouterr().out


def test_the_file_is_a_cloud_of_vertices(one_rank):
    """What a reader of ParaView needs; with VTK at hand, what it makes of it. Fails if a point has no vertex."""
    import h5py

    cloud = read_tracers(one_rank, 2)
    count, path = cloud.particle.size, tracer_path(one_rank, 2)
    with h5py.File(path, "r") as file:
        root = file["VTKHDF"]
        assert root.attrs["Type"] == b"PolyData"
        assert root["Points"].shape == (count, 3)
        assert root["Vertices/Offsets"][...].tolist() == list(range(count + 1))
        assert root["Vertices/Connectivity"][...].tolist() == list(range(count))
        assert root["Polygons/Offsets"][...].tolist() == [0]
    assert np.bincount(cloud.particle)[~cloud.particles.cut].tolist() == [40] * int((~cloud.particles.cut).sum())
    reader = pytest.importorskip("vtkmodules.vtkIOHDF").vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetOutput().GetNumberOfVerts() == count


def test_a_damaged_file_is_refused(one_rank, tmp_path):
    shutil.copytree(one_rank, tmp_path / "copy")
    tracer_path(tmp_path / "copy", 2).write_bytes(b"no")
    with pytest.raises(F2SError, match="damaged file of tracers"):
        load_deposit(tmp_path / "copy")


# --- analysis ---------------------------------------------------------------------------------------


def made_cloud(centres: list, axes: list, cut: list[bool], beyond: int = 0) -> TracerCloud:
    """Return ellipsoids of semi-axes ``axes`` (m); the last ``beyond`` points of each are in void cells far above."""
    ball = unit_ball(100)
    points = np.array([centre + ball * axis for centre, axis in zip(np.array(centres), np.array(axes))])
    fraction = np.ones(points.shape[:2])
    if beyond:
        points[:, -beyond:, 2] = 170e-6
        fraction[:, -beyond:] = 0.0
    size = len(centres)
    diameter = 2.0 * np.cbrt(np.prod(axes, axis=1))
    table = ParticleTable(diameter, np.array(centres), np.zeros(size), np.array(cut))
    values = np.zeros(100 * size)
    return TracerCloud(2e-7, np.repeat(np.arange(size), 100), points.reshape(-1, 3), fraction.ravel(), values, values,
                       table, (0, 100 * size))


def test_made_ellipsoids_are_measured_in_closed_form(one_rank, tmp_path):
    """W, H and both ratios, written, read and measured; cut particles and those not in the deposit are left out.

    Fails if ``trace`` measures cut particles, or takes all points instead of those in landed material.
    """
    run = tmp_path / "run"
    shutil.copytree(one_rank, run)
    axes = [[15e-6, 15e-6, 6e-6], [12e-6, 12e-6, 12e-6], [12e-6, 12e-6, 3e-6], [9e-6, 9e-6, 4e-6]]
    centres = [[30e-6, 40e-6, 20e-6], [50e-6, 60e-6, 20e-6], [4e-6, 40e-6, 20e-6], [40e-6, 40e-6, 160e-6]]
    cloud = made_cloud(centres, axes, [False, False, True, False])
    write_tracers(run, 2, cloud, {})
    deposit = load_deposit(run)
    landed = np.zeros(deposit.landed.shape, dtype=bool)
    landed[:10] = True
    found = measure(dataclasses.replace(deposit, landed=landed), Settings(cutoff=30e-6))
    traced, flat = found.traced, found.traced.flattening
    assert traced.fates.tolist() == [MEASURED, MEASURED, CUT, APART]
    assert flat.width == pytest.approx([30e-6, 24e-6, np.nan, np.nan], rel=1e-5, nan_ok=True)
    assert flat.height == pytest.approx([12e-6, 24e-6, np.nan, np.nan], rel=1e-5, nan_ok=True)
    assert flat.equation_5[:2] == pytest.approx([2.5, 1.0], rel=1e-5)
    assert flat.equation_6[:2] == pytest.approx([2.5 ** (1 / 3), 1.0], rel=1e-5)
    assert flat.exact_6[:2] == pytest.approx(flat.equation_6[:2], rel=1e-5)
    assert traced.waiting == deposit.diameters.size - 4
    values = {q.key: q.value for q in quantities(found)}
    assert values["tracer_equation_5"] == pytest.approx(1.75, rel=1e-5)
    assert (values["tracer_particles"], values["tracer_cut"], values["tracer_apart"]) == (2.0, 1.0, 1.0)
    assert "1.750" in build_page([("", found)], {})


def test_splashes_do_not_count_as_the_particle(one_rank):
    """Fails if the shape is taken of all points: ten of a hundred, far above, would make it as high as the box."""
    deposit = load_deposit(one_rank)
    landed = np.zeros(deposit.landed.shape, dtype=bool)
    landed[:10] = True
    cloud = made_cloud([[40e-6, 50e-6, 20e-6]], [[15e-6, 15e-6, 6e-6]], [False], beyond=10)
    traced = trace(dataclasses.replace(deposit, landed=landed, tracers=cloud))
    assert traced.fates.tolist() == [MEASURED]
    assert traced.share[0] == pytest.approx(0.9)
    assert traced.in_void == 10
    assert traced.flattening.height[0] == pytest.approx(12e-6, rel=0.1)


def test_a_point_beyond_a_high_side_is_outside(one_rank):
    """On the side is inside, a quarter of a cell beyond is not, on each axis; fails if ``<=`` is taken of cells + 1."""
    deposit = load_deposit(one_rank)
    cloud = made_cloud([[40e-6, 50e-6, 20e-6]], [[15e-6, 15e-6, 6e-6]], [False])
    sides = np.array(deposit.fraction.shape[::-1]) * deposit.dx
    for number, side in enumerate(sides):
        cloud.position[number, number] = side * (1.0 + 1e-7 * (number == 0))  # (single precision says so too)
        cloud.position[3 + number, number] = side + 0.25 * deposit.dx
        cloud.position[6 + number, number] = -0.25 * deposit.dx
    assert trace(dataclasses.replace(deposit, tracers=cloud)).outside == 6


def test_a_particle_with_too_few_points_left_is_not_said_to_be_gone(one_rank):
    """Nine of its ten points are in the deposit. Fails when ``landed < LEAST_POINTS`` counts as apart."""
    deposit = load_deposit(one_rank)
    cloud = made_cloud([[40e-6, 50e-6, 20e-6]], [[15e-6, 15e-6, 6e-6]], [False])
    few = slice(0, 10)
    position = cloud.position[few].copy()
    position[0] = -1.0
    cloud = dataclasses.replace(cloud, particle=cloud.particle[few], position=position, fraction=cloud.fraction[few],
                                peeq=cloud.peeq[few], temperature=cloud.temperature[few])
    assert list(trace(dataclasses.replace(deposit, tracers=cloud)).fates) == [FEW]


def test_analyse_and_report_show_both_ways(one_rank, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["analyse", str(one_rank), "--out", str(out), "--cutoff", "30 um"]) == 0
    said = capsys.readouterr().out
    assert "Tracers: flattening of every particle" in said
    numbers = json.loads((out / "analysis.json").read_text(encoding="utf-8"))
    summary = runs.read_summary(one_rank)
    assert numbers["tracer_points"] == summary["tracers"]
    assert numbers["tracer_in_void"] == summary["tracers_in_void"]
    with (out / "flattening-tracers.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == numbers["tracer_particles"] + numbers["tracer_cut"] + numbers["tracer_apart"]
    assert numbers["tracer_particles"] > 3
    assert len(rows) + numbers["tracer_waiting"] == 24
    widths = [float(row["width_um"]) for row in rows if row["fate"] == MEASURED]
    assert np.mean(widths) == pytest.approx(1e6 * numbers["tracer_width_m"], rel=1e-6)
    assert (out / "flattening-tracers.png").exists()
    assert main(["report", str(one_rank), "--out", str(tmp_path / "page.html"), "--cutoff", "30 um"]) == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "by tracers" in page
    assert "Every particle" in page


@pytest.mark.mpi
def test_room_is_looked_for_for_all_of_a_file_of_points(shared_path, monkeypatch):
    """Fails when the vertices, or the particles, are written by rank 0 beside the blocks: nothing asks for their room,
    and a rank that finds none leaves the others in a call.
    """
    asked, reserve = [], layout._reserve
    monkeypatch.setattr(layout, "_reserve", lambda path, size: (asked.append(size), reserve(path, size)))
    count = 20_000
    first, end = (count * r // mpi.size() for r in (mpi.rank(), mpi.rank() + 1))
    particle = np.arange(first, end)
    zero = np.zeros(end - first)
    table = ParticleTable(np.arange(1.0, count + 1.0), np.zeros((count, 3)), np.zeros(count), np.zeros(count, bool))
    if mpi.is_root():
        (shared_path / layout.TRACERS).mkdir()
    mpi.barrier()
    cloud = TracerCloud(0.0, particle, np.zeros((end - first, 3)), zero, zero, zero, table, (first, count))
    path = write_tracers(shared_path, 1, cloud, {})
    if mpi.is_root():
        assert path.stat().st_size < asked[0] + 50_000
        with h5py.File(path, "r") as file:
            assert np.array_equal(file["VTKHDF/Vertices/Offsets"], np.arange(count + 1))
            assert np.array_equal(file["VTKHDF/Vertices/Connectivity"], np.arange(count))
        assert np.array_equal(read_tracers(shared_path, 1).particles.diameter, table.diameter)
