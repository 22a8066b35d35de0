"""The tables of ``f2s verify`` as text: one of a case, and the overview of all."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from f2s_hpc.analysis.table import aligned
from f2s_hpc.units import count_text

_HEAD = ("quantity", "cells", "dx", "value", "reference", "error", "order", "bar", "verdict", "steps", "cell-steps",
         "wall s")
_VERDICT = {True: "met", False: "MISSED", None: "-"}
_WIDEST = 60
NOTHING = "nothing judged"


def case_table(name: str, text: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of one case: its name, what it compares (``text``, first line the title), and a line per row.

    ``rows``: mappings with quantity, resolution, dx_m, value, reference, error, order, bar, least_order, passed,
    steps, cell_steps, wall_s (SI; None where there is nothing). Rows of one quantity stand together, coarse to fine.
    """
    quantities = list(dict.fromkeys(row["quantity"] for row in rows))
    ordered = [row for quantity in quantities for row in rows if row["quantity"] == quantity]
    lines, last = [], None
    for row in ordered:
        lines.append((row["quantity"] if row["quantity"] != last else "", _plain(row["resolution"], 4),
                      _plain(row["dx_m"], 3), _plain(row["value"], 6), _plain(row["reference"], 6),
                      _scientific(row["error"]), _plain(row["order"], 3), _bar(row), _VERDICT[row["passed"]],
                      f"{row['steps']:d}", _plain(float(row["cell_steps"]), 3), f"{row['wall_s']:.2f}"))
        last = row["quantity"]
    title, _, rest = text.partition("\n")
    told = textwrap.wrap(" ".join(rest.split()), 118, initial_indent="  ", subsequent_indent="  ")
    return "\n".join([f"{name}: {title}", *told, _aligned(_HEAD, lines)])


def overview_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line per case (bars met, the bar with the least margin, wall time) and ``N of M bars met``.

    Where there is no bar at all, nothing is judged, which is not met.
    """
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        asked = [row for row in mine if row["passed"] is not None]
        lines.append((case, _met(asked), _tightest(asked), f"{_wall(mine):.1f}"))
    asked = [row for row in rows if row["passed"] is not None]
    told = f"{_met(asked)} bars met" if asked else NOTHING
    skipped = sum(row["quantity"].startswith("skipped: ") for row in rows)
    told += f", {count_text(skipped, 'resolution')} skipped: too small a box for so many ranks" if skipped else ""
    table = _aligned(("case", "bars met", "least margin", "wall s"), lines, left=(0, 2))
    return f"{table}\n{told}"


def _met(asked: Sequence[Mapping[str, Any]]) -> str:
    """Say how many of the rows with a verdict have met theirs."""
    return f"{sum(row['passed'] for row in asked)} of {len(asked)}" if asked else NOTHING


def _wall(rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the wall time of a case: rows of one run share theirs."""
    return sum({(row["resolution"], row["steps"], row["wall_s"]): row["wall_s"] for row in rows}.values())


def _tightest(rows: Sequence[Mapping[str, Any]]) -> str:
    """Say which bar is missed by most, or nearest to being missed."""
    missed = [row for row in rows if not row["passed"]]
    best, text = -1.0, "-"
    for row in missed or rows:
        share = 0.0
        if row["bar"] is not None:
            share = row["error"] / row["bar"] if row["bar"] > 0.0 else (math.inf if row["error"] > 0.0 else 0.0)
        if share > best:
            best, short = share, textwrap.shorten(row["quantity"], _WIDEST, placeholder=" ...")
            text = f"{'MISSED: ' if missed else ''}{short}, {_plain(row['resolution'], 4)} cells: "
            text += f"error {_scientific(row['error'])}, bar {_bar(row)}"
            if row["least_order"] is not None:
                text += f", order {_plain(row['order'], 3)}"
    return text


def _bar(row: Mapping[str, Any]) -> str:
    parts = [] if row["bar"] is None else [f"{row['bar']:.2g}"]
    if row["least_order"] is not None:
        parts.append(f"order {row['least_order']:g}")
    return ", ".join(parts) or "-"


def _plain(number: float | None, digits: int) -> str:
    return "-" if number is None or math.isnan(number) else f"{number:.{digits}g}"


def _scientific(number: float) -> str:
    return f"{number:.2e}" if math.isfinite(number) and number != 0.0 else f"{number:g}"


def _aligned(head: Sequence[str], lines: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Return head, rule and lines, with cells that are too long cut short."""
    lines = [[textwrap.shorten(cell, 2 * _WIDEST, placeholder=" ...") for cell in line] for line in lines]
    return "\n".join(aligned([head, *lines], left, rule=True))
