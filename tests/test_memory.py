"""Memory: what is predicted is what real runs take, and a scene allocates no field that it does not need."""

from __future__ import annotations

import math
import pathlib
import re
import sys
import tracemalloc

import numpy as np
import pytest
from conftest import launch

from f2s_hpc import fields, mpi
from f2s_hpc.analysis import picture, surface
from f2s_hpc.bench.hook import Stopwatches, hooked
from f2s_hpc.build import build_state
from f2s_hpc.config import load_scene, scene_names
from f2s_hpc.grid.box import GHOST, Box
from f2s_hpc.grid.decomposition import ownership_ranges, process_grid
from f2s_hpc.io import runs, vtkhdf
from f2s_hpc.io.layout import Block
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.plan import BatchPlan, make_batches
from f2s_hpc.verify.scenes import prepare
from f2s_hpc.workload import memory

SHORT = ["cycles.count=1", "cycles.duration=3 ns", "cycles.last_duration=3 ns", "output.checkpoints=true",
         "output.picture=false", "domain.substrate_height=0.35 mm"]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Compile what such a run needs: a process that compiles takes memory for that too."""
    settings = [word for one in ["domain.cell_size=24 um", *SHORT] for word in ("--set", one)]
    done = launch([sys.executable, "-m", "f2s_hpc", "run", "section4", "--out", "run", *settings], 1,
                  tmp_path_factory.mktemp("compiled"))
    assert done.returncode == 0, done.stdout + done.stderr


def predicted_and_measured(folder: pathlib.Path, ranks: int, *settings: str) -> tuple[memory.RankMemory, float]:
    """Return what the fullest rank of a short run of section4 should take, and what it did (bytes)."""
    overrides = [*SHORT, *settings]
    scene = load_scene("section4", overrides)
    box = Box(scene.domain.cells, scene.domain.cell_size)
    expected = memory.of_fullest(scene, ownership_ranges(box, process_grid(box, ranks)), make_batches(scene))
    words = [word for one in overrides for word in ("--set", one)]
    done = launch([sys.executable, "-m", "f2s_hpc", "run", "section4", "--out", "run", *words], ranks, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return expected, runs.read_summary(folder / "run")["peak_memory_bytes_per_rank"]


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(("cell_um", "ranks"), [(12, 1), (12, 2), (5, 1), (5, 2)])
def test_prediction_is_true_within_ten_percent(tmp_path, cell_um, ranks):
    """Fails if a field, the ghosts or the maps are forgotten: at 5 um they are a fifth of it."""
    expected, measured = predicted_and_measured(tmp_path, ranks, f"domain.cell_size={cell_um} um")
    assert expected.total == pytest.approx(measured, rel=0.1)
    if cell_um == 5:
        assert expected.arrays + expected.maps > 0.2 * measured


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("ranks", [1, 2])
def test_prediction_is_true_of_a_box_that_is_mostly_void(tmp_path, ranks):
    """Fails if the DMDAs of cells and of nodes are there at once, if a derived field is written where there is void, or
    if a whole field is copied to be written or read back.
    """
    expected, measured = predicted_and_measured(
        tmp_path, ranks, "domain.cell_size=12 um", 'domain.size=["1.2 mm", "1.2 mm", "6 mm"]',
        "domain.substrate_height=24 um", "batches.particles=100", "output.checkpoints=false")
    assert expected.total == pytest.approx(measured, rel=0.1)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("ranks", [1, 2])
def test_prediction_knows_the_tracers(tmp_path, ranks):
    """A million points, seeded at once and written: what they take more, with and without. Fails if it is forgotten."""
    expected, measured = [], []
    for points in (0, 2000):
        overrides = ["domain.cell_size=24 um", *SHORT, "particles.flight=eulerian", f"output.tracers={points}"]
        scene = load_scene("section4", overrides)
        box = Box(scene.domain.cells, scene.domain.cell_size)
        ranges = ownership_ranges(box, process_grid(box, ranks))
        expected.append(memory.of_fullest(scene, ranges, make_batches(scene)).total)
        settings = [word for one in overrides for word in ("--set", one)]
        command = [sys.executable, "-m", "f2s_hpc", "run", "section4", "--out", f"run-{points}", *settings]
        done = launch(command, ranks, tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        measured.append(runs.read_summary(tmp_path / f"run-{points}")["peak_memory_bytes_per_rank"])
    assert expected[1] - expected[0] == pytest.approx(measured[1] - measured[0], rel=0.15)
    assert expected[1] > 1.3 * expected[0]


def test_planes_are_touched_by_what_lands_before_the_end():
    """Fails when ``touched_planes`` counts what is still in the air, or leaves out the particle on top."""
    scene = load_scene("section4", ["cycles.count=2", "cycles.duration=0.3 us", "cycles.last_duration=0.1 us"])
    dx, ground = scene.domain.cell_size, scene.domain.substrate_height
    bottom, area = scene.domain.layer_bottom, scene.domain.extents[0] * scene.domain.extents[1]
    low, high = ground - bottom + 20e-6, ground - bottom + 120e-6  # over the substrate: 0.02 and 0.2 us of flight
    r = 15e-6
    batch = Batch(*(np.full(40, 1e-4),) * 2, np.repeat([low + r, high + r], 20), np.full(40, r))
    # of the second batch the upper half does not come down any more
    top = ground + 60 * 4.0 / 3.0 * np.pi * r**3 / area + 2.0 * r
    planes = memory.touched_planes(scene, BatchPlan([batch], [0, 0]))
    assert planes == math.ceil(top / dx) + GHOST
    assert planes < scene.domain.cells[2]


def test_the_picture_takes_the_place_of_fields_that_were_given_back():
    """Fails when the picture is forgotten, or counted in a scene that draws none."""
    small, large = (memory.RankMemory(memory.BASELINE, arrays, 0, 1000) for arrays in (28 * 2**20, 280 * 2**20))
    scene, silent = load_scene("section4"), load_scene("section4", ["output.picture=false"])
    plan = BatchPlan([], [])
    work, rows = 14 / 28 * 28 * 2**20, memory.DRAWN * 117 * 64 * 200
    drawn = memory.on_root(scene, small, plan)
    assert drawn + work > memory.PICTURE + rows
    assert drawn + work - memory.PICTURE - rows == pytest.approx(memory.on_root(
        silent, memory.RankMemory(memory.BASELINE, 0, 0, 1000), plan), abs=1)
    assert memory.on_root(scene, large, plan) == 0


def test_what_is_drawn_is_not_held_whole(tmp_path, monkeypatch):
    """A full box from a frame: what is allocated is what the forecast has, matplotlib aside.

    Fails when a field is read whole (``[:, :]`` for ``[:, rows]`` in ``survey``), or the labels are.
    """
    monkeypatch.setattr(surface, "LABELLED_AT_ONCE", 2**16)
    scene = load_scene("section4", ['domain.size=["0.2 mm", "5 mm", "0.6 mm"]', "domain.cell_size=10 um"])
    shape = scene.domain.cells[::-1]
    full = [Block(name, np.full(shape, value), (0, 0, 0), shape) for name, value in
            zip(picture.NEEDED, (1.0, 0.5, 300.0, 0.0))]
    vtkhdf.write_frame(tmp_path / "frames", 0, 0.0, full, (0.0,) * 3, (1e-5,) * 3, {})
    monkeypatch.setattr(memory, "touched_planes", lambda scene, plan: shape[0])
    expected = memory.on_root(scene, memory.RankMemory(0, 0, 0, 1000), BatchPlan([], [])) - memory.PICTURE
    fields, _ = runs.frame_fields(tmp_path, 0, picture.NEEDED)
    surface.grounded_cells(np.ones((1, 1, 1), dtype=bool))  # (loads scipy)
    tracemalloc.start()
    try:
        seen = picture.survey(fields, 1e-5, scene.domain.substrate_height, 200.0)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert seen[0] == pytest.approx(shape[0] * 1e-5)
    assert 0.5 * expected < peak < 1.05 * expected
    assert expected < 4.0 * np.prod(shape)


def test_check_prints_bytes_per_cell(run_f2s):
    done = run_f2s(["check", "section4"])
    assert done.returncode == 0, done.stderr
    line = next(text for text in done.stdout.splitlines() if text.startswith("# memory"))
    found = re.search(r"([\d.]+ MiB) for the process and its libraries, and (\d+) bytes per cell", line)
    assert found, line
    assert 150 < int(found.group(2)) < 320


BASE = {f.name for f in fields.FIELDS} - {"internal_energy", "particle_fraction", "lent_mass"}

FINE = {"section4", "section4-standard", "multitrack", "track-160", "track-120", "track-80", "splat", "splat-quarter"}
"""Scenes whose cells are fine enough for fewer remaps."""


@pytest.mark.parametrize("name", scene_names())
def test_built_in_scenes_allocate_what_they_need_and_no_more(name):
    """No energy without Mie-Grueneisen pressure, no origin unless asked for, no losses unless they heat, no
    displaced mesh where each step is remapped.
    """
    coarse = {"wide-100k": "80 um", "section4": "15 um", "section4-standard": "15 um", "multitrack": "15 um"}.get(
        name, "16 um" if name.startswith("track") else None)
    size = [f"domain.cell_size={coarse}"] if coarse else []
    remaps = set() if name in FINE else set(fields.DISPLACEMENT)
    assert {f.name for f in load_scene(name, []).needed_fields} == BASE - remaps
    for overrides, missing in ((["numerics.steps_per_remap=8"], set()),
                               (["numerics.steps_per_remap=8", "numerics.loss_heating=false"], {"lost_energy"}),
                               (["numerics.steps_per_remap=1"], set(fields.DISPLACEMENT))):
        state = build_state(load_scene(name, [*size, *overrides]))
        assert set(state.views) == BASE - missing, name
        cells = sum(view.size for view in state.views.values())
        assert state.pool.memory.size < cells + 1024 * len(state.views)
    assert len(BASE) == 31 - 3


@pytest.mark.parametrize(("settings", "called"), [
    ([], {"conduction.heat_gained", "momentum.specific_losses"}),
    (["numerics.conduction=false"], {"momentum.specific_losses"}),
    (["numerics.conduction=false", "numerics.loss_heating=false"], set())])
def test_what_is_switched_off_is_not_computed(settings, called):
    """Fails if a kernel of conduction, or of the heat of losses, runs in a scene without it."""
    setup, _ = prepare(load_scene("quickstart", ["domain.cell_size=10 um", *settings]))
    watches = Stopwatches()
    with hooked(watches.wrap):
        setup.advance(1)
    names = set(watches.read()[1])
    assert names & {"conduction.heat_gained", "conduction.add_heat", "momentum.specific_losses"} >= called
    assert ("conduction.heat_gained" in names) == ("conduction.heat_gained" in called)
    assert ("momentum.specific_losses" in names) == ("momentum.specific_losses" in called)


def test_options_bring_their_fields():
    assert fields.needed(True, True, True, True, True) == fields.FIELDS
    assert {f.name for f in fields.needed(False, False, False)} == BASE - {"lost_energy", *fields.DISPLACEMENT}
    assert mpi.size() == 1
