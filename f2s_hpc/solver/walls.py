"""What walls hold: the velocity of their nodes, and the kinetic energy that goes with it."""

from __future__ import annotations

from f2s_hpc.fields import VELOCITY
from f2s_hpc.kernels import momentum
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State


def hold(state: State, model: Model, ledger: Ledger, count: str) -> None:
    """Set to zero the velocity components that walls and the floor hold.

    Mixing with the nodes beside it, in the remap or the exchange of light ones, gives a node of a fixed wall some
    velocity along the wall; what kinetic energy that is the wall takes, and ``count`` of the ledger receives. The mass
    of the cells must be valid in their first ghosts.
    """
    runs, number = state.runs
    for axis, plane in state.boundary.fixed_planes():
        walls = [state.views[name][(slice(None),) * (2 - axis) + (plane,)] for name in VELOCITY]
        if not any(wall.any() for wall in walls):
            continue
        window = list(state.node_window())
        low = 4 - 2 * axis
        window[low:low + 2] = max(window[low], plane), min(window[low + 1], plane + 1)
        ledger.add(count, momentum.wall_energy(
            runs, number, tuple(window), state.part.cell_shape[1:], state.boundary.weights, state.flat["mass"],
            *state.velocity, model.energy_quantum, model.dx, model.bulk.density))
        # at once, so that no edge is counted twice
        for wall in walls:
            wall[...] = 0.0
    state.boundary.hold([state.views[n] for n in VELOCITY])
