"""A short, coarse version of the paper's recurring scheme on the authors' own batches."""

from __future__ import annotations

import json
import pathlib
import sys

import pytest
from conftest import launch

from f2s_hpc.io import runs
from f2s_hpc.particles.batch import Batch, clipped_volume, read_csv

CELL_UM = 12
SPEED = 615.0
DENSITY = 8960.0
EXTENTS = (348e-6, 348e-6, 600e-6)  # whole cells
LAYER_BOTTOM = 600e-6 - 203e-6


@pytest.fixture(scope="module")
def files(paper_data: pathlib.Path) -> list[pathlib.Path]:
    """Return both of the authors' files, or skip."""
    found = sorted(paper_data.glob("spheres_info-*.csv"))[:2]
    if len(found) < 2:
        pytest.skip(f"{paper_data} holds only {len(found)} of the two authors' batches")
    return found


@pytest.fixture(scope="module")
def summary(files: list[pathlib.Path], tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Return the summary of two cycles on 2 ranks."""
    folder = tmp_path_factory.mktemp("section4")
    names = json.dumps([str(path) for path in files])
    done = launch([sys.executable, "-m", "f2s_hpc", "run", "section4", "--out", "out",
                   "--set", f"domain.cell_size={CELL_UM} um", "--set", f"batches.files={names}",
                   "--set", "cycles.count=2",
                   "--set", "output.picture=false", "--set", "output.checkpoints=false"], 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return runs.read_summary(folder / "out")


def test_both_batches_are_in(summary):
    assert summary["status"] == "complete"
    assert summary["particles"] == 1000
    assert summary["particles_waiting"] == 0
    assert summary["ranks"] == 2
    assert summary["cells"] == 29 * 29 * 50


def test_mass_is_kept(summary):
    """Fails if ``insert._add`` counts ghost cells as painted: ``mass_quanta(added, ...)``."""
    assert abs(summary["mass_drift_relative"]) < 1e-10
    assert summary["mass_left_kg"] == 0.0
    assert summary["mass_capped_kg"] < 1e-5 * summary["painted_volume_m3"] * DENSITY


def test_the_dense_height_is_the_volume_of_the_files_over_the_area(summary, files):
    """The volume of both files, cut by the walls, less what is still in flight: nothing was lost or made on the way.

    Fails if a moved sphere is cut otherwise than it was asked for, or ``substrate_quanta`` is not subtracted.
    """
    volume = 0.0
    for path in files:
        batch = read_csv(path)
        volume += clipped_volume(Batch(batch.x, batch.y, batch.z + LAYER_BOTTOM, batch.r), *EXTENTS)
    landed = volume - summary["volume_in_flight_m3"]
    assert 0.9 * volume < landed <= volume
    assert summary["painted_volume_m3"] == pytest.approx(landed, rel=1e-3, abs=0.0)
    assert summary["dense_height_m"] == pytest.approx(landed / (EXTENTS[0] * EXTENTS[1]), rel=1e-3)


def test_nothing_races(summary):
    """Fails if light nodes share no momentum and stress acts on them unweighted (the closure of mixed cells)."""
    assert 0.95 * SPEED < summary["speed_max_heavy_m_s"] < 1.3 * SPEED
    assert 0.5 < summary["peeq_max"] < 8.0


def test_the_deposit_is_a_deposit(summary):
    """The first batch has landed, of the second some: the deposit is as high as that, strained and hot."""
    assert 0.3 * summary["dense_height_m"] < summary["height_mean_m"] < 1.1 * summary["dense_height_m"]
    assert summary["height_mean_m"] < summary["height_p95_m"] < summary["height_max_m"]
    assert summary["height_max_m"] < 150e-6
    assert summary["peeq_p50"] > 0.5
    assert 400.0 < summary["temperature_p50_degC"] < 800.0
    energy = summary["energy"]
    assert abs(energy["remainder"]) < 0.03 * energy["brought_in"]
