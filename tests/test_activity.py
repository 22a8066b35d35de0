"""Active blocks: they hold all that material can reach, nothing is left outside, and they change no bit."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, make_model, make_setup

from f2s_hpc.kernels import activity
from f2s_hpc.kernels.activity import BLOCK

MODEL = make_model(3e-6)
CELLS = (70, 9, 8)


def active_cells(state):
    """Return the local cells of active blocks (bool)."""
    wide = np.repeat(state.active.astype(bool), BLOCK, axis=2)
    return wide[:, :, :state.part.cell_shape[2]]


def listed_cells(state, axis=None):
    """Return how often the list of runs, or of columns along ``axis``, names each local cell."""
    times = np.zeros(state.part.cell_shape, dtype=int)
    if axis is None:
        runs, count = state.runs
        for k, j, first, last in runs[:count]:
            times[k, j, first:last] += 1
    else:
        columns, count = state.columns(axis)
        for fixed, first, last, start, end in columns[:count]:
            if axis == 1:
                times[fixed, first:last, start:end] += 1
            else:
                times[first:last, fixed, start:end] += 1
    return times


def scatter(state, rng, count):
    """Put ``count`` lone cells of material anywhere, ghosts included."""
    state.views["mass"][...] = 0.0
    state.flat["mass"][rng.choice(state.flat["mass"].size, count, replace=False)] = 0.7


@pytest.mark.parametrize("count", [1, 3, 40])
def test_all_that_material_can_reach_is_active(count, rng):
    """One cell and one node around each cell of material: one below, two above, in all directions, edges included.

    Fails when ``mass[row + max(last - 2, first)]`` or one bit of ``holds`` is dropped, or ``k + 2`` becomes ``k + 1``.
    """
    state = make_setup(CELLS, MODEL).state
    for _ in range(60):
        scatter(state, rng, count)
        state.everything_active()
        state.update_activity()
        active = active_cells(state)
        shape = np.array(active.shape)
        for place in np.argwhere(state.views["mass"] > 0.0):
            low, high = np.maximum(place - 1, 0), np.minimum(place + 3, shape)
            assert active[low[0]:high[0], low[1]:high[1], low[2]:high[2]].all(), place
        assert (listed_cells(state) == active).all()
        for times in (listed_cells(state, 1), listed_cells(state, 2)):
            # a column may take in a few inactive cells, but walks no active one twice and leaves none out
            assert (times[active.astype(bool)] == 1).all()
            assert times.sum() <= 1.25 * active.sum()


def test_an_empty_box_has_no_active_cell_and_material_is_not_missed_after_rest():
    """Material that was put into a resting box is found after ``everything_active``; fails when it sets zeros."""
    state = make_setup(CELLS, MODEL).state
    assert state.run_count == 0
    assert state.active_cells() == 0
    state.owned("mass")[4, 4, 30] = 1.0
    state.everything_active()
    state.update_activity()
    assert 0 < state.active_cells() < np.prod(CELLS) // 4


def test_material_that_arrives_from_another_rank_is_noticed():
    """It comes into the ghosts of blocks at rest, on any side; all that it can reach must become active.

    Fails when ``or outside or first < ghosts`` of ``mark_material`` is dropped.
    """
    for axis in range(3):
        for layer in (0, -1):
            state = make_setup(CELLS, MODEL).state
            place = [5, 5, 5]
            place[axis] = range(state.part.cell_shape[axis])[2 if layer == 0 else -3]
            state.views["mass"][tuple(place)] = 0.3
            state.update_activity()
            low, high = np.maximum(np.array(place) - 1, 0), np.minimum(np.array(place) + 3, state.part.cell_shape)
            reached = active_cells(state)[tuple(slice(a, b) for a, b in zip(low, high))]
            assert reached.all(), (axis, layer)


def test_blocks_that_retire_are_zero(rng):
    """All arrays are filled, then the material goes: outside the active blocks every field is zero.

    Fails when ``f in range(nodes.size)`` or ``f in range(cells.size)`` of ``retire`` becomes empty.
    """
    state = make_setup(CELLS, MODEL).state
    state.views["mass"][...] = 1.0
    state.update_activity()
    for _ in range(5):
        state.pool.memory[...] = np.where(state.pool.memory == 0.0, 1.0, state.pool.memory)
        scatter(state, rng, 6)
        state.everything_active()
        state.update_activity()
        active = active_cells(state)
        assert 0 < active.sum() < active.size
        for view in state.views.values():
            cells = view[tuple(slice(0, n) for n in active.shape)]
            assert (cells[~active] == 0.0).all()
            if view.shape == active.shape:
                assert np.count_nonzero(cells[active]) or view is state.views["mass"]


def run_impact(steps):
    """Return all saved fields, the steps' sizes and the ledger after ``steps`` steps of two spheres that collide."""
    setup = make_setup((68, 11, 10), MODEL, [(22.1, 5.3, 4.9, 3.2), (48.1, 5.0, 5.2, 3.0)], (600.0, 20.0, -40.0),
                       sides=ALL_SYMMETRY | {"x_high": "free"})
    state = setup.state
    right = state.views["velocity_x"][:, :, 37:]
    right[...] = np.where(right > 0.0, -right, 0.0)
    state.exchange(state.ghosted)
    sizes, share = [], []
    for _ in range(steps):
        setup.advance(1)
        sizes.append(setup.clock.dt)
        share.append(state.active_cells())
    return {name: state.owned(name).copy() for name in state.saved}, sizes, setup.ledger.totals(), share


def test_skipping_void_changes_no_bit(monkeypatch):
    """Two spheres fly, collide and pass block borders: as with every block active, in every field and every step size.

    Fails when ``holds[kk, jj, b + 1] & 2`` or ``holds[kk, jj, b - 1] & 4`` of ``grow_active`` is dropped.
    """
    fields, sizes, totals, share = run_impact(200)
    assert fields["peeq"].max() > 0.1
    assert max(share) < 0.75 * 68 * 11 * 10
    monkeypatch.setattr(activity, "grow_active", lambda holds, active: active.fill(1))
    all_fields, all_sizes, all_totals, all_share = run_impact(200)
    assert min(all_share) == 68 * 11 * 10
    assert sizes == all_sizes
    assert totals == all_totals
    for name, field in fields.items():
        assert field.tobytes() == all_fields[name].tobytes(), name
