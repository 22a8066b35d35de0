"""The script that measures whole runs: its parts run, and their lines say what was measured."""

from __future__ import annotations

import json
import math
import pathlib
import re
import shutil

import pytest

from f2s_hpc.bench import performance
from f2s_hpc.config import dump_scene, load_scene
from f2s_hpc.errors import F2SError


def test_the_splat_is_the_one_that_other_codes_ran(tmp_path, monkeypatch):
    """At coarse cells; fails if a setting no longer exists, or the sphere starts inside the block."""
    monkeypatch.setattr(performance, "PEERS_SPLAT", (*performance.PEERS_SPLAT, "domain.cell_size=7.5 um"))
    line = performance.splat(tmp_path)
    found = performance.runs.read_summary(tmp_path / "splat")
    assert found["cells"] == 20 * 20 * 16
    assert found["particles"] == 1
    assert found["painted_volume_m3"] == pytest.approx(4.0 / 3.0 * math.pi * 15e-6**3, rel=1e-3, abs=0.0)
    assert float(re.search(r"([0-9.]+) s of CPU", line)[1]) > 0.3


def test_twice_the_height_is_the_same_run(tmp_path, monkeypatch):
    """Same deposit and nearly the same cell-steps; fails if the particles of the high box start elsewhere."""
    monkeypatch.setattr(performance, "QUIET", (*performance.QUIET, "domain.cell_size=10 um"))
    line = performance.empty_height(tmp_path, pairs=1)
    low, high = (performance.runs.read_summary(tmp_path / name) for name in ("low-0", "high-0"))
    assert high["cells"] == 2 * low["cells"]
    assert high["dense_height_m"] == pytest.approx(low["dense_height_m"], rel=1e-9)
    assert abs(float(re.search(r"cell-steps ([+-][0-9.]+)%", line)[1])) < 3.0
    assert abs(float(re.search(r"peak memory ([+-][0-9.]+)%", line)[1])) < 3.0


def test_a_run_that_fails_says_so(tmp_path):
    """Fails if the exit code of a run is not looked at."""
    with pytest.raises(F2SError, match="speed"):
        performance.run_once("splat", ["particles.speed=fast"], tmp_path / "x")


def test_cost_per_particle_wants_a_run(tmp_path):
    """Fails if a wrong folder ends in a traceback."""
    shutil.rmtree(tmp_path)
    with pytest.raises(F2SError):
        performance.per_particle(tmp_path, tmp_path, "mpirun -n")


def test_cost_per_particle_compares_like_with_like(tmp_path, monkeypatch):
    """Fails if the patch is of another scene than the run's own, or on other ranks than it had."""
    wide, calls = tmp_path / "wide", []
    wide.mkdir()
    (wide / "scene.toml").write_text(dump_scene(load_scene("wide-100k", ["domain.cell_size=16 um"])))
    summary = {"status": "complete", "particles": 100, "painted_volume_m3": 1e-9, "active_cell_steps": 1000,
               "wall_s": 10.0, "peak_memory_bytes": 1e9, "ranks": 3}
    (wide / "summary.json").write_text(json.dumps(summary))

    def run(command, what):
        calls.append(command)
        folder = pathlib.Path(command[command.index("--out") + 1])
        folder.mkdir()
        (folder / "summary.json").write_text(json.dumps(summary | {"particles": 50}))

    monkeypatch.setattr(performance.launch, "run", run)
    text = performance.per_particle(wide, tmp_path, "srun -n")
    assert "cell-steps per particle -50.0%" in text
    assert [command[:3] for command in calls] == [["srun", "-n", "3"]] * 2
    scene, = (word for word in calls[1] if word.endswith("scene.toml"))
    assert scene == str(wide / "scene.toml")
    patch = load_scene(scene, [word for word in calls[1] if "=" in word])
    assert (patch.domain.cell_size, patch.batches.particles) == (16e-6, 418)
