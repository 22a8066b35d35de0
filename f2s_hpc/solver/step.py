"""One time step, on one screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc.errors import UnstableStep
from f2s_hpc.solver import heat, lagrange, remap, sleep, timestep
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

SMALLEST_SHARE = 1e-4
"""A step this much smaller than the sound limit of the material at rest is a collapse."""


@dataclass
class Clock:
    """Where the run is: time (s) as the cycle's start plus the time in the cycle, steps, last step."""

    cycle_start: float = 0.0
    in_cycle: float = 0.0
    steps: int = 0
    remaps: int = 0
    dt: float | None = None
    between_remaps: float = 0.0  # time (s) between the last two remaps of which the end of a cycle cut none short
    limit: str = ""
    limits: timestep.Limits = field(default_factory=timestep.Limits)
    fastest_heavy: float = 0.0
    stop: bool = False  # some rank asked for a stop; all ranks know it after the same step
    save: bool = False  # likewise, for a checkpoint
    active_cell_steps: int = 0
    sleep: sleep.Sleep = field(default_factory=sleep.Sleep)

    @property
    def time(self) -> float:
        """Time since the start of the run (s)."""
        return self.cycle_start + self.in_cycle


def advance(state: State, model: Model, clock: Clock, ledger: Ledger, cycle_end: float,
            most: int | None = None, follow: Callable[[float, bool], None] | None = None) -> None:
    """Take Lagrangian steps on the moving mesh, then remap back onto the fixed one.

    As many steps as the settings allow, at most ``most``; between two remaps velocity is at half steps, at a remap
    everything is at the same time. ``cycle_end``: duration of the cycle (s). Before and after, the ghosts that the next
    step reads are valid: all of mass and velocity, the first layer of the other fields. Stops all ranks with
    ``UnstableStep``.
    ``follow`` is called before the remap, for what moves with the nodes: with the last step (s), and whether others
    before it have displaced them.
    """
    if model.settings.sleeping_depth:
        sleep.look(state, model, clock.sleep, clock.time, clock.remaps, ledger)
    state.update_activity()
    since, started = timestep.SinceRemap(), clock.in_cycle
    while True:
        displaced, limits, power = since.steps > 0, clock.limits, np.zeros(1, dtype=np.int64)
        limits.wave, limits.wave_cell = lagrange.forces(state, model, clock.dt or 0.0, power, displaced)
        limits.highest = state.highest_plane()
        size = timestep.choose(state, model, limits, clock.dt, cycle_end - clock.in_cycle, since)
        _refuse_collapse(state, model, size, limits)
        dt, since = size.dt, size.since
        clock.stop, clock.save = size.rates[4] >= timestep.STOP, size.rates[4] == timestep.SAVE
        state.pool.cover(int(size.rates[5]))

        # from the remap, or from the middle of the last step, to the middle of this one
        before = clock.dt if displaced else 0.0
        kicked = 0.5 * (before + dt)
        ledger.add_power("hourglass_power", power[0], kicked)
        lagrange.kick(state, model, before, dt, ledger)
        limits.light_speed, limits.heavy_speed = lagrange.calm_light_nodes(state, model, dt, ledger)
        last = size.last or since.steps == most
        if model.settings.conduction and last:
            heat.conduct(state, model, clock.in_cycle + dt - started, displaced)
        limits.gradient, limits.gradient_cell = lagrange.deform(state, model, dt, ledger, displaced, last, kicked)

        clock.active_cell_steps += state.active_cells()
        clock.fastest_heavy = max(clock.fastest_heavy, limits.heavy_speed)
        clock.in_cycle, clock.steps = clock.in_cycle + dt, clock.steps + 1
        clock.dt, clock.limit = dt, size.limit
        if last:
            break
        lagrange.displace(state, model, dt, displaced)
    if follow is not None:
        follow(dt, displaced)
    lagrange.second_half(state, model, dt, displaced, ledger)
    remap.remap_all(state, model, clock.remaps, ledger)
    interval = clock.in_cycle - started
    if clock.in_cycle > cycle_end * (1.0 - 1e-9):  # cut short by the end of the cycle
        interval = max(interval, clock.between_remaps)
    clock.remaps, clock.between_remaps = clock.remaps + 1, interval


def _refuse_collapse(state: State, model: Model, size: timestep.StepSize, limits: timestep.Limits) -> None:
    """Raise ``UnstableStep`` when the step has collapsed; names the limit and the cell."""
    if size.limit == "end of cycle" or size.dt > SMALLEST_SHARE * model.settings.courant * model.dx / model.sound:
        return
    which = 3 if size.limit == "strain" else 0
    local = (limits.wave, limits.gradient)[which // 3]
    cell = timestep.locate(state, local, size.rates[which], (limits.wave_cell, limits.gradient_cell)[which // 3])
    raise UnstableStep(f"the time step collapsed to {size.dt:.3g} s, limited by {size.limit}, near cell (i, j, k) = "
                       f"{cell}")
