"""The dwell between two cycles: the deposit stands still, and heat flows for as long as the spray gun stays away.

A pass of the gun takes seconds to come back, conduction by explicit sub-steps 1e-8 s at a time. So heat is conducted in
super steps of the Runge-Kutta-Legendre kind (RKL2: Meyer, Balsara and Aslam, J. Comput. Phys. 257 (2014) 594): s stages
go as far as s^2 / 4 explicit steps, stable at any s, of second order, and heat is kept as the fluxes are the same. An
implicit solution by Krylov's methods would need sums over all cells, whose bits hang on the number of ranks; here each
cell sees its neighbours only.

Nothing moves, so nothing contracts either: with Mie-Grueneisen pressure the internal energy, and with it pressure and
density, stays as it was. Energy that followed the heat would put all of a deposit that cools by some 300 K in place
under a tension beyond the spall cutoff, and it would tear in the next step, every cell of it; real metal contracts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.fields import VOLUME_FLUX
from f2s_hpc.grid.pages import sparse_zeros
from f2s_hpc.kernels import conduction
from f2s_hpc.phases import phase
from f2s_hpc.solver.heat import diffusivity
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

LARGEST_NUMBER = 1.0 / 7.0
"""Explicit limit of k dt / (rho c_p dx^2): six faces, of which the one to what is held can count twice."""

GROWTH = 1.3
"""Each super step is longer than the one before by this: fine differences have gone by then."""

MOST_STAGES = 999
LONGEST_NUMBER = 0.25 * (MOST_STAGES**2 + MOST_STAGES - 2) * LARGEST_NUMBER
"""k tau / (rho c_p dx^2) of the longest super step."""

NOTHING_CHANGES = 1e-3
"""A dwell ends when at the present rate no cell would change by more than this (K) until its end."""

ROUND_OFF = 1e-8
"""It also ends when the longest super step changes no cell by more than this (K): of 999 stages round-off alone leaves
some 1e-9, so that a dwell of an hour on fine cells would else never come to its end."""

STAGE_SHARE = 0.02
"""Time of a stage over that of a step on the same cells, measured."""


@dataclass
class Course:
    """How far a dwell has come: ``left`` (s), ``number`` = k tau / (rho c_p dx^2) of its next super step, ``stages``
    taken so far."""

    left: float
    number: float = 2.0 * LARGEST_NUMBER
    stages: int = 0


def most_stages(duration: float, per_second: float) -> int:
    """Return how many stages a dwell of ``duration`` (s) takes if it does not end early; ``per_second``: k / (rho c_p
    dx^2)."""
    left, course = duration * per_second, Course(duration)
    while left > 0.0 and course.number < LONGEST_NUMBER:
        course.stages += stage_count(min(course.number, left))
        left, course.number = left - course.number, GROWTH * course.number
    return course.stages + max(0, math.ceil(left / LONGEST_NUMBER)) * MOST_STAGES


def stage_count(number: float) -> int:
    """Return the least odd number of stages that takes a super step of ``number`` = k tau / (rho c_p dx^2)."""
    wanted = 0.5 * (math.sqrt(9.0 + 16.0 * number / LARGEST_NUMBER) - 1.0)
    return max(3, 2 * math.ceil((wanted * (1.0 - 1e-12) - 1.0) / 2.0) + 1)


def stage_weights(stages: int) -> list[tuple[float, float, float, float]]:
    """Return (mu, nu, mu~, gamma~) of each stage of RKL2, the first included (its mu, nu and gamma~ are 1, 0 and 0)."""
    def b(j: int) -> float:
        return (j * j + j - 2.0) / (2.0 * j * (j + 1.0)) if j > 1 else 1.0 / 3.0

    w = 4.0 / (stages * stages + stages - 2.0)
    weights = [(1.0, 0.0, b(1) * w, 0.0)]
    for j in range(2, stages + 1):
        mu = (2.0 * j - 1.0) / j * b(j) / b(j - 1)
        weights.append((mu, -(j - 1.0) / j * b(j) / b(j - 2), mu * w, -(1.0 - b(j - 1)) * mu * w))
    return weights


def _nothing(_left: float) -> int:
    return 0


@phase("conduction")
def dwell(state: State, model: Model, course: Course, backing: float | None, held_at: float,
          asks: Callable[[float], int] = _nothing) -> int:
    """Conduct heat, and nothing else, until nothing is left of ``course``. Collective.

    ``backing``: thickness (m) of what lies below the box, whose far side is held at ``held_at`` (K) and which takes up
    no heat itself; None: nothing flows through the bottom. What sleeps takes part. All ghosts are valid before and
    after.
    ``asks``: called after each super step with the seconds that are left; returns what this rank asks for, 0 for
    nothing. Returns the highest of what all ranks ask for: then ``course`` says how to go on, to the same bits; 0 at
    the end.
    """
    state.update_activity()
    work = _Work(state, model, backing, held_at)
    per_second, asked = diffusivity(model) / model.dx**2, 0
    while course.left > 0.0 and not asked:
        step = min(course.number / per_second, course.left)
        stages, own_change = work.super_step(step * per_second)
        course.stages, course.left = course.stages + stages, course.left - step
        change, asked = mpi.maximum(np.array([own_change, asks(course.left)]))
        unchanged = change < ROUND_OFF and course.number == LONGEST_NUMBER
        if unchanged or change * course.left < NOTHING_CHANGES * step:
            course.left = 0.0
        course.number = min(GROWTH * course.number, LONGEST_NUMBER)
    state.exchange(("temperature",), asleep=True)
    state.release_work()
    return int(asked) if course.left > 0.0 else 0


class _Work:
    """Arrays and windows of a dwell, which live no longer than it."""

    def __init__(self, state: State, model: Model, backing: float | None, held_at: float) -> None:
        self.state, self.model, self.held_at = state, model, held_at
        part = state.part
        self.shape, self.window, (self.runs, self.count) = part.cell_shape[1:], state.owned_window(), state.all_runs
        self.start, self.before = (sparse_zeros(part.cell_shape).reshape(-1) for _ in range(2))
        self.first_gained = sparse_zeros(state.views[VOLUME_FLUX].shape).reshape(-1)
        at_bottom = backing is not None and part.start[2] == 0
        self.share = model.dx / (0.5 * model.dx + backing) if at_bottom else 0.0

    @property
    def _where(self) -> tuple:
        return self.runs, self.count, self.window, self.shape

    def _heat_gained(self, number: float, gained: np.ndarray) -> None:
        """What each cell would gain in an explicit step of ``number``, however long, into ``gained`` (K)."""
        mass, temperature = self.state.flat["mass"], self.state.flat["temperature"]
        conduction.heat_gained(*self._where, number, (-1, 0.0, 1.0), mass, temperature, gained)
        if self.share:
            conduction.heat_through_bottom(*self._where, number, self.share, self.held_at, mass, temperature, gained)

    def super_step(self, number: float) -> tuple[int, float]:
        """Take a super step of ``number`` = k tau / (rho c_p dx^2); return its stages and largest change here (K)."""
        state, gained = self.state, self.state.flat[VOLUME_FLUX]
        temperature = state.flat["temperature"]
        conduction.remember(self.runs, self.count, state.views["temperature"], self.start, self.before)
        self._heat_gained(number, self.first_gained)
        stages = stage_count(number)
        for j, weights in enumerate(stage_weights(stages)):
            if j:
                state.exchange(("temperature",), layers=1, asleep=True)
                self._heat_gained(number, gained)
            conduction.super_stage(*self._where, weights, gained if j else self.first_gained, self.first_gained,
                                   self.start, self.before, temperature)
        state.exchange(("temperature",), layers=1, asleep=True)
        return stages, conduction.largest_change(*self._where, self.start, temperature)
