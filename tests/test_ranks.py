"""One scene with impacts on 1, 2, 3 and 4 ranks: the same bits, and a comparison that would see a single one."""

from __future__ import annotations

import json
import pathlib
import shutil

import h5py
import numpy as np
import pytest
from conftest import f2s

from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.layout import Block
from f2s_hpc.io.manifest import as_text, manifest_path, partial_checksums

# 21 x 17 x 40 cells: no rank count but 1 divides them evenly. The spheres fill the box down to the substrate,
# so that they hit it and each other at once, and the second batch meets the first.
SCENE = """
title = "Impacts in a small box"

[domain]
size = ["126 um", "102 um", "240 um"]
cell_size = "6 um"
substrate_height = "36 um"
particle_layer_height = "204 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"
direction = [0.1, -0.05, -1.0]

[batches]
count = 2
particles = 24
seed = 1
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
"""


@pytest.fixture(scope="module")
def one_rank(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the folder of the run on one rank; the scene file lies beside it."""
    folder = tmp_path_factory.mktemp("ranks")
    (folder / "impacts.toml").write_text(SCENE, encoding="utf-8")
    f2s("run", "impacts.toml", "--out", "on-1", cwd=folder)
    return folder / "on-1"


def change_one_bit(path: pathlib.Path, field: str) -> None:
    """Flip the last bit of the largest value of a checkpoint's field, and let its manifest agree."""
    with h5py.File(path, "r+") as file:
        data = file[f"{layout.FIELDS_GROUP}/{field}"][...]
        place = np.unravel_index(np.argmax(data), data.shape)
        data.view(np.uint64)[place] ^= np.uint64(1)
        file[f"{layout.FIELDS_GROUP}/{field}"][...] = data
    place = manifest_path(path)
    record = json.loads(place.read_text(encoding="utf-8"))
    checksum = partial_checksums([Block(field, data, (0, 0, 0), data.shape)])[0]
    record["fields"][field]["checksum"] = as_text(checksum)
    record["size"] = path.stat().st_size
    place.write_text(json.dumps(record), encoding="utf-8")


def test_the_scene_has_impacts_and_a_batch_that_meets_the_one_before(one_rank):
    summary = runs.read_summary(one_rank)
    assert summary["status"] == "complete"
    assert summary["particles"] + summary["particles_waiting"] == 48
    assert summary["peeq_max"] > 0.3
    assert summary["particles_moved"] > 0
    assert summary["steps"] > 100


@pytest.mark.parametrize("ranks", [2, 3, 4])
def test_any_number_of_ranks_gives_the_same_bits(one_rank, ranks):
    """Fails if one ghost is not exchanged: leave the last ``state.exchange(VELOCITY)`` out of
    ``solver/lagrange.py:calm_light_nodes``."""
    folder = one_rank.parent
    f2s("run", "impacts.toml", "--out", f"on-{ranks}", ranks=ranks, cwd=folder)
    assert runs.read_summary(folder / f"on-{ranks}")["ranks"] == ranks
    said = f2s("compare", one_rank.name, f"on-{ranks}", "--exact", cwd=folder).stdout
    assert "identical in every saved bit" in said
    checkpoints = [[path.name for path in list_checkpoints(run / layout.CHECKPOINTS)]
                   for run in (one_rank, folder / f"on-{ranks}")]
    assert checkpoints[0] == checkpoints[1]
    assert len(checkpoints[0]) == 2
    assert runs.list_frames(one_rank) == runs.list_frames(folder / f"on-{ranks}") == [0, 1]


@pytest.mark.parametrize("field", ["mass", "stress_xz", "velocity_z"])
def test_compare_sees_one_bit(one_rank, tmp_path, field):
    """Fails if ``io/compare.py:_compare_checkpoints`` compares the manifests only, or leaves a field out."""
    copy = tmp_path / "copy"
    shutil.copytree(one_rank, copy)
    change_one_bit(list_checkpoints(copy / layout.CHECKPOINTS)[-1], field)
    done = f2s("compare", one_rank, copy, "--exact", cwd=tmp_path, code=1)
    assert not done.stderr
    lines = [line for line in done.stdout.splitlines() if "checkpoint cycle" in line]
    assert len(lines) == 1
    assert field in lines[0]
    assert "1 of " in lines[0]
    # without --exact the differences are told, and that is no failure
    f2s("compare", one_rank, copy, cwd=tmp_path)
