"""The command ``f2s``: what it prints, what it refuses and how, and what a run leaves behind."""

from __future__ import annotations

import json
import math
import os
import pathlib
import re
import sys
import tomllib

import numpy as np
import pytest
from conftest import f2s, launch

from f2s_hpc import mpi
from f2s_hpc.cli import tasks
from f2s_hpc.cli.main import _parser, main
from f2s_hpc.cli.notes import crowded_nodes, scene_notes
from f2s_hpc.config import load_scene, scene_hash, scene_names
from f2s_hpc.particles.batch import read_csv
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver.ledger import ENERGY_TERMS

SCENE = """
title = "Two spheres"

[domain]
size = ["36 um", "40 um", "72 um"]
cell_size = "4 um"
substrate_height = "16 um"
particle_layer_height = "56 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"

[batches]
spheres = [["14 um", "15 um", "11 um", "10 um"], ["25 um", "28 um", "37 um", "9 um"]]

[cycles]
count = 1
duration = "15 ns"
"""

SUMMARY_KEYS = (
    "status", "ranks", "cells", "steps", "time_s", "wall_s", "active_cell_steps", "active_cell_steps_per_s",
    "peak_memory_bytes", "particles", "painted_volume_m3", "mass_drift_relative", "mass_left_kg", "mass_capped_kg",
    "dense_height_m", "height_mean_m", "height_p95_m", "height_max_m", "speed_max_heavy_m_s", "peeq_p50",
    "peeq_p95", "peeq_max", "temperature_p50_degC", "temperature_p95_degC", "energy", "numerical_loss_fraction",
    "numerical_loss_unheated_fraction",
    "startup_s", "startup_memory_bytes",
)


@pytest.fixture
def workplace(shared_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """Make a folder shared by all ranks, with a scene in it, the current one."""
    if mpi.is_root():
        (shared_path / "two.toml").write_text(SCENE, encoding="utf-8")
        (shared_path / "bad.csv").write_text("x,y,z,r\n0.01,0.01,0.02,0.005\n0.02,oops,0.02,0.005\n", encoding="ascii")
        (shared_path / "outside.csv").write_text("x,y,z,r\n0.01,0.01,0.9,0.005\n", encoding="ascii")
    mpi.barrier()
    monkeypatch.chdir(shared_path)
    return shared_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[pathlib.Path, str]:
    """Return the folder of a small run on 2 ranks, started as ``python -m f2s_hpc``, and what it printed."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "two.toml").write_text(SCENE, encoding="utf-8")
    done = launch([sys.executable, "-m", "f2s_hpc", "run", "two.toml", "--set", "cycles.duration=20 ns"], 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "runs" / "two", done.stdout


def snapshot(folder: pathlib.Path) -> list[tuple[str, int]]:
    return sorted((str(path.relative_to(folder)), path.stat().st_mtime_ns) for path in folder.rglob("*"))


# --- scenes and check -----------------------------------------------------------------------------------


def test_scenes_lists_all_built_in_scenes(capsys):
    assert main(["scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(scene_names())
    assert {"splat", "section4", "section4-standard", "quickstart"} <= set(scene_names())
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", ["splat", "section4", "section4-standard", "quickstart", "track-120", "multitrack",
                                  "wide-100k"])
def test_a_printed_scene_loads_as_the_scene(capsys, tmp_path, name):
    assert main(["scenes", name]) == 0
    path = tmp_path / "edited.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert scene_hash(load_scene(path)) == scene_hash(load_scene(name))


def test_an_unknown_scene_is_refused_with_a_suggestion(capsys):
    assert main(["scenes", "quikstart"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.splitlines() == ['no built-in scene "quikstart"; did you mean "quickstart"?']


@pytest.mark.mpi
def test_check_prints_the_scene_and_what_it_will_take(capsys, workplace):
    before = snapshot(workplace)
    assert main(["check", "two.toml", "--set", "cycles.duration=40 ns"]) == 0
    out, err = capsys.readouterr()
    assert not err
    assert mpi.is_root() or not out
    if mpi.is_root():
        facts = dict(re.findall(r"^# ([a-z ]+?)  +(.+)$", out, re.MULTILINE))
        assert facts["cells"] == "9 x 10 x 18 = 1,620 of 4 um"
        assert facts["ranks"] == str(mpi.size())
        spread = re.search(r"\(([\d,]+) to ([\d,]+)\)", facts["cells per rank"])
        counts = [int(n.replace(",", "")) for n in spread.groups()]
        assert counts[0] <= 1620 / mpi.size() <= counts[1]
        sound = float(re.search(r"(\d+) m/s", facts["time step"])[1])
        number, unit = re.search(r"about ([\d.]+) (ps|ns)", facts["time step"]).groups()
        step = float(number) * {"ps": 1e-12, "ns": 1e-9}[unit]
        assert math.isclose(step, 0.7 * 4e-6 / (1.5 * sound), rel_tol=0.01)
        assert abs(int(re.search(r"\d+", facts["steps"])[0]) - 40e-9 / step) < 2
        for name in ("memory", "frames", "checkpoints"):
            assert re.search(r"\d (KiB|MiB|kB|MB|B)\b", facts[name]), facts[name]
        assert "f2s plan" in facts["run time"]
        assert facts["resolution"].startswith("4.75 cells across the median particle of 19 um")
        scene = tomllib.loads(out)  # (its notes are remarks too, so that it may be kept as a scene)
        assert "# note: cycles.duration" in out
        assert scene["domain"]["cell_size"] == "4 um"
        assert scene["numerics"]["courant"] == 0.7
    mpi.barrier()
    assert snapshot(workplace) == before


def test_more_ranks_than_cores_are_told(capsys, monkeypatch, tmp_path):
    """Fails if ranks are counted over all nodes, or ``_finish`` does not ask."""
    assert crowded_nodes([("one", 2), ("two", 2), ("one", 2), ("two", 2)]) == []
    assert crowded_nodes([("one", 4), ("two", 2), ("two", 2), ("two", 2)])[0].startswith("3 ranks share 2 cores of two")
    monkeypatch.setattr(tasks, "crowded_nodes", lambda ranks: [f"{len(ranks)} asked"])
    assert main(["run", "splat-quarter", "--out", str(tmp_path / "r"), "--set", "cycles.duration=1 ns", "--set",
                 "domain.cell_size=6 um", "--set", "output.picture=false"]) == 0
    assert f"note: {mpi.size()} asked" in capsys.readouterr().out


@pytest.mark.mpi
def test_coarse_cells_and_a_box_of_another_size_are_told(capsys, workplace):
    """The spheres have 10 and 9 um, their median 19 um. Fails when ``check`` or ``run`` leaves ``scene_notes`` out."""
    text = (workplace / "two.toml").read_text(encoding="utf-8")
    if mpi.is_root():
        coarse = text.replace('cell_size = "4 um"', 'cell_size = "10 um"').replace('"56 um"', '"54 um"')
        (workplace / "coarse.toml").write_text(coarse, encoding="utf-8")
    mpi.barrier()
    if mpi.size() == 1:  # (the box is too small for more)
        assert main(["check", "coarse.toml"]) == 0
        out = capsys.readouterr().out
        assert "note: domain.size along x: 36 um are 3.6 cells of 10 um; the box has 4, so it is 40 um there" in out
        assert "along y" not in out
        assert "note: domain.cell_size: the median particle (19 um) has 1.9 cells to its diameter" in out
        assert main(["run", "coarse.toml", "--out", str(workplace / "coarse")]) == 0
        out = capsys.readouterr().out
        assert out.count("note: domain.size along x") == out.count("note: domain.cell_size") == 1
        assert main(["check", "two.toml"]) == 0
        assert "note: domain" not in capsys.readouterr().out


# --- bad input ------------------------------------------------------------------------------------------

BAD = {
    "unknown key": (["--set", "domain.cel_size=3 um"], ["domain.cel_size", 'did you mean "domain.cell_size"']),
    "wrong unit": (["--set", "particles.speed=615 um"], ["particles.speed", "615 um"]),
    "no unit": (["--set", "domain.cell_size=3"], ["domain.cell_size", "um"]),
    "impossible box": (["--set", "domain.substrate_height=1 mm"], ["domain.substrate_height", "lower than the box"]),
    "layer too high": (["--set", "domain.particle_layer_height=70 um"], ["domain.particle_layer_height", "56 um"]),
    "missing file": (["--set", 'batches.files=["none.csv"]'], ["batches.files", "none.csv"]),
    "bad row": (["--set", 'batches.files=["bad.csv"]'], ["bad.csv", "row 2", "oops"]),
    "sphere outside": (["--set", 'batches.files=["outside.csv"]'], ["outside.csv", "row 1", "0.9"]),
    "no use": (["--set", "batches.count=2"], ["--set batches.count", "has no effect where batches.spheres are given"]),
    "undone": (["--set", 'batches.files=["a"]', "--set", "batches={count=1}"], ["--set batches: ", "put it first"]),
    "no equals sign": (["--set", "domain.cell_size"], ["--set domain.cell_size", "key=value"]),
}


@pytest.mark.mpi
@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("wrong", list(BAD))
def test_bad_input_is_one_line_and_nothing_is_written(capsys, workplace, command, wrong):
    """The same exit code on every rank, one line from rank 0.

    Fails if an input error passes ``mpi.run_together`` on rank 0 only (the others would wait for ever), or if the
    folder is made before the scene is checked (``cli/tasks.py:run``).
    """
    extra, words = BAD[wrong]
    before = snapshot(workplace)
    mpi.barrier()
    assert main([command, "two.toml", *extra]) == 2
    out, err = capsys.readouterr()
    assert not out
    if mpi.is_root():
        assert len(err.splitlines()) == 1
        for word in words:
            assert word in err
    else:
        assert not err
    mpi.barrier()
    assert snapshot(workplace) == before


@pytest.mark.mpi
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_box_too_small_for_the_ranks_is_refused(capsys, workplace, command):
    """Fails if ``decomposition_fits`` is left out of ``tasks.run``: the folder would be there."""
    size = 'domain.size=["20 um","20 um","20 um"]'
    arguments = ["--set", size, "--set", "domain.substrate_height=4 um", "--set", "domain.particle_layer_height=12 um",
                 "--set", 'batches.spheres=[["10 um","10 um","6 um","5 um"]]', "--set", "cycles.duration=1 ns"]
    before = snapshot(workplace)
    if mpi.size() == 1:
        pytest.skip("one rank takes a box of any size")
    mpi.barrier()
    assert main([command, "two.toml", *arguments]) == 2
    out, err = capsys.readouterr()
    assert not out
    if mpi.is_root():
        assert len(err.splitlines()) == 1
        assert "5 x 5 x 5" in err
        assert "fewer ranks or smaller cells" in err
    mpi.barrier()
    assert snapshot(workplace) == before


def test_mpirun_gets_the_exit_code_of_bad_input(tmp_path):
    (tmp_path / "two.toml").write_text(SCENE.replace("cell_size", "cellsize"), encoding="utf-8")
    done = launch([sys.executable, "-m", "f2s_hpc", "run", "two.toml"], 3, tmp_path, timeout=120)
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if "two.toml" in line]
    assert len(said) == 1
    assert "cellsize" in said[0]
    assert 'did you mean "domain.cell_size"' in said[0]
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path) == ["two.toml"]


@pytest.mark.parametrize(("changes", "keys"), [
    ([], []), (["cycles.count=40"], ["domain.size"]), (["cycles.last_duration=60 ns"], ["cycles.last_duration"]),
    (["particles.speed=300 m/s"], ["cycles.duration", "cycles.last_duration"]),
    (["particles.speed=300 m/s", "cycles.count=40"], ["domain.size", "cycles.duration"])])
def test_a_low_box_and_short_cycles_are_told_and_what_is_enough(changes, keys):
    """Each note in turn is followed until none is left.

    Fails if ``scene_notes`` leaves one out or tells it of a scene that is right, or if ``_late`` takes another height
    than that of the layer's bottom, or of the deposit at the end.
    """
    changes, told = list(changes), []
    while notes := scene_notes(scene := load_scene("quickstart", changes), make_batches(scene)):
        key, text = notes[0].split(": ", 1)
        told.append(key)
        enough = re.search(r"; ([\d.]+ [a-z]+) let all|make the box ([\d.]+ [a-z]+) high", text)
        size = [f"{length} m" for length in scene.domain.size[:2]]
        changes.append(f"{key}={json.dumps([*size, enough[2]]) if enough[2] else enough[1]}")
        assert len(told) <= len(keys), notes
    assert told == keys


def test_what_leans_out_of_the_box_is_told_before_and_after(tmp_path):
    """A sphere that flies through a side is named by check's note and by the line of the cycle.

    Fails when ``_crossing`` leaves out ``velocity * time``, or ``_finish_cycle`` does not compare ``mass_left_kg``.
    """
    changes = ["domain.cell_size=8 um", 'domain.size=["96 um", "96 um", "88 um"]', "particles.direction=[1, 0, -0.1]",
               "cycles.duration=150 ns"]

    def told(*more: str) -> list[str]:
        scene = load_scene("splat", [*changes, *more])
        return scene_notes(scene, make_batches(scene))

    (thrown,) = [note for note in told() if "thrown back" in note]
    assert "84 degrees" in thrown
    assert "100 % of the powder" in thrown
    out = "domain.faces.x_high=free"
    (lost,) = [note for note in told(out) if "x_high" in note]
    assert lost.startswith('100 % of the powder leave the box through domain.faces.x_high = "free"')
    assert not [note for note in told(out, "particles.direction=[0.1, 0, -1]") if "x_high" in note]
    settings = [word for change in [*changes, out] for word in ("--set", change)]
    done = f2s("run", "splat", "--out", "out", *settings, cwd=tmp_path)
    found = re.search(r"cycle 1/1 done: .*left the box: ([\d.]+) % of the powder's mass", done.stdout + done.stderr)
    assert 95.0 < float(found[1]) <= 100.1


@pytest.mark.parametrize(("radius", "cell", "instead"), [
    ("0.006", "2 um", ["speed_limit_factor = 1.2", "speed_cap_factor = 2"]), ("0.03", "6 um", ["steps_per_remap = 8"]),
    ("0.0149", "6 um", [])])
def test_numerics_for_another_powder_are_told(tmp_path, radius, cell, instead):
    """By the median of the files, and what to write. Fails when ``_other_powder`` takes the scene's median for both."""
    (tmp_path / "a.csv").write_text(f"x,y,z,r\n0.05,0.05,0.05,{radius}\n")
    changes = [f"domain.cell_size={cell}", "cycles.count=1", f"batches.files=['{tmp_path}/a.csv']"]

    def told() -> list[str]:
        scene = load_scene("quickstart", changes)
        return [note for note in scene_notes(scene, make_batches(scene)) if note.startswith("numerics: ")]

    assert [note.rpartition("write ")[2].split(", ") for note in told()] == ([instead] if instead else [])
    changes += [f"numerics.{pair}" for pair in instead]
    assert not told()


@pytest.mark.mpi
@pytest.mark.parametrize(("arguments", "word"), [
    (["runn", "quickstart"], "runn"), (["run"], "SCENE"), (["run", "splat", "--oout", "x"], "--oout"),
    (["run", "splat", "runs/x"], "f2s run: unrecognized arguments: runs/x; 'f2s run --help'"),
    (["check", "splat", "--set", "domain.cell_size", "=", "6 um"], "KEY=VALUE without spaces around ="),
    (["analyse", "x", "--cycle", "one"], "'one'")])
def test_wrong_arguments_are_one_line_from_rank_0(capsys, arguments, word):
    """Fails if every rank prints, if the usage comes along, or if ``parse_known_args`` leaves it to f2s."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == int(mpi.is_root())
    assert not mpi.is_root() or word in err


def test_the_help_of_each_command_explains_all_it_takes():
    """Fails if an argument of any command is added, or left, without ``help``: nothing but its name is told then."""
    (choice,) = _parser()._subparsers._group_actions
    assert len(choice.choices) > 10
    unexplained = {f"{name} {action.metavar or action.dest}" for name, parser in choice.choices.items()
                   for action in parser._actions if not action.help}
    assert unexplained == set()


def test_mpirun_gets_the_exit_code_of_wrong_arguments(tmp_path):
    """Fails if a rank ends before rank 0 has printed, or prints itself."""
    done = launch([sys.executable, "-m", "f2s_hpc", "runn", "quickstart"], 3, tmp_path, timeout=120)
    assert done.returncode == 2
    assert len([line for line in done.stderr.splitlines() if "runn" in line]) == 1
    assert "usage" not in done.stderr


# --- particles ------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_particles_writes_the_batches_that_a_run_would_use(capsys, workplace):
    """Fails if ``write_csv`` rounds, or if ``tasks.write_particles`` draws from another seed."""
    assert main(["particles", "quickstart", "--set", "batches.seed=5", "--out", "out"]) == 0
    out, err = capsys.readouterr()
    assert not err
    plan = make_batches(load_scene("quickstart", ["batches.seed=5"]))
    mpi.barrier()
    files = sorted((workplace / "out").iterdir())
    assert [path.name for path in files] == ["batch-01.csv", "batch-02.csv", "batch-03.csv", "batches.png"]
    for path, batch in zip(files, plan.batches):
        found = read_csv(path)
        assert all(np.array_equal(getattr(found, n), getattr(batch, n)) for n in "xyzr")
    if mpi.is_root():
        assert "order of batches over the cycles: " + " ".join(str(b + 1) for b in plan.order) in out
    mpi.barrier()
    assert main(["particles", "quickstart", "--out", "out"]) == 2
    assert (not mpi.is_root()) or "not empty" in capsys.readouterr().err


@pytest.mark.mpi
def test_particles_into_a_file_is_one_line_and_leaves_it(capsys, workplace):
    """Fails if the file is looked into as a folder (``NotADirectoryError``)."""
    before = snapshot(workplace)
    mpi.barrier()
    assert main(["particles", "splat", "--out", "bad.csv"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.splitlines() == (["bad.csv: is a file; name a new folder with --out"] if mpi.is_root() else [])
    assert main(["particles", "splat", "--out", "bad.csv/new"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == int(mpi.is_root())
    assert snapshot(workplace) == before


@pytest.mark.mpi
def test_particles_that_cannot_all_be_written_leave_nothing(capsys, workplace, monkeypatch):
    """Fails if the batches written before a full disk stay, or if the other ranks do not hear of it."""
    plain = tasks.write_csv

    def full(path, batch) -> None:
        if path.name == "batch-02.csv":
            raise OSError(28, "No space left on device")
        plain(path, batch)

    monkeypatch.setattr(tasks, "write_csv", full)
    before = snapshot(workplace)
    mpi.barrier()
    assert main(["particles", "quickstart", "--out", "out"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == int(mpi.is_root())
    mpi.barrier()
    assert snapshot(workplace) == before


# --- a run ----------------------------------------------------------------------------------------------


def test_a_run_leaves_a_summary_with_every_key(finished):
    summary = json.loads((finished[0] / "summary.json").read_text(encoding="utf-8"))
    assert not [key for key in SUMMARY_KEYS if key not in summary]
    assert summary["status"] == "complete"
    assert (summary["ranks"], summary["cells"], summary["particles"]) == (2, 1620, 2)
    assert math.isclose(summary["time_s"], 20e-9, rel_tol=1e-12)
    assert set(summary["energy"]) == set(ENERGY_TERMS)
    volume = 4.0 / 3.0 * math.pi * (10e-6**3 + 9e-6**3)
    assert math.isclose(summary["painted_volume_m3"], volume, rel_tol=1e-12)
    assert math.isclose(summary["dense_height_m"], volume / (36e-6 * 40e-6), rel_tol=1e-6)
    assert 0.3 < summary["peeq_max"] < 8.0
    assert 500.0 < summary["speed_max_heavy_m_s"] < 1.3 * 615.0
    assert summary["peak_memory_bytes"] > 2e7
    rate = summary["active_cell_steps"] / summary["wall_s"]
    assert math.isclose(summary["active_cell_steps_per_s"], rate, rel_tol=0.01)


def test_a_run_names_only_what_it_has_written(finished, tmp_path):
    """Fails if the last line promises a picture that the scene did not ask for."""
    def named(text: str) -> list[str]:
        return re.findall(r"\S+\.(?:json|csv|vtkhdf|png)", text.splitlines()[-1])

    folder, said = finished
    assert {pathlib.Path(name).name for name in named(said)} == {"summary.json", "summary.csv", "deposit.vtkhdf",
                                                                "deposit.png"}
    root = folder.parents[1]
    assert all((root / name).is_file() for name in named(said))
    done = launch([sys.executable, "-m", "f2s_hpc", "run", str(root / "two.toml"), "--out", "plain", "--set",
                   "output.picture=false", "--set", "output.frames=none", "--set", "cycles.duration=1 ns"], 1, tmp_path)
    assert done.returncode == 0, done.stderr
    assert not [name for name in named(done.stdout) if not (tmp_path / name).is_file()], done.stdout


def test_the_folder_of_a_run_holds_its_scene_and_its_batch(finished):
    folder, _ = finished
    scene = load_scene(folder / "scene.toml")
    assert scene_hash(scene) == scene_hash(load_scene(folder.parents[1] / "two.toml", ["cycles.duration=20 ns"]))
    batch = read_csv(folder / "batches" / "batch-001.csv")
    assert batch.count == 2
    assert np.allclose(batch.r, [10e-6, 9e-6], rtol=1e-14, atol=0.0)
    assert (folder / "deposit.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_inspect_prints_the_cycle_table(capsys, finished):
    assert main(["inspect", str(finished[0])]) == 0
    out, err = capsys.readouterr()
    assert not err
    lines = out.splitlines()
    assert lines[0] == "Two spheres: complete, 2 particles, 2 ranks"
    assert any("dense" in line and "PEEQ" not in line for line in lines)
    rows = [line.split() for line in lines if re.match(r"\s*1\s", line)]
    summary = json.loads((finished[0] / "summary.json").read_text(encoding="utf-8"))
    assert len(rows) == 1
    assert rows[0][1:3] == ["0.020", str(summary["steps"])]
    assert f"{1e6 * summary['dense_height_m']:.1f}" in rows[0]
    assert lines[-1].startswith("dense: height of all mass")


def test_one_of_a_kind_is_no_plural(capsys, tmp_path):
    """Fails when ``count_text`` always adds its "s"."""
    (tmp_path / "summary.json").write_text('{"scene": "x", "status": "complete", "particles": 1, "ranks": 1}')
    (tmp_path / "summary.csv").write_text("cycle,particles\n1,1\n")
    assert main(["inspect", str(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith("x: complete, 1 particle, 1 rank\n")


def test_inspect_and_compare_refuse_what_is_no_run(capsys, tmp_path):
    assert main(["inspect", str(tmp_path)]) == 2
    assert "summary.json" in capsys.readouterr().err
    assert main(["compare", str(tmp_path), str(tmp_path / "none")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(("text", "words"), [
    ('{"scene": "x"}', "lacks status, particles, ranks"), ("[]", "not a JSON object"), ("{", "not JSON")])
def test_inspect_refuses_a_foreign_summary(capsys, tmp_path, text, words):
    """Fails with a ``KeyError`` if the keys are taken without looking whether they are there."""
    (tmp_path / "summary.json").write_text(text, encoding="utf-8")
    assert main(["inspect", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == 1
    assert f"summary.json: {words}" in err


def test_inspect_refuses_a_table_that_is_no_text(capsys, tmp_path):
    """Fails with a traceback if only a missing table is thought of."""
    summary = {"scene": "x", "status": "complete", "particles": 1, "ranks": 1}
    (tmp_path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (tmp_path / "summary.csv").write_bytes(b"\xff\xfe\n1")
    assert main(["inspect", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert "summary.csv: not a readable table" in err


def test_a_run_under_mpirun_prints_plain_lines_once(finished):
    """Every line comes from one rank, and there is no bar where there is no terminal."""
    said = finished[1]
    assert "\r" not in said
    assert "\033" not in said
    assert len(re.findall(r"cycle 1/1 done", said)) == 1
    assert "on 2 ranks" in said
