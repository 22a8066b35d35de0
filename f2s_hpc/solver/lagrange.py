"""The Lagrangian half of the step: forces, kick, light nodes, strain and stress."""

from __future__ import annotations

import numpy as np

from f2s_hpc.fields import VELOCITY, VOLUME_FLUX
from f2s_hpc.grid.box import GHOST
from f2s_hpc.kernels import deformed, force, momentum, remap, strain
from f2s_hpc.phases import phase
from f2s_hpc.solver import absorbing, walls
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State


@phase("forces")
def forces(state: State, model: Model, last_dt: float, ledger_power: np.ndarray,
           displaced: bool = False) -> tuple[float, int]:
    """Sum the cells' forces on the owned nodes.

    Reads mass, volume fraction, stress and velocity (ghosts valid); writes the
    nodal masses and forces, and what will be heat: viscous pressure and hourglass power of the cells, lost energy of
    the nodes. ``last_dt``: the last step (s). ``ledger_power`` int64[1] receives the power of hourglass control.
    ``displaced``: a step was taken since the last remap; what was lost before it has been returned by that one.
    Returns the largest effective wave speed (m/s) and the flat index of its cell.
    """
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    if displaced:
        momentum.clear_array(runs, count, shape, state.flat["dual_flux"])
    else:
        window = state.node_window((2, 2, 2), (2, 2, 2))
        remap.nodal_masses(runs, count, window, shape, state.flat["mass"], state.flat["nodal_mass"])
        if state.lost.size > 1:
            momentum.specific_losses(runs, count, window, shape, state.flat["nodal_mass"], state.lost,
                                     state.flat["dual_flux"])
    return _add_forces(state, model, last_dt, False, (displaced, 1.0, *state.displacement), ledger_power)


def _add_forces(state: State, model: Model, last_dt: float, again: bool, moved: tuple,
                power: np.ndarray) -> tuple[float, int]:
    """Set the forces of the nodes; ``again``, ``moved``: what ``nodal_forces`` takes of step and mesh."""
    s = model.settings
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    momentum.clear_nodes(runs, count, shape, *state.force)
    return force.nodal_forces(
        runs, count, state.cell_window(*state.boundary.pulled()), state.cell_window(), shape, model.dx, last_dt,
        model.bulk, model.eos, s.viscosity, s.hourglass, again, state.flat["mass"], state.flat["volume_fraction"],
        state.energy, state.stress, *state.velocity, *state.force, *moved, *state.sweep,
        *(state.flat[n] for n in TO_HEAT), model.energy_quantum * 1e9, power)


TO_HEAT = ("viscous_pressure", "hourglass_power", "mass_flux")
"""What the forces leave for the deformation: viscous pressure, hourglass power, and, in an array that is free until the
remap, the divergence of the velocity."""


@phase("nodes")
def kick(state: State, model: Model, before: float, after: float, ledger: Ledger) -> None:
    """Accelerate the owned nodes and hold the walls; ghosts of velocity are not valid after.

    Over half of the step ``before`` (s) and half of the one ``after``; none of them beside a remap.
    """
    runs, count = state.runs
    dt = 0.5 * (before + after)
    sums = np.zeros(5, dtype=np.int64)
    boundary, lost = state.boundary, state.lost if _half_kicks_heat(state) else state.empty
    absorbing.apply_traction(state, model, before, after, ledger)
    momentum.accelerate(
        runs, count, state.node_window(), state.part.cell_shape[1:], dt, after - before, model.dx, model.bulk.density,
        model.settings.light_mass_floor, boundary.weights, boundary.free_motion, state.flat["nodal_mass"],
        *state.force, *state.velocity, lost, model.energy_quantum, sums)
    for name, value in zip(("kinetic_before", "kinetic_after", "work", "withheld"), sums):
        ledger.add(name, value)
    _add_half_kicks(state, ledger, sums[4])


def _half_kicks_heat(state: State) -> bool:
    """Tell whether the energy of uneven kicks is added to what nodes lost, so that heat pays for it.

    Not where the internal energy is kept: there most comes from the work of compression, and behind a shock of 1000 m/s
    temperature would be 4 instead of 0.6 % too low.
    """
    return state.lost.size > 1 and state.energy.size == 1


def _add_half_kicks(state: State, ledger: Ledger, quanta: int) -> None:
    """Enter the energy of uneven kicks into the ledger."""
    ledger.add("half_kicks", quanta)
    if _half_kicks_heat(state):
        ledger.add("half_kicks_kept", quanta)


@phase("forces")
def second_half(state: State, model: Model, dt: float, displaced: bool, ledger: Ledger) -> None:
    """Kick the nodes over the second half of the last step (s) before a remap, with the stresses after it.

    On the mesh where the step has left it, so that nodes and cells exchange the same work over the whole step (velocity
    Verlet). Left to the kick after the remap, the half step met other stresses and velocities: 0.3 % of the energy of
    a single impact and 1 % of that of a deposit then came out of nothing. The viscous pressure is that of the step's
    start: the same impulse in both halves leaves no energy of first order in the step.
    ``displaced``: other steps have moved the nodes since the last remap. Ghosts of velocity are not valid after.
    """
    if model.settings.steps_per_remap > 1:
        displace(state, model, dt, displaced)
        moved = (True, 1.0, *state.displacement)
    else:
        state.exchange(state.strained_cells, layers=1)
        moved = (True, dt / model.dx, *state.velocity)
    power = np.zeros(1, dtype=np.int64)
    _add_forces(state, model, dt, True, moved, power)
    ledger.add_power("hourglass_power", power[0], 0.5 * dt)
    kick(state, model, dt, 0.0, ledger)


@phase("nodes")
def calm_light_nodes(state: State, model: Model, dt: float, ledger: Ledger) -> tuple[float, float]:
    """Exchange momentum between light neighbours and around nodes beyond the speed limit; cap racing fragments.

    Between the kick and the step ``dt`` (s); the arrays of the forces still hold those of the kick.
    Returns the largest speed (m/s) of light nodes and of heavy nodes on this rank.
    """
    s = model.settings
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    nodal = state.flat["nodal_mass"]
    state.exchange(VELOCITY, layers=1)
    momentum.mark_fast_rows(runs, count, shape, s.speed_limit, *state.velocity, state.fast_rows)
    weights, taken = state.boundary.weights, np.zeros(1, dtype=np.int64)
    momentum.exchange_light(
        runs, count, state.node_window(), shape, dt, model.cell_mass, s.exchange_strength, s.exchange_mass_limit,
        s.speed_limit, state.fast_rows, weights, state.boundary.free_motion, nodal, *state.velocity, *state.force,
        state.lost, float(_half_kicks_heat(state)), model.energy_quantum, taken)
    _add_half_kicks(state, ledger, taken[0])
    sums = np.zeros(4, dtype=np.int64)
    speeds = momentum.apply_exchange(
        runs, count, state.node_window(), shape, s.exchange_mass_limit, s.speed_cap, weights,
        model.bulk.density, model.dx, nodal, *state.velocity, *state.force, model.energy_quantum,
        model.mass_quantum * model.cell_mass, sums)
    for name, value in zip(("exchanged", "capped", "nodes_capped"), sums):
        ledger.add(name, value)
    if state.lost.size > 1:
        ledger.add("exchange_kept", sums[0])
    walls.hold(state, model, ledger, "exchanged")
    state.exchange(VELOCITY)
    return speeds


@phase("deformation")
def deform(state: State, model: Model, dt: float, ledger: Ledger, displaced: bool = False,
           last: bool = True, kicked: float | None = None) -> tuple[float, int]:
    """Strain the cells with the new velocity: swept volumes of the faces, stress, plastic flow, heating, closure.

    ``displaced``: a step was taken since the last remap; ``last``: :func:`second_half` and a remap come next;
    ``kicked``: duration (s) of the kick before, half the step if not given. Ghosts of what changes are not valid after.
    Returns the largest velocity-gradient norm (1/s) and the flat index of its cell.
    """
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    s = model.settings
    sums = np.zeros(8, dtype=np.int64)
    full = state.cell_window((GHOST, GHOST, GHOST), (GHOST, GHOST, GHOST))
    # (before the first step there is no displacement, nor memory for one where each step is remapped)
    deformed.sweep_faces(runs, count, full, shape, displaced, dt / model.dx, *state.velocity,
                         *(state.displacement if displaced else state.velocity), *state.sweep,
                         state.flat[VOLUME_FLUX])
    # the viscous pressure works over the half step before, none beside a remap, over the one after, and in second_half.
    # Hourglass control has another power there, but heat of the first is near enough
    times = (0.5 * dt if displaced else 0.0, 0.5 * dt, 1.0 if last else 0.0,
             (0.5 * dt if kicked is None else kicked) + (0.5 * dt if last else 0.0))
    gradient, where = strain.lagrangian_step(
        runs, count, state.cell_window(), shape, dt, times, model.dx, s.largest_strain, model.bulk, model.eos,
        model.flow, (float(s.viscous_heating), float(s.loss_heating)), state.flat["mass"],
        state.flat["volume_fraction"], state.energy, state.stress, state.flat["peeq"], state.flat["temperature"],
        *state.velocity, displaced, *state.displacement, *state.sweep, state.flat[VOLUME_FLUX],
        *(state.flat[n] for n in TO_HEAT[:2]), state.flat["dual_flux"], state.flat["mass_flux"],
        model.energy_quantum, sums)
    for name, value in zip(("elastic_before", "elastic_after", "plastic_work", "heat", "shock_viscosity", "returned",
                            "closing", "compression"), sums):
        ledger.add(name, value)
    return gradient, where


@phase("nodes")
def displace(state: State, model: Model, dt: float, displaced: bool) -> None:
    """Move the nodes on and go on without a remap: ghosts as the next forces read them."""
    runs, count = state.runs
    deformed.move_nodes(runs, count, state.part.cell_shape[1:], not displaced, dt / model.dx, *state.velocity,
                        *state.displacement)
    state.exchange(state.strained_cells, layers=1)
