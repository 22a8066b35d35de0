"""``f2s verify --levers``: what leaving out saves, and what it changes."""

from __future__ import annotations

import mmap
import pathlib

import pytest

from f2s_hpc import mpi
from f2s_hpc.config.load import load_scene
from f2s_hpc.grid.pages import real_bytes, sparse_zeros
from f2s_hpc.verify import levers


def test_levers_save_and_change_what_they_should():
    """Fails when numerics.active_rows or numerics.conduction has no effect, or the settings of a lever are not used."""
    rows = {row.lever: row for row in levers.run()}
    assert list(rows) == ["everything", *(lever.name for lever in levers.LEVERS), "all levers"]
    whole, active, cold = rows["everything"], rows["active rows"], rows["no conduction"]
    assert active.cell_steps < 0.8 * whole.cell_steps
    assert active.fraction_change == active.height_mean_m == active.peeq_p50 == active.temperature_p50 == 0.0
    assert cold.temperature_p95 > 10.0
    assert 0.0 < cold.fraction_change < 0.02
    fewer = rows["fewer remaps"]
    assert 0.0 < fewer.fraction_change < 0.01
    assert 0.0 < abs(fewer.temperature_p95) < 10.0
    assert 0.0 < rows["remap of order 1"].fraction_change < 0.05
    assert abs(rows["remap of order 1"].peeq_p95) > 0.01
    asleep = rows["sleeping depth"]
    assert asleep.cell_steps < 0.9 * whole.cell_steps
    assert 0.0 < asleep.fraction_change < 0.02
    assert abs(asleep.temperature_p95) < 10.0
    shallow = rows["half substrate, absorbing"]
    assert shallow.cell_steps < 0.8 * whole.cell_steps
    assert shallow.fraction_change is None
    assert 0.0 < abs(shallow.temperature_p95) < 20.0
    assert all(row.wall_s > 0.0 and row.steps > 100 for row in rows.values())
    assert len(levers.table(list(rows.values())).splitlines()) == len(rows) + 1


@pytest.mark.mpi
def test_a_lever_that_does_nothing_saves_no_memory():
    """Fails when memory is that of the process before and after: freed memory is used again, 0.69 was found."""
    rows = levers.run(levers=[levers.Lever("nothing", (), ())])
    assert [row.memory for row in rows] == pytest.approx([1.0] * 3, abs=0.02)
    # some 240 bytes per cell of 10 x 10 x 35, and what is beyond is not real
    assert 0.5e6 < rows[0].memory_bytes < 8e6 * mpi.size()


def test_levers_full_scene_loads():
    """The full size is the scene quickstart with every lever's settings; fails when a lever names a key that is not."""
    for lever in levers.LEVERS:
        saving, full = (load_scene(levers.SCENE, settings) for settings in (lever.saving, lever.full))
        assert saving != full


def test_memory_is_what_was_written():
    """Pages that are only read are none; fails when every page that is mapped counts (bit 63 of its entry)."""
    array = sparse_zeros((100, mmap.PAGESIZE // 8))
    if not pathlib.Path("/proc/self/pagemap").exists():
        assert real_bytes(array) == array.nbytes
        return
    array[:30] = 0.0
    assert array[50:80].sum() == 0.0
    assert real_bytes(array) == 30 * mmap.PAGESIZE
