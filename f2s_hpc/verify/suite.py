"""``f2s verify``: run cases, print and write what they measured, and judge."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import os
import pathlib
from collections.abc import Sequence
from typing import Any

from f2s_hpc import mpi, places
from f2s_hpc.analysis.verification import case_table, overview_table
from f2s_hpc.analysis.work_precision import draw_case, draw_overview
from f2s_hpc.config.messages import did_you_mean
from f2s_hpc.errors import InputError, TooManyRanks, UnstableStep
from f2s_hpc.verify.box import make_model
from f2s_hpc.verify.case import MATERIAL, Case, Measured, Options, Row, judged
from f2s_hpc.verify.registry import find

COLUMNS = ("case", "quantity", "resolution", "dx_m", "value", "reference", "error", "order", "bar", "least_order",
           "passed", "steps", "cell_steps", "wall_s")
"""Columns of the CSV and JSON files, SI."""


MATERIAL_NAME = "material"
"""Setting of the cases whose metal can be chosen."""


def verify(names: Sequence[str], overrides: Sequence[str], full: bool, out: str | os.PathLike,
           json_file: str | os.PathLike | None) -> int:
    """Run the named cases (all if none), print their tables, write files into ``out``; return the exit code.

    ``json_file``: where all rows go as one JSON list as well. 0 if no bar is missed, 1 otherwise. Collective; rank 0
    prints and writes. Raises ``InputError`` for unknown cases and settings, and values that a case can not run with,
    before anything runs.
    """
    cases = find(names)
    _check_overrides(cases, overrides)
    runs = [(case, _options(case, full, overrides)) for case in cases]
    for case, options in runs:
        _check(case, options)
    folder = pathlib.Path(out)
    mpi.run_together(_prepare, folder, json_file)
    all_rows: list[dict[str, Any]] = []
    for case, options in runs:
        rows = [as_dict(row) for row in run_case(case, options)]
        all_rows += rows
        mpi.say(case_table(case.name, case.text, rows) + "\n")
        mpi.run_together(_write_case, folder, case, rows)
        if json_file is not None:
            # after every case, so that a long job that is cut off leaves what it had
            mpi.run_together(_write_json, pathlib.Path(json_file), all_rows)
    mpi.say(overview_table(all_rows))
    mpi.run_together(draw_overview, all_rows, folder / "overview.png")
    mpi.say(f"tables and plots: {folder}")
    return 1 if any(row["passed"] is False for row in all_rows) else 0


def list_cases() -> str:
    """Return all cases with their settings as text."""
    lines = []
    for case in find(()):
        settings = ", ".join(f"{name}={setting.default}" for name, setting in case.settings.items())
        lines.append(f"{case.name:24s} {case.text.splitlines()[0]}")
        lines.append(f"{'':24s} resolutions {_levels(case.quick)}; full {_levels(case.full)}"
                     + (f"; settings {settings}" if settings else ""))
    return "\n".join(lines)


def _levels(levels: Sequence[float]) -> str:
    return ",".join(f"{level:g}" for level in levels)


def run_case(case: Case, options: Options) -> list[Row]:
    """Return the judged rows of one case; a run that the solver stops, or that breaks, leaves a row that has failed.

    A resolution whose box is too small for the ranks of this run is skipped: its row has no verdict. On several ranks
    an exception that is none of ours ends the job through the abort hook, since a rank may be alone with it.
    """
    skipped: list[Measured] = []
    while True:
        measured: list[Measured] = []
        try:
            for row in case.run(options):
                measured.append(row)  # noqa: PERF402  (what was measured before a stop is kept)
        except TooManyRanks as small:
            coarsest, *finer = options.levels
            skipped.append(Measured(f"skipped: {small}", coarsest, math.nan, math.nan, None, 0.0, compares=False))
            if len(finer) >= max(case.fewest, 1):
                options = dataclasses.replace(options, levels=tuple(finer))
                continue
            measured = []
        except UnstableStep as stop:
            measured.append(_failed(f"stopped: {stop}"))
        except InputError as refusal:
            measured.append(_failed(f"refused: {refusal}"))
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            if mpi.size() > 1:
                raise
            measured.append(_failed(f"failed: {type(error).__name__}: {error}"))
        return judged(case.name, skipped + measured)


def _failed(what: str) -> Measured:
    return Measured(what, math.nan, math.nan, math.nan, None, math.inf, bar=0.0, compares=False)


def as_dict(row: Row) -> dict[str, Any]:
    """Return a row as plain numbers and text, keys as :data:`COLUMNS` and ``compares``."""
    m = row.measured
    return {"case": row.case, "quantity": m.quantity, "resolution": m.resolution, "dx_m": m.dx_m, "value": m.value,
            "reference": m.reference, "error": m.error, "order": row.order, "bar": m.bar, "least_order": m.least_order,
            "passed": row.passed, "steps": m.steps, "cell_steps": m.cell_steps, "wall_s": m.wall_s,
            "compares": m.compares}


def _check_overrides(cases: list[Case], overrides: Sequence[str]) -> None:
    """Raise ``InputError`` for an override that none of the cases knows."""
    known = dict.fromkeys(name for case in cases for name in (*case.settings, "resolutions"))
    for override in overrides:
        name, equals, _ = override.partition("=")
        if not equals:
            raise InputError(f"--set {override}: write it as NAME=VALUE")
        if not any(case.takes(override) for case in cases):
            who = f'case "{cases[0].name}" has' if len(cases) == 1 else "the chosen cases have"
            raise InputError(f'--set {override}: {who} no setting "{name.strip()}"; '
                             f'{did_you_mean(name.strip(), known)}')


def _check(case: Case, options: Options) -> None:
    """Raise ``InputError`` for options that ``case`` can not run with: now, not after an hour of others."""
    if MATERIAL_NAME in options.values:
        make_model(1e-6, options[MATERIAL_NAME], overrides=options.overrides)
    else:
        make_model(1e-6, overrides=[o for o in options.overrides if not o.strip().startswith(MATERIAL)])
    case.check(options)


def _options(case: Case, full: bool, overrides: Sequence[str]) -> Options:
    return case.options(full, [override for override in overrides if case.takes(override)])


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """Return the row's columns, with nothing where a number is not finite: JSON has no word for it."""
    return {key: None if isinstance(row[key], float) and not math.isfinite(row[key]) else row[key] for key in COLUMNS}


def _prepare(folder: pathlib.Path, json_file: str | os.PathLike | None) -> None:
    """Make the folders now: a place that can not be written must not be found out after an hour."""
    for path in (folder, *([pathlib.Path(json_file).parent] if json_file is not None else ())):
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path}: no folder can be made there ({error.strerror or error})") from None
    if json_file is not None:
        places.check_file(json_file, "--json")


def _write_case(folder: pathlib.Path, case: Case, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    places.write_text(folder / f"{case.name}.csv", text.getvalue())
    _write_json(folder / f"{case.name}.json", rows)
    draw_case(rows, folder / f"{case.name}.png", case.name, case.text.splitlines()[0])


def _write_json(path: pathlib.Path, rows: list[dict[str, Any]]) -> None:
    places.write_text(path, json.dumps([_finite(row) for row in rows], indent=1, allow_nan=False) + "\n")
