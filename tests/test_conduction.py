"""Heat conduction: a decaying cosine, conserved heat, and void that insulates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, cell_coordinates, make_block, make_model, make_setup

from f2s_hpc.solver.heat import conduct, conduct_asleep, diffusivity

DX = 3e-6
MODEL = make_model(DX)


def heat(setup):
    """Return mass times temperature of all owned cells (full cells times K)."""
    return float((setup.state.owned("mass") * setup.state.owned("temperature")).sum())


def conduct_many(setup, dt, steps):
    for _ in range(steps):
        conduct(setup.state, setup.model, dt)
        setup.state.exchange(("temperature",))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_conductivity_is_that_of_the_material(axis):
    """One step of a parabola warms every cell inside by k / (rho c) times its curvature.

    Fails when the two neighbours of one axis in ``heat_gained`` read ``c - 1``, ``c + 1`` of another.
    """
    cells = [5, 5, 5]
    cells[axis] = 12
    setup = make_block(cells, MODEL)
    position = cell_coordinates(setup.state)[axis]
    setup.state.views["temperature"][...] = 400.0 + position**2
    dt = 1e-10
    conduct(setup.state, MODEL, dt)
    gain = (setup.state.views["temperature"] - 400.0 - position**2)[setup.state.part.owned_cells]
    gain = np.moveaxis(gain, 2 - axis, 0)
    bulk = MODEL.bulk
    expected = bulk.conductivity / (bulk.density * bulk.specific_heat) * dt * 2.0 / DX**2
    assert gain[1:-1] == pytest.approx(expected, rel=1e-7)


def cosine_error(cells, axis):
    """Return the largest error (K) of a cosine of 100 K between mirrors after it has decayed to about a third."""
    size = [3, 3, 3]
    size[axis] = cells
    setup = make_block(size, MODEL)
    position = cell_coordinates(setup.state)[axis]
    profile = 100.0 * np.cos(math.pi * position / cells)
    setup.state.views["temperature"][...] = 500.0 + profile
    dt = 0.1 * DX**2 / diffusivity(MODEL)
    steps = round(1.0 / (0.1 * (math.pi / cells) ** 2))
    conduct_many(setup, dt, steps)
    decayed = 500.0 + profile * math.exp(-0.1 * (math.pi / cells) ** 2 * steps)
    return float(np.abs(setup.state.views["temperature"] - decayed)[setup.state.part.owned_cells].max())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cosine_decays_at_its_rate_with_second_order(axis):
    """12 and 24 cells, to 0.3 K of 100 K and order >= 1.9.

    Fails when ``number * total`` becomes ``0.99 * number * total``.
    """
    coarse, fine = cosine_error(12, axis), cosine_error(24, axis)
    assert coarse < 0.3
    assert math.log2(coarse / fine) > 1.9


def test_heat_is_conserved_between_slivers_and_void(rng):
    """Touching spheres at random temperatures: heat to 1e-13, and no temperature leaves its range.

    Fails when ``min(mass[c + 1], x)`` becomes ``mass[c + 1]``.
    """
    setup = make_setup((20, 14, 13), MODEL, [(6.1, 7.2, 6.4, 4.6), (14.6, 7.0, 6.2, 3.9)], sides=ALL_SYMMETRY)
    temperature = setup.state.views["temperature"]
    temperature[...] = np.where(setup.state.views["mass"] > 0.0, rng.uniform(300.0, 1200.0, temperature.shape), 0.0)
    before, matter = heat(setup), setup.state.owned("mass") > 0.0
    conduct_many(setup, DX**2 / diffusivity(MODEL) / 6.0, 60)
    assert heat(setup) == pytest.approx(before, rel=1e-13)
    values = setup.state.owned("temperature")
    assert (values[~matter] == 0.0).all()
    assert 300.0 <= values[matter].min() <= values[matter].max() <= 1200.0
    assert np.ptp(values[matter]) < 500.0


def test_void_insulates():
    """A hot and a cold body with one void cell between them keep their temperatures, every bit.

    Fails when a conductance ``min(mass[c - 1], x)`` becomes ``max(mass[c - 1], x)``.
    """
    setup = make_setup((11, 5, 5), MODEL, sides=ALL_SYMMETRY)
    state = setup.state
    for first, last, kelvin in ((0, 5, 1000.0), (6, 11, 300.0)):
        for name, value in (("mass", 1.0), ("volume_fraction", 1.0), ("temperature", kelvin)):
            state.owned(name)[:, :, first:last] = value
    state.exchange(state.ghosted)
    setup.activate()
    conduct_many(setup, 1e-9, 50)
    assert (state.owned("temperature")[:, :, :5] == 1000.0).all()
    assert (state.owned("temperature")[:, :, 5] == 0.0).all()
    assert (state.owned("temperature")[:, :, 6:] == 300.0).all()


def test_long_steps_are_cut_into_stable_ones():
    """Ten times the explicit limit in one call equals ten calls at the limit; fails when ``substeps`` is always 1."""
    fields = []
    for calls in (1, 10):
        setup = make_block((8, 4, 3), MODEL)
        x, y, _ = cell_coordinates(setup.state)
        setup.state.views["temperature"][...] = 500.0 + 100.0 * np.cos(math.pi * x / 8) * np.cos(math.pi * y / 4)
        conduct_many(setup, 10.0 / calls * 0.999 * DX**2 / diffusivity(MODEL) / 6.0, calls)
        fields.append(setup.state.owned("temperature").copy())
    assert fields[0] == pytest.approx(fields[1], rel=1e-13)
    assert np.ptp(fields[0]) < 150.0


@pytest.mark.parametrize("sleeping", [False, True])
def test_heat_takes_its_thermal_pressure_along(sleeping):
    """Mie-Grueneisen pressure follows the internal energy: what is conducted moves there, too, also in what sleeps.

    Fails when ``add_heat`` leaves ``energy`` alone.
    """
    model = make_model(DX, "copper-piston", overrides=["material.conductivity=385 W/m/K"])
    setup = make_block((4, 5, 8), model)
    state, specific_heat = setup.state, model.bulk.specific_heat
    state.owned("temperature")[:4] += 100.0
    state.owned("internal_energy")[:4] = 100.0 * specific_heat
    state.settle()
    if sleeping:
        state.set_floor(6)
    before = state.owned("temperature").copy()
    dt = DX**2 / diffusivity(model)
    (conduct_asleep if sleeping else conduct)(state, model, dt)
    gained = state.owned("temperature") - before
    assert gained[3].max() < -10.0
    expected = np.where(before > before.min(), 100.0, 0.0) + gained
    assert state.owned("internal_energy") / specific_heat == pytest.approx(expected, abs=1e-9)
