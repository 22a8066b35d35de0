"""Free flight: a sphere of five cells across must not notice the grid, whatever the distance and direction."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import make_model, make_setup

from f2s_hpc import mpi
from f2s_hpc.fields import STRESS, VELOCITY
from f2s_hpc.materials.flow_stress import flow_stress

DX = 3e-6
SPEED, TEMPERATURE, CELLS_FLOWN, RADIUS = 600.0, 723.15, 50.0, 2.5
MODEL = make_model(DX)


def fly(direction, cells, start):
    """Fly a sphere from ``start`` (cells) over 50 cells and check all that must stay, on all ranks."""
    direction = np.array(direction) / np.linalg.norm(direction)
    velocity = SPEED * direction
    setup = make_setup(cells, MODEL, [(*start, RADIUS)], velocity, TEMPERATURE)
    state = setup.state
    setup.advance_to(CELLS_FLOWN * DX / SPEED)
    share = state.owned("mass")
    matter = share > 0.0
    flown = np.zeros(4)
    for axis in range(3):
        index = np.arange(share.shape[2 - axis]) + state.part.start[axis] + 0.5
        flown[axis] = np.tensordot(share, index, axes=([2 - axis], [0])).sum()
    flown[3] = share.sum()
    flown = sum(np.array(part) for part in mpi.all_gather(flown.tolist()))
    # planes alone in the place of the curved surface would carry the body up to dx^2 / (6 r^2) = 2.7 % ahead
    assert flown[:3] / flown[3] == pytest.approx(np.array(start) + CELLS_FLOWN * direction, abs=0.003 * CELLS_FLOWN)

    # cells of less than 1e-12 are emptied; what they held is counted
    emptied = setup.ledger.totals()["mass_capped"] * MODEL.mass_quantum
    assert flown[3] + emptied == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=1e-13)
    assert emptied < 1e-12 * flown[3]

    heavy = state.views["nodal_mass"][state.part.owned_nodes] > 1e-9
    for name, component in zip(VELOCITY, velocity):
        assert np.abs(state.owned(name)[heavy] - component).max(initial=0.0) < 1e-9 * SPEED, name
    yield_stress = flow_stress(MODEL.flow, 0.0, 0.0, TEMPERATURE)[0]
    for name in STRESS:
        assert np.abs(state.owned(name)).max() < 1e-9 * yield_stress, name
    assert np.abs(state.owned("temperature")[matter] - TEMPERATURE).max(initial=0.0) < 1e-9 * TEMPERATURE
    assert (state.owned("peeq") == 0.0).all()
    assert state.owned("mass").max() < 1.0 + 1e-9


@pytest.mark.mpi
def test_flight_along_x():
    """Across all blocks of a row; fails when ``(q_low - q)`` of the remap's updates is taken at the other face."""
    fly((1.0, 0.0, 0.0), (62, 12, 12), (5.3, 5.8, 6.1))


def test_flight_downwards():
    """Along -z, as particles do; fails when ``mass_flux[n] - mass_flux[n + step]`` of ``sweep_mass`` is turned."""
    fly((0.0, 0.0, -1.0), (12, 11, 62), (5.9, 5.2, 56.4))


@pytest.mark.mpi
def test_flight_along_a_diagonal():
    """(1, 1, -1): three sweeps in a step; fails when ``values[old, ...]``, ``values[new, ...]`` of the update swap."""
    fly((1.0, 1.0, -1.0), (40, 40, 40), (5.3, 5.7, 34.4))
