"""Decomposition and ghosts: every ghost is what its global index says, on any number of ranks and any process grid."""

from __future__ import annotations

import gc
import mmap
import weakref
from itertools import product

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, STANDARD_SIDES, make_model, make_setup

from f2s_hpc import mpi
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL, FIELDS, VELOCITY, needed
from f2s_hpc.grid import halo
from f2s_hpc.grid.box import GHOST, SIDES, Box
from f2s_hpc.grid.decomposition import Decomposition, process_grid
from f2s_hpc.state import ROOM, State

CELLS = (13, 14, 17)
MIXED = dict(zip(SIDES, ("symmetry", "outflow", "free", "fixed", "outflow", "free")))


@pytest.fixture(params=["in one message", "each in its own"])
def messages(request, monkeypatch):
    """Exchange all fields in one message per neighbour, or each in its own."""
    monkeypatch.setattr(halo, "PACKED", halo.PACKED if request.param == "in one message" else -1)


def process_grids():
    """Return all process grids of as many ranks as there are that leave slabs of at least ``GHOST`` cells."""
    ranks = mpi.size()
    return [grid for grid in product(range(1, ranks + 1), repeat=3)
            if np.prod(grid) == ranks and all(n // p >= GHOST for n, p in zip(CELLS, grid))]


def value_at(name, i, j, k):
    """Return a number, different for all fields and places, that float64 holds exactly."""
    return ((list(BY_NAME).index(name) * 64.0 + k) * 64.0 + j) * 64.0 + i + 1.0


def source(index, count, on_nodes, low, high, sign):
    """Return where ghosts of one axis come from and the factor they take, after the sides' rules."""
    last = count if on_nodes else count - 1
    of, factor = index.copy(), np.ones(index.size)
    for outside, kind, edge, image in ((index < 0, low, 0, -index - (0 if on_nodes else 1)),
                                       (index > last, high, last, 2 * last - index + (0 if on_nodes else 1))):
        if kind in ("symmetry", "fixed"):
            of, factor = np.where(outside, image, of), np.where(outside, sign, factor)
        else:
            of = np.where(outside, edge, of)
            factor = np.where(outside, 1.0 if on_nodes else 0.0, factor)
    return of, factor


def expected(state, name):
    """Return the field's local array, ghosts included, from the global indices."""
    field, part = BY_NAME[name], state.part
    on_nodes = field.location != CELL
    shape = part.node_shape if on_nodes else part.cell_shape
    places, factors = [], []
    for axis, side in enumerate(("x", "y", "z")):
        index = np.arange(shape[2 - axis]) - GHOST + part.start[axis]
        kinds = state.boundary.kinds
        of, factor = source(index, part.box.cells[axis], on_nodes, kinds[f"{side}_low"], kinds[f"{side}_high"],
                            field.mirror_sign[axis])
        places.append(of.astype(float))
        factors.append(factor)
    k, j, i = np.meshgrid(places[2], places[1], places[0], indexing="ij")
    return value_at(name, i, j, k) * np.einsum("k,j,i->kji", *factors[::-1])


@pytest.mark.mpi
@pytest.mark.parametrize("sides", [ALL_SYMMETRY, STANDARD_SIDES, MIXED], ids=["mirrors", "standard", "mixed"])
@pytest.mark.usefixtures("messages")
def test_ghosts_are_what_their_global_index_says(sides):
    """All fields, all process grids of this many ranks: faces, edges, corners, mirror signs, copies and voids.

    Fails when ``BOX`` of the DMDAs becomes ``STAR`` or
    ``layer - 1`` of ``fill_side`` becomes ``layer``.
    """
    for grid in process_grids():
        state = State(Decomposition(Box(CELLS, 1e-6), grid), sides, needed(True))
        part = state.part
        for name in state.ghosted:
            state.views[name][...] = np.nan
            state.owned(name)[...] = expected(state, name)[
                part.owned_cells if BY_NAME[name].location == CELL else part.owned_nodes]
        state.exchange(state.ghosted)
        for name in state.ghosted:
            wanted, found = expected(state, name), state.views[name]
            if BY_NAME[name].location != CELL:
                # on inner ranks the node arrays have a spare layer, so that they have one size on all ranks
                natural = tuple(slice(0, n + 2 * GHOST) for n in part.node_count[::-1])
                wanted, found = wanted[natural], found[natural]
            assert np.array_equal(found, wanted), (grid, name)


@pytest.mark.mpi
@pytest.mark.usefixtures("messages")
def test_exchange_touches_only_the_named_fields():
    """Fails when ``Pool._packed``, or ``_plan``, runs over ``self.names``."""
    state = State(Decomposition(Box(CELLS, 1e-6)), MIXED, needed(False))
    for name in state.ghosted:
        state.views[name][...] = np.nan
        state.owned(name)[...] = 1.0
    state.exchange(("mass", "velocity_y"))
    for name in state.ghosted:
        # all but the spare layer of the node arrays of inner ranks
        filled = state.views[name][tuple(slice(0, n + 2 * GHOST) for n in state.part.count[::-1])]
        untouched = np.count_nonzero(np.isnan(state.views[name])) == state.views[name].size - state.owned(name).size
        assert untouched if name not in ("mass", "velocity_y") else not np.isnan(filled).any()


@pytest.mark.mpi
@pytest.mark.usefixtures("messages")
def test_only_ghosts_up_to_the_highest_material_are_exchanged(monkeypatch):
    """On all process grids, for cells and nodes; fails when ``top`` of ``GhostMap.part`` is taken for a global one."""
    monkeypatch.setattr(halo, "HEADROOM", 1)
    monkeypatch.setattr(halo, "STRIDE", 2)
    for grid in process_grids():
        state = State(Decomposition(Box(CELLS, 1e-6), grid), ALL_SYMMETRY, needed(False))
        part, names = state.part, ("mass", "velocity_x")
        for highest, limit in ((3, 7), (5, 7), (6, 10)):  # one plane more, and two more at once when it grows
            state.pool.cover(highest)
            for name in names:
                state.views[name][...] = np.nan
                state.owned(name)[...] = 1.0
            state.pool.exchange(names)
            for name in names:
                nodes = int(BY_NAME[name].location != CELL)
                counts = part.node_count if nodes else part.count
                index = [np.arange(n + 2 * GHOST) - GHOST + s for n, s in zip(counts, part.start)]
                inside = [(i >= 0) & (i < n + nodes) for i, n in zip(index, CELLS)]
                inside[2] &= index[2] < limit + nodes
                owned = [(i >= s) & (i < s + n) for i, s, n in zip(index, part.start, counts)]
                filled = np.einsum("k,j,i->kji", *inside[::-1]) | np.einsum("k,j,i->kji", *owned[::-1])
                found = state.views[name][tuple(slice(0, n) for n in filled.shape)]
                assert np.array_equal(~np.isnan(found), filled), (grid, name, highest)
        state.pool.cover_all()
        state.pool.exchange(names)
        assert state.pool.top is None


@pytest.mark.mpi
def test_memory_of_work_fields_is_given_back_and_no_other():
    """Big enough that each field has pages of its own; fails when ``give_back`` rounds its first page down."""
    state = State(Decomposition(Box((40, 40, 40), 1e-6)), MIXED, needed(False))
    for view in state.views.values():
        view[...] = 3.0
    state.release_work()
    saved = {f.name for f in state.fields if f.saved}
    for name, view in state.views.items():
        if name in saved:
            assert (view == 3.0).all()
        else:
            assert np.count_nonzero(view) <= 2 * mmap.PAGESIZE // 8
            assert (view[1] != 3.0).any()
    state.views["force_x"][...] = 2.0  # it can be written again
    assert (state.views["force_x"] == 2.0).all()


@pytest.mark.mpi
def test_memory_of_rows_far_from_material_is_given_back_and_no_other():
    """Fails when ``release_empty`` keeps no ``ROOM``, forgets the row of nodes more, or takes axis j for k."""
    state = State(Decomposition(Box((40, 40, 40), 1e-6)), MIXED, needed(False))
    for view in state.views.values():
        view[...] = 3.0
    state.active[:] = 0
    ny = state.active.shape[1]
    state.active[:10] = 1
    state.active[30, ny - 1, 0] = 1
    state.release_empty()
    for view in state.views.values():
        assert (view[:10 + ROOM] == 3.0).all()
        assert (view[30 - ROOM:31 + ROOM, ny - 1 - ROOM:] == 3.0).all()
        for planes in (slice(16, 24), slice(38, None)):
            kept = np.count_nonzero(view[planes])
            assert kept < 2 * mmap.PAGESIZE // 8
        assert np.count_nonzero(view[30, :ny - 5 - ROOM]) < 2 * mmap.PAGESIZE // 8


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [CELLS, (12, 12, 12), (31, 13, 14)])
def test_every_cell_and_node_has_one_owner(cells):
    """Fails when ``self.at_high`` in ``Part.node_count`` becomes ``self.at_low``: the extra node goes to the first."""
    for location in ("cell", "node"):
        part = Decomposition(Box(cells, 1e-6)).part
        count = part.count if location == "cell" else part.node_count
        owned = np.zeros(tuple(n + (location == "node") for n in cells[::-1]), dtype=np.int64)
        owned[tuple(slice(s, s + n) for s, n in zip(part.start[::-1], count[::-1]))] = 1
        assert (mpi.total(owned) == 1).all()
        assert min(part.count) >= GHOST


@pytest.mark.mpi
def test_walls_hold_their_velocities():
    """Normal velocity on mirrors, all on fixed sides, none on open ones; the share of the planes inside the box.

    Fails when ``free_motion[axis, axis, wall]`` becomes ``free_motion[axis, :, wall]``.
    """
    state = State(Decomposition(Box(CELLS, 1e-6)), MIXED, needed(False))
    for name in VELOCITY:
        state.views[name][...] = 1.0
    state.boundary.hold([state.views[name] for name in VELOCITY])
    low, high = state.part.at_low, state.part.at_high
    # x_low is a mirror, y_high is fixed, z is open
    assert (state.owned("velocity_x")[:, :-1, 0] == (0.0 if low[0] else 1.0)).all()
    assert (state.owned("velocity_y")[:, :-1, 0] == 1.0).all()
    for name in VELOCITY:
        assert (state.owned(name)[:, -1, 1:] == (0.0 if high[1] else 1.0)).all()
        assert (state.owned(name)[:, :-1, 1:] == 1.0).all()
    weights = [w[GHOST:GHOST + n] for w, n in zip(state.boundary.weights, state.part.node_count)]
    assert weights[0][0] == (0.5 if low[0] else 1.0)
    assert weights[1][0] == 1.0
    assert weights[1][-1] == (0.5 if high[1] else 1.0)
    assert weights[2][0] == 1.0
    assert weights[2][-1] == 1.0


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [(2, 7, 5), (7, 5, 2), (1, 1, 1)])
def test_slabs_thinner_than_the_ghosts_are_refused_on_all_ranks(cells):
    """A thin box is for one rank only; fails when ``n // p < GHOST`` of ``process_grid`` becomes ``n // p < 1``."""
    if mpi.size() == 1:
        assert Decomposition(Box(cells, 1e-6)).part.count == cells
        return
    with pytest.raises(InputError, match=" x ".join(map(str, cells))) as caught:
        Decomposition(Box(cells, 1e-6))
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    assert len(set(mpi.all_gather(str(caught.value)))) == 1


@pytest.mark.mpi
def test_a_process_grid_with_thin_slabs_is_refused():
    """Fails without the check of ``min(r) < GHOST``."""
    if mpi.size() == 1:
        assert Decomposition(Box((2, 9, 9), 1e-6), (1, 1, 1)).part.count == (2, 9, 9)
        return
    with pytest.raises(InputError, match=f"thinner than {GHOST} cells"):
        Decomposition(Box((2 * mpi.size(), 9, 9), 1e-6), (mpi.size(), 1, 1))


@pytest.mark.parametrize(("cells", "ranks", "grid"), [
    ((117, 117, 200), 1, (1, 1, 1)),
    ((117, 117, 200), 4, (2, 2, 1)),
    ((117, 117, 200), 16, (4, 4, 1)),
    ((300, 30, 200), 4, (4, 1, 1)),
    ((30, 300, 200), 4, (1, 4, 1)),
    ((200, 100, 400), 8, (4, 2, 1)),
    ((8, 9, 400), 8, (2, 2, 2)),
    ((3, 3, 40), 5, (1, 1, 5)),
])
def test_process_grids_have_the_smallest_surface_and_whole_columns(cells, ranks, grid):
    """Fails when ``shape[2]`` is left out of ``rating``, or ``surface`` is."""
    assert process_grid(Box(cells, 1e-6), ranks) == grid


@pytest.mark.parametrize(("cells", "ranks"), [((5, 5, 5), 2), ((9, 9, 9), 64), ((30, 3, 3), 11), ((30, 30, 30), 11)])
def test_too_many_ranks_are_refused_with_a_way_out(cells, ranks):
    """11 ranks need one axis of 44 cells; fails when ``best is None`` falls through to ``(ranks, 1, 1)``."""
    with pytest.raises(InputError, match=f"{ranks} blocks of at least {GHOST} cells a side; use fewer ranks"):
        process_grid(Box(cells, 1e-6), ranks)


def test_the_mirror_turns_what_is_odd_behind_a_wall():
    """Normal velocity and the two shears with the normal, nothing else; fails when any sign in ``FIELDS`` is turned."""
    odd = [{"velocity_x", "stress_xy", "stress_xz"}, {"velocity_y", "stress_xy", "stress_yz"},
           {"velocity_z", "stress_yz", "stress_xz"}]
    for field in FIELDS:
        assert [sign == -1 for sign in field.mirror_sign] == [field.name in names for names in odd], field.name


def test_the_memory_of_a_box_is_given_back_with_it():
    """Cases that run one box after the other need memory for one. Fails when ``_living`` keeps the pools themselves."""
    setup = make_setup((16, 16, 16), make_model(3e-6), substrate=8)
    setup.advance(2)
    pool = weakref.ref(setup.state.pool)
    del setup
    gc.collect()
    assert pool() is None
