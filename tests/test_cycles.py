"""Cycles of short runs: stops at the end of one, frames at their times, what is counted and what is written."""

from __future__ import annotations

import json
import pathlib
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_mishaps import stop_when

from f2s_hpc.cli import tasks
from f2s_hpc.cli.main import main
from f2s_hpc.config import parse_scene
from f2s_hpc.config.describe import checkpoint_bytes, frame_count
from f2s_hpc.cycles import output, progress, simulation
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.cycles.stop import StopRequest
from f2s_hpc.cycles.supply import Supply
from f2s_hpc.cycles.tracers import PLACES, bytes_saved
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver import sleep
from f2s_hpc.verify.scenes import prepare

SCENE = """
title = "Short cycles"
domain = { size = ["36 um", "48 um", "96 um"], cell_size = "4 um", substrate_height = "16 um", \
particle_layer_height = "56 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC", flight = "eulerian" }
batches = { spheres = [["14 um", "15 um", "11 um", "10 um"], ["25 um", "35 um", "11 um", "9 um"]] }
cycles = { count = 3, duration = "2 ns" }
output = { picture = false }
"""


@pytest.fixture
def run(tmp_path):
    """Return ``run(code, *settings)``: run SCENE in this process, check the exit code, return the folder."""
    def start(code: int, *settings: str) -> pathlib.Path:
        (tmp_path / "short.toml").write_text(SCENE, encoding="utf-8")
        words = [word for setting in settings for word in ("--set", setting)]
        assert main(["run", str(tmp_path / "short.toml"), "--out", str(tmp_path / "run"), *words]) == code
        return tmp_path / "run"

    return start


# --- stops --------------------------------------------------------------------------------------------------


def test_a_stop_at_the_end_of_a_cycle_leaves_a_checkpoint_to_go_on_from(run):
    """Cycles of a single step, the budget spent before the first; the scene asks for no checkpoints.

    Fails when ``_finish_cycle`` saves only what the scene asks for, or the run goes on after the cycle of the stop.
    """
    folder = run(75, "cycles.duration=0.01 ns", "run.wall_time=1 us", "output.checkpoints=false")
    summary = runs.read_summary(folder)
    assert (summary["status"], summary["cycles"], summary["steps"]) == ("timeout", 1, 1)
    assert len(list_checkpoints(folder / layout.CHECKPOINTS)) == 1
    assert main(["resume", str(folder), "--set", "run.wall_time=1 h"]) == 0
    summary = runs.read_summary(folder)
    assert (summary["status"], summary["cycles"]) == ("complete", 3)
    assert [row["cycle"] for row in runs.read_cycle_table(folder)] == ["1", "2", "3"]


def test_a_stop_in_the_last_step_of_all_is_none(run):
    """Fails when the end of the last cycle passes for a timeout: a batch system would start the run again for ever."""
    folder = run(0, "cycles.count=1", "cycles.duration=0.01 ns", "run.wall_time=1 us")
    assert runs.read_summary(folder)["status"] == "complete"


@pytest.mark.parametrize("settings", [["cycles.count=1"], ["run.wall_time=1 us"]])
def test_a_run_counts_its_time_from_the_command_on_and_measures_its_saving(run, monkeypatch, settings):
    """At the end of a cycle and within one. Fails if ``main`` or ``tasks`` does not hand ``started`` on, or without
    ``saving`` around ``_finish_cycle`` or around ``_checkpoint`` in ``_save``.
    """
    stops, batches, saved = [], [], []

    def kept(*arguments):
        stops.append(StopRequest(*arguments))
        return stops[-1]

    def made(scene):
        batches.append(time.monotonic())
        return make_batches(scene)

    def written(self, *arguments):
        began = time.monotonic()
        path = write_checkpoint(self, *arguments)
        saved.append(time.monotonic() - began)
        return path

    write_checkpoint = RunFolder.write_checkpoint
    monkeypatch.setattr(simulation, "StopRequest", kept)
    monkeypatch.setattr(tasks, "make_batches", made)
    monkeypatch.setattr(RunFolder, "write_checkpoint", written)
    began = time.monotonic()
    folder = run(75 if "run.wall_time=1 us" in settings else 0, *settings)
    assert began < stops[0].started < batches[0] < stops[0].start
    assert len(saved) == 1
    assert stops[0].reserve > saved[0]
    began = time.monotonic()
    assert main(["resume", str(folder), "--set", "run.wall_time=1 h"]) == 0
    assert began < stops[1].started < stops[1].start


# --- files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("settings", "times"), [
    (["output.frame_interval=1 ns"], [1, 2, 3, 4, 5, 6]), (["output.frame_interval=1.5 ns"], [1.5, 2, 3, 4, 4.5, 6]),
    (["output.frame_interval=1.5 ns", 'output.frames="none"'], [1.5, 3, 4.5, 6]), ([], [2, 4, 6])])
def test_frames_come_at_their_times_and_once_only(run, settings, times):
    """Also where an interval ends with a cycle; fails when that is written twice, or ``frame_count`` counts it twice.

    A frame comes after the step that passes its time.
    """
    folder = run(0, *settings)
    metas = [runs.read_frame_meta(folder / layout.FRAMES / layout.frame_name(n)) for n in runs.list_frames(folder)]
    found = [1e9 * meta.time_s for meta in metas]
    assert len(found) == len(times) == frame_count(parse_scene(SCENE, "test", settings))
    step = 1e9 * runs.read_summary(folder)["time_s"] / runs.read_summary(folder)["steps"]
    assert all(wanted - 1e-9 <= time < wanted + 2.0 * step for time, wanted in zip(found, times))
    if 'output.frames="none"' not in settings:
        ends = [round(time) for time, meta in zip(found, metas) if meta.provenance["ends_cycle"]]
        assert ends == [2, 4, 6]


def test_the_cycle_table_holds_every_digit_of_the_summary(run):
    """Fails when ``_flat`` rounds the energies."""
    folder = run(0)
    summary, row = runs.read_summary(folder), runs.read_cycle_table(folder)[-1]
    for name, value in summary["energy"].items():
        assert float(row[f"energy_{name}_J"]) == value, name
    assert float(row["dense_height_m"]) == summary["dense_height_m"]


@pytest.mark.parametrize(("settings", "stopped", "begins"), [
    ([], True, "2 particles, "), (["output.frame_interval=25 ns", 'output.frames="none"'], False, "within cycle 3, ")])
def test_the_picture_tells_of_the_frame_that_it_shows(run, monkeypatch, settings, stopped, begins):
    """A stop in the second cycle, whose batch no frame has yet; and frames that come at their own times only.

    Fails when the caption is of the present state: 4 particles at the time of the stop, 6 at the end.
    """
    captions = []
    monkeypatch.setattr(output.picture, "draw", lambda *values, **_: captions.append(values[4]))
    if stopped:
        stop_when(lambda clock: clock.cycle_start > 0.0 and clock.in_cycle > 1e-9, monkeypatch)
    folder = run(75 if stopped else 0, "output.picture=true", "cycles.duration=30 ns", *settings)
    (caption,) = captions
    newest = runs.list_frames(folder)[-1]
    time = runs.read_frame_meta(folder / layout.FRAMES / layout.frame_name(newest)).time_s
    assert caption.startswith(f"{begins}{1e6 * time:.2f} µs, ")
    row = runs.read_cycle_table(folder)[0]
    assert (f"dense height {1e6 * float(row['dense_height_m']):.1f} µm" in caption) is stopped
    assert time < runs.read_summary(folder)["time_s"]


def test_what_check_foretells_of_files_is_what_they_take(run):
    """Fails when nodes are counted as cells in ``checkpoint_bytes``, or one of three places in ``bytes_saved``."""
    folder = run(0, "output.tracers=50")
    arrays, _ = runs.open_checkpoint_serial(list_checkpoints(folder / layout.CHECKPOINTS)[-1])
    points = sum(arrays.pop(name).nbytes for name in PLACES)
    assert checkpoint_bytes(parse_scene(SCENE, "test")) == sum(array.nbytes for array in arrays.values())
    count = runs.read_summary(folder)["tracers"]
    assert count > 0
    assert bytes_saved(1, count)[0] == points


# --- what is counted ----------------------------------------------------------------------------------------


def put_in(text: str, *overrides: str) -> Supply:
    """Return the supply of a scene, nothing put in yet."""
    scene = parse_scene(text, "test", overrides)
    setup, plan = prepare(scene)
    return Supply(scene, plan, setup.state, setup.model, setup.clock, setup.ledger)


@pytest.mark.parametrize("flight", ["eulerian", "ballistic"])
def test_particles_that_were_moved_add_up_over_cycles_and_a_resume(flight):
    """A second batch on top of the first, before a step is taken.

    Fails when ``insert`` forgets those moved before, ``restore`` does, or ``row`` leaves out those raised in flight.
    """
    supply = put_in(SCENE, f"particles.flight={flight}")
    reports = [supply.insert(cycle)[0] for cycle in range(3)]
    moved = [report.moved for report in reports]
    assert min(moved[1:]) > 0
    assert supply.row()["particles_moved"] == sum(moved)
    assert supply.row()["particles"] + supply.row()["particles_waiting"] == 6
    if flight == "ballistic":
        supply.flight.raised += 2
        assert supply.row()["particles_moved"] == sum(moved) + 2
        assert supply.row()["volume_in_flight_m3"] == pytest.approx(
            3 * 4 / 3 * np.pi * (10e-6**3 + 9e-6**3), rel=1e-9, abs=0.0)
    other = put_in(SCENE, f"particles.flight={flight}")
    other.restore(json.loads(json.dumps(supply.attributes())))
    assert other.row() == supply.row()


@pytest.mark.parametrize("flight", ["eulerian", "ballistic"])
def test_the_time_step_knows_of_what_was_just_put_in(flight):
    """Fails when ``_paint`` leaves out ``put_in``, or ``_put_down`` the speed: the next step would be one of rest."""
    supply = put_in(SCENE, f"particles.flight={flight}", "batches.spheres=[['14 um', '15 um', '25 um', '10 um']]")
    limits = supply.clock.limits
    assert limits.heavy_speed == 0.0
    supply.insert(0)
    if flight == "ballistic":
        assert limits.heavy_speed == 0.0
        assert supply.land_all().count == 1
    assert limits.heavy_speed == 615.0
    assert (limits.gradient > 615.0 / 4e-6) is (flight == "eulerian")


def test_a_batch_that_is_painted_wakes_what_sleeps_below_it():
    """Fails when ``_paint`` leaves ``wake_for`` out: what was put in would meet a rigid floor."""
    supply = put_in(SCENE, "domain.substrate_height=40 um", "domain.particle_layer_height=36 um",
                    "numerics.sleeping_depth=32 um")
    supply.state.set_floor(9)
    supply.insert(0)
    assert supply.state.floor == 15 - sleep.MARGIN  # the layer begins 60 um above the bottom


# --- what is said -------------------------------------------------------------------------------------------


def test_the_estimated_end_counts_this_session_only(monkeypatch, capsys):
    """Half was done before; a tenth in 20 s leaves 80 s. Fails when the whole time counts, or what others did.

    Nor do the 30 s of the first step, which compiles the kernels, and nothing is foretold before 2 % are done: fails
    when ``start`` is set where the object is made, or ``ETA_SHARE`` is 0.
    """
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    line = progress.Progress(True, lambda time: time / 1e-6, 10.0)
    clock = SimpleNamespace(time=0.5e-6, in_cycle=0.1e-6, steps=7, dt=1e-10, limit="sound",
                            limits=SimpleNamespace(heavy_speed=615.0))
    now[0] = 130.0
    line.step(clock, 1, 2, 0.5e-6)
    assert "ETA" not in capsys.readouterr().out
    now[0], clock.time = 139.0, 0.505e-6
    line.step(clock, 1, 2, 0.5e-6)
    assert not capsys.readouterr().out
    now[0] = 140.0
    line.step(clock, 1, 2, 0.5e-6)
    said = capsys.readouterr().out
    assert "50.5 %" in said
    assert "ETA" not in said
    now[0], clock.time = 150.0, 0.6e-6
    line.step(clock, 1, 2, 0.5e-6)
    said = capsys.readouterr().out
    assert re.search(r"cycle 2/2 .* 60\.0 % of the work  ETA 0:01:20$", said.strip())


def test_the_share_that_is_done_is_one_of_the_work(run, capsys):
    """Of the cell-steps that there will be, within a few per cent, not of the time, of which each cycle is a third.

    Fails when ``load_and_growth`` leaves out the cells of a moment, or ``step`` tells of the time. After a resume too.
    """
    folder = run(0, "output.progress_seconds=1 ns", "cycles.duration=100 ns", "particles.flight=ballistic",
                 "domain.substrate_height=4 um")
    said = capsys.readouterr().out
    done = [int(row["active_cell_steps"]) for row in runs.read_cycle_table(folder)]
    told = [float(re.findall(rf"cycle {n}/3 .* ([\d.]+) % of the work", said)[-1]) for n in (1, 2, 3)]
    assert told == pytest.approx([100.0 * steps / done[-1] for steps in done], abs=3.0)
    assert told[2] == 100.0
    assert told[0] < 28.0
    first = list_checkpoints(folder / layout.CHECKPOINTS)[-2]
    for path in list_checkpoints(folder / layout.CHECKPOINTS):
        if path != first:
            path.unlink()
    assert main(["resume", str(folder)]) == 0
    again = re.findall(r"cycle \d/3 .* ([\d.]+) % of the work", capsys.readouterr().out)
    assert float(again[0]) > told[1]
    assert float(again[-1]) == 100.0


def test_a_dwell_tells_how_far_it_is(monkeypatch, capsys):
    """As often as steps do; fails when a dwell of minutes is silent, or says so after each super step."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    line = progress.Progress(True, lambda time: time / 1e-6, 10.0)
    for now[0], left in ((5.0, 9e-3), (11.0, 7.5e-3), (12.0, 5e-3)):
        line.dwell(left, 10e-3, 2, 9)
    assert capsys.readouterr().out == "dwell after cycle 2/9   25.0 % of 10 ms\n"


def test_the_fastest_particle_may_not_be_on_the_grid_yet(monkeypatch, capsys):
    """Fails when ``step`` prints the grid's speed alone: "fastest 0 m/s" while all particles fly at 615 m/s."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    line = progress.Progress(True, lambda time: time / 1e-6, 10.0)
    clock = SimpleNamespace(time=0.6e-6, in_cycle=0.1e-6, steps=7, dt=1e-10, limit="sound",
                            limits=SimpleNamespace(heavy_speed=0.0))
    now[0] = 20.0
    line.step(clock, 1, 2, 0.5e-6, lambda: 615.0)
    assert "fastest 615 m/s" in capsys.readouterr().out


def test_a_run_tells_how_fast_its_spheres_fly(run, capsys):
    """Fails when ``_run_cycle`` does not pass ``_fastest_in_flight`` on; the substrate alone is on the grid."""
    run(0, "particles.flight=ballistic", "output.progress_seconds=1 ns", "cycles.count=1")
    (said, *_) = [line for line in capsys.readouterr().out.splitlines() if "fastest" in line]
    assert "fastest 615 m/s" in said
