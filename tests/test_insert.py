"""Painting: substrate and batches, exactly; on any number of ranks (each test also runs under mpirun)."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.config.load import parse_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import OVERFILL, InsertReport, mass_quanta, paint_batch, paint_substrate
from f2s_hpc.fields import BY_NAME, NODE, STRESS, VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.kernels import paint, remap
from f2s_hpc.particles.batch import Batch, clipped_volume, join

pytestmark = pytest.mark.mpi

DX = 3e-6
CELLS = (19, 17, 32)
SPEED = (60.0, -80.0, -600.0)
HOT_K = 723.15

SCENE = """
title = "An empty box"
domain = { size = ["57 um", "51 um", "96 um"], cell_size = "3 um", substrate_height = "9 um", \
particle_layer_height = "60 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC" }
batches = { spheres = [["20 um", "20 um", "20 um", "10 um"]] }
cycles = { count = 1, duration = "1 ns" }
"""


class Setup:
    """State, model and ledger of an empty box, and what the tests ask of them (collective)."""

    def __init__(self) -> None:
        self.scene: Scene = parse_scene(SCENE, "test")
        self.model = build_model(self.scene)
        self.state = build_state(self.scene)
        self.ledger = build_ledger(self.model)
        assert self.state.part.box.cells == CELLS

    def put(self, batch: Batch, bottom: float = 0.0, velocity: tuple[float, float, float] = SPEED) -> InsertReport:
        return paint_batch(self.state, self.model, batch, bottom, velocity, HOT_K, self.ledger, 7)

    def whole(self, name: str) -> np.ndarray:
        """Return the global array [k, j, i] of a field, on every rank."""
        part = self.state.part
        own = self.state.owned(name).copy()
        box = part.box.node_shape if BY_NAME[name].location == NODE else part.box.shape
        out = np.full(box, np.nan)
        for start, block in mpi.all_gather((part.start, own)):
            out[tuple(slice(s, s + n) for s, n in zip(start[::-1], block.shape))] = block
        assert not np.isnan(out).any()
        return out

    def volume(self) -> float:
        """Return the volume of all material (m3), from the global array."""
        return float(self.whole("mass").sum()) * DX**3


@pytest.fixture
def setup() -> Setup:
    return Setup()


def batch_of(*spheres: tuple[float, float, float, float]) -> Batch:
    """Return a batch of spheres given in micrometres."""
    return Batch(*(np.ascontiguousarray(column) * 1e-6 for column in np.array(spheres, dtype=float).T))


def volume_inside(batch: Batch, bottom: float = 0.0) -> float:
    return clipped_volume(Batch(batch.x, batch.y, batch.z + bottom, batch.r), *(n * DX for n in CELLS))


def nodal(setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return the momentum (full cells m/s, x y z) and the mass (full cells) of all nodes, wall nodes by their share."""
    state = setup.state
    state.everything_active()
    state.update_activity()
    remap.nodal_masses(*state.runs, state.node_window(), state.part.cell_shape[1:], state.flat["mass"],
                       state.flat["nodal_mass"])
    mass = setup.whole("nodal_mass")
    for axis in range(3):
        for plane in (0, -1):
            mass[(slice(None),) * axis + (plane,)] *= 0.5
    return np.array([(mass * setup.whole(name)).sum() for name in VELOCITY]), mass.sum()


@pytest.mark.parametrize(("height", "cells"), [(9e-6, 3.0), (10.1e-6, 10.1 / 3.0), (36e-6, 12.0),
                                               (6.900000000000001e-05, 23.0)])
def test_the_substrate_has_its_volume(setup, height, cells):
    """Fails if ``share[share < 1e-9] = 0.0`` is left out of ``paint_substrate`` (the last would be 24 layers)."""
    paint_substrate(setup.state, height, 298.15)
    mass = setup.whole("mass")
    assert np.isclose(mass.sum(), CELLS[0] * CELLS[1] * cells, rtol=1e-12, atol=0.0)
    layers = int(np.ceil(cells - 1e-9))
    assert np.allclose(mass[:int(cells + 1e-9)], 1.0, rtol=0.0, atol=1e-12)
    assert (mass[layers:] == 0.0).all()
    assert np.array_equal(setup.whole("volume_fraction"), mass)
    assert (setup.whole("temperature")[mass > 0.0] == 298.15).all()
    assert all((setup.whole(name) == 0.0).all() for name in (*VELOCITY, *STRESS, "peeq"))


def test_a_batch_has_its_clipped_volume_and_the_bits_of_one_rank(setup, rng):
    """Fails if a rank misses a sphere that reaches into its part: subtract 1 from ``i1`` in ``sphere_bounds``.

    The reference is painted on one array of the whole box.
    """
    grid = np.stack(np.meshgrid([1.0, 20.0, 38.0, 57.0], [0.0, 25.0, 50.0], [14.0, 34.0, 54.0, 74.0], indexing="ij"))
    places = grid.reshape(3, -1) + rng.uniform(-0.9, 0.9, (3, grid[0].size))
    batch = Batch(*(1e-6 * places), 1e-6 * rng.uniform(5.0, 8.5, grid[0].size))
    report = setup.put(batch, 8e-6)
    assert report.moved == 0
    assert report.spheres == batch.count
    wanted = volume_inside(batch, 8e-6)
    assert np.isclose(report.volume, wanted, rtol=1e-12, atol=0.0)
    assert np.isclose(setup.volume(), wanted, rtol=1e-12, atol=0.0)
    reference = np.zeros(CELLS[::-1])
    paint.add_spheres(batch.x, batch.y, batch.z + 8e-6, batch.r, (0, 0, 0), DX, reference)
    assert np.array_equal(setup.whole("mass"), reference)
    painted = setup.ledger.totals()["mass_painted"] * setup.model.mass_quantum * DX**3
    assert np.isclose(painted, wanted, rtol=1e-12, atol=0.0)


def test_walls_cut_spheres_and_mirror_them(setup):
    """Fails if ``state.exchange(state.ghosted)`` is dropped from ``insert._add``."""
    batch = batch_of((0.0, 0.0, 30.0, 12.0), (57.0, 20.0, 30.0, 9.0))
    setup.put(batch)
    ball = 4.0 / 3.0 * np.pi * 1e-18
    assert np.isclose(setup.volume(), ball * (12.0**3 / 4.0 + 9.0**3 / 2.0), rtol=1e-12, atol=0.0)
    state = setup.state
    mass, u, w = (state.views[n] for n in ("mass", "velocity_x", "velocity_z"))
    if state.part.at_low[0]:
        assert np.array_equal(mass[:, :, GHOST - 1::-1], mass[:, :, GHOST:2 * GHOST])
        assert (u[:, :, GHOST] == 0.0).all()
        assert np.array_equal(w[:, :, GHOST - 1::-1], w[:, :, GHOST + 1:2 * GHOST + 1])
        assert np.array_equal(u[:, :, GHOST - 1::-1], -u[:, :, GHOST + 1:2 * GHOST + 1])


def test_the_energy_brought_in_is_that_of_the_spheres(setup):
    """Fails if nodes on a wall count wholly: ``weights`` 1 instead of 1/2 in ``grid/boundary.py``."""
    batch = batch_of((0.0, 20.0, 30.0, 12.0), (40.0, 25.0, 60.0, 11.0))
    setup.put(batch, velocity=(0.0, 0.0, -615.0))
    brought = setup.ledger.totals()["brought_in"] * setup.model.energy_quantum
    wanted = 0.5 * setup.model.bulk.density * volume_inside(batch) * 615.0**2
    assert np.isclose(brought, wanted, rtol=1e-9, atol=0.0)


def test_merging_conserves_mass_momentum_and_heat(setup, rng):
    """Fails if new material replaces old: ``temperature[c] = new_temperature`` always, or ``share = 1`` at nodes.

    Both in ``kernels/paint.py`` (``merge_cells``, ``merge_nodes``). Fails too if what a wall cuts off is taken for
    what lies mirrored behind it: drop ``state.boundary.fill`` from ``insert._add``.
    """
    state, model = setup.state, setup.model
    paint_substrate(state, 25.5e-6, 298.15)
    cells = {"temperature": (300.0, 600.0), "peeq": (0.0, 3.0), "stress_xy": (-1e8, 1e8), "stress_zz": (-1e8, 1e8)}
    part = state.part
    for name, (low, high) in cells.items():
        values = rng.uniform(low, high, part.box.shape)[tuple(slice(s, s + n) for s, n in zip(part.start[::-1],
                                                                                            part.count[::-1]))]
        state.owned(name)[...] = np.where(state.owned("mass") > 0.0, values, 0.0)
    for name in VELOCITY:
        values = rng.uniform(-50.0, 50.0, part.box.node_shape)
        # walls hold: away from them the momentum of both is free
        values[:2], values[-2:], values[:, :2], values[:, -2:], values[:, :, :2], values[:, :, -2:] = (0.0,) * 6
        state.owned(name)[...] = values[tuple(slice(s, s + n) for s, n in zip(part.start[::-1],
                                                                             part.node_count[::-1]))]
    state.exchange(state.ghosted)
    before = {name: (setup.whole("mass") * setup.whole(name)).sum() for name in cells}
    momentum, mass = nodal(setup)
    batch = batch_of((28.0, 25.0, 37.5, 11.6), (12.0, 36.0, 66.0, 9.0), (5.0, 16.0, 37.5, 11.6))
    report = setup.put(batch)
    assert report.moved == 0
    added = report.volume / DX**3
    filled = setup.whole("mass")
    shared = (setup.whole("temperature") > 300.0) & (setup.whole("temperature") < HOT_K) & (setup.whole("peeq") > 0.0)
    assert ((filled > 0.5) & shared)[8].any()  # the half full layer has taken in a part of the first sphere
    after = {name: (setup.whole("mass") * setup.whole(name)).sum() for name in cells}
    assert np.isclose(after["temperature"], before["temperature"] + added * HOT_K, rtol=1e-12, atol=0.0)
    for name in ("peeq", "stress_xy", "stress_zz"):
        assert np.isclose(after[name], before[name], rtol=1e-11, atol=1e-12 * cells[name][1] * mass)
    new_momentum, new_mass = nodal(setup)
    assert np.isclose(new_mass, mass + added, rtol=1e-12, atol=0.0)
    # the wall that cuts the last sphere takes up momentum along its normal, x, and no other
    wanted = momentum + added * np.array(SPEED)
    assert np.allclose(new_momentum[1:], wanted[1:], rtol=0.0, atol=1e-11 * added * 600.0)
    assert np.isclose(setup.volume(), CELLS[0] * CELLS[1] * 8.5 * DX**3 + volume_inside(batch), rtol=1e-12, atol=0.0)
    assert model.dx == DX


def overlapping_spheres(setup: Setup) -> tuple[Batch, InsertReport, np.ndarray]:
    """Paint spheres, two of them cut by walls, where others are; return the batch, the report and the mass before."""
    setup.put(batch_of((24.0, 25.0, 30.0, 10.0), (2.0, 25.0, 32.0, 8.0), (50.0, 44.0, 40.0, 9.0)), 20e-6)
    before = setup.whole("mass")
    batch = batch_of((25.0, 24.0, 24.0, 9.0), (1.0, 22.0, 34.0, 7.0), (48.0, 47.0, 44.0, 8.0), (20.0, 8.0, 12.0, 6.0))
    return batch, setup.put(batch, 20e-6), before


def test_a_sphere_on_material_is_moved_until_no_cell_is_overfull(setup):
    """Fails if ``_overlaps`` looks at one rank's part only (no ``mpi.maximum``), or nothing is moved at all."""
    batch, report, before = overlapping_spheres(setup)
    assert before.max() <= 1.0 + 1e-12
    assert report.moved == 3
    assert report.spheres == 4
    assert report.deferred is None
    assert "3 spheres moved" in report.message()
    asked = np.array([batch.x, batch.y, batch.z + 20e-6])
    placed = np.array([report.positions.x, report.positions.y, report.positions.z])
    moves = np.linalg.norm(placed - asked, axis=0)
    assert np.isclose(report.largest_move, moves.max(), rtol=1e-12, atol=0.0)
    assert moves[3] == 0.0
    assert all(np.array_equal(placed, other) for other in mpi.all_gather(placed))
    reference = before.copy()
    paint.add_spheres(*placed, report.positions.r, (0, 0, 0), DX, reference)
    mass = setup.whole("mass")
    assert np.allclose(mass, reference, rtol=0.0, atol=1e-15)
    assert mass.max() <= OVERFILL
    gaps = np.linalg.norm(placed[:, :, None] - placed[:, None, :], axis=0) + np.diag([1.0] * 4)
    assert (gaps >= report.positions.r[:, None] + report.positions.r[None, :]).all()


def test_moving_spheres_neither_creates_nor_loses_mass(setup):
    """The painted volume is that of the batch as it was asked for, though two of the spheres are cut by a wall.

    Fails if a sphere that a wall cuts is moved along that wall's normal (``insert._proposal``).
    """
    batch, report, before = overlapping_spheres(setup)
    wanted = volume_inside(batch, 20e-6)
    assert np.isclose(report.volume, wanted, rtol=1e-12, atol=0.0)
    assert np.isclose(setup.volume(), before.sum() * DX**3 + wanted, rtol=1e-12, atol=0.0)


def test_a_sphere_without_a_free_place_waits(setup):
    """Fails if ``paint_batch`` paints blocked spheres, or drops them: return ``report`` without ``deferred``."""
    paint_substrate(setup.state, 87e-6, 298.15)
    before = {name: setup.whole(name) for name in setup.state.saved}
    batch = batch_of((25.0, 24.0, 20.0, 9.0), (5.0, 40.0, 30.0, 8.0))
    report = setup.put(batch, 36e-6)
    assert report.spheres == 0
    assert report.moved == 0
    assert report.volume == 0.0
    assert "2 spheres found no free place and wait for the next batch" in report.message()
    assert "2 spheres found no free place and are left out, as no batch follows" in report.message(last=True)
    for name in ("x", "y", "z", "r"):
        assert np.array_equal(getattr(report.deferred, name), getattr(batch, name))
    assert all(np.array_equal(setup.whole(name), array) for name, array in before.items())
    assert setup.ledger.totals()["mass_painted"] == 0
    assert setup.ledger.totals()["brought_in"] == 0
    # later, in a free box, they come in where they were asked for
    later = Setup()
    again = later.put(report.deferred, 36e-6)
    assert again.moved == 0
    assert np.isclose(again.volume, volume_inside(batch, 36e-6), rtol=1e-12, atol=0.0)


def test_a_sphere_that_waited_is_moved_out_of_the_batch_it_is_joined_to(setup):
    """The later one of the list is moved, wherever it would meet the other; what meets nothing keeps its very place.

    Fails if ``settle_in_order`` is left out of ``insert._free_places``: nothing is moved, and cells hold 2.
    """
    coming = batch_of((28.0, 25.0, 30.0, 8.0), (12.0, 12.0, 70.0, 9.0))
    waiting = batch_of((32.0, 25.0, 30.0, 8.0), (44.0, 36.0, 60.0, 7.0))
    batch = join([coming, waiting])
    report = setup.put(batch)
    assert (report.spheres, report.moved, report.deferred) == (4, 1, None)
    assert "1 sphere moved" in report.message()
    asked, placed = (np.array((which.x, which.y, which.z)) for which in (batch, report.positions))
    assert (placed != asked).any(axis=0).tolist() == [False, False, True, False]
    assert np.linalg.norm(placed[:, 2] - placed[:, 0]) >= 16e-6
    assert all(np.array_equal(placed, other) for other in mpi.all_gather(placed))
    assert setup.whole("mass").max() <= OVERFILL
    assert np.isclose(setup.volume(), volume_inside(batch), rtol=1e-12, atol=0.0)


def test_a_sphere_that_finds_no_place_beside_its_batch_waits(setup):
    """Two of the largest in a layer for one; fails if ``_proposal`` looks at material only."""
    batch = batch_of((24.0, 25.0, 22.0, 20.0), (26.0, 25.0, 24.0, 20.0))
    report = setup.put(batch, 36e-6)
    assert (report.spheres, report.moved, report.deferred.count) == (1, 0, 1)
    assert report.deferred.x[0] == batch.x[1]
    assert "1 sphere found no free place" in report.message()
    assert setup.whole("mass").max() <= OVERFILL


def test_spheres_that_share_less_than_a_cell_may_be_overfilled_by_keep_their_places(setup):
    """Written with few digits, spheres in touch overlap a little; fails if ``shareable_volume`` returns 0."""
    batch = batch_of((20.0, 25.0, 30.0, 8.0), (35.96, 25.0, 30.0, 8.0))
    report = setup.put(batch)
    assert report.moved == 0
    assert np.array_equal(report.positions.x, batch.x)
    assert setup.whole("mass").max() <= OVERFILL


def test_the_exact_sum_of_mass_is_the_same_on_any_rank(setup):
    """Fails if ``material_quanta`` sums floating-point numbers over ranks instead of integers."""
    overlapping_spheres(setup)
    quanta = measure.material_quanta(setup.state, setup.model)
    whole = setup.whole("mass")
    assert quanta == int(np.floor(whole / setup.model.mass_quantum).astype(np.int64).sum())
    assert mpi.all_gather(quanta) == [quanta] * mpi.size()


def test_the_exact_sum_of_mass_holds_for_very_wide_planes(setup):
    """725 x 725 full cells, over 2^63 quanta; fails when ``mass_quanta`` sums whole quanta: -522951 cells."""
    quantum = setup.model.mass_quantum
    assert mass_quanta(np.ones((1, 725, 725)), quantum) * quantum == 725**2
    shares = np.linspace(0.0, 1.0, 120).reshape(3, 5, 8)
    assert mass_quanta(shares, quantum) == sum(int(share / quantum) for share in shares.flat)
