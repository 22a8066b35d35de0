"""What goes wrong around a run: numbers that are none, files of another run, logs that are full, folders in use."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest
from conftest import F2S, ROOT
from test_damaged import SCENE, copy, edit, finished  # noqa: F401  (fixtures)

from f2s_hpc import mpi
from f2s_hpc._cache import package_hash
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene, parse_scene
from f2s_hpc.cycles import simulation
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.errors import InputError
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints, newest_valid_checkpoint
from f2s_hpc.origin import commit
from f2s_hpc.particles.plan import make_batches, plan_digest

QUICK = SCENE + "output = { picture = false }\n"


@pytest.fixture
def scene(shared_path) -> str:
    """Return the file of a quick scene, shared by all ranks."""
    path = shared_path / "scene.toml"
    if mpi.is_root():
        path.write_text(QUICK, encoding="utf-8")
    mpi.barrier()
    return str(path)


def stop_when(late, monkeypatch) -> None:
    """Let a run stop, as for a signal, when ``late`` says so of its clock."""
    advance = simulation.advance

    def stopped(state, model, clock, *more):
        advance(state, model, clock, *more)
        clock.stop = late(clock)

    monkeypatch.setattr(simulation, "advance", stopped)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["temperature", "peeq"])
def test_what_is_no_number_stops_the_run_before_it_is_saved(shared_path, capsys, monkeypatch, name, scene):
    """A single cell, in the second cycle: exit code 4 on all ranks, the checkpoint of the first cycle stands.

    Fails without ``refuse_what_is_not_finite``: temperature and PEEQ limit no step, and the run ends as complete.
    """
    advance = simulation.advance

    def poisoned(state, model, clock, ledger, cycle_end, *more):
        advance(state, model, clock, ledger, cycle_end, *more)
        if clock.cycle_start > 0.0 and clock.in_cycle > 0.99 * cycle_end and mpi.rank() == mpi.size() - 1:
            state.owned(name)[1, 1, 1] = np.nan

    monkeypatch.setattr(simulation, "advance", poisoned)
    assert main(["run", scene, "--out", str(shared_path / "run")]) == 4
    assert not mpi.is_root() or f"{name} is not finite at cell (i, j, k) = " in capsys.readouterr().err
    kept = list_checkpoints(shared_path / "run" / layout.CHECKPOINTS)
    assert [layout.checkpoint_key(path.name)[0] for path in kept] == [1]

    def refuse(text):
        raise AssertionError(f"{text} is not JSON")

    text = (shared_path / "run" / layout.SUMMARY_JSON).read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=refuse)["status"] == "failed"


@pytest.mark.mpi
def test_checkpoints_within_a_cycle_change_nothing(finished, shared_path, capsys, scene):  # noqa: F811
    """After every remap, as asked for. Fails when ``clock.save`` is not looked at, or ends the run."""
    assert main(["run", scene, "--out", str(shared_path / "run"), "--set", "run.checkpoint_interval=1 us"]) == 0
    said = capsys.readouterr().out
    assert not mpi.is_root() or said.count("\ncheckpoint ") > 2
    ends = [list_checkpoints(folder / layout.CHECKPOINTS)[-1] for folder in (finished, shared_path / "run")]
    assert ends[0].name == ends[1].name
    (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
    for name, values in fields.items():
        assert np.array_equal(values, others[name]), name


def test_a_picture_after_each_cycle_if_asked_for(tmp_path, monkeypatch):
    """Fails when ``_finish_cycle`` draws none, or one more at the end."""
    drawn, draw = [], RunFolder._draw
    monkeypatch.setattr(RunFolder, "_draw",
                        lambda self, rows, *more: (drawn.append(len(rows)), draw(self, rows, *more)))
    (tmp_path / "scene.toml").write_text(QUICK, encoding="utf-8")
    assert main(["run", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "run"), "--set",
                 "output.picture_each_cycle=true"]) == 0
    assert drawn == [1, 2]
    assert (tmp_path / "run" / "deposit.png").exists()


@pytest.mark.mpi
def test_a_file_stops_a_run_with_a_checkpoint_until_it_is_removed(finished, shared_path, capsys, monkeypatch, scene):  # noqa: F811
    """``touch RUN/STOP``: exit code 75, refused while it is there, then the bits of a run that never stopped.

    Fails if ``StopRequest`` does not look for the file, or if ``f2s resume`` passes over it.
    """
    monkeypatch.setattr("f2s_hpc.cycles.stop.LOOK_FOR_FILE", 0.0)
    folder, advance = shared_path / "run", simulation.advance

    def stopped(state, model, clock, *more):
        advance(state, model, clock, *more)
        if clock.remaps == 5 and mpi.is_root():
            (folder / layout.STOP_FILE).touch()

    monkeypatch.setattr(simulation, "advance", stopped)
    assert main(["run", scene, "--out", str(folder)]) == 75
    said = capsys.readouterr().out
    assert not mpi.is_root() or f"stopped: {folder / layout.STOP_FILE} is there; checkpoint" in said
    assert main(["resume", str(folder)]) == 2
    said = capsys.readouterr().err
    assert not mpi.is_root() or "remove that file to go on" in said
    if mpi.is_root():
        assert 5 <= runs.read_summary(folder)["steps"] < 15
        (folder / layout.STOP_FILE).unlink()
    mpi.barrier()
    assert main(["resume", str(folder)]) == 0
    ends = [list_checkpoints(pathlib.Path(place) / layout.CHECKPOINTS)[-1] for place in (finished, folder)]
    (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
    assert all(np.array_equal(values, others[name]) for name, values in fields.items())


@pytest.mark.mpi
@pytest.mark.parametrize("stopped", [False, True])
def test_a_run_that_gets_more_cycles_is_one_that_had_them_from_the_start(finished, shared_path, capsys, stopped, scene):  # noqa: F811
    """To the last bit. ``stopped``: once more between being told and the end of the new cycle.

    Fails when ``plan_of_cycles`` has no batch for the new cycle, or ``_scenes_of`` does not look into the folder.
    """
    folder = str(shared_path / "run")
    assert main(["run", scene, "--out", folder, "--set", "cycles.count=1"]) == 0
    capsys.readouterr()
    assert main(["resume", folder, "--set", "cycles.count=0"]) == 2
    limit = ["--set", "run.wall_time=1 us", "--set", "output.checkpoints=false"] if stopped else []
    assert main(["resume", folder, "--set", "cycles.count=2", *limit]) == (75 if stopped else 0)
    if stopped:
        if mpi.is_root():  # as if it had been killed
            newest = list_checkpoints(pathlib.Path(folder) / layout.CHECKPOINTS)[-1]
            newest.unlink()
        mpi.barrier()
        assert main(["resume", folder]) == 0
    assert main(["resume", folder, "--set", "cycles.count=1"]) == 2
    ends = [list_checkpoints(pathlib.Path(place) / layout.CHECKPOINTS)[-1] for place in (finished, folder)]
    (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
    for name, values in fields.items():
        assert np.array_equal(values, others[name]), name
    assert not mpi.is_root() or "of this run 2 cycles came before" in capsys.readouterr().err


@pytest.mark.mpi
def test_the_folder_stays_locked_while_a_run_gets_more_cycles(copy, monkeypatch):  # noqa: F811
    """Its scene is written anew. Fails when the lock is on that file, whose place another takes."""
    seen = []

    def looked(self):
        with pytest.raises(InputError, match="another run is at work"), runs.hold(copy):
            pass
        seen.append(self.scene.cycles.count)
        return simulation.COMPLETE  # (the box is too low for a third)

    monkeypatch.setattr(simulation.Simulation, "run", looked)
    assert main(["resume", str(copy), "--set", "cycles.count=3"]) == 0
    assert seen == [3]


@pytest.mark.mpi
def test_fewer_cycles_are_kept_to_and_a_refused_change_changes_nothing(shared_path, capsys, scene):
    """Stopped in the first of four: told to do two it ends with two, now and later; more tracers are refused at once.

    Fails when the folder's scene is written only for more cycles, or before the run has been set up.
    """
    folder = str(shared_path / "run")
    assert main(["run", scene, "--out", folder, "--set", "cycles.count=4", "--set", "run.wall_time=1 us"]) == 75
    before = (shared_path / "run" / layout.SCENE_FILE).read_text(encoding="utf-8")
    assert main(["resume", folder, "--set", "cycles.count=5", "--set", "output.tracers=20"]) != 0
    assert (shared_path / "run" / layout.SCENE_FILE).read_text(encoding="utf-8") == before
    for more in (["--set", " cycles.count = 2", "--set", "run.wall_time=1 h"], []):
        assert main(["resume", folder, *more]) == 0
        assert runs.read_summary(folder)["cycles"] == 2
    capsys.readouterr()


@pytest.mark.mpi
def test_a_last_cycle_that_has_gone_on_for_long_ends_before_others_follow(shared_path, capsys, monkeypatch, scene):
    """It takes 40 ns as the last one and 15 ns otherwise. Fails without the look at the time passed: time runs back."""
    folder = str(shared_path / "run")
    advance = simulation.advance
    stop_when(lambda clock: clock.in_cycle > 25e-9, monkeypatch)
    assert main(["run", scene, "--out", folder, "--set", "cycles.count=1", "--set",
                 "cycles.last_duration=40 ns"]) == 75
    monkeypatch.setattr(simulation, "advance", advance)
    capsys.readouterr()
    assert main(["resume", folder, "--set", "cycles.count=2"]) == 2
    assert not mpi.is_root() or "let it end first" in capsys.readouterr().err
    assert main(["resume", folder]) == 0
    assert main(["resume", folder, "--set", "cycles.count=2"]) == 0
    assert not mpi.is_root() or "cycle 1 was the last and took 40 ns" in capsys.readouterr().out


@pytest.mark.mpi
def test_a_stopped_run_can_be_analysed_whatever_was_saved_within_its_cycle(shared_path, capsys, monkeypatch, scene):
    """Fails when ``prune`` counts the end of a cycle among the checkpoints within the next: none is left of it."""
    folder = str(shared_path / "run")
    stop_when(lambda clock: clock.cycle_start > 0.0 and clock.in_cycle > 10e-9, monkeypatch)
    assert main(["run", scene, "--out", folder, "--set", "run.checkpoint_interval=1 us", "--set",
                 "output.frames=none"]) == 75
    kept = [layout.checkpoint_key(path.name)[0] for path in list_checkpoints(pathlib.Path(folder) / layout.CHECKPOINTS)]
    assert kept == [1, 1, 1]
    assert mpi.size() > 1 or main(["analyse", folder, "--no-handover", "--cutoff", "20 um"]) == 0
    capsys.readouterr()


@pytest.mark.mpi
@pytest.mark.parametrize("damage", [b"\xff\xfe", b""])
def test_a_folder_whose_scene_is_damaged_says_what_to_do(copy, capsys, damage):  # noqa: F811
    """Fails when only wrong scenes are refused in one line, not files that hold no text."""
    if mpi.is_root():
        (copy / layout.SCENE_FILE).write_bytes(damage)
    mpi.barrier()
    assert main(["resume", str(copy)]) == 2
    assert not mpi.is_root() or "or remove the file: the checkpoint is enough" in capsys.readouterr().err
    if mpi.is_root():
        (copy / layout.SCENE_FILE).unlink()
    mpi.barrier()
    assert main(["resume", str(copy)]) == 0


def test_more_cycles_follow_the_order_and_the_mirrors_of_the_plan(tmp_path):
    """Generated batches, mirrored when they come again. Fails when only the order is continued."""
    scene = QUICK.replace('batches = { spheres = [["14 um", "15 um", "11 um", "10 um"], ["25 um", "28 um", "37 um", '
                          '"9 um"]] }', 'batches = { count = 2, particles = 2, diameter_min = "8 um", '
                          'diameter_d10 = "10 um", diameter_d50 = "14 um", diameter_d90 = "20 um", '
                          'diameter_max = "30 um", mirror_repeats = ["x", "y"] }').replace("15 ns", "1 ns")
    (tmp_path / "scene.toml").write_text(scene, encoding="utf-8")
    path, out = str(tmp_path / "scene.toml"), str(tmp_path / "run")
    assert main(["run", path, "--out", out]) == 0
    assert main(["resume", out, "--set", "cycles.count=5"]) == 0
    whole = make_batches(parse_scene(scene, "test", ["cycles.count=5"]))
    kept = RunFolder(out, parse_scene(scene, "test", ["cycles.count=5"])).read_plan()
    assert kept.order == whole.order
    assert plan_digest(kept, 5) == plan_digest(whole, 5)
    assert len(kept.batches) == 5


@pytest.mark.mpi
def test_a_checkpoint_of_another_scene_is_refused(copy, capsys):  # noqa: F811
    """Fails when only the checkpoint's own hash is looked at."""
    if mpi.is_root():
        text = (copy / layout.SCENE_FILE).read_text(encoding="utf-8")
        (copy / layout.SCENE_FILE).write_text(text.replace('speed = "615 m/s"', 'speed = "600 m/s"'), encoding="utf-8")
    mpi.barrier()
    assert main(["resume", str(copy)]) == 3
    assert not mpi.is_root() or "their particles differ" in capsys.readouterr().err


@pytest.mark.mpi
def test_batches_that_were_changed_are_refused(copy, capsys):  # noqa: F811
    """Fails when no digest of the batches is saved."""
    if mpi.is_root():
        path = next((copy / "batches").glob("*.csv"))
        path.write_text(path.read_text(encoding="utf-8").replace("0.014", "0.0141", 1), encoding="utf-8")
    mpi.barrier()
    assert main(["resume", str(copy)]) == 3
    assert not mpi.is_root() or "are not those of this run any more" in capsys.readouterr().err


@pytest.mark.mpi
def test_a_damaged_checkpoint_costs_no_valid_one(copy):  # noqa: F811
    """After it is resumed both that are kept are whole. Fails without ``set_aside_after``: one of them is damaged."""
    newest = list_checkpoints(copy / layout.CHECKPOINTS)[-1]
    mpi.barrier()
    edit(newest.with_suffix(".json"), size=1)
    assert main(["resume", str(copy)]) == 0
    found, skipped = newest_valid_checkpoint(copy / layout.CHECKPOINTS)
    assert not skipped
    assert len(list_checkpoints(copy / layout.CHECKPOINTS)) == 2
    assert found.name == newest.name
    assert newest.with_name(newest.name + layout.DAMAGED).exists()


@pytest.mark.mpi
def test_a_folder_in_which_a_run_is_at_work_is_not_called_lost(copy):  # noqa: F811
    """Fails when ``check_new_folder`` does not ask for the lock: it says to remove what another run needs."""
    with runs.hold(copy), pytest.raises(InputError, match="another run is at work in it"):
        runs.check_new_folder(copy)
    with pytest.raises(InputError, match="holds a run already"):
        runs.check_new_folder(copy)


@pytest.mark.mpi
@pytest.mark.parametrize("cycle", [0, 1])
def test_inspect_tells_a_run_under_way_from_one_that_was_killed(shared_path, capsys, monkeypatch, scene, cycle):
    """In its first cycle, before it has a checkpoint, and in its second; what kills it leaves it no time to say so.

    Fails when ``run`` writes no summary at its start, or ``inspect`` believes what that says.
    """
    folder, advance = shared_path / "run", simulation.advance

    def inspected() -> list[str]:
        capsys.readouterr()
        assert main(["inspect", str(folder)]) == 0
        return capsys.readouterr().out.splitlines()

    def killed(state, model, clock, *more):
        advance(state, model, clock, *more)
        if (clock.cycle_start > 0.0) == bool(cycle):
            said = inspected()
            assert not mpi.is_root() or ": running, " in said[0]
            raise RuntimeError

    monkeypatch.setattr(simulation, "advance", killed)
    with pytest.raises(RuntimeError):
        main(["run", scene, "--out", str(folder)])
    said = inspected()
    hint = f"go on with: f2s resume {folder}" if cycle else "no checkpoint to go on from; remove it"
    assert not mpi.is_root() or (": interrupted, " in said[0] and hint in said[1])
    if not cycle:
        return
    monkeypatch.setattr(simulation, "advance", advance)
    assert main(["resume", str(folder)]) == 0
    said = inspected()
    assert not mpi.is_root() or ": complete, " in said[0]


@pytest.mark.parametrize("why", ["another machine", "no locks"])
def test_inspect_calls_no_run_interrupted_that_may_go_on(copy, capsys, monkeypatch, why):  # noqa: F811
    """Fails when ``at_work`` does not look which machine held the lock last, or takes a missing lock for a free one."""
    edit(copy / layout.SUMMARY_JSON, status="running")
    assert runs.at_work(copy) is False
    if why == "no locks":
        monkeypatch.setitem(sys.modules, "fcntl", None)
    else:
        (copy / layout.LOCK).write_text("another", encoding="ascii")
    assert main(["inspect", str(copy)]) == 0
    said = capsys.readouterr().out
    assert ": running, or interrupted, " in said
    assert f"if not, go on with: f2s resume {copy}" in said


def test_inspect_tells_how_a_run_that_was_stopped_goes_on(copy, capsys):  # noqa: F811
    """Fails when ``_standing`` says so of runs alone that were killed."""
    edit(copy / layout.SUMMARY_JSON, status="timeout")
    assert main(["inspect", str(copy)]) == 0
    head, hint, *_ = capsys.readouterr().out.splitlines()
    assert ": stopped early, " in head
    assert hint == f"go on with: f2s resume {copy}"


@pytest.mark.mpi
@pytest.mark.parametrize("place", [layout.CHECKPOINTS, layout.FRAMES])
def test_a_folder_that_cannot_be_written_is_told_before_anything_is_computed(copy, capsys, monkeypatch, place):  # noqa: F811
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: access(path, mode) and not (
        mode & os.W_OK and pathlib.Path(path).name == place))
    assert main(["resume", str(copy)]) == 2
    assert not mpi.is_root() or f"{copy / place}: cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "particles"])
def test_a_place_without_room_for_a_folder_is_told_first(capsys, monkeypatch, tmp_path, command):
    """Fails if ``check_new_folder`` or ``write_particles`` calls no ``check_folder``, or a run is set up before."""
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: access(path, mode) and pathlib.Path(path) != tmp_path)
    monkeypatch.setattr("f2s_hpc.cli.tasks.Simulation", None)
    assert main([command, "splat-quarter", "--out", str(tmp_path / "runs" / "x")]) == 2
    said = capsys.readouterr()
    assert not said.out
    assert said.err == (f"{tmp_path / 'runs' / 'x'}: cannot be written ({tmp_path}: Permission denied); name another "
                        "folder with --out\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi
def test_a_frame_that_cannot_be_written_does_not_cost_the_checkpoint(shared_path, capsys, scene):
    """Fails when ``_finish_cycle`` leaves at the frame: nothing of the cycle is left."""
    assert main(["run", scene, "--out", str(shared_path / "run"), "--set", "run.wall_time=1 us"]) == 75
    mpi.barrier()
    if mpi.is_root():
        shutil.rmtree(shared_path / "run" / layout.FRAMES)
        (shared_path / "run" / layout.FRAMES).write_text("in the way")
    mpi.barrier()
    assert main(["resume", str(shared_path / "run"), "--set", "run.wall_time=1 h"]) == 1
    newest, _ = newest_valid_checkpoint(shared_path / "run" / layout.CHECKPOINTS)
    assert layout.checkpoint_key(newest.name)[0] == 1


def test_a_log_without_room_does_not_end_a_run(tmp_path):
    """Fails when only a closed pipe is no error."""
    (tmp_path / "scene.toml").write_text(QUICK, encoding="utf-8")
    with open("/dev/full", "w") as full:
        done = subprocess.run([*F2S, "run", "scene.toml", "--out", "run"], cwd=tmp_path, stdout=full,
                              env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=300, check=False)
    assert done.returncode == 0
    assert runs.read_summary(tmp_path / "run")["status"] == "complete"


def test_a_terminal_that_goes_away_leaves_a_checkpoint(tmp_path):
    """SIGHUP is a request to stop, but not under nohup. Fails when ``StopRequest`` does not listen to it."""
    from f2s_hpc.cycles.stop import StopRequest

    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGTERM,
                                                              signal.SIGINT)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        request = StopRequest(None)
        os.kill(os.getpid(), signal.SIGHUP)
        assert request.asked()
        assert request.reason() == "signal SIGHUP"
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        request = StopRequest(None)
        os.kill(os.getpid(), signal.SIGHUP)
        assert not request.asked()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("text", [f"title = {'[' * 5000}", "\ufeff" + QUICK])
def test_a_scene_with_a_mark_is_read_and_one_too_deep_refused(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    if text.startswith("title"):
        with pytest.raises(InputError, match="too deep"):
            load_scene(str(path), [])
    else:
        assert load_scene(str(path), []).title == "Two spheres"
    with pytest.raises(InputError):
        parse_scene(QUICK, "test", [f"domain.cell_size={'[' * 3000}"])


@pytest.mark.parametrize(("arguments", "said"), [
    (["run", "splat", "--out", ""], "names no folder"),
    (["check", "splat", "--set", "output.frame_interval=1e-30 s"], "1e+06 are possible"),
    (["verify", "--extreme", "--levers"], "one after the other"),
    (["plan", "splat", "--rates", "nowhere/rates.json"], "no folder nowhere"),
    (["resume", "."], "no such folder; is . the folder of a run?")])
def test_small_mistakes_are_one_line(capsys, monkeypatch, tmp_path, arguments, said):
    """Nor do they leave anything. Fails if ``resume`` locks a folder before it looks whether that is a run's."""
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_files_tell_commit_and_libraries(finished, capsys):  # noqa: F811
    """Fails when ``provenance`` leaves ``versions`` out, or checkpoint or summary do."""
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert commit() is None or commit()[:12] in said
    assert f"sources {package_hash()})" in said
    told = runs.read_frame_meta(finished / layout.FRAMES / layout.frame_name(0)).provenance
    assert told["commit"] == commit()
    assert told["sources"] == package_hash()
    assert told["libraries"]["numpy"] == np.__version__
    # (Debian's h5py with MPI is not known to the list of installed packages)
    assert told["libraries"]["h5py"] == h5py.__version__
    newest = list_checkpoints(finished / layout.CHECKPOINTS)[-1]
    for other in (runs.open_checkpoint_serial(newest, [])[1]["versions"], runs.read_summary(finished)["versions"]):
        assert other == {key: told[key] for key in ("version", "commit", "sources", "libraries")}


@pytest.mark.skipif(shutil.which("flock") is None, reason="flock is not installed")
def test_a_chain_leaves_a_folder_alone_in_which_a_run_is_at_work(tmp_path):
    """Fails when ``lost`` looks for checkpoints only: the folder of a run in its first cycle is moved away."""
    folder = tmp_path / "runs"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / layout.SCENE_FILE).write_text("")
    with runs.hold(folder):
        done = subprocess.run(["bash", "jobs/chain.sh"], cwd=ROOT, capture_output=True, text=True, check=False,
                              env=os.environ | {"OUT": str(folder), "DRY_RUN": "1"})
    assert done.returncode == 2
    assert "another run is at work in it" in done.stdout
    assert "becomes" in subprocess.run(["bash", "jobs/chain.sh"], cwd=ROOT, capture_output=True, text=True, check=True,
                                       env=os.environ | {"OUT": str(folder), "DRY_RUN": "1"}).stdout
