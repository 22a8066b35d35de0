"""Where a run's time goes: wall seconds of this rank, by phase.

Each moment belongs to the innermost phase that is under way, to ``other`` if none is, so that the phases of a rank add
up to its wall time. Up to the end of the first step, which compiles or loads the kernels, all of it is ``startup``. No
communication: that ranks wait for each other shows in ``ghosts`` and ``reductions``, and in ``output`` where rank 0
writes alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from time import perf_counter

PHASES = {
    "startup": "set up or read the state, up to the end of the first step or to a dwell that comes first",
    "particles": "look for arrivals, paint them, insert batches",
    "activity": "find the active blocks, and what sleeps",
    "forces": "forces of the cells on the nodes",
    "nodes": "kick and move the nodes, light nodes",
    "deformation": "strain, stress and plastic flow (one kernel)",
    "conduction": "conduction, and the pauses between cycles in which only heat flows",
    "remap": "remap",
    "ghosts": "ghosts of all the above that other ranks own, waiting for them",
    "reductions": "maxima and sums over the ranks, waiting for all",
    "tracers": "seed and move tracers",
    "measuring": "the row of the cycle table",
    "output": "checkpoints, frames, view, tables",
    "other": "the rest",
}
"""The phases and what is in them."""

_NUMBERS = {name: number for number, name in enumerate(PHASES)}
_STARTUP, _OTHER = _NUMBERS["startup"], _NUMBERS["other"]


class _Watch:
    """The stopwatch of this process; ``follow`` is told the number of each phase that is entered."""

    def __init__(self) -> None:
        self.spent = [0.0] * len(PHASES)
        self.present = _OTHER
        self.since = perf_counter()
        self.follow: Callable[[int], None] | None = None

    def switch(self, phase: int) -> int:
        """Enter ``phase``; return the one that is left."""
        now, left = perf_counter(), self.present
        self.spent[left] += now - self.since
        self.present, self.since = phase, now
        if self.follow is not None:
            self.follow(phase)
        return left


_watch = _Watch()


def phase(name: str) -> Callable[[Callable], Callable]:
    """Return a decorator: what the function takes belongs to phase ``name``, but for inner phases. Costs 0.5 us."""
    number, watch = _NUMBERS[name], _watch

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def timed(*arguments, **named):
            left = watch.switch(number)
            try:
                return function(*arguments, **named)
            finally:
                watch.switch(left)

        return timed

    return decorate


def start() -> None:
    """Start anew, with ``startup``."""
    _watch.follow = None
    _watch.spent = [0.0] * len(PHASES)
    _watch.present, _watch.since = _STARTUP, perf_counter()


def started(follow: Callable[[int], None] | None = None) -> None:
    """End ``startup``, between two phases; ``follow`` is told the number of each phase from now on."""
    _watch.switch(_OTHER)
    everything = sum(_watch.spent)
    _watch.spent = [0.0] * len(PHASES)
    _watch.spent[_STARTUP] = everything
    _watch.follow = follow


def seconds() -> list[float]:
    """Return the seconds of each of ``PHASES`` since the start, on this rank."""
    _watch.switch(_watch.present)
    return list(_watch.spent)
