"""A checkpoint and its manifest belong together: what was copied, renamed, edited or half made is refused."""

from __future__ import annotations

import json
import pathlib
import shutil

import h5py
import numpy as np
import pytest

from f2s_hpc.errors import CheckpointError
from f2s_hpc.io import checkpoint, layout, runs
from f2s_hpc.io.layout import Block
from f2s_hpc.io.manifest import manifest_path

SHAPE = (4, 3, 5)


def write(folder: pathlib.Path, cycle: int) -> pathlib.Path:
    """Write a small checkpoint of its own values."""
    data = cycle + np.arange(60.0).reshape(SHAPE)
    return checkpoint.write_checkpoint(folder, cycle, [Block("mass", data, (0, 0, 0), SHAPE)],
                                       {"step": 100 * cycle, "time_s": 0.25})


def edit_manifest(path: pathlib.Path, **changes: object) -> None:
    place = manifest_path(path)
    place.write_text(json.dumps(json.loads(place.read_text(encoding="utf-8")) | changes), encoding="utf-8")


@pytest.mark.parametrize(("changes", "words"), [
    ({"complete": False}, "not the manifest of a complete"), ({"complete": 1}, "not the manifest of a complete"),
    ({"format": layout.FORMAT_VERSION - 1}, f"this version reads {layout.FORMAT_VERSION}"),
    ({"file": "checkpoint_cycle_0001_step_00000100.h5"}, "not the manifest of a complete")])
def test_a_manifest_of_something_else_is_refused_and_the_older_checkpoint_taken(tmp_path, changes, words):
    """Fails when ``read_manifest`` does not look at ``complete``, at the format, or at the name of the file."""
    older, newer = write(tmp_path, 1), write(tmp_path, 2)
    edit_manifest(newer, **changes)
    with pytest.raises(CheckpointError, match=words):
        checkpoint.read_checkpoint(newer, {"mass": ((0, 0, 0), SHAPE)})
    found, skipped = checkpoint.newest_valid_checkpoint(tmp_path)
    assert found == older
    assert words in skipped[0]


def test_a_checkpoint_under_another_name_is_refused(tmp_path):
    """Copied with its manifest to another cycle's name, it is sound in itself; fails when the name is not compared."""
    older = write(tmp_path, 1)
    renamed = tmp_path / layout.checkpoint_name(7, 700)
    shutil.copy(older, renamed)
    shutil.copy(manifest_path(older), manifest_path(renamed))
    assert checkpoint.newest_valid_checkpoint(tmp_path)[0] == older


def test_edited_attributes_are_found_by_the_serial_reader(tmp_path):
    """What ``f2s resume`` and ``analyse`` read first; fails when ``open_checkpoint_serial`` takes no digest."""
    path = write(tmp_path, 1)
    with h5py.File(path, "r+") as file:
        text = layout.read_text(file, layout.ATTRIBUTES)
        file[layout.ATTRIBUTES][()] = np.bytes_(text.replace("0.25", "0.26").encode())
    with pytest.raises(CheckpointError, match="the attributes have another checksum"):
        runs.open_checkpoint_serial(path, [])


def test_a_box_before_the_first_cell_is_not_in_the_field(tmp_path):
    """Fails when ``_unfit`` leaves out ``min(start) < 0``: the slice would count from the other end."""
    path = write(tmp_path, 1)
    with pytest.raises(CheckpointError, match="not in it"):
        checkpoint.read_checkpoint(path, {"mass": ((-2, 0, 0), (1, 1, 1))})
