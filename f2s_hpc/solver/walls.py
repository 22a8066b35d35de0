"""What walls hold: the velocity of their nodes, and the kinetic energy that goes with it."""

from __future__ import annotations

from f2s_hpc.fields import VELOCITY
from f2s_hpc.kernels import momentum, remap
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State


def hold(state: State, model: Model, ledger: Ledger, count: str, masses_known: bool) -> None:
    """Set to zero the velocity components that walls and the floor hold.

    Mixing with the nodes beside it, in the remap or the exchange of light ones, gives a node of a fixed wall some
    velocity along the wall; what kinetic energy that is the wall takes, and ``count`` of the ledger receives.
    ``masses_known``: the nodal masses of the walls are those of now; else they are renewed from the mass of the cells,
    of which the first ghosts must be valid.
    """
    runs, number = state.runs
    shape = state.part.cell_shape[1:]
    for axis, plane in state.boundary.fixed_planes():
        window = list(state.node_window())
        low = 4 - 2 * axis
        window[low:low + 2] = max(window[low], plane), min(window[low + 1], plane + 1)
        if not masses_known:
            remap.nodal_masses(runs, number, tuple(window), shape, state.flat["mass"], state.flat["nodal_mass"])
        ledger.add(count, momentum.kinetic_energy(
            runs, number, tuple(window), shape, state.boundary.weights, state.flat["nodal_mass"], *state.velocity,
            model.energy_quantum, model.dx, model.bulk.density))
        # at once, so that no edge is counted twice
        for name in VELOCITY:
            state.views[name][(slice(None),) * (2 - axis) + (plane,)] = 0.0
    state.boundary.hold([state.views[n] for n in VELOCITY])
