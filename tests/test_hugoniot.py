"""Mie-Grueneisen material behind a strong shock: pressure, density, internal energy and temperature."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, make_block, make_model

from f2s_hpc.cycles import measure
from f2s_hpc.materials.pressure import stiffness
from f2s_hpc.verify.box import cell_coordinates, node_coordinates
from f2s_hpc.verify.piston import block

CELLS, DX = 120, 1e-6


def behind(model, speed: float) -> tuple[float, float, float, float]:
    """Return pressure (Pa), density (kg/m3), internal energy (J/kg) and temperature (K) behind a shock from rest.

    Rankine and Hugoniot, with U = c + s u; temperature by c_p dT = T dS + (T beta / rho) dp along all weaker shocks,
    beta = Gamma rho c_p / K.
    """
    eos, temperature = model.eos, 298.15
    v0, steps = 1.0 / eos.density, 20000
    shock = eos.sound_speed + eos.slope * speed
    volumes = np.linspace(v0, v0 * (1.0 - speed / shock), steps + 1)
    strain = 1.0 - volumes / v0
    pressure = eos.density * eos.sound_speed**2 * strain / (1.0 - eos.slope * strain) ** 2
    energy = 0.5 * pressure * (v0 - volumes)
    for n in range(steps):
        dv, dp = volumes[n + 1] - volumes[n], pressure[n + 1] - pressure[n]
        heat = energy[n + 1] - energy[n] + 0.5 * (pressure[n] + pressure[n + 1]) * dv
        hard = stiffness(eos, v0 / volumes[n], energy[n])
        temperature += heat / model.bulk.specific_heat + temperature * eos.gamma / hard * dp
    return float(pressure[-1]), 1.0 / float(volumes[-1]), float(energy[-1]), temperature


@pytest.mark.parametrize("speed", [150.0, 500.0, 1000.0])
def test_a_strong_shock_leaves_what_rankine_and_hugoniot_say(speed):
    """A soft block runs into a mirror, away from whose wall heating it is looked at.

    Fails when the pressure that works is that of the energy before the step (3 % of the energy is missing at 1000 m/s),
    or temperature does not follow the pressure (75 K are missing at 500 m/s).
    """
    model = make_model(DX, "copper-piston", overrides=["material.flow_stress.yield_stress=1 MPa"])
    setup = block(CELLS, model, speed)
    setup.advance_to(0.7 * CELLS * DX / (model.eos.sound_speed + model.eos.slope * speed))
    state, inner = setup.state, (1, 1, slice(20, 36))
    mass, energy, temperature = (float(state.owned(name)[inner].mean())
                                 for name in ("mass", "internal_energy", "temperature"))
    _, density, specific, hot = behind(model, speed)
    assert mass * model.bulk.density == pytest.approx(density, rel=1e-3)
    assert energy == pytest.approx(specific, rel=0.02)
    assert temperature - 298.15 == pytest.approx(hot - 298.15, rel=0.03)
    balance = measure.measure_balance(state, setup.model, setup.ledger, measure.material_quanta(state, setup.model))
    whole = 0.5 * model.bulk.density * CELLS * 9.0 * DX**3 * speed**2
    assert abs(balance["energy"]["time_step"]) < 8e-3 * whole


@pytest.mark.parametrize("steps_per_remap", [1, 8])
def test_what_tears_keeps_its_energy(steps_per_remap):
    """A plate of 30 cells hits one of 60, which tears where the waves from both free ends meet.

    Fails when the energy of its tension is taken out of the internal energy as it tears (1.3 and 1.5 % of the impact
    energy had no name but that of the explicit step).
    """
    model = make_model(DX, "copper-piston", steps_per_remap=steps_per_remap)
    setup = make_block((130, 3, 3), model, sides=ALL_SYMMETRY)
    state, speed = setup.state, 250.0
    place = np.broadcast_to(cell_coordinates(state)[0], state.part.cell_shape)
    beyond = (place < 5.0) | (place > 95.0)
    for name in ("mass", "volume_fraction", "temperature"):
        state.views[name][beyond] = 0.0
    nodes = np.broadcast_to(node_coordinates(state)[0], state.part.node_shape)
    state.views["velocity_x"][(nodes >= 4.0) & (nodes < 35.0)] = speed
    state.exchange(state.ghosted)
    setup.activate()
    setup.clock.limits.put_in(speed, DX)
    brought = measure.kinetic_quanta(state, model) * model.energy_quantum
    setup.advance_to(3.0 * 90.0 * DX / model.sound)
    fraction = state.owned("volume_fraction")[1, 1]
    inside = np.flatnonzero(fraction > 0.5)
    assert fraction[inside[0]:inside[-1]].min() < 0.5  # torn
    energy = measure.measure_balance(state, model, setup.ledger, measure.material_quanta(state, model))["energy"]
    assert abs(energy["time_step"]) < 8e-3 * brought
    assert abs(energy["remainder"] + brought) < 1e-4 * brought  # (it was not painted, so nothing was brought in)
