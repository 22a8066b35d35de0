"""Load balance: the expected load, ranges weighted by it, and that they change no bit of a result."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from conftest import launch
from solver_setup import ALL_SYMMETRY

from f2s_hpc import mpi
from f2s_hpc.build import build_state
from f2s_hpc.config import load_scene
from f2s_hpc.config.load import parse_scene
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL, needed
from f2s_hpc.grid.box import GHOST, Box
from f2s_hpc.grid.decomposition import Decomposition, ownership_ranges
from f2s_hpc.io import runs
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.state import State
from f2s_hpc.workload.balance import balanced, imbalance_of
from f2s_hpc.workload.expected import block_shares, column_load, moments

# all particles come down on a quarter of a box without substrate: even ranges leave most ranks idle
ONE_SIDED = """
title = "Particles on one side"

[domain]
size = ["300 um", "150 um", "120 um"]
cell_size = "6 um"
substrate_height = "6 um"
particle_layer_height = "108 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"
flight = "eulerian"

[batches]
spheres = [["21 um", "24 um", "20 um", "15 um"], ["54 um", "30 um", "22 um", "15 um"],
           ["24 um", "60 um", "24 um", "15 um"], ["60 um", "66 um", "20 um", "15 um"],
           ["40 um", "45 um", "60 um", "15 um"], ["80 um", "90 um", "60 um", "15 um"]]

[cycles]
count = 1
duration = "60 ns"

[output]
picture = false
"""


def one_sided():
    scene = parse_scene(ONE_SIDED, "one-sided")
    return scene, make_batches(scene)


@pytest.mark.parametrize("parts", [1, 2, 5, 12])
def test_weighted_ranges_cover_the_box_and_stay_as_wide_as_the_ghosts(parts, rng):
    weights = np.where(np.arange(60) < 7, 100.0, 0.1) * rng.random(60)
    (x, y, z) = ownership_ranges(Box((60, 60, 30), 1e-6), (parts, 1, 2), (weights, weights))
    assert sum(x) == 60
    assert y == [60]
    assert z == [15, 15]
    assert len(x) == parts
    assert min(x) >= GHOST


def test_weighted_ranges_share_the_weight(rng):
    weights = 1.0 + 9.0 * np.exp(-((np.arange(400) - 120) / 40.0) ** 2)
    x, _, _ = ownership_ranges(Box((400, 4, 4), 1e-6), (8, 1, 1), (weights, np.ones(4)))
    shares = np.add.reduceat(weights, np.cumsum([0, *x[:-1]]))
    assert shares.max() / shares.mean() < 1.1
    even = weights.reshape(8, 50).sum(axis=1)
    assert even.max() / even.mean() > 1.5


def test_equal_or_no_weights_give_even_ranges():
    box = Box((60, 48, 20), 1e-6)
    even = ownership_ranges(box, (4, 3, 1))
    assert even == ([15] * 4, [16] * 3, [20])
    assert ownership_ranges(box, (4, 3, 1), (np.ones(60), np.zeros(48))) == even


def test_too_many_ranks_are_refused_with_weights_too():
    with pytest.raises(InputError, match="thinner than 4 cells"):
        ownership_ranges(Box((15, 8, 8), 1e-6), (4, 1, 1), (np.ones(15), np.ones(8)))


def test_uniform_sprays_keep_even_ranges():
    for name in ("section4", "section4-standard", "quickstart"):
        scene = load_scene(name, ["domain.cell_size=6 um"])
        found = balanced(scene, make_batches(scene), 4)
        assert not found.weighted, name
        assert 1.0 <= found.imbalance < 1.08


def test_one_sided_spray_gets_uneven_ranges():
    """Fails if ``balanced`` takes the even ranges, or the load forgets the particles."""
    scene, plan = one_sided()
    found = balanced(scene, plan, 4)
    assert found.weighted
    assert found.imbalance < 0.8 * found.even
    load = column_load(scene, plan)
    assert load.shape == (25, 50)
    assert found.imbalance == imbalance_of(load, found.ranges)


def test_expected_load_is_what_the_solver_finds_active():
    """The blocks that the particles and the substrate mark are those that the kernels mark, at the start, exactly."""
    from f2s_hpc.build import build_ledger, build_model
    from f2s_hpc.cycles.insert import paint_batch, paint_substrate

    scene, plan = one_sided()
    scene = parse_scene(ONE_SIDED, "one-sided", ["cycles.duration=1e-15 s"])
    first = next(iter(moments(scene, plan)))
    state, model = build_state(scene), build_model(scene)
    paint_substrate(state, scene.domain.substrate_height, 300.0)
    paint_batch(state, model, plan.batches[0], scene.domain.layer_bottom, (0.0, 0.0, -615.0), 700.0,
                build_ledger(model), 1)
    state.everything_active()
    state.update_activity()
    nx, ny, nz = scene.domain.cells
    inner = state.active[GHOST:GHOST + nz, GHOST:GHOST + ny]
    assert np.array_equal(first.blocks[:, :, :inner.shape[2]], inner[:, :, :first.blocks.shape[2]])
    assert int((first.blocks.astype(int) @ block_shares(nx, [0], [nx])).sum()) == state.active_cells()


@pytest.mark.mpi
def test_ghosts_of_uneven_ranges_are_what_their_owners_hold():
    """Fails if the nodes do not follow the cells' ranges, with one more on the last rank."""
    cells = (9 * max(mpi.size(), 2), 13, 12)
    grid = (mpi.size(), 1, 1)
    weights = (np.where(np.arange(cells[0]) < 12, 5.0, 1.0), np.ones(13))
    ranges = ownership_ranges(Box(cells, 1e-6), grid, weights)
    state = State(Decomposition(Box(cells, 1e-6), ranges=ranges), ALL_SYMMETRY, needed(False))
    assert state.part.count[0] == ranges[0][mpi.rank()]
    for name in ("mass", "velocity_x"):
        on_nodes = BY_NAME[name].location != CELL
        shape = state.part.node_shape if on_nodes else state.part.cell_shape
        place = np.arange(shape[2]) - GHOST + state.part.start[0]
        value = np.broadcast_to(place + 1.0, shape)
        state.owned(name)[...] = value[state.part.owned_nodes if on_nodes else state.part.owned_cells]
        state.everything_active()
        state.pool.exchange((name,))
        inside = (place >= 0) & (place < cells[0] + int(on_nodes))
        inner = state.views[name][GHOST:-GHOST - 1, GHOST:-GHOST - 1, :shape[2] - int(on_nodes)]
        assert np.array_equal(inner[..., inside[:inner.shape[2]]],
                              value[GHOST:-GHOST - 1, GHOST:-GHOST - 1, :inner.shape[2]][..., inside[:inner.shape[2]]])


def test_uneven_ranges_change_no_bit_and_lower_the_measured_imbalance(tmp_path):
    """Fails if anything depends on which rank owns a cell: leave an exchange out of the step."""
    (tmp_path / "one.toml").write_text(ONE_SIDED, encoding="utf-8")
    for ranks in (1, 2, 3, 4):
        done = launch([sys.executable, "-m", "f2s_hpc", "run", "one.toml", "--out", f"on-{ranks}"], ranks, tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
    for ranks in (2, 3, 4):
        done = launch([sys.executable, "-m", "f2s_hpc", "compare", "on-1", f"on-{ranks}", "--exact"], cwd=tmp_path)
        assert done.returncode == 0, done.stdout
    scene, plan = one_sided()
    expected = balanced(scene, plan, 4)
    row = runs.read_summary(tmp_path / "on-4")
    assert 1.0 <= row["imbalance"] < 0.8 * expected.even
    assert row["imbalance"] == pytest.approx(expected.imbalance, rel=0.15)
    assert runs.read_summary(tmp_path / "on-1")["imbalance"] == 1.0


def test_check_tells_the_imbalance(run_f2s, tmp_path):
    (tmp_path / "one.toml").write_text(ONE_SIDED, encoding="utf-8")
    done = run_f2s(["check", "one.toml"], ranks=4)
    assert done.returncode == 0, done.stderr
    line = next(text for text in done.stdout.splitlines() if text.startswith("# imbalance"))
    assert "with ranges weighted by the expected deposit" in line
