"""The verification cases by name: one line per module that has some."""

from __future__ import annotations

from collections.abc import Sequence

from f2s_hpc.config.messages import did_you_mean
from f2s_hpc.errors import InputError
from f2s_hpc.verify import (
    absorbing,
    against_lagrangian,
    contact,
    deposit,
    free_bodies,
    heat,
    impact,
    material,
    motion,
    piston,
    radial_return,
    taylor,
    vof,
    waves,
)
from f2s_hpc.verify.case import Case

MODULES = (
    material,
    radial_return,
    waves,
    absorbing,
    piston,
    motion,
    free_bodies,
    heat,
    vof,
    taylor,
    impact,
    against_lagrangian,
    deposit,
    contact,
)

CASES: tuple[Case, ...] = tuple(case for module in MODULES for case in module.CASES)


def find(names: Sequence[str]) -> list[Case]:
    """Return the cases of these names, each once, or all of them if none is named.

    Raises ``InputError`` for an unknown name, with a suggestion.
    """
    by_name = {case.name: case for case in CASES}
    for name in names:
        if name not in by_name:
            raise InputError(f'no verification case "{name}"; {did_you_mean(name, by_name)}')
    return [by_name[name] for name in dict.fromkeys(names)] if names else list(CASES)
