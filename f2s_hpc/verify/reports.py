"""``f2s verify --extreme`` and ``--levers``: stability on stiff and extreme cases, and what leaving out saves."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence

from f2s_hpc import mpi, places
from f2s_hpc.verify import extreme, fuzz, levers, watch

QUICK_FUZZ, FULL_FUZZ = 8, 300


def _write(json_file: str | os.PathLike | None, rows: Sequence) -> None:
    """Write rows of a dataclass as a JSON list. Collective; raises ``InputError`` on all ranks."""
    if json_file is not None:
        text = json.dumps([dataclasses.asdict(row) for row in rows], indent=2)
        mpi.run_together(places.write_text, json_file, text + "\n")


def _test_place(json_file: str | os.PathLike | None) -> None:
    """Raise ``InputError`` on all ranks now for a place that could not be written after an hour. Collective."""
    if json_file is not None:
        mpi.run_together(places.check_file, json_file, "--json")


def stability(full: bool, overrides: Sequence[str], scenes: int | None, seed: int,
              json_file: str | os.PathLike | None) -> int:
    """Run the matrix of extreme scenes and the fuzz, print their verdicts; return 0 if none failed, else 1.

    ``overrides``: "numerics.KEY=value" for every scene; ``scenes``: number of random scenes (default 300 at full
    size, 8 otherwise); ``json_file``: where the outcomes go as well. Collective; raises ``InputError``.
    """
    extreme.check(overrides)
    _test_place(json_file)
    outcomes = extreme.run(full, overrides, report=lambda o: mpi.say(f"{o.scene}: {o.verdict} {o.reason}"))
    count = (FULL_FUZZ if full else QUICK_FUZZ) if scenes is None else scenes
    outcomes += fuzz.run(count, seed, overrides, report=lambda o: mpi.say(f"{o.scene}: {o.verdict} {o.reason}"))
    mpi.say("\n" + watch.table(outcomes))
    _write(json_file, outcomes)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


def savings(full: bool, overrides: Sequence[str], json_file: str | os.PathLike | None) -> int:
    """Print what each lever saves and what it changes against the full computation; return 0. Collective."""
    _test_place(json_file)
    rows = levers.run(full, overrides)
    mpi.say(levers.table(rows))
    _write(json_file, rows)
    return 0
