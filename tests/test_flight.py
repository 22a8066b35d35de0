"""Ballistic flight: analytic until something is within reach, then on the grid as if it had always been there."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, make_model, make_setup

from f2s_hpc import mpi
from f2s_hpc.cycles import insert
from f2s_hpc.cycles.flight import CLEARANCE, LOOK, REACH, Flight
from f2s_hpc.cycles.insert import OVERFILL, paint_arrivals
from f2s_hpc.errors import UnstableStep
from f2s_hpc.grid.box import GHOST
from f2s_hpc.particles.batch import Batch, smallest_gap
from f2s_hpc.particles.meeting import LEAD, waits

DX = 3e-6
CELLS = (24, 20, 40)
DOWN = (0.0, 0.0, -600.0)

pytestmark = pytest.mark.mpi


@pytest.fixture
def setup():
    return make_setup(CELLS, make_model(DX), substrate=10)


def spheres(*rows, velocity=None):
    return Batch(*np.array(rows, dtype=float).T, velocity if velocity is None else np.array(velocity, dtype=float))


def test_a_sphere_is_painted_when_the_surface_is_within_reach_and_not_before(setup):
    """Its place is that of its straight flight, to round-off.

    Fails if ``at`` forgets the start time, or ``spheres_near_material`` takes the box of the sphere for the sphere.
    """
    flight = Flight(DX, setup.state.part.box.extents)
    r, z = 9e-6, 100e-6
    flight.launch(setup.state, spheres((30e-6, 30e-6, z, r)), DOWN, 2e-6)
    step = 0.2 * DX / 600.0
    surface = 9.5 * DX  # centre of the highest cells
    time, arrived = 2e-6, None
    while arrived is None:
        time += step
        arrived = flight.arrivals(setup.state, time, step)
    batch, velocity = arrived
    assert velocity == DOWN
    assert batch.velocity is None
    assert batch.z[0] == pytest.approx(z - 600.0 * (time - 2e-6), rel=1e-12)
    gap = batch.z[0] - r - surface
    assert REACH * DX < gap <= REACH * DX + 2 * LOOK * 0.2 * DX
    assert gap > (REACH + 2 * LOOK * 0.2 - LOOK * 0.2) * DX - 0.3 * DX
    assert flight.count == 0


@pytest.mark.parametrize("own", [None, [(0.0, 0.0, -600.0), (9.0, 0.0, -590.0)]])
@pytest.mark.parametrize(("z", "substrate"), [((19e-6, 70e-6), 3), ((60e-6, 75e-6), 3), ((95e-6, 112e-6), 3),
                                              ((9.5e-6, 70e-6), 0), ((60e-6, 112.5e-6), 0)])
def test_painting_looks_at_the_planes_of_the_spheres_only_and_gives_the_same_bits(z, substrate, own):
    """At the bottom, in the middle and at the top; every ghost that a step reads too: ten steps follow.

    Fails if ``paint_arrivals`` leaves out a plane (``np.floor`` for ``np.ceil``), or the ghosts below and above the box
    (without ``if low < high``): nodes on the mirrors there get twice the momentum.
    """
    found = []
    for paint in (paint_arrivals, insert.paint_batch):
        setup = make_setup(CELLS, make_model(DX), substrate=substrate, sides=ALL_SYMMETRY)
        batch = spheres((2e-6, 30e-6, z[0], 9e-6), (50e-6, 57e-6, z[1], 7e-6), velocity=own)
        if paint is paint_arrivals:
            paint(setup.state, setup.model, (batch, DOWN), 700.0, setup.ledger)
        else:
            paint(setup.state, setup.model, batch, 0.0, DOWN, 700.0, setup.ledger, 1)
        setup.clock.limits.put_in(600.0, DX)
        setup.advance(10)
        found.append(([setup.state.owned(n).copy() for n in setup.state.saved], setup.ledger.totals()))
    for one, other in zip(found[0][0], found[1][0]):
        assert np.array_equal(one, other)
    assert found[0][1] == found[1][1]
    assert found[0][1]["brought_in"] > 0


def test_what_arrives_is_all_that_was_launched(setup):
    """Mass of the painted sphere against its volume; fails if ``paint_arrivals`` paints with another place or twice."""
    flight = Flight(DX, setup.state.part.box.extents)
    flight.launch(setup.state, spheres((30e-6, 30e-6, 60e-6, 9e-6)), DOWN, 0.0)
    before = mpi.total(setup.state.owned("mass").sum())
    arrived = flight.arrivals(setup.state, 3e-8, 1e-10)
    paint_arrivals(setup.state, setup.model, arrived, 700.0, setup.ledger)
    painted = (mpi.total(setup.state.owned("mass").sum()) - before) * DX**3
    assert painted == pytest.approx(4.0 / 3.0 * np.pi * (9e-6) ** 3, rel=1e-9, abs=0.0)


def _painted_companion(setup, *rows):
    """Launch spheres, paint the first as if it had met something, and return the flight of the others."""
    flight = Flight(DX, setup.state.part.box.extents)
    first = Flight(DX, setup.state.part.box.extents)
    first.launch(setup.state, spheres(rows[0]), DOWN, 0.0)
    flight.launch(setup.state, spheres(*rows[1:]), DOWN, 0.0)
    paint_arrivals(setup.state, setup.model, (spheres(rows[0]), DOWN), 700.0, setup.ledger)
    return flight


def test_material_that_flies_along_calls_no_sphere_down_until_it_is_stopped(setup):
    """Two spheres in touch, one on the grid; fails if ``spheres_near_material`` takes all material for an obstacle.

    Or if it looks at one node of a cell only: the last node that is stopped here is a single one.
    """
    r = 9e-6
    flight = _painted_companion(setup, (36e-6, 30e-6, 70e-6, r), (36e-6, 30e-6, 70e-6 + 2.0 * r, r))
    assert flight.arrivals(setup.state, 1e-12, 1e-12) is None
    flight.calls = 0
    w = setup.state.views["velocity_z"]
    k, j, i = (int(p / DX) - o for p, o in zip((77e-6, 30e-6, 36e-6), setup.state.part.offset[::-1]))
    if all(GHOST <= at < GHOST + n for at, n in zip((i, j, k), setup.state.part.count)):
        assert w[k, j, i] == DOWN[2]
        w[k, j, i] *= 0.99
    setup.state.exchange(("velocity_z",))
    arrived, _ = flight.arrivals(setup.state, 1e-12, 1e-12)
    assert arrived.count == 1
    assert flight.raised == 0


def test_spheres_that_would_overfill_cells_are_raised_with_what_is_above_them(setup):
    """Fails if ``_make_room`` forgets the places in flight, or ``_push_up`` the sphere above the one that it moves."""
    r = 9e-6
    flight = _painted_companion(setup, (36e-6, 30e-6, 60e-6, r), (36e-6, 30e-6, 110e-6, r), (36e-6, 30e-6, 130e-6, r))
    flight.spheres.z[:] = 60e-6 + 2.0 * r - 2.0 * DX, 60e-6 + 4.0 * r - 2.0 * DX
    setup.state.views["velocity_z"][:] = 0.0
    arrived, _ = flight.arrivals(setup.state, 1e-12, 1e-12)
    before = mpi.total(setup.state.owned("mass").sum())
    paint_arrivals(setup.state, setup.model, (arrived, DOWN), 700.0, setup.ledger)
    assert mpi.maximum(np.float64(setup.state.owned("mass").max())) <= OVERFILL
    assert flight.raised == 2
    assert arrived.z.min() - 60e-6 == pytest.approx(2.0 * r, abs=2.0 * CLEARANCE * DX)
    above = flight.at(1e-12).z.max() if flight.count else arrived.z.max()
    assert above - arrived.z.min() >= 2.0 * r * (1.0 - 1e-6)
    added = (mpi.total(setup.state.owned("mass").sum()) - before) * DX**3
    assert added == pytest.approx(arrived.count * 4.0 / 3.0 * np.pi * r**3, rel=1e-9, abs=0.0)


def test_spheres_that_fit_one_by_one_but_not_together_are_raised(setup):
    """A cell that is 30 % full, and 47 % of it in each of two spheres in touch; without ``added`` it would hold 1.24.

    Fails if ``fullest_cells`` looks at each sphere alone.
    """
    state, at = setup.state, 10.5 * DX
    k, j, i = (n - o for n, o in zip((20, 10, 10), state.part.offset[::-1]))
    if all(0 <= a < n for a, n in zip((k, j, i), state.part.cell_shape)):
        state.views["mass"][k, j, i] = state.views["volume_fraction"][k, j, i] = 0.3
    state.settle()
    setup.activate()
    flight = Flight(DX, state.part.box.extents)
    r = 9e-6
    batch = spheres((at - r, at, 90e-6, r), (at + r, at, 90e-6, r))
    flight.launch(state, batch, DOWN, 0.0)
    flight.spheres.z[:] = 20.5 * DX
    arrived, _ = flight.arrivals(state, 1e-12, 1e-12)
    assert arrived.count == flight.raised == 2
    paint_arrivals(state, setup.model, (arrived, DOWN), 700.0, setup.ledger)
    assert mpi.maximum(np.float64(state.owned("mass").max())) <= OVERFILL


def test_a_faster_sphere_meets_a_slower_one_when_their_gap_is_two_reaches(setup):
    """|p + w t| = r_1 + r_2 + 2 reach in closed form; fails if the later root is taken, or one radius only."""
    flight = Flight(DX, setup.state.part.box.extents)
    batch = spheres((30e-6, 30e-6, 160e-6, 6e-6), (30e-6, 30e-6, 210e-6, 9e-6), (50e-6, 20e-6, 300e-6, 5e-6),
                    velocity=[(0, 0, -500.0), (0, 0, -700.0), (0, 0, -500.0)])
    flight.launch(setup.state, batch, DOWN, 1e-6)
    wanted = 1e-6 + (50e-6 - 15e-6 - 2 * REACH * DX) / 200.0
    assert flight.contact[:2] == pytest.approx(wanted, rel=1e-12)
    assert np.isinf(flight.contact[2])


def test_spheres_that_pass_by_do_not_wait_and_those_that_close_in_slowly_wait_late(setup):
    """Never in touch, or only below the ground: no wait. At 20 m/s towards each other: ``LEAD`` cells before touch.

    Fails when ``meets`` of ``waits`` asks who comes near, or ``LEAD`` is left out of ``when``.
    """
    both, speed = 15e-6, 600.0
    flight = Flight(DX, setup.state.part.box.extents)
    for aside, fast in ((both + REACH * DX, -700.0), (0.0, -600.0)):
        flight.launch(setup.state, spheres((20e-6, 30e-6, 60e-6, 6e-6), (20e-6 + aside, 30e-6, 110e-6, 9e-6),
                                           velocity=[(0, 0, -500.0), (0, 0, fast)]), DOWN, 0.0)
        assert np.isinf(flight.contact).all()
        flight = Flight(DX, setup.state.part.box.extents)
    gap = 2e-6 + DX
    flight.launch(setup.state, spheres((30e-6, 30e-6, 300e-6, 6e-6), (30e-6, 30e-6, 300e-6 + both + gap, 9e-6),
                                       velocity=[(0, 0, -speed), (0, 0, -speed - 20.0)]), DOWN, 1e-6)
    assert flight.contact == pytest.approx(1e-6 + (gap - DX) / 20.0 - LEAD * DX / speed, rel=1e-12)


def test_one_sphere_at_rest_does_not_pair_all_with_all(rng):
    """In a jet, by brute force with and without it; the same for one that flies up. Fails without ``_odd_ones``.

    Or if those are compared with the common ones only, or with each other only.
    """
    count, down = 400, rng.uniform(550.0, 640.0, 400)
    velocity = np.stack([rng.normal(0.0, 5.0, count), rng.normal(0.0, 5.0, count), -down], axis=1)
    velocity[7], velocity[11], velocity[300] = (0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, 0.0, -5.0)
    x, y, z = rng.uniform(0.0, 300e-6, count), rng.uniform(0.0, 300e-6, count), rng.uniform(60e-6, 400e-6, count)
    batch = Batch(x, y, z, np.full(count, 5e-6), velocity)
    with np.errstate(all="raise"):
        found = waits(batch, DX)
    places, wanted = np.stack([x, y, z], axis=1), np.full(count, np.inf)
    landing = z / np.maximum(-velocity[:, 2], 1e-3)
    for a in range(count):
        for b in range(a + 1, count):
            p, w = places[b] - places[a], velocity[b] - velocity[a]
            times = []
            for gap in (DX, 2.0 * REACH * DX):
                inner = p @ p - (10e-6 + gap) ** 2
                root = (p @ w) ** 2 - (w @ w) * inner
                meets = p @ w < 0.0 <= root
                times.append((0.0 if inner <= 0.0 else (-(p @ w) - root**0.5) / (w @ w)) if meets else np.inf)
            if times[0] < min(landing[a], landing[b]):
                lead = LEAD * DX / max(np.linalg.norm(velocity[a]), 1e-3)
                for one in (a, b):
                    wanted[one] = min(wanted[one], max(times[1], times[0] - lead, 0.0))
    assert np.isfinite(wanted).sum() > 20
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_a_sphere_that_would_start_in_another_or_in_material_starts_higher(setup):
    """Fails if ``_free_places`` looks at material only, or at flying spheres only."""
    flight = Flight(DX, setup.state.part.box.extents)
    assert flight.launch(setup.state, spheres((30e-6, 30e-6, 80e-6, 9e-6)), DOWN, 0.0) == 0
    raised = flight.launch(setup.state, spheres((33e-6, 30e-6, 84e-6, 9e-6), (50e-6, 30e-6, 36e-6, 9e-6),
                                                (12e-6, 12e-6, 80e-6, 9e-6)), DOWN, 0.0)
    assert raised == 2
    x, z, r = flight.spheres.x, flight.spheres.z, flight.spheres.r
    assert np.hypot(x[1] - x[0], z[1] - z[0]) >= r[0] + r[1]
    assert z[2] - r[2] >= 9.0 * DX
    assert z[3] == 80e-6


def test_a_sphere_that_is_lifted_again_counts_once(setup):
    """At launch, on the way, and after another one has landed and a stop. Fails if ``_count`` adds what it is given.

    Or if ``_take`` leaves the mark of the sphere that has landed, or a checkpoint loses the marks.
    """
    flight = Flight(DX, setup.state.part.box.extents)
    three = spheres((30e-6, 30e-6, 60e-6, 8e-6), (12e-6, 12e-6, 80e-6, 5e-6), (30e-6, 30e-6, 60e-6, 8e-6))
    assert flight.launch(setup.state, three, DOWN, 0.0) == 1
    assert flight.lifted.tolist() == [False, False, True]
    flight._count(np.array([False, True, True]))
    assert flight.raised == 1
    flight._take(flight.at(0.0), np.array([True, False, False]))
    again = Flight(DX, setup.state.part.box.extents)
    again.restore(flight.attributes())
    again._count(np.array([True, True]))
    assert again.raised == 1
    assert again.lifted.all()


def test_a_sphere_that_is_raised_at_launch_does_not_end_up_in_another_of_its_batch(setup):
    """Material lifts the first up to the second, which stays; both arrive together.

    Fails if ``settle_in_order`` is left out of ``Flight._free_places`` (``settled |= ~hit``): they overlap by a sixth.
    """
    state = setup.state
    k, j, i = np.ogrid[tuple(slice(o, o + n) for o, n in zip(state.part.offset[::-1], state.part.cell_shape))]
    state.views["mass"][(k < 15) & (j >= 0) & (i < 9)] = 1.0
    state.settle()
    flight = Flight(DX, state.part.box.extents)
    batch = spheres((20e-6, 25e-6, 44e-6, 8e-6), (33e-6, 25e-6, 56e-6, 8e-6), (50e-6, 40e-6, 60e-6, 8e-6))
    assert flight.launch(state, batch, DOWN, 0.0) == 1
    assert np.array_equal(flight.spheres.z[1:], batch.z[1:])
    assert smallest_gap(flight.spheres) >= 1.0
    assert all(np.array_equal(flight.spheres.z, other) for other in mpi.all_gather(flight.spheres.z))
    before = mpi.total(state.owned("mass").sum())
    arrived = flight.arrivals(state, 1e-10, 2e-8)
    assert arrived[0].count == 3
    paint_arrivals(state, setup.model, arrived, 700.0, setup.ledger)
    assert mpi.maximum(np.float64(state.owned("mass").max())) <= OVERFILL
    added = (mpi.total(state.owned("mass").sum()) - before) * DX**3
    assert added == pytest.approx(3.0 * 4.0 / 3.0 * np.pi * (8e-6) ** 3, rel=1e-9, abs=0.0)


def test_of_spheres_launched_into_each_other_the_later_starts_higher(setup):
    """Three at one place; fails if ``settle_in_order`` goes through the batch backwards, or takes one round only."""
    flight = Flight(DX, setup.state.part.box.extents)
    batch = spheres(*[(30e-6, 30e-6, 60e-6, 8e-6)] * 3)
    assert flight.launch(setup.state, batch, DOWN, 0.0) == 2
    z = flight.spheres.z
    assert z[0] == 60e-6
    assert z[1:] - z[:-1] == pytest.approx(16e-6, abs=CLEARANCE * DX)
    assert smallest_gap(flight.spheres) >= 1.0


@pytest.mark.parametrize(("place", "velocity", "near"), [
    ((36e-6, 42e-6), (0.0, 300.0), True), ((36e-6, 38e-6), (0.0, 300.0), False), ((36e-6, 42e-6), (0.0, -300.0), False),
    ((54e-6, 30e-6), (300.0, 0.0), True), ((45e-6, 30e-6), (300.0, 0.0), False), ((17e-6, 30e-6), (-300.0, 0.0), True),
    ((22e-6, 30e-6), (-300.0, 0.0), False), ((36e-6, 17e-6), (0.0, -300.0), True)])
def test_a_side_that_a_sphere_flies_towards_calls_it_down(setup, place, velocity, near):
    """A box of 72 x 60 um, a radius and a reach of 9 um each; fails when ``_at_side`` mixes up axes or signs."""
    flight = Flight(DX, setup.state.part.box.extents)
    flight.launch(setup.state, spheres((*place, 90e-6, 9e-6), velocity=[(*velocity, -1.0)]), DOWN, 0.0)
    assert (flight.arrivals(setup.state, 1e-12, 1e-12) is not None) is near


def test_of_spheres_that_ran_into_each_other_above_the_box_the_upper_waits_on_the_lower(setup):
    """Both are due; fails when ``_overlapping`` holds none back: their common part would be painted twice."""
    flight = Flight(DX, setup.state.part.box.extents)
    flight.launch(setup.state, spheres((30e-6, 30e-6, 60e-6, 6e-6), (33e-6, 30e-6, 110e-6, 9e-6),
                                       velocity=[(0, 0, -500.0), (0, 0, -700.0)]), DOWN, 0.0)
    flight.spheres.z[:] = 90e-6, 96e-6
    flight.contact[:] = 0.0
    arrived, velocity = flight.arrivals(setup.state, 0.0, 1e-12)
    assert (arrived.count, arrived.z[0], velocity[2]) == (1, 90e-6, -500.0)
    assert flight.spheres.z == pytest.approx(90e-6 + np.sqrt((15e-6) ** 2 - (3e-6) ** 2), rel=1e-12)


def test_the_volume_in_flight_is_that_between_the_walls(setup):
    """Half of a sphere on a wall counts, all of one above the box; fails when width and depth change places."""
    flight = Flight(DX, setup.state.part.box.extents)
    flight.launch(setup.state, spheres((66e-6, 30e-6, 90e-6, 5e-6), (30e-6, 60e-6, 200e-6, 4e-6)), DOWN, 0.0)
    wanted = 4.0 / 3.0 * np.pi * ((5e-6) ** 3 + 0.5 * (4e-6) ** 3)
    assert flight.volume(3e-8) == pytest.approx(wanted, rel=1e-12, abs=0.0)


def test_a_sphere_that_does_not_fit_under_the_top_stops_the_run_on_all_ranks(setup):
    """Fails if the part above the top is cut off in silence."""
    flight = Flight(DX, setup.state.part.box.extents)
    setup.state.views["mass"][-12:-4] = 1.0
    setup.activate()
    top = setup.state.part.box.extents[2]
    flight.launch(setup.state, spheres((30e-6, 30e-6, top + 20e-6, 9e-6)), DOWN, 0.0)
    with pytest.raises(UnstableStep, match="top of the box"):
        flight.arrivals(setup.state, 10e-6 / 600.0, 1e-10)


def test_a_restored_flight_is_the_same(setup):
    """Fails if ``attributes`` leaves out ``calls`` or ``contact``."""
    flight, other = (Flight(DX, setup.state.part.box.extents) for _ in range(2))
    flight.launch(setup.state, spheres((30e-6, 30e-6, 60e-6, 6e-6), (30e-6, 30e-6, 110e-6, 9e-6),
                                       velocity=[(0, 0, -500.0), (0, 0, -700.0)]), DOWN, 1e-6)
    flight.arrivals(setup.state, 1.01e-6, 1e-10)
    other.restore(flight.attributes())
    assert other.attributes() == flight.attributes()
    assert np.array_equal(other.at(2e-6).z, flight.at(2e-6).z)
