"""Stop anywhere, go on with any number of ranks: the same bits as a run that never stopped."""

from __future__ import annotations

import hashlib
import math
import os
import pathlib
import re
import shutil
import signal
import subprocess
import threading

import pytest
from conftest import F2S, ROOT, f2s

from f2s_hpc import mpi
from f2s_hpc.cli import tasks
from f2s_hpc.cli.main import main
from f2s_hpc.config import dump_scene, parse_scene, scene_hash
from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import CheckpointError
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints

REQUEUE = 75

SCENE = """
title = "Impacts in a small box"

[domain]
size = ["90 um", "102 um", "180 um"]
cell_size = "6 um"
substrate_height = "36 um"
particle_layer_height = "144 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"

[batches]
count = 2
particles = 16
seed = 3
diameter_d10 = "20 um"
diameter_d50 = "30 um"
diameter_d90 = "42 um"
diameter_min = "14 um"
diameter_max = "48 um"

[cycles]
count = 2
duration = "60 ns"

[output]
picture = false
frame_interval = "25 ns"
"""


def interrupted(arguments: list[object], ranks: int, cwd: pathlib.Path, when: str) -> tuple[int, str]:
    """Run f2s, send SIGUSR1 when a printed line matches ``when``; return the exit code and what was printed."""
    variables = launch_environment(os.environ) | {"OMPI_MCA_hwloc_base_binding_policy": "none"}
    variables["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    command = [*(["mpirun", "-n", str(ranks)] if ranks > 1 else []), *F2S, *map(str, arguments)]
    process = subprocess.Popen(command, cwd=cwd, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)
    watchdog = threading.Timer(300, process.terminate)
    watchdog.start()
    lines = []
    for line in process.stdout:
        lines.append(line)
        if when and re.match(when, line):
            # mpirun passes the signal on to all its ranks
            process.send_signal(signal.SIGUSR1)
            when = ""
    watchdog.cancel()
    return process.wait(), "".join(lines)


@pytest.fixture(scope="module")
def never_stopped(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the folder of the run that was left alone."""
    folder = tmp_path_factory.mktemp("resume")
    (folder / "impacts.toml").write_text(SCENE, encoding="utf-8")
    f2s("run", "impacts.toml", "--out", "whole", ranks=2, cwd=folder)
    assert runs.read_summary(folder / "whole")["peeq_max"] > 0.3
    return folder / "whole"


@pytest.fixture(scope="module")
def stopped_twice(never_stopped: pathlib.Path) -> pathlib.Path:
    """Return a run stopped by its wall-time budget in cycle 1, resumed, and stopped by a signal in cycle 2."""
    folder = never_stopped.parent
    done = f2s("run", "impacts.toml", "--out", "stopped", "--set", "run.wall_time=1 ms", cwd=folder, code=REQUEUE)
    assert "wall-time budget" in done.stdout
    summary = runs.read_summary(folder / "stopped")
    assert summary["status"] == "timeout"
    assert summary["cycles"] == 0
    assert 0 < summary["steps"] < 10
    go_on = ["resume", "stopped", "--set", "run.wall_time=1 h", "--set", "output.progress_seconds=1 ms"]
    code, said = interrupted(go_on, 2, folder, r"cycle 2/2 .* 2\d\.\d of 60 ns")
    assert code == REQUEUE, said
    assert "signal SIGUSR1" in said
    return folder / "stopped"


def checkpoint_key(path: pathlib.Path) -> tuple[int, int]:
    return layout.checkpoint_key(path.name)[:2]


def test_a_stopped_run_says_where_it_is(stopped_twice, never_stopped):
    summary, whole = runs.read_summary(stopped_twice), runs.read_summary(never_stopped)
    assert summary["status"] == "timeout"
    assert summary["cycles"] == 1
    assert 0.5 * whole["steps"] < summary["steps"] < whole["steps"]
    assert 60e-9 < summary["time_s"] < 120e-9
    # the newest checkpoint is the one of the stop, in the middle of cycle 2, the other the end of cycle 1
    last = list_checkpoints(stopped_twice / layout.CHECKPOINTS)[-2:]
    assert checkpoint_key(last[1]) == (1, summary["steps"])
    assert checkpoint_key(last[0])[1] < summary["steps"]


def test_resumed_on_another_number_of_ranks_it_ends_in_the_same_bits(stopped_twice, never_stopped, tmp_path):
    """Fails if what the next step reads is saved wrongly: ``"steps": clock.steps + 1`` in ``Simulation._attributes``.

    (The order of the sweeps follows the number of the step.)
    """
    copy = tmp_path / "copy"
    shutil.copytree(stopped_twice, copy)
    # as a session leaves it that went on past its last checkpoint and was killed
    frames = [copy / layout.FRAMES / layout.frame_name(number) for number in (0, 90)]
    shutil.copy(*frames)
    said = f2s("resume", copy, ranks=3, cwd=tmp_path).stdout
    assert [path.exists() for path in frames] == [True, False]
    before = runs.read_summary(stopped_twice)
    steps = before["steps"]
    assert f"_step_{steps:08d}.h5" in said
    summary = runs.read_summary(copy)
    assert summary["status"] == "complete"
    assert summary["ranks"] == 3
    # time and memory are those of all sessions
    assert summary["wall_s"] > before["wall_s"]
    assert summary["peak_memory_bytes"] >= before["peak_memory_bytes"]
    rate = summary["active_cell_steps"] / summary["wall_s"]
    assert math.isclose(summary["active_cell_steps_per_s"], rate, rel_tol=0.02)
    assert "identical in every saved bit" in f2s("compare", never_stopped, copy, "--exact", cwd=tmp_path).stdout


def test_a_resumed_run_takes_a_new_frame_interval(tmp_path):
    """Frames while it flies, asked for on resume only; fails if the appointments of before stand."""
    (tmp_path / "flying.toml").write_text(SCENE.replace('frame_interval = "25 ns"', ""), encoding="utf-8")
    f2s("run", "flying.toml", "--out", "run", "--set", "run.wall_time=1 ms", cwd=tmp_path, code=REQUEUE)
    f2s("resume", "run", "--set", "run.wall_time=1 h", "--set", "output.frame_interval=25 ns", cwd=tmp_path)
    # at 25 and 50 ns of each cycle of 60 ns, and at the ends of both
    assert len(list((tmp_path / "run" / layout.FRAMES).glob("*.vtkhdf"))) == 2 + 4


@pytest.mark.parametrize("damage", ["flipped byte", "cut off"])
def test_a_damaged_checkpoint_is_passed_over(stopped_twice, never_stopped, tmp_path, damage):
    """Fails if ``newest_valid_checkpoint`` trusts the newest file: return ``paths[-1]`` without verifying."""
    copy = tmp_path / "copy"
    shutil.copytree(stopped_twice, copy)
    older, newest = list_checkpoints(copy / layout.CHECKPOINTS)[-2:]
    content = bytearray(newest.read_bytes())
    if damage == "cut off":
        del content[len(content) // 2:]
    else:
        content[len(content) // 2] ^= 4
    newest.write_bytes(content)
    said = f2s("resume", copy, cwd=tmp_path).stdout
    assert f"resuming from {older}" in said
    assert any(newest.name in line for line in said.splitlines() if "resuming" not in line)
    assert runs.read_summary(copy)["status"] == "complete"
    # it does not count among those kept
    assert newest.with_name(newest.name + ".damaged").exists()
    assert f"note: {newest} is damaged" in said
    assert "identical in every saved bit" in f2s("compare", never_stopped, copy, "--exact", cwd=tmp_path).stdout


def test_resuming_a_finished_run_changes_nothing(never_stopped, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(never_stopped, copy)
    said = f2s("resume", copy, cwd=tmp_path).stdout
    assert "complete" in said
    cycles = [tuple(map(int, pair)) for pair in re.findall(r"cycle (\d+) of (\d+)", said)]
    assert all(number <= of for number, of in cycles), said
    assert runs.read_summary(copy)["status"] == "complete"
    assert runs.read_cycle_table(copy) == runs.read_cycle_table(never_stopped)
    assert "identical in every saved bit" in f2s("compare", never_stopped, copy, "--exact", cwd=tmp_path).stdout


def test_a_used_folder_is_refused(never_stopped):
    """Fails if ``prepare_run_folder`` takes a folder with checkpoints in it."""
    before = {path: path.stat().st_mtime_ns for path in never_stopped.rglob("*")}
    done = f2s("run", "impacts.toml", "--out", "whole", cwd=never_stopped.parent, code=2)
    assert len(done.stderr.splitlines()) == 1
    assert "f2s resume" in done.stderr
    assert before == {path: path.stat().st_mtime_ns for path in never_stopped.rglob("*")}


def test_a_folder_that_another_run_is_at_work_in_is_refused(stopped_twice, tmp_path):
    """Fails if ``tasks.resume`` does not take ``runs.hold``: two runs would write one folder."""
    copy = tmp_path / "copy"
    shutil.copytree(stopped_twice, copy)
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    with runs.hold(copy):
        done = f2s("resume", copy, cwd=tmp_path, ranks=2, code=2)
    assert done.stderr.count("another run is at work") == 1
    assert before == {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    with runs.hold(copy):  # nothing is left of the lock
        pass


def test_resume_refuses_what_would_change_the_result(never_stopped):
    done = f2s("resume", never_stopped, "--set", "domain.cell_size=3 um", cwd=never_stopped.parent, code=2)
    assert "domain.cell_size" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_folder_without_a_checkpoint_cannot_be_resumed(tmp_path):
    (tmp_path / "nothing").mkdir()
    done = f2s("resume", tmp_path / "nothing", cwd=tmp_path, code=2)
    assert len(done.stderr.splitlines()) == 1
    assert "nothing" in done.stderr
    assert not done.stdout


@pytest.mark.mpi
def test_what_is_no_folder_cannot_be_resumed(capsys, shared_path):
    """A mistyped name is wrong input; fails if it passes for a run whose checkpoints are lost (exit code 3)."""
    if mpi.is_root():
        (shared_path / "file").touch()
    mpi.barrier()
    for name, words in (("nothing", "no such folder"), ("file", "is a file, not the folder of a run")):
        assert main(["resume", str(shared_path / name)]) == 2
        out, err = capsys.readouterr()
        assert not out
        assert len(err.splitlines()) == int(mpi.is_root())
        assert not mpi.is_root() or err.startswith(f"{shared_path / name}: {words}")


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_resumed_run_cannot_begin_to_follow_the_origin(never_stopped, ranks):
    """Fails if the field that the checkpoint has not is missed only when it is read (exit code 3)."""
    done = f2s("resume", never_stopped, "--set", "output.origin=true", ranks=ranks, cwd=never_stopped.parent, code=2)
    said = [line for line in done.stderr.splitlines() if "output.origin" in line]
    assert len(said) == 1
    assert "leave it out" in said[0]
    assert "Traceback" not in done.stderr


def saved_by_an_older_version() -> dict:
    """Return the attributes of a checkpoint from before there was ``numerics.dust``."""
    text = dump_scene(parse_scene(SCENE, "test"))
    old = "\n".join(line for line in text.splitlines() if not line.startswith("dust = ")) + "\n"
    assert old != text
    return {"scene": old, "scene_hash": hashlib.sha256(old.encode("utf-8")).hexdigest()}


def test_a_checkpoint_from_before_a_setting_is_taken_and_says_so():
    """Fails if the hash is taken of the scene as this version would write it: it knows more settings."""
    scene, _, notes = tasks._saved_scene(saved_by_an_older_version(), "old.h5", [])
    assert scene == parse_scene(SCENE, "test")
    assert len(notes) == 1
    assert "dust = 1e-12" in notes[0]
    now = {"scene": dump_scene(scene), "scene_hash": scene_hash(scene)}
    assert tasks._saved_scene(now, "new.h5", ["run.wall_time=1 h"])[2] == []


def test_a_checkpoint_whose_scene_was_edited_is_refused():
    """Fails if the stored text is not compared with the stored hash."""
    edited = saved_by_an_older_version()
    edited["scene"] = edited["scene"].replace("615.0 m/s", "715.0 m/s").replace("615 m/s", "715 m/s")
    with pytest.raises(CheckpointError, match=r"old\.h5: its scene does not match its own hash"):
        tasks._saved_scene(edited, "old.h5", [])
    with pytest.raises(CheckpointError, match="holds no scene"):
        tasks._saved_scene({}, "old.h5", [])
