"""The phases of a run as stages of PETSc's own log (``PETSC_OPTIONS=-log_view``)."""

from __future__ import annotations

from collections.abc import Callable

from f2s_hpc.grid import petsc
from f2s_hpc.phases import PHASES


def stages() -> Callable[[int], None] | None:
    """Return what ends the present stage and begins that of a phase's number; None where PETSc was asked for no log.

    To be called by all ranks, which must know the same stages. Until the first call the first phase is under way.
    """
    log = petsc.load().Log
    if not log.isActive():
        return None
    known = [log.Stage(name) for name in PHASES]
    present = 0
    known[present].push()

    def enter(phase: int) -> None:
        nonlocal present
        if phase != present:
            known[present].pop()
            known[phase].push()
            present = phase

    return enter
