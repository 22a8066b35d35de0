"""Sleeping depth: only what is deep and at rest, not a bit of it moves, nothing is lost, and it wakes."""

from __future__ import annotations

import pathlib
import shutil

import numpy as np
import pytest
from conftest import f2s
from solver_setup import ALL_SYMMETRY, cell_coordinates, make_block, make_model, make_setup

from f2s_hpc import mpi
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.simulation import Simulation
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL, VELOCITY
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver import sleep
from f2s_hpc.solver.step import advance
from f2s_hpc.verify.scenes import write_scene

DX = 3e-6
DEPTH = 8
CELLS = (20, 20, 48)
GROUND = 26
MODEL = make_model(DX)
SLEEPING = make_model(DX, sleeping_depth=DEPTH * DX)


def impact(model, steps, grid=None):
    """Return a box after ``steps`` steps of a sphere's fall onto a deep substrate, and its balance."""
    setup = make_setup(CELLS, model, [(9.3, 10.4, GROUND + 3.2, 3.0)], (30.0, -20.0, -600.0), 700.0, GROUND, grid=grid)
    substrate = measure.material_quanta(setup.state, setup.model) - setup.ledger.totals()["mass_painted"]
    setup.advance(steps)
    return setup, measure.measure_balance(setup.state, setup.model, setup.ledger, substrate)


def whole(state, name):
    """Return the bits of a field of the whole box, as integers [k, j, i], on every rank."""
    part = state.part
    on_cells = BY_NAME[name].location == CELL
    array = np.zeros(part.box.shape if on_cells else part.box.node_shape, dtype=np.int64)
    count = part.count if on_cells else part.node_count
    place = tuple(slice(s, s + n) for s, n in zip(part.start[::-1], count[::-1]))
    array[place] = np.ascontiguousarray(state.owned(name)).view(np.int64)
    return mpi.total(array)


@pytest.mark.mpi
def test_every_process_grid_gives_the_same_bits():
    """Cut along x, y or z, through the floor or not: the same floor, fields, steps and ledger.

    Fails when ``hold_floor`` leaves out planes that are ghosts (``0 <= plane`` becomes ``GHOST < plane``), or when
    ``conduct_asleep`` leaves out ``state.exchange``.
    """
    ranks = mpi.size()
    found = []
    for grid in ((1, 1, ranks), (1, ranks, 1), (ranks, 1, 1)):
        setup, balance = impact(SLEEPING, 150, grid)
        state = setup.state
        found.append((state.floor, setup.clock.dt, balance, {name: whole(state, name) for name in state.saved}))
    assert 0 < found[0][0] < GROUND
    for floor, dt, balance, fields in found[1:]:
        assert (floor, dt, balance) == found[0][:3]
        for name, bits in fields.items():
            assert (bits == found[0][3][name]).all(), name


def test_what_sleeps_stays_as_it_is_and_costs_nothing():
    """Below the floor no field but temperature changes any more, in a step that flows above; fewer cells are stepped.

    Fails when ``first_plane`` is ``GHOST``, or when ``_stop`` leaves the velocities.
    """
    setup, _ = impact(SLEEPING, 101)
    state = setup.state
    k = state.part.owned_cells[0].start + state.floor
    assert 4 <= state.floor <= GROUND - DEPTH
    before = {name: view[:k].copy() for name, view in state.views.items() if name in state.saved}
    del before["temperature"]
    peeq = (state.owned("mass") * state.owned("peeq")).sum()
    steps = setup.clock.active_cell_steps
    setup.advance(15)
    assert (state.owned("mass") * state.owned("peeq")).sum() > peeq
    for name, planes in before.items():
        assert (state.views[name][:k] == planes).all(), name
    for name in VELOCITY:
        assert not state.views[name][:k + 1].any()
        assert state.views[name][k + 1].any()
    assert np.prod(CELLS[:2]) * (GROUND - state.floor) <= (setup.clock.active_cell_steps - steps) / 15
    assert (setup.clock.active_cell_steps - steps) / 15 < np.prod(CELLS[:2]) * (GROUND - state.floor + 13)


@pytest.mark.mpi
def test_the_balance_still_closes():
    """Mass is kept, and the energy that nothing explains is as small as without sleep.

    Fails when ``_stop`` returns 0, or when ``elastic_quanta`` takes ``state.cell_window()`` as it is.
    """
    boxes = [impact(MODEL, 140)[0] for _ in range(2)]
    boxes[1].model = SLEEPING._replace(settings=SLEEPING.settings._replace(rest_speed=100.0))
    balances = []
    for setup in boxes:
        setup.advance(160)
        balances.append(measure.measure_balance(setup.state, setup.model, setup.ledger, 0)["energy"])
    full, sleeping = balances
    assert boxes[1].state.floor > 0
    assert sleeping["put_to_sleep"] > 1e-5 * full["brought_in"]
    assert full["put_to_sleep"] == 0.0
    assert abs(sleeping["remainder"] - full["remainder"]) < 5e-7 * full["brought_in"]
    assert np.isclose(sleeping["plastic_work"], full["plastic_work"], rtol=0.02)
    drifts = [impact(model, 100)[1]["mass_drift_relative"] for model in (MODEL, SLEEPING)]
    assert abs(drifts[1]) < 2.0 * abs(drifts[0]) + 1e-12


def test_heat_flows_in_what_sleeps_and_through_the_floor():
    """A resting block with a hot layer on the floor: heat is kept, and the profile is as without sleep.

    Fails when ``conduct`` lets the floor row conduct downwards too (its share 0.0 becomes 1.0), or when
    ``conduct_asleep`` does nothing.
    """
    boxes = []
    for model in (MODEL, SLEEPING):
        setup = make_block((5, 5, 24), model, sides=ALL_SYMMETRY)
        z = cell_coordinates(setup.state)[2]
        setup.state.views["temperature"][...] = 300.0 + 400.0 * (np.abs(z - 16.0) < 2.0)
        setup.advance(161)
        boxes.append(setup)
    sleeping = boxes[1]
    assert sleeping.state.floor == 16
    heats = [float((b.state.owned("mass") * b.state.owned("temperature")).sum()) for b in boxes]
    assert np.isclose(*heats, rtol=1e-12, atol=0.0)
    profiles = [b.state.owned("temperature")[:, 2, 2] for b in boxes]
    assert profiles[0][13] > 301.0
    assert np.abs(profiles[0] - profiles[1]).max() < 5.0


def test_it_wakes_when_flow_comes_near():
    """Nodes just above the floor get fast: it falls, and the cells that woke move again.

    Fails when ``find_floor`` takes the largest of the two floors always.
    """
    setup, _ = impact(SLEEPING, 101)
    state = setup.state
    floor = state.floor
    assert floor >= 4
    k = state.part.owned_nodes[0].start + floor
    state.views["velocity_z"][k + 2] = -400.0
    state.exchange(VELOCITY)
    setup.advance(30)
    assert state.floor <= floor - sleep.MARGIN
    assert state.views["velocity_z"][k - 2].any()
    assert not state.views["velocity_z"][k + state.floor - floor].any()


def test_pressure_keeps_awake_and_the_floor_goes_on_rising():
    """Nothing moves, but one plane is under pressure, as where a wave is thrown back.

    Fails when ``_planes`` takes speed alone, or ``find_floor`` takes what sleeps already for the surface (without
    ``low[:state.floor] = False``).
    """
    setup = make_block((5, 5, 24), SLEEPING, sides=ALL_SYMMETRY)
    state = setup.state
    assert sleep.find_floor(state, SLEEPING) == 24 - DEPTH
    state.set_floor(5)
    assert sleep.find_floor(state, SLEEPING) == 24 - DEPTH
    state.owned("mass")[15] = 1.01
    state.exchange(("mass",))
    assert sleep.find_floor(state, SLEEPING) == 14


def test_what_wakes_has_the_heat_of_the_time_that_it_slept():
    """Fails when ``wake_for`` leaves ``_conduct_asleep`` out: heat would stand still since the last look."""
    setup = make_block((5, 5, 24), SLEEPING, sides=ALL_SYMMETRY)
    state, asleep = setup.state, sleep.Sleep()
    state.owned("temperature")[4] = 900.0
    state.exchange(("temperature",))
    state.set_floor(16)
    sleep.wake_for(state, SLEEPING, asleep, 1e-7, 16 * DX)
    assert (asleep.since, state.floor) == (1e-7, 16 - sleep.MARGIN)
    assert state.owned("temperature")[4].max() < 899.0
    assert state.owned("temperature")[5].min() > 298.5


def test_material_that_is_put_in_wakes_what_it_may_meet(tmp_path):
    """Spheres that land on a floor just under the surface, as in a pit: it falls below them before they are painted.

    Fails when ``Supply.land`` leaves ``wake_for`` out.
    """
    scene = parse_scene(SCENE, "deep")
    simulation = Simulation(scene, tmp_path, make_batches(scene))
    simulation.begin()
    simulation.insert()
    state, clock, ground = simulation.state, simulation.clock, 16
    state.set_floor(ground - 1)
    waiting = simulation.supply.flight.count
    simulation.supply.land()
    while simulation.supply.flight.count == waiting:
        assert state.floor == ground - 1
        advance(state, simulation.model, clock, simulation.ledger, 60e-9)
        simulation.supply.land()
    assert ground - sleep.MARGIN <= state.floor < ground - 1
    assert not state.views["velocity_z"][:state.part.owned_nodes[0].start + state.floor + 1].any()


def test_a_depth_of_few_cells_is_refused():
    """Fails when ``_check_sleep`` is not called."""
    def scene(depth):
        return write_scene((20, 20, 40), DX, "copper-ge", 600.0, 1e-7, spheres=[(30e-6, 30e-6, 15e-6, 9e-6)],
                           substrate=20, overrides=(f"numerics.sleeping_depth={depth} um",))

    assert scene(24).numerics.sleeping_depth == 24e-6
    with pytest.raises(InputError, match=r"numerics\.sleeping_depth.*at least 8 cells \(24 um\)"):
        scene(23)


# a substrate that is deep enough to sleep under the impacts
SCENE = """
title = "Impacts on a deep substrate"
domain = { size = ["84 um", "66 um", "240 um"], cell_size = "6 um", substrate_height = "96 um", \
particle_layer_height = "144 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC", direction = [0.1, -0.05, -1.0] }
batches = { count = 2, particles = 8, seed = 3, diameter_min = "14 um", diameter_d10 = "20 um", \
diameter_d50 = "30 um", diameter_d90 = "42 um", diameter_max = "48 um" }
cycles = { count = 2, duration = "60 ns" }
numerics = { sleeping_depth = "48 um" }
output = { picture = false }
"""


@pytest.fixture(scope="module")
def one_rank(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the folder of a run on one rank; the scene file lies beside it."""
    folder = tmp_path_factory.mktemp("sleep")
    (folder / "deep.toml").write_text(SCENE, encoding="utf-8")
    f2s("run", "deep.toml", "--out", "on-1", cwd=folder)
    return folder / "on-1"


@pytest.mark.parametrize("ranks", [2, 4])  # (3: the next test)
def test_any_number_of_ranks_gives_the_same_bits(one_rank, ranks):
    """Fails when ``_planes`` leaves out ``mpi.maximum`` (take ``square`` itself)."""
    folder = one_rank.parent
    f2s("run", "deep.toml", "--out", f"on-{ranks}", ranks=ranks, cwd=folder)
    assert "identical in every saved bit" in f2s("compare", "on-1", f"on-{ranks}", "--exact", cwd=folder).stdout


def test_resumed_it_sleeps_on(one_rank, tmp_path):
    """From the checkpoint after the first cycle, on three ranks: the same bits as the run that went on.

    Fails when ``Simulation._restore`` leaves ``set_floor`` out.
    """
    summary = runs.read_summary(one_rank)
    assert summary["peeq_max"] > 0.3
    assert summary["energy"]["put_to_sleep"] > 0.0
    copy = tmp_path / "copy"
    shutil.copytree(one_rank, copy)
    first, last = list_checkpoints(copy / layout.CHECKPOINTS)
    last.unlink()
    last.with_suffix(".json").unlink()
    assert f"resuming from {first}" in f2s("resume", copy, ranks=3, cwd=tmp_path).stdout
    assert "identical in every saved bit" in f2s("compare", one_rank, copy, "--exact", cwd=tmp_path).stdout
