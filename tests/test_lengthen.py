"""More cycles onto a deposit where something has happened to its folder, and checkpoints that are kept for good."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
from test_damaged import SCENE

from f2s_hpc.cli.main import main
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints

FILES = SCENE.replace('spheres = [["14 um", "15 um", "11 um", "10 um"], ["25 um", "28 um", "37 um", "9 um"]]',
                      'files = ["a.csv", "b.csv"], shuffle = false')
FILES = FILES.replace('"72 um"', '"96 um"').replace('"56 um"', '"80 um"') + "output = { picture = false }\n"


@pytest.fixture
def folder(tmp_path) -> pathlib.Path:
    """Return a folder with a scene of two CSV files, of which one cycle has run in ``run``."""
    assert "a.csv" in FILES
    (tmp_path / "a.csv").write_text("x,y,z,r\n0.014,0.015,0.011,0.010\n", encoding="utf-8")
    (tmp_path / "b.csv").write_text("x,y,z,r\n0.022,0.025,0.035,0.009\n", encoding="utf-8")
    (tmp_path / "scene.toml").write_text(FILES, encoding="utf-8")
    assert main(["run", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "run"), "--set", "cycles.count=1"]) == 0
    return tmp_path


def ends(*folders: pathlib.Path) -> list[dict]:
    """Return the fields of the newest checkpoint of each run."""
    return [runs.open_checkpoint_serial(list_checkpoints(place / layout.CHECKPOINTS)[-1])[0] for place in folders]


@pytest.mark.parametrize("happened", ["gone", "edited"])
def test_more_cycles_need_the_copies_of_the_batches_only(folder, happened):
    """The files were deleted, or edited, after the run began. Fails when ``plan_of_cycles`` reads them again."""
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "whole")]) == 0
    copies = {path: path.read_bytes() for path in (folder / "run" / "batches").glob("*.csv")}
    if happened == "gone":
        (folder / "a.csv").unlink()
        (folder / "b.csv").unlink()
    else:
        (folder / "b.csv").write_text("x,y,z,r\n0.022,0.025,0.035,0.012\n", encoding="utf-8")
    assert main(["resume", str(folder / "run"), "--set", "cycles.count=2"]) == 0
    assert all(path.read_bytes() == held for path, held in copies.items())
    whole, lengthened = ends(folder / "whole", folder / "run")
    assert all(np.array_equal(values, lengthened[name]) for name, values in whole.items())
    assert main(["compare", "--exact", str(folder / "whole"), str(folder / "run")]) == 0


def test_a_run_without_its_scene_file_can_be_lengthened_and_resumed_again(folder, capsys):
    """Fails when the batches are written anew only if the folder's scene tells of another number of cycles."""
    (folder / "run" / layout.SCENE_FILE).unlink()
    assert main(["resume", str(folder / "run"), "--set", "cycles.count=2"]) == 0
    capsys.readouterr()
    assert main(["resume", str(folder / "run")]) == 0
    assert "all 2 cycles are done" in capsys.readouterr().out


def test_what_is_kept_for_good_stays_when_the_run_goes_on_otherwise(folder):
    """Fails when ``prune`` goes by the present ``archive_every`` only."""
    out = folder / "kept"
    settings = ["--set", "output.archive_every=1", "--set", "output.keep_checkpoints=1"]
    assert main(["run", str(folder / "scene.toml"), "--out", str(out), *settings]) == 0
    before = list_checkpoints(out / layout.CHECKPOINTS)
    assert len(before) == 2
    assert main(["resume", str(out), "--set", "output.archive_every=0", "--set", "cycles.count=3"]) == 0
    after = list_checkpoints(out / layout.CHECKPOINTS)
    assert len(after) == 3
    assert set(before) < set(after)


def test_check_tells_how_many_are_kept_for_good(folder, capsys):
    """Fails when ``describe`` counts the newest only, or an archive without checkpoints is taken."""
    asked = ["check", str(folder / "scene.toml"), "--set", "output.archive_every=1", "--set", "cycles.count=1000"]
    assert main(asked) == 0
    assert "the last 2 kept and 1,000 for good" in capsys.readouterr().out
    assert main([*asked, "--set", "output.checkpoints=false"]) == 2
    assert "output.archive_every has no effect" in capsys.readouterr().err
