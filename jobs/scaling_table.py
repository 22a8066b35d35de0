"""Table of a scaling study from the summaries of its runs: ``python jobs/scaling_table.py FOLDER``.

Reads ``FOLDER/ranks-*/summary.json``, prints a table and writes ``FOLDER/scaling.csv``. The efficiency
is the rate per rank (active cell-steps per second) over that of the run with the fewest ranks; this
holds for strong and weak scaling alike.
"""

from __future__ import annotations

import csv
import json
import pathlib
import sys

COLUMNS = ("ranks", "cells", "steps", "wall_s", "active_cell_steps_per_s", "efficiency", "memory_per_rank_bytes")


def scaling_rows(folder: pathlib.Path) -> list[dict[str, float]]:
    """Return one row per complete run below ``folder``, by ranks; keys are ``COLUMNS``.

    Raises ``ValueError`` if there is none.
    """
    summaries = [json.loads(path.read_text()) for path in folder.glob("ranks-*/summary.json")]
    complete = sorted((s for s in summaries if s.get("status") == "complete"), key=lambda s: s["ranks"])
    for summary in complete:
        lacking = [name for name in (*COLUMNS[:5], "peak_memory_bytes") if name not in summary]
        if lacking:
            raise ValueError(f"{folder}: a summary lacks {', '.join(lacking)}")
    if not complete:
        raise ValueError(f"{folder}: no ranks-*/summary.json of a complete run")
    base = complete[0]["active_cell_steps_per_s"] / complete[0]["ranks"]
    return [{
        **{name: summary[name] for name in COLUMNS[:5]},
        "efficiency": summary["active_cell_steps_per_s"] / summary["ranks"] / base,
        "memory_per_rank_bytes": summary["peak_memory_bytes"] / summary["ranks"],
    } for summary in complete]


def main(arguments: list[str]) -> int:
    """Print and write the table; return the exit code."""
    if len(arguments) != 1:
        print("usage: python jobs/scaling_table.py FOLDER", file=sys.stderr)
        return 2
    folder = pathlib.Path(arguments[0])
    try:
        rows = scaling_rows(folder)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    with open(folder / "scaling.csv", "w", newline="", encoding="ascii") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    print(f"{'ranks':>6} {'cells':>12} {'steps':>8} {'wall s':>9} {'Mcell-steps/s':>14} {'efficiency':>11} "
          f"{'MiB/rank':>9}")
    for row in rows:
        print(f"{row['ranks']:>6} {row['cells']:>12} {row['steps']:>8} {row['wall_s']:>9.1f} "
              f"{row['active_cell_steps_per_s'] / 1e6:>14.3f} {row['efficiency']:>11.2f} "
              f"{row['memory_per_rank_bytes'] / 2**20:>9.0f}")
    print(f"also in {folder / 'scaling.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
