"""Run folders with damaged or unfit files: passed over with the reason, or refused in one line that names the file."""

from __future__ import annotations

import csv
import json
import pathlib
import shutil

import pytest

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.errors import CheckpointError
from f2s_hpc.io import layout
from f2s_hpc.io.checkpoint import list_checkpoints, newest_valid_checkpoint, verify_checkpoint

SCENE = """
title = "Two spheres"
domain = { size = ["36 um", "40 um", "72 um"], cell_size = "4 um", substrate_height = "16 um", \
particle_layer_height = "56 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC" }
batches = { spheres = [["14 um", "15 um", "11 um", "10 um"], ["25 um", "28 um", "37 um", "9 um"]] }
cycles = { count = 2, duration = "15 ns" }
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> pathlib.Path:
    """Return the folder of a run of two cycles, shared by all ranks: two checkpoints and two frames."""
    folder = mpi.broadcast(tmp_path_factory.mktemp("damaged"))
    if mpi.is_root():
        (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    mpi.barrier()
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


@pytest.fixture
def copy(finished, shared_path) -> pathlib.Path:
    """Return a copy of the run to damage, shared by all ranks."""
    if mpi.is_root():
        shutil.copytree(finished, shared_path / "copy")
    mpi.barrier()
    return shared_path / "copy"


def edit(path: pathlib.Path, **changes: object) -> None:
    """Change entries of a JSON file, on rank 0."""
    if mpi.is_root():
        path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")
    mpi.barrier()


@pytest.mark.mpi
@pytest.mark.parametrize("left", [0, 3])
def test_a_manifest_without_all_fields_is_no_proof(copy, left):
    """Fails if a checkpoint counts as whole when all fields that its manifest names do: resume then ends without them.

    One line makes it fail: leave out the test of ``read_manifest`` (none) or of ``_file_checksums`` (some).
    """
    older, newest = list_checkpoints(copy / layout.CHECKPOINTS)
    fields = json.loads(newest.with_suffix(".json").read_text(encoding="utf-8"))["fields"]
    mpi.barrier()
    edit(newest.with_suffix(".json"), fields=dict(list(fields.items())[:left]))
    with pytest.raises(CheckpointError, match="damaged"):
        verify_checkpoint(newest)
    found, skipped = newest_valid_checkpoint(copy / layout.CHECKPOINTS)
    assert found == older
    assert len(skipped) == 1


def test_a_damaged_checkpoint_is_told_of_where_its_cycle_is_measured(copy, capsys):
    """Fails if ``load_deposit`` drops the reasons: the numbers then are those of a frame, or of an older cycle."""
    newest = list_checkpoints(copy / layout.CHECKPOINTS)[-1]
    edit(newest.with_suffix(".json"), fields={})
    for cycle, told in (([], True), (["--cycle", "2"], True), (["--cycle", "1"], False)):
        assert main(["analyse", str(copy), "--cutoff", "16 um", "--no-handover", *cycle]) == 0
        assert (f"note: skipped: {newest.with_suffix('.json')}: damaged" in capsys.readouterr().out) == told


def test_frames_that_cannot_be_measured_say_why(copy, capsys):
    """Fails if all that is said is that there is no frame."""
    shutil.rmtree(copy / layout.CHECKPOINTS)
    for number in range(2):
        (copy / layout.FRAMES / layout.frame_name(number)).write_bytes(b"no frame")
    assert main(["analyse", str(copy)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{layout.frame_name(1)}: not a readable frame" in line
    assert line.endswith("(and 1 more)")


def test_frames_with_other_fields_say_which_are_needed(tmp_path, capsys):
    """Fails if a frame that lacks fields is passed over without a word."""
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    run = tmp_path / "run"
    assert main(["run", str(tmp_path / "scene.toml"), "--out", str(run), "--set", 'output.fields=["mass"]']) == 0
    shutil.rmtree(run / layout.CHECKPOINTS)
    capsys.readouterr()
    assert main(["analyse", str(run)]) == 2
    assert f"{layout.frame_name(1)}: lacks volume_fraction, peeq" in capsys.readouterr().err


@pytest.mark.parametrize("ranks", ["two", {}, [1], None, 10**400])
def test_the_report_leaves_out_what_is_no_number(copy, capsys, ranks):
    """Fails with a traceback if an entry of the summary or of the table goes to ``float`` unseen."""
    edit(copy / layout.SUMMARY_JSON, ranks=ranks)
    with (copy / layout.SUMMARY_CSV).open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with (copy / layout.SUMMARY_CSV).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(row | {"steps": "many", "energy_kinetic_J": "some"} for row in rows)
    assert main(["report", str(copy), "--cutoff", "16 um", "--no-handover"]) == 0
    assert not capsys.readouterr().err


def test_inspect_names_the_file_of_a_wrong_table(copy, capsys):
    """Fails if only row and column are named."""
    table = (copy / layout.SUMMARY_CSV).read_text(encoding="utf-8").splitlines()
    (copy / layout.SUMMARY_CSV).write_text("\n".join([table[0], "x" + table[1]]) + "\n", encoding="utf-8")
    assert main(["inspect", str(copy)]) == 2
    assert capsys.readouterr().err.startswith(f"{copy / layout.SUMMARY_CSV}: cycle table, row 1, cycle: ")


@pytest.mark.mpi
@pytest.mark.parametrize(("override", "code", "said"), [
    ('output={frames="none"}', 0, ""), ("run = {}", 0, ""), ("output=5", 2, "output = 5: must be a section"),
    ("outputs.frames=none", 2, "may change only"), ("=5", 2, "may change only")])
def test_a_whole_section_may_be_replaced_on_the_way(copy, capsys, override, code, said):
    """Fails if the name of the section is taken with what stands behind its "="."""
    assert main(["resume", str(copy), "--set", override]) == code
    assert not mpi.is_root() or said in capsys.readouterr().err
