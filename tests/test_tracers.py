"""Tracers: seeded evenly, moved with the material."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, make_block, make_model, make_setup, node_coordinates

from f2s_hpc import mpi
from f2s_hpc.analysis.flattening import LEAST_POINTS, flattening_from_points
from f2s_hpc.cli.main import main
from f2s_hpc.config.sections import LEAST_TRACERS
from f2s_hpc.cycles.tracers import SORTED, TOGETHER, Tracers
from f2s_hpc.fields import VELOCITY
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.tracers import read_tracers
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.cloud import unit_ball
from f2s_hpc.solver.step import advance

DX = 3e-6


def positions(tracers: Tracers, state) -> np.ndarray:
    """Return the places of all points in the order of their numbers, (n, 3), on every rank."""
    return np.concatenate(mpi.all_gather(tracers.cloud_at(state, 0.0).position))


def follow(setup, tracers: Tracers, remaps: int) -> None:
    """Advance by so many remaps, and the tracers with it."""
    end = setup.clock.remaps + remaps
    while setup.clock.remaps < end:
        advance(setup.state, setup.model, setup.clock, setup.ledger, 1.0, None,
                lambda dt, displaced: tracers.move(setup.state, dt, displaced, setup.clock.remaps))


# --- seeding ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [10, 50, 200, 1000])
def test_points_stand_for_equal_volumes_of_the_ball(count):
    """Second moments 1/5 in closed form; fails if the radii go with number / count instead of its cube root."""
    points = unit_ball(count)
    assert points.shape == (count, 3)
    assert points.mean(axis=0) == pytest.approx(0.0, abs=1e-14)
    assert points.T @ points / count == pytest.approx(np.eye(3) / 5.0, abs=1e-14)
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() < (1.04 if count < 100 else 1.001)
    if count >= 200:
        for inner in (0.3, 0.5, 0.7, 0.9):
            assert (radius < inner).mean() == pytest.approx(inner**3, abs=0.02)
        # as many in each octant
        octant = (points > 0.0) @ [1, 2, 4]
        assert np.bincount(octant, minlength=8) / count == pytest.approx(1.0 / 8.0, abs=0.02)


def test_the_scene_and_the_analysis_agree_on_the_fewest_points():
    assert LEAST_TRACERS == LEAST_POINTS


@pytest.mark.mpi
def test_a_sphere_cut_by_a_side_keeps_its_points_inside_and_is_marked():
    """Fails if ``seed`` keeps points beyond the side, or calls a sphere cut that only touches it."""
    setup = make_setup((16, 12, 20), make_model(DX))
    tracers = Tracers(200, setup.state)
    r = 3.0 * DX
    tracers.seed(Batch(*np.array([[3.0 * DX, 6 * DX, 8 * DX, r], [1.0 * DX, 6 * DX, 14 * DX, r]]).T), 2e-7)
    tracers.seed(Batch(*np.array([[10.0 * DX, 6 * DX, 8 * DX, r]]).T), 3e-7)
    assert tracers.particles.cut.tolist() == [False, True, False]
    assert tracers.particles.time.tolist() == [2e-7, 2e-7, 3e-7]
    assert tracers.first[2] - tracers.first[1] == pytest.approx(200 * 0.741, abs=4)  # a cap of 2/3 r is 7/27 of it
    assert tracers.count == tracers.first[2] + 200
    assert mpi.total(np.int64(tracers.number.size)) == tracers.count
    places = positions(tracers, setup.state)
    assert (places >= 0.0).all()
    found = flattening_from_points(np.repeat([0, 1], 200), np.concatenate([places[:200], places[-200:]]),
                                   np.array([2 * r, 2 * r]))
    assert found.width == pytest.approx(2 * r, rel=1e-12)
    assert found.height == pytest.approx(2 * r, rel=1e-12)


# --- motion -----------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_in_free_flight_points_keep_their_relative_places():
    """x + v t to round-off, through many cells, sortings and ranks; fails if a point is lost or doubled on its way."""
    model, velocity = make_model(DX), (90.0, -60.0, -600.0)
    setup = make_setup((20, 20, 44), model, [(8.0, 12.0, 38.0, 4.0)], velocity)
    tracers = Tracers(100, setup.state)
    tracers.seed(setup.report.positions, 0.0)
    before = positions(tracers, setup.state)
    follow(setup, tracers, SORTED + 4 * TOGETHER)
    way = np.array(velocity) * setup.clock.in_cycle
    assert abs(way[2]) > 4.5 * DX
    assert np.abs(positions(tracers, setup.state) - before - way).max() < 1e-10 * DX
    assert tracers.census(setup.state) == {"tracers": 100, "tracers_in_void": 0, "tracers_outside": 0}


@pytest.mark.mpi
@pytest.mark.parametrize("displaced", [False, True])
def test_a_known_strain_field_moves_points_by_the_closed_form(displaced):
    """With nodes displaced by D x and then moving with v = G x a step h takes x to x (1 + D + h G).

    Fails if ``move_points`` mixes up axes or corners, or leaves out the displacement, or always adds it.
    """
    setup = make_block((16, 16, 20), make_model(DX))
    state, step = setup.state, 1e-9
    gradient = 1e7 * np.array([[1.0, 0.6, -0.2], [-0.9, -0.7, 0.4], [0.3, 0.5, -1.1]])
    before = 1e-2 * np.array([[0.4, -0.3, 0.1], [0.5, -0.2, 0.6], [-0.7, 0.8, -0.4]])
    centre = np.array([8.0, 8.0, 10.0])
    places = [a - c for a, c in zip(node_coordinates(state), centre)]
    for axis, letter in enumerate("xyz"):
        state.views[f"velocity_{letter}"][...] = DX * sum(g * a for g, a in zip(gradient[axis], places))
        state.views[f"displacement_{letter}"][...] = sum(d * a for d, a in zip(before[axis], places))
    tracers = Tracers(60, state)
    tracers.seed(Batch(*(np.array([a]) for a in (*centre * DX, 4.5 * DX))), 0.0)
    relative = positions(tracers, state) - centre * DX
    moved = np.eye(3) + step * gradient + (before if displaced else 0.0)
    for number in range(1, 9):
        tracers.move(state, step, displaced, number)
        relative = relative @ moved.T
    assert np.abs(positions(tracers, state) - centre * DX - relative).max() < 1e-11 * DX


@pytest.mark.mpi
def test_several_steps_to_a_remap_lead_where_single_ones_do():
    """A spinning sphere: each point by the same way, to second order. Fails if the last step stands for all of them."""
    found = []
    for steps in (1, 3):
        model = make_model(DX, steps_per_remap=steps, strain_per_remap=1.0)
        setup = make_setup((18, 18, 18), model, [(9.0, 9.0, 9.0, 5.0)])
        x, y, _ = (a - 9.0 for a in node_coordinates(setup.state))
        moves = setup.state.views["nodal_mass"] > 0.0
        setup.state.views["velocity_x"][...] = np.where(moves, -8.0 * y, 0.0)
        setup.state.views["velocity_y"][...] = np.where(moves, 8.0 * x, 0.0)
        setup.state.exchange(VELOCITY)  # nodal masses are not valid in ghosts
        tracers = Tracers(80, setup.state)
        tracers.seed(setup.report.positions, 0.0)
        start = positions(tracers, setup.state)
        while setup.clock.in_cycle < 40e-9 * (1.0 - 1e-12):
            advance(setup.state, setup.model, setup.clock, setup.ledger, 40e-9, None,
                    lambda dt, displaced, s=setup, t=tracers: t.move(s.state, dt, displaced, s.clock.remaps))
        found.append(positions(tracers, setup.state) - start)
        assert setup.clock.remaps < setup.clock.steps or steps == 1
    assert np.abs(found[0]).max() > 0.4 * DX
    assert np.abs(found[1] - found[0]).max() < 2e-3 * np.abs(found[0]).max()


@pytest.mark.mpi
def test_in_void_cells_points_follow_the_nodes_that_have_mass():
    """Fails if void nodes, at rest, count: the point just above the surface would lag; or if the far one moves."""
    setup = make_setup((12, 16, 16), make_model(DX), substrate=8.0, sides=ALL_SYMMETRY)
    state = setup.state
    z = node_coordinates(state)[2]
    state.views["velocity_z"][...] = np.where(z <= 8.0, -100.0, 0.0)
    tracers = Tracers(10, state)
    tracers.cloud = np.zeros((1, 3))
    places = np.array([[5.5, 5.5, 8.7], [5.5, 5.5, 4.2], [5.5, 9.5, 12.0]]) * DX
    tracers.seed(Batch(*places.T, np.full(3, 1e-9)), 0.0)
    tracers.move(state, 1e-9, False, TOGETHER)
    moved = positions(tracers, state) - places
    assert moved[:, 2] == pytest.approx([-1e-7, -1e-7, 0.0], rel=1e-9, abs=0.0)
    assert tracers.census(state) == {"tracers": 3, "tracers_in_void": 2, "tracers_outside": 0}


@pytest.mark.mpi
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("displaced", [False, True])
def test_in_a_cell_with_a_free_surface_void_closes_and_not_the_material(axis, displaced):
    """Nodes on the void side come down, all stretch sideways by g: a point h above the inner face moves by - h g.

    Fails without ``_beside_void``: the point would follow the nodes of the void side.
    """
    setup = make_setup((18, 18, 18), make_model(DX), sides=ALL_SYMMETRY)
    state, stretch = setup.state, 0.04
    places = np.broadcast_arrays(*node_coordinates(state))
    cells = places[axis][:-1, :-1, :-1]  # low corners
    state.views["mass"][...] = np.where(cells < 8.5, 1.0, np.where(cells < 9.5, 0.5, 0.0))
    side = (axis + 1) % 3
    for number, letter in enumerate("xyz"):
        way = np.zeros_like(places[0])
        if number == axis:
            way[places[axis] > 9.5] = -0.1
        elif number == side:
            way = stretch * (places[side] - 9.0)
        # half of it before the last step
        state.views[f"velocity_{letter}"][...] = (0.5 if displaced else 1.0) * way * DX / 1e-9
        state.views[f"displacement_{letter}"][...] = 0.5 * way
    tracers = Tracers(10, state)
    tracers.cloud = np.zeros((1, 3))
    start = np.full((3, 3), 9.2)
    start[:, axis] = [9.3, 9.8, 8.9]  # in the material, above it, in the full cell below
    tracers.seed(Batch(*start.T * DX, np.full(3, 1e-9)), 0.0)
    tracers.move(state, 1e-9, displaced, TOGETHER)
    moved = positions(tracers, state) / DX - start
    assert moved[0, axis] == pytest.approx(0.3 * (-0.1) - 0.3 * (stretch - 0.1), rel=1e-9)
    assert moved[1, axis] == pytest.approx(0.8 * (-0.1), rel=1e-9)  # outside already, so no further
    assert moved[2, axis] == pytest.approx(0.0, abs=1e-12)
    assert moved[:, side] == pytest.approx(stretch * 0.2, rel=1e-9)


@pytest.mark.mpi
def test_no_point_passes_a_wall_and_one_that_left_is_counted():
    """Fails without the bounds of ``move_points``: in a void cell only the nodes with mass count, not the wall's."""
    sides = ALL_SYMMETRY | {"y_high": "free"}
    setup = make_setup((12, 16, 16), make_model(DX), sides=sides)
    state = setup.state
    state.views["mass"][...] = np.where((node_coordinates(state)[0][:, :, :-1] >= 1.0), 1.0, 0.0)
    state.views["velocity_x"][...] = -600.0
    state.views["velocity_y"][...] = 600.0
    tracers = Tracers(10, state)
    tracers.cloud = np.zeros((1, 3))
    tracers.seed(Batch(*(np.array([[0.1, 8.0, 8.2], [6.5, 15.9, 8.2]]) * DX).T, np.full(2, 1e-9)), 0.0)
    for number in range(1, 3):
        tracers.move(state, 1e-9, False, number)
    places = positions(tracers, state)
    assert places[0, 0] == 0.0
    assert places[1, 1] == pytest.approx(15.9 * DX + 6e-7)  # not moved on outside
    assert tracers.census(state) == {"tracers": 2, "tracers_in_void": 1, "tracers_outside": 1}


def test_tracers_have_the_width_of_the_material(tmp_path):
    """One splat, against the share of each cell that came with the particle, which the remap carries.

    Fails if points move with the velocity of the wrong time or place: give ``move_points`` half the step. Fails, by
    1.2 um at the surface, without ``_beside_void``.
    """
    run = tmp_path / "run"
    assert main(["run", "splat", "--out", str(run), "--set", "domain.cell_size=4 um", "--set", "output.tracers=3000",
                 "--set", "output.origin=true", "--set", "output.frame_interval=1 us", "--set",
                 "cycles.duration=60 ns", "--set", "output.picture=false"]) == 0
    arrays, attributes = runs.open_checkpoint_serial(list_checkpoints(run / layout.CHECKPOINTS)[-1])
    mass = arrays["mass"] * arrays["particle_fraction"]
    k, j, i = (np.indices(mass.shape) + 0.5) * 4e-6
    mean = [float((mass * a).sum() / mass.sum()) for a in (i, j, k)]
    spread = [float((mass * (a - m) ** 2).sum() / mass.sum()) for a, m in zip((i, j, k), mean)]
    cloud = read_tracers(run, attributes["cycle"])
    found = flattening_from_points(cloud.particle, cloud.position, cloud.particles.diameter)
    assert found.equation_5[0] > 2.0
    assert cloud.position[:, :2].mean(axis=0) == pytest.approx(mean[:2], abs=0.02e-6)
    assert cloud.position[:, 2].mean() == pytest.approx(mean[2], abs=0.4e-6)
    middle = arrays["volume_fraction"][:, 11:13, 11:13].mean(axis=(1, 2))
    above = np.abs(cloud.position[:, :2] - 48e-6).max(axis=1) < 4e-6
    assert cloud.position[above, 2].max() == pytest.approx(4e-6 * middle.sum(), abs=0.4e-6)
    assert found.width[0] == pytest.approx(2.0 * np.sqrt(2.5 * (spread[0] + spread[1])), rel=0.02)
    # the remap smears the boundary of the share by half a cell
    assert 0.0 < 2.0 * np.sqrt(5.0 * spread[2]) - found.height[0] < 4e-6
