"""Sleeping depth: what lies deep below the surface and has come to rest is not stepped; it wakes when flow reaches it.

The floor is one horizontal plane. Below it nothing is stepped and velocities are zero; what stands on it meets a rigid
wall, as at the bottom of the box. Stress, PEEQ and mass below stay as they are, and heat still flows, there and through
the floor, in one large step at each look.

Every ``EVERY`` remaps, or after each where sound would cross too much in so many, the floor rises to the highest plane
that is at least ``sleeping_depth`` below the surface and has nothing but rest below it; the surface is the highest
plane below which every plane is ``FULL`` filled. A plane is at rest while no node of it is faster than a small share of
the particles' speed, and no cell under a higher pressure than that of a sound wave of that speed (where a wave is
thrown back nothing moves, but all is under twice its pressure). The kinetic energy of the ringing that is left is taken
out and entered in the ledger. The floor falls by ``MARGIN`` planes when among as many planes above it speed or pressure
is ``WAKES`` times as high, and below all material that is put in. All sums over ranks are of integers, or are maxima,
so any number of ranks finds the same floor.

Measured on a patch of section4 at 6 um, 10 cycles: PEEQ p95 rises by 1.3 to 1.4 % at a depth of 12 cells, and (with
``WAKES`` 4, ``MARGIN`` 4) by 1.5 % even at 25, ten times the scatter of the full computation; so it is off by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.fields import VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.kernels import activity, momentum, remap
from f2s_hpc.solver import heat
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

EVERY = 2
"""Remaps between two looks, if a sound wave passes no more than ``MARGIN`` planes in that time."""

FULL = 0.9
"""Share of a plane that is filled below the surface."""

REST = 0.03
"""Speed of rest over the particles' speed."""

WAKES = 1.5
"""Speed that wakes what sleeps, over the speed of rest."""

MARGIN = 8
"""Planes by which the floor falls, and above it in which flow is looked for."""


@dataclass
class Sleep:
    """``since``: time (s) up to which heat has been conducted in what sleeps."""

    since: float = 0.0


def look(state: State, model: Model, sleep: Sleep, time: float, remaps: int, ledger: Ledger) -> None:
    """Every so many remaps: conduct heat in what sleeps up to ``time`` (s), and find the floor anew (collective).

    ``remaps``: those done so far. All ghosts must be valid, as after a remap.
    """
    s = model.settings
    if remaps % (EVERY if EVERY * s.steps_per_remap * s.courant <= MARGIN else 1):
        return
    catch_up(state, model, sleep, time)
    floor = find_floor(state, model)
    if floor > state.floor:
        ledger.add("put_to_sleep", _stop(state, model, floor))
    if floor != state.floor:
        state.set_floor(floor)


def wake_for(state: State, model: Model, sleep: Sleep, time: float, height: float) -> None:
    """Wake what lies above ``MARGIN`` planes below ``height`` (m, from the bottom of the box); material comes there.

    ``time``: now (s). To be called before it is put in. Collective.
    """
    floor = max(math.floor(height / model.dx) - MARGIN, 0)
    if floor < state.floor:
        catch_up(state, model, sleep, time)
        state.set_floor(floor)


def catch_up(state: State, model: Model, sleep: Sleep, time: float) -> None:
    """Conduct heat in what sleeps up to ``time`` (s); collective."""
    if state.floor and model.settings.conduction and time > sleep.since:
        heat.conduct_asleep(state, model, time - sleep.since)
    sleep.since = time


def find_floor(state: State, model: Model) -> int:
    """Return the plane of the box (global k) below which all may sleep now; 0: nothing. Collective."""
    s, box = model.settings, state.part.box
    filled, speed = _planes(state, model)
    low = ~(filled >= FULL * box.cells[0] * box.cells[1])
    low[:state.floor] = False
    surface = int(np.argmax(low)) if low.any() else low.size
    fast = speed > s.rest_speed
    deepest = int(np.argmax(fast)) if fast.any() else fast.size
    floor = min(surface - round(s.sleeping_depth / model.dx), deepest - 1)
    if state.floor and speed[state.floor:state.floor + MARGIN + 1].max() > WAKES * s.rest_speed:
        return max(state.floor - MARGIN, 0)
    return max(floor, state.floor)


def _planes(state: State, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the filled cells of each plane of cells of the box, and the largest speed (m/s) of each plane of nodes.

    That of a sound wave counts as speed, of as much pressure as the cells above the nodes bear. Zero for what sleeps.
    """
    box, start, bulk = state.part.box, state.part.start[2], model.bulk
    quanta, most = np.zeros(box.cells[2], dtype=np.int64), np.zeros((2, box.cells[2] + 1))
    activity.look_at_planes(
        state.cell_window(), state.node_window(), state.part.cell_shape[1:], start - GHOST, model.eos,
        state.flat["mass"], state.flat["volume_fraction"], state.energy, *state.velocity, quanta, *most)
    pressure, square = mpi.maximum(most)
    impedance = np.sqrt(bulk.density * (bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus))
    return mpi.total(quanta) / 2.0**20, np.maximum(np.sqrt(square), pressure / impedance)


def _stop(state: State, model: Model, floor: int) -> int:
    """Bring all nodes on and below ``floor`` to rest; return their kinetic energy on this rank in quanta, exact."""
    shape = state.part.cell_shape[1:]
    end = GHOST + floor + 1 - state.part.start[2]
    k0, k1, *across = state.node_window()
    window = (k0, min(k1, end), *across)
    state.update_activity()
    runs, count = state.runs
    remap.nodal_masses(runs, count, window, shape, state.flat["mass"], state.flat["nodal_mass"])
    quanta = momentum.kinetic_energy(runs, count, window, shape, state.boundary.weights, state.flat["nodal_mass"],
                                     *state.velocity, model.energy_quantum, model.dx, model.bulk.density)
    for name in (*VELOCITY, *(("lost_energy",) if state.lost.size > 1 else ())):
        state.views[name][:max(end, 0)] = 0.0
    return int(quanta)
