"""Verification cases of bodies as tests run them: judged rows by quantity, and made-up impacts."""

from __future__ import annotations

import math
from types import SimpleNamespace

from f2s_hpc.solver.ledger import ENERGY_TERMS
from f2s_hpc.verify import contact, deposit, impact, taylor
from f2s_hpc.verify.case import Case, Row, judged
from f2s_hpc.verify.splat import Splat

CASES = {case.name: case for module in (taylor, impact, deposit, contact) for case in module.CASES}


def rows(name: str, *overrides: str) -> dict[tuple[str, float], Row]:
    """Return the judged rows of a case at quick size, by quantity and resolution; each is finite and has a cost."""
    case: Case = CASES[name]
    found = judged(case.name, list(case.run(case.options(False, list(overrides)))))
    for row in found:
        assert math.isfinite(row.measured.value)
        assert math.isfinite(row.measured.error)
        assert row.measured.steps > 0
        assert row.measured.cell_steps > 0
        assert row.measured.wall_s > 0.0
    return {(row.measured.quantity, row.measured.resolution): row for row in found}


def error(found: dict[tuple[str, float], Row], quantity: str, resolution: float) -> float:
    return found[quantity, resolution].measured.error


def made_splat(impact_: impact.Impact, level: float, _, place: float = 0.0) -> Splat:
    """Return what a run of an impact would, in round numbers, and with a loss of a tenth."""
    energy = dict.fromkeys(ENERGY_TERMS, 0.0) | {"brought_in": 1.0, "plastic_work": 0.9, "hourglass": 0.1}
    settings = SimpleNamespace(courant=0.5, remap_courant=0.4, strain_per_step=0.1, strain_per_remap=0.2)
    return Splat(impact_.diameter / level, 1.0, 1.0, 1.2 * impact_.duration, (0.4 + place) * impact_.diameter, 1.0, 0.9,
                 0.5, 400.0, {"energy": energy, "numerical_loss_fraction": 0.1}, settings, 1, 1, 1.0)
