"""Conduction, explicit, in as many sub-steps as its own limit asks for."""

from __future__ import annotations

import math

from f2s_hpc.fields import VOLUME_FLUX
from f2s_hpc.grid.box import GHOST
from f2s_hpc.kernels import conduction
from f2s_hpc.phases import phase
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

LARGEST_NUMBER = 1.0 / 6.0
"""Explicit limit of k dt / (rho c_p dx^2) in three dimensions."""


def diffusivity(model: Model) -> float:
    """Return the thermal diffusivity k / (rho c_p) in m2/s."""
    return model.bulk.conductivity / (model.bulk.density * model.bulk.specific_heat)


def conduct(state: State, model: Model, dt: float, heated: bool = False) -> None:
    """Conduct heat over ``dt``; ghosts of temperature must be valid before, those after the last sub-step are not.

    ``heated``: they are not valid, cells were heated since. Nothing flows to or from what sleeps.
    """
    if heated:
        state.exchange(("temperature",), layers=1)
    floor = state.floor_plane if state.floor else -1
    _conduct(state, model, dt, state.runs, state.cell_window(), (floor, 0.0, 1.0))


def conduct_asleep(state: State, model: Model, dt: float) -> None:
    """Conduct heat over ``dt`` in what sleeps, and through the floor; all ghosts of what it changes are valid after."""
    k0, k1, *across = state.cell_window()
    end = min(k0 + 1, k1) if state.part.start[2] <= state.floor else k0
    _conduct(state, model, dt, state.all_runs, (GHOST, end, *across), (state.floor_plane, 1.0, 0.0))
    state.exchange(tuple(n for n in ("temperature", "internal_energy") if n in state.views), asleep=True)


@phase("conduction")
def _conduct(state: State, model: Model, dt: float, listed: tuple, window: tuple, floor: tuple) -> None:
    number = diffusivity(model) * dt / model.dx**2
    substeps = max(1, math.ceil(number / LARGEST_NUMBER))
    runs, count = listed
    shape = state.part.cell_shape[1:]
    gained, temperature = state.flat[VOLUME_FLUX], state.flat["temperature"]
    for substep in range(substeps):
        conduction.heat_gained(runs, count, window, shape, number / substeps, floor, state.flat["mass"], temperature,
                               gained)
        conduction.add_heat(runs, count, window, shape, gained, model.bulk.specific_heat, temperature, state.energy)
        if substep + 1 < substeps:
            state.exchange(("temperature",), asleep=True)
