"""The energy that no term explains, as a row with its bar, for any case whose box has a ledger."""

from __future__ import annotations

from collections.abc import Sequence

from f2s_hpc.cycles import measure
from f2s_hpc.verify.box import Setup
from f2s_hpc.verify.case import Measured

BAR = 0.005
"""Largest share of the energy brought in that neither physics nor a loss in space may leave unexplained."""

QUANTITY = "time step and remainder"


def unexplained(balance: dict) -> float:
    """Return the share of the energy brought in that is error of the explicit step, or that no term explains.

    ``balance``: of ``measure_balance``.
    """
    energy = balance["energy"]
    return (energy["time_step"] + energy["remainder"]) / energy["brought_in"]


def row(balances: Sequence[dict], level: float, dx: float, cost: dict, of: str = "",
        bar: float | None = BAR) -> Measured:
    """Return the row of the share that is unexplained, of the run out of ``balances`` with the largest."""
    worst = max((unexplained(balance) for balance in balances), key=abs)
    return Measured(QUANTITY + of, level, dx, worst, 0.0, abs(worst), bar, **cost)


def row_of(setup: Setup, level: float, cost: dict, bar: float = BAR) -> Measured:
    """Return the row of a box that was empty before its bodies were painted, as it stands; collective."""
    balance = measure.measure_balance(setup.state, setup.model, setup.ledger, 0)
    return row([balance], level, setup.model.dx, cost, bar=bar)
