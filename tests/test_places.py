"""Files and folders that a user names and that the system refuses: one line that names the place, on all ranks."""

from __future__ import annotations

import json
import os
import pathlib

import pytest
from conftest import F2S, launch

from f2s_hpc import mpi, places
from f2s_hpc.cli import main as cli
from f2s_hpc.cli.main import main
from f2s_hpc.errors import InputError

LONG = "n" * 300
"""No file system has a name this long: refused as a folder of another user is, even to the superuser."""


def one_line(capsys) -> str:
    """Return the only line that was printed: on standard error, by rank 0."""
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == (1 if mpi.is_root() else 0), err
    return mpi.broadcast(err)


@pytest.mark.mpi
@pytest.mark.parametrize(("arguments", "named"), [
    (["check", LONG], LONG), (["check", f"{LONG}.toml"], LONG), (["check", "~nosuchuser/scene.toml"], "~nosuchuser"),
    (["check", "quickstart", "--set", f'batches.files=["{LONG}"]'], "--set batches.files"),
    (["check", "quickstart", "--set", 'batches.files=["~nosuchuser/a.csv"]'], "--set batches.files"),
    (["check", "quickstart", "--set", f"particles.stream={LONG}"], LONG),
    (["check", "quickstart", "--set", "particles.stream=~nosuchuser/a.json"], "~nosuchuser"),
    (["run", "quickstart", "--out", LONG], LONG), (["resume", LONG], LONG), (["inspect", LONG], LONG)])
def test_a_place_that_cannot_be_reached_is_one_line(capsys, arguments, named):
    """Fails with a traceback if ``places.kind`` asks ``Path.is_file``, or ``places.expanded`` lets RuntimeError out."""
    assert main(arguments) == 2
    assert named in one_line(capsys)


@pytest.mark.parametrize("arguments", [["analyse"], ["report"], ["compare", "--exact", "."], ["compare", "."],
                                       ["plan", "quickstart", "--rates"]])
def test_the_commands_of_one_rank_name_the_place_too(capsys, arguments):
    """Fails with a traceback if one of them looks for its folder or file without ``places``."""
    assert main([*arguments, LONG]) == 2
    assert LONG in one_line(capsys) or arguments[0] == "compare"


@pytest.mark.parametrize("part", ["frames", "checkpoints"])
@pytest.mark.parametrize("command", [["analyse"], ["report"], ["compare", "--exact", "run"]])
def test_a_part_of_a_run_that_cannot_be_reached_is_named(capsys, tmp_path, monkeypatch, part, command):
    """Fails with a traceback if ``places.entries`` asks ``Path.is_dir``."""
    monkeypatch.chdir(tmp_path)
    pathlib.Path("run").mkdir()
    os.symlink(LONG, f"run/{part}")
    assert main([*command, "run"]) == 2
    assert f"run/{part}: cannot be reached" in one_line(capsys)


@pytest.mark.mpi
@pytest.mark.parametrize("error", [OSError(28, "No space left on device", "here.json"), MemoryError("9 TiB")])
def test_what_nobody_thought_of_is_one_line_on_all_ranks(capsys, monkeypatch, error):
    """Fails with a traceback, and with other ranks waiting, if ``mpi.run_together`` only knows ``F2SError``."""
    def work() -> None:
        raise error

    monkeypatch.setitem(cli._COMMANDS, "inspect", lambda parsed: mpi.run_together(work))
    assert main(["inspect", "x"]) == 2
    assert ("here.json: No space left" if isinstance(error, OSError) else "9 TiB") in one_line(capsys)


@pytest.mark.parametrize("arguments", [
    ["analyse", "run", "--json", "none/x"], ["analyse", "run", "--json", "run"], ["analyse", "run", "--out", "file"],
    ["analyse", "run", "--out", "file/below"], ["report", "run", "--out", "none/x"], ["report", "run", "--out", "run"],
    ["stream", "none.csv", "--json", "none/x"], ["stream", "none.csv", "--out", "file"], ["feed", "--json", "none/x"],
    ["plan", "quickstart", "--json", "none/x"], ["plan", "quickstart", "--json", "run"]])
def test_the_place_of_results_is_tested_before_the_work(capsys, tmp_path, monkeypatch, arguments):
    """Fails if the place is tested only after measuring: the folder holds no run, and that would be said."""
    monkeypatch.chdir(tmp_path)
    pathlib.Path("run").mkdir()
    pathlib.Path("file").write_text("kept", encoding="utf-8")
    assert main(arguments) == 2
    assert f"{arguments[-1]}: " in one_line(capsys)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "run"]


@pytest.mark.mpi
@pytest.mark.parametrize("arguments", [["--levers"], ["--extreme"], ["simple-shear", "--out", "."]])
def test_verify_tests_the_place_of_its_rows_first(capsys, shared_path, monkeypatch, arguments):
    """Fails after the work, with other ranks waiting, if only rank 0 learns that its rows cannot be written."""
    monkeypatch.chdir(shared_path)
    assert main(["verify", *arguments, "--json", str(shared_path)]) == 2
    assert f"{shared_path}: is a folder" in one_line(capsys)


def test_a_text_that_cannot_be_written_leaves_the_older_one(tmp_path, monkeypatch):
    """Fails with a file cut short, or one more beside it, if ``write_text`` writes under the real name."""
    path, link = tmp_path / "numbers.json", tmp_path / "link.json"
    places.write_text(path, "old")
    link.symlink_to(path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(InputError, match=r"numbers\.json: cannot be written \(No space left"):
            places.write_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old"
    places.write_text(link, "new")
    assert link.is_symlink()
    assert path.read_text(encoding="utf-8") == "new"
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(InputError, match=r"/dev/full: cannot be written \(No space left"):
        places.write_text("/dev/full", "new")


@pytest.mark.mpi
def test_scenes_speaks_once_and_compare_works_alone(capsys):
    """Fails if ``f2s scenes`` prints, or ``f2s compare`` measures, on every rank."""
    assert main(["scenes"]) == 0
    assert capsys.readouterr().out.count("quickstart") == (1 if mpi.is_root() else 0)
    assert main(["compare", "none", "none"]) == 2
    assert ("works alone" in one_line(capsys)) == (mpi.size() > 1)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_without_the_letters_gets_question_marks(run_f2s, tmp_path, encoding):
    """Fails with a UnicodeEncodeError if ``entry`` leaves the streams as Python opened them."""
    summary = {"scene": "copper → steel", "status": "complete", "particles": 1, "ranks": 1}
    (tmp_path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    done = run_f2s(["inspect", tmp_path], environment={"PYTHONIOENCODING": encoding})
    assert (done.returncode, done.stderr) == (0, "")
    assert "copper ? steel" in done.stdout


def test_a_reader_that_has_enough_ends_the_command_quietly(tmp_path):
    """Fails with a traceback if the broken pipe of ``f2s ... | head`` is an error like others."""
    done = launch(["bash", "-c", f'{" ".join(F2S)} stream synthetic | true; exit "${{PIPESTATUS[0]}}"'], cwd=tmp_path)
    assert (done.returncode, done.stderr) == (141, "")
