"""The remap half of the step: three directional sweeps back onto the fixed grid."""

from __future__ import annotations

import numpy as np

from f2s_hpc.fields import VELOCITY, VOLUME_FLUX
from f2s_hpc.grid.box import SIDES
from f2s_hpc.kernels import flux, momentum, remap, seal, tag
from f2s_hpc.phases import phase
from f2s_hpc.solver import absorbing, walls
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

SWEEP_ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0), (0, 2, 1), (1, 0, 2))

LAYERS_OF_CELLS, LAYERS_OF_NODES = 2, 3
"""Layers of ghosts that a sweep of cells (third order) and of nodes (fifth order) reads along its axis."""


def sweep_order(number: int) -> tuple[int, int, int]:
    """Return the axes in the order in which the remap of this number sweeps them."""
    return SWEEP_ORDERS[number % len(SWEEP_ORDERS)]


@phase("remap")
def remap_all(state: State, model: Model, number: int, ledger: Ledger) -> None:
    """Carry every field back onto the grid; the order of the three sweeps changes with ``number``, that of the remap.

    Valid before: ghosts of mass.
    The kinetic energy that the mixing of nodes takes is added to what light nodes lost since the last one, and entered.
    """
    # where losses do not heat they are counted in an array that is free until the next forces
    heats = state.lost.size > 1
    lost = state.lost if heats else state.flat["force_y"]
    runs, count = state.runs
    if not heats:
        momentum.clear_array(runs, count, state.part.cell_shape[1:], lost)
    done = 0
    order = sweep_order(number)
    state.exchange(("volume_fraction",))
    absorbing.lend_mass(state, model, ledger)
    state.exchange(state.swept_cells, LAYERS_OF_CELLS, order[0])
    state.exchange(VELOCITY, LAYERS_OF_NODES, order[0])
    for position, axis in enumerate(order):
        _fluxes(state, model, axis, done, ledger)
        _count_energy_out(state, model, axis, ledger)
        _sweep_nodes(state, model, axis, lost)
        _count_energy_out(state, model, axis, ledger)
        _sweep_cells(state, model, axis, done)
        done |= 1 << axis
        if position == 2:
            ledger.add("lost", momentum.sum_lost(
                runs, count, state.node_window(), state.part.cell_shape[1:], state.boundary.weights, lost,
                model.cell_mass, model.energy_quantum))
            _close(state, model, ledger)
        state.exchange(("mass", "volume_fraction"))
        walls.hold(state, model, ledger, "lost")
        if position < 2:
            state.exchange(state.swept_cells, LAYERS_OF_CELLS, order[position + 1])
            state.exchange(VELOCITY, LAYERS_OF_NODES, order[position + 1])
        else:
            state.exchange(state.carried_cells, layers=1)
            _seal(state, model)
            state.exchange(VELOCITY)
            if heats:
                state.exchange(("lost_energy",), layers=2)


def _fluxes(state: State, model: Model, axis: int, done: int, ledger: Ledger) -> None:
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    low, high = [1, 1, 1], [1, 1, 1]
    low[axis], high[axis] = 2, 2
    window = state.cell_window(tuple(low), tuple(high))
    arrays = (*state.sweep, state.flat["mass"], state.flat["volume_fraction"], state.flat[VOLUME_FLUX])
    boundary, memory, offset = state.boundary, state.pool.memory, state.pool.offsets["volume_fraction"]
    boundary.continue_outwards(memory, offset, state.active, True)
    flux.volume_fluxes(runs, count, window, shape, axis, done, *arrays)
    boundary.continue_outwards(memory, offset, state.active, False)
    low[axis] = 1
    window = state.cell_window(tuple(low), tuple(high))
    # (the dual fluxes come after)
    around, density = state.cell_window(*(tuple(3 if a == axis else 1 for a in range(3)),) * 2), state.flat["dual_flux"]
    flux.material_densities(runs, count, around, shape, done, *arrays[:5], density)
    flux.mass_fluxes(runs, count, window, shape, axis, float(model.settings.second_order), density, *arrays[3:],
                     state.flat["mass_flux"])
    _count_mass_out(state, model, axis, ledger)


def _outflow(state: State, axis: int) -> list[tuple]:
    """Return what the kernels of outflow take first, for each open side normal to ``axis`` that this rank touches."""
    return [(state.flat["mass_flux"], state.boundary.wall_plane(side), state.part.cell_shape[1:],
             1.0 if SIDES.index(side) % 2 else -1.0) for side in state.boundary.open_sides(axis)]


def _across(window: tuple[int, ...], axis: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the low and the high bounds of a window along the two axes that are not ``axis``."""
    k0, k1, j0, j1, i0, i1 = window
    bounds = [(i0, i1), (j0, j1), (k0, k1)]
    del bounds[axis]
    return tuple(b[0] for b in bounds), tuple(b[1] for b in bounds)


def _count_mass_out(state: State, model: Model, axis: int, ledger: Ledger) -> None:
    """Enter the mass that leaves through open faces into the ledger."""
    for flux_array, plane, shape, outward in _outflow(state, axis):
        ledger.add("mass_left", flux.mass_through_plane(flux_array, plane, shape, *_across(state.cell_window(), axis),
                                                        axis, outward, model.mass_quantum))


def _count_energy_out(state: State, model: Model, axis: int, ledger: Ledger) -> None:
    """Enter half of the kinetic energy that leaves through open faces into the ledger; before and after the nodes move.

    The dual flux takes half of what leaves from the node on the side, with the velocity that it had; the other half was
    in the node's outer half, of which nothing remains, and goes with the velocity that it gets.
    """
    for flux_array, plane, shape, outward in _outflow(state, axis):
        ledger.add("through_faces", flux.energy_through_plane(
            flux_array, plane, shape, *_across(state.node_window(), axis), axis, outward, state.boundary.weights,
            *state.velocity, 2.0 * model.energy_quantum / model.cell_mass))


def _sweep_nodes(state: State, model: Model, axis: int, lost: np.ndarray) -> None:
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    remap.nodal_masses(runs, count, state.node_window((3, 3, 3), (3, 3, 3)), shape, state.flat["mass"],
                       state.flat["nodal_mass"])
    high = [0, 0, 0]
    high[axis] = 1
    remap.dual_fluxes(runs, count, state.node_window(high=tuple(high)), shape, axis, state.flat["mass_flux"],
                      state.flat["dual_flux"])
    ny, nx = (n + 1 for n in shape)
    _sweep_fields(state, model, axis, state.node_window(), (nx * ny, nx), state.offsets(VELOCITY),
                  state.flat["nodal_mass"], state.flat["dual_flux"], lost)


def _sweep_cells(state: State, model: Model, axis: int, done: int) -> None:
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    ny, nx = shape
    for name in state.tags:
        _sweep_tag(state, axis, name)
    _sweep_fields(state, model, axis, state.cell_window(), (nx * ny, nx), state.offsets(state.swept_cells),
                  state.flat["mass"], state.flat["mass_flux"], None)
    remap.sweep_mass(runs, count, state.cell_window(), shape, axis, done, *state.sweep, state.flat[VOLUME_FLUX],
                     state.flat["mass_flux"], state.flat["mass"], state.flat["volume_fraction"])


def _sweep_tag(state: State, axis: int, name: str) -> None:
    """Move a tag along ``axis``; its planes need ghosts on all sides, where slopes need them along the axis alone."""
    state.exchange((name,), LAYERS_OF_CELLS)
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    around = [0, 0, 0]
    around[axis] = 1
    # (the dual fluxes are those of the nodes, which have moved)
    moved, tagged, mass = state.flat["mass_flux"], state.flat["dual_flux"], state.flat["mass"]
    tag.tag_fluxes(runs, count, state.cell_window(tuple(around), tuple(around)), shape, axis, moved, mass,
                   state.flat[name], tagged)
    tag.sweep_tag(runs, count, state.cell_window(), shape, axis, moved, tagged, mass, state.flat[name])


def _sweep_fields(state: State, model: Model, axis: int, window: tuple[int, ...], strides: tuple[int, int],
                  offsets: np.ndarray, masses: np.ndarray, moved: np.ndarray, lost: np.ndarray | None) -> None:
    ny, nx = (n + 1 for n in state.part.cell_shape[1:])
    moved_strides = (nx * ny, nx)
    second = float(model.settings.second_order)
    memory = state.pool.memory
    if axis == 0:
        runs, count = state.runs
        remap.sweep_along_rows(runs, count, window, strides, moved_strides, second, memory, offsets, masses, moved,
                               lost)
        return
    columns, count = state.columns(axis)
    k0, k1, j0, j1, i0, i1 = window
    if axis == 2:
        window = (j0, j1, k0, k1, i0, i1)
        strides, moved_strides = strides[::-1], moved_strides[::-1]
    remap.sweep_across_rows(columns, count, window, strides, moved_strides, second, memory, offsets, masses, moved,
                            lost)


def _close(state: State, model: Model, ledger: Ledger) -> None:
    runs, count = state.runs
    sums = np.zeros(1, dtype=np.int64)
    remap.close_cells(runs, count, state.cell_window(), state.part.cell_shape[1:], model.settings.dust,
                      model.bulk.spall_pressure, flux.FULL, model.eos, state.energy, state.flat["mass"],
                      state.flat["volume_fraction"], state.pool.memory, state.offsets(state.carried_cells),
                      model.mass_quantum, sums)
    ledger.add("mass_capped", sums[0])


def _seal(state: State, model: Model) -> None:
    """Close traces of void inside material, in the first layer of ghosts too; needs theirs and two of mass."""
    runs, count = state.runs
    seal.seal_cells(runs, count, state.cell_window((1, 1, 1), (1, 1, 1)), state.part.cell_shape[1:],
                    model.bulk.spall_pressure, model.eos, state.energy, state.flat["mass"], state.flat["peeq"],
                    state.flat["volume_fraction"])
