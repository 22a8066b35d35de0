"""The time step: what limits it, and where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import UnstableStep
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

START = 10.0
"""The first step after material was put in is chosen as for a velocity gradient so many times its speed per cell: no
gradient has been measured yet, and it may touch a side or other material from the start. The step then grows by its own
limit."""

SAVE, STOP = 1, 2

LIMITS = ("sound", "motion", "strain", "growth", "end of cycle")


@dataclass
class Limits:
    """Largest rates of this rank: wave speed, speed of light and heavy nodes (m/s), velocity gradient (1/s)."""

    wave: float = 0.0
    wave_cell: int = 0
    light_speed: float = 0.0
    heavy_speed: float = 0.0
    gradient: float = 0.0
    gradient_cell: int = 0
    request: int = 0  # this rank asks for a checkpoint (SAVE) or the end (STOP: signal, wall time)
    highest: int = -1  # plane of cells (global k): none above it is active

    def put_in(self, speed: float, dx: float) -> None:
        """Take notice of material that was painted with ``speed`` (m/s), wherever it is."""
        self.heavy_speed = max(self.heavy_speed, speed)
        self.gradient = max(self.gradient, START * speed / dx)

    def over_ranks(self) -> np.ndarray:
        """Return the largest wave, light, heavy speed, gradient, request, highest of all ranks; NaN as infinity."""
        local = np.array([self.wave, self.light_speed, self.heavy_speed, self.gradient, float(self.request),
                          float(self.highest)])
        return mpi.maximum(np.where(np.isnan(local), np.inf, local))


def cell_position(state: State, flat_index: int) -> tuple[int, int, int]:
    """Return the global (i, j, k) of a flat local cell index."""
    k, j, i = np.unravel_index(flat_index, state.part.cell_shape)
    return tuple(int(a) + o for a, o in zip((i, j, k), state.part.offset))


def locate(state: State, local_value: float, global_value: float, flat_index: int) -> tuple[int, int, int]:
    """Return, on every rank, the cell that set a limit: the lowest (k, j, i) among the ranks that reached it."""
    mine = math.isnan(local_value) or local_value == global_value
    cells = [c for c in mpi.all_gather(cell_position(state, flat_index)[::-1] if mine else None) if c is not None]
    return tuple(int(a) for a in min(cells)[::-1]) if cells else (-1, -1, -1)


@dataclass
class SinceRemap:
    """What happened since the last remap, at most: steps, way of material (in cells), strain."""

    steps: int = 0
    moved: float = 0.0
    strained: float = 0.0


@dataclass
class StepSize:
    """The chosen step (s), the name of its limit, and the rates that it follows from.

    ``since``: what will have happened since the last remap when the step is done; ``last``: is a remap due then?
    """

    dt: float
    limit: str
    rates: np.ndarray
    since: SinceRemap
    last: bool


def choose(state: State, model: Model, limits: Limits, previous: float | None, remaining: float,
           since: SinceRemap) -> StepSize:
    """Return the step that every rank takes.

    sound: courant dx / c (Lagrangian limit; c includes the shock viscosity, and is that of the material at rest while
    the box is empty, so that what flies is looked at on its way); motion: what is left of remap_courant dx
    since the last remap, over |u|; strain: strain_per_step / |grad v| of the last step; growth: 1.2 times the last
    step. Raises ``UnstableStep`` on all ranks, naming the cell, when a rate is not finite.
    """
    rates = limits.over_ranks()
    if not np.isfinite(rates).all():
        which = int(np.argmax(~np.isfinite(rates)))
        name = ("wave speed", "speed of a light node", "speed of a node", "velocity gradient")[which]
        local = (limits.wave, limits.light_speed, limits.heavy_speed, limits.gradient)[which]
        flat = limits.wave_cell if which < 3 else limits.gradient_cell
        cell = locate(state, local if math.isfinite(local) else math.nan, math.nan, flat)
        raise UnstableStep(f"the {name} is not finite at cell (i, j, k) = {cell}")
    wave, light, heavy, gradient = rates[:4]
    s = model.settings
    wave = wave or model.sound
    speed = max(light, heavy)
    sizes = [s.courant * model.dx / wave,
             (s.remap_courant - since.moved) * model.dx / speed if speed > 0.0 else math.inf,
             s.strain_per_step / gradient if gradient > 0.0 else math.inf,
             1.2 * previous if previous else math.inf]
    dt = min(sizes)
    limit = LIMITS[sizes.index(dt)]
    if not math.isfinite(dt):
        dt = remaining
    steps_left = max(1, math.ceil(remaining / dt * (1.0 - 1e-12)))
    if steps_left <= 4:
        # the last steps of a cycle share what is left, so none of them is a sliver
        shared = remaining / steps_left
        dt, limit = shared, (limit if shared > 0.9 * dt else LIMITS[4])
    moved, strained = dt * speed / model.dx, dt * gradient
    # the step after this one would be about as large, by what is known on all ranks
    last = (since.steps + 1 >= s.steps_per_remap or since.moved + 2.2 * moved > s.remap_courant
            or since.strained + 2.2 * strained > s.strain_per_remap or dt >= remaining)
    return StepSize(float(dt), limit, rates, SinceRemap(since.steps + 1, since.moved + moved,
                                                        since.strained + strained), last)
