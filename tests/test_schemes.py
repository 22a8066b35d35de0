"""The table of the recurring against the standard scheme, from two runs."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from f2s_hpc.bench import schemes
from f2s_hpc.config import load_scene
from f2s_hpc.errors import F2SError
from f2s_hpc.particles.plan import make_batches

ROOT = pathlib.Path(__file__).parents[1]
FOUND = {"status": "complete", "ranks": 2, "cells": 1000, "startup_s": 5.0, "wall_s": 125.0,
         "startup_memory_bytes": 2e8, "peak_memory_bytes": 4e8, "dense_height_m": 3.36e-4, "height_mean_m": 3.4e-4,
         "height_p95_m": 3.5e-4, "peeq_p50": 3.0, "peeq_p95": 6.0, "temperature_p50_degC": 700.0,
         "temperature_p95_degC": 800.0}


def _leave(folder: pathlib.Path, **other: object) -> None:
    folder.mkdir()
    (folder / "summary.json").write_text(json.dumps(FOUND | other), encoding="utf-8")


def test_table_of_both_schemes(tmp_path):
    """Fails if execution is taken with the preparation in it, or a ratio upside down."""
    _leave(tmp_path / "recurring")
    _leave(tmp_path / "standard", cells=4000, wall_s=305.0, height_mean_m=3.332e-4)
    done = subprocess.run([sys.executable, str(ROOT / "scripts" / "schemes.py"), "--out", str(tmp_path)],
                          capture_output=True, text=True, check=True)
    lines = {line[:20].strip(): line[20:].split() for line in done.stdout.splitlines()}
    assert lines["elements"][:3] == ["1,000", "4,000", "25.0%"]
    assert lines["execution time"][:5] == ["2.0", "min", "5.0", "min", "40.0%"]
    assert lines["total time"][:5] == ["2.1", "min", "5.1", "min", "41.0%"]
    assert lines["execution time"][5:] == ["310.0", "min", "668.0", "min", "46.4%"]
    assert lines["height_mean_m"] == ["340.0000", "333.2000", "+2.04%"]


def test_both_schemes_spray_the_same_particles(tmp_path):
    """Sphere by sphere and in the same order; fails if either scene is changed alone, or the files do not fit one."""
    files = schemes.batch_files(tmp_path)
    recurring, standard = (make_batches(load_scene(name, schemes.particles_of(scheme, files)))
                           for scheme, name in schemes.SCENES.items())
    sprayed = np.concatenate([recurring.batches[index].r for index in recurring.order])
    assert sprayed.size == 5000
    assert np.array_equal(standard.batches[0].r, sprayed)
    words = schemes.command_of("standard", files[:1], ["run.wall_time=1 h"], 3, pathlib.Path("x"), "srun -n")
    assert words[:3] == ["srun", "-n", "3"]
    assert words[words.index("section4-standard"):][1:4] == ["--out", "x", "--set"]
    assert sum(word.count(files[0]) for word in words) == 10
    assert words[-1] == "run.wall_time=1 h"


def test_an_unfinished_run_is_refused(tmp_path):
    """Fails if the table is made of a run that stopped early."""
    _leave(tmp_path / "recurring", status="timeout")
    with pytest.raises(F2SError, match="timeout"):
        schemes.measure("recurring", ["a.csv"], [], 2, tmp_path, "mpirun -n")


def test_half_the_batches_are_not_taken_for_all(tmp_path):
    """Fails if a folder that an interrupted writing left is sprayed as it is, or other files in it count."""
    (tmp_path / "batches").mkdir()
    (tmp_path / "batches" / "batch-01.csv").touch()
    (tmp_path / "batches" / "other.csv").touch()
    with pytest.raises(F2SError, match=r"batches: holds 1 batches of 5; remove it"):
        schemes.batch_files(tmp_path)


@pytest.mark.parametrize("key", ["status", "wall_s", "peeq_p50"])
def test_a_summary_that_lacks_something_is_one_line(tmp_path, key):
    """Fails with a ``KeyError``."""
    _leave(tmp_path / "recurring")
    (tmp_path / "recurring" / "summary.json").write_text(json.dumps({k: v for k, v in FOUND.items() if k != key}))
    with pytest.raises(F2SError, match=f"lacks {key}"):
        schemes.measure("recurring", ["a.csv"], [], 2, tmp_path, "mpirun -n")
