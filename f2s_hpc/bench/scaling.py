"""Strong and weak scaling: real runs on more and more ranks, their table, CSV, JSON and a plot of the efficiency.

The scripts in ``jobs/`` start the runs themselves and make the table of what these left (``rows_of_folder``).
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import pathlib
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from f2s_hpc import places
from f2s_hpc.bench import launch
from f2s_hpc.config import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.grid.box import Box
from f2s_hpc.grid.decomposition import process_grid

COLUMNS = ("kind", "ranks", "cells", "steps", "step_s", "busy_s", "cell_steps_per_s_per_core", "imbalance",
           "efficiency", "busy_efficiency", "memory_per_rank_bytes")
NEEDED = ("ranks", "cells", "steps", "active_cell_steps", "imbalance", "peak_memory_bytes")
TIMES = "times.json"
QUIET = ("cycles.count=1", "output.frames=none", "output.checkpoints=false", "output.picture=false")


def rank_list(most: int) -> list[int]:
    """Return 1, 2, 4, ... up to ``most``."""
    return [2**n for n in range(int(math.log2(max(most, 1))) + 1)]


def weak_settings(scene: Scene, ranks: int) -> list[str]:
    """Return the settings that repeat the scene's patch ``ranks`` times, as square as it goes, with its particles."""
    along_y = next(n for n in range(math.isqrt(ranks), 0, -1) if ranks % n == 0)
    x, y, z = scene.domain.size
    size = ", ".join(f'"{length!r} m"' for length in (ranks // along_y * x, along_y * y, z))
    if scene.batches.source != "generated":
        raise InputError("weak scaling needs a scene whose batches are generated: its particles grow with the patch")
    return [f"domain.size=[{size}]", f"batches.particles={scene.batches.particles * ranks}"]


@dataclass(frozen=True)
class Run:
    """One run of a study: ``command`` leaves its summary and times in ``folder``."""

    kind: str
    command: tuple[str, ...]
    folder: pathlib.Path


def _run(kind: str, scene: str, overrides: Sequence[str], duration: str, ranks: int, out: pathlib.Path,
         launcher: str) -> Run:
    """Return the run: ``launcher`` N f2s run ..., one short cycle and no output. Raises ``InputError``."""
    more = weak_settings(load_scene(scene, overrides), ranks) if kind == "weak" else []
    settings = [*overrides, *more, *QUIET, f"cycles.duration={duration}", f"cycles.last_duration={duration}"]
    domain = load_scene(scene, settings).domain
    process_grid(Box(domain.cells, domain.cell_size), ranks)
    folder = out / f"{kind}-{ranks}"
    command = (sys.executable, "-m", "f2s_hpc.cli.timed_run", "run", scene, "--out", str(folder),
               *(word for s in settings for word in ("--set", s)))
    return Run(kind, tuple(launch.on_ranks(launcher, ranks, command)), folder)


def planned(kinds: Sequence[str], scene: str, overrides: Sequence[str], duration: str, ranks: Sequence[int],
            out: pathlib.Path, launcher: str) -> list[Run]:
    """Return the runs of the studies ``kinds`` (strong, weak), a run per number of ranks in each.

    Raises ``InputError`` for what would end one of them: a wrong scene, a box that cannot be cut into so many parts.
    """
    return [_run(kind, scene, overrides, duration, count, out, launcher) for kind in kinds for count in ranks]


def row_of(kind: str, folder: pathlib.Path) -> dict:
    """Return the row of a run that :mod:`f2s_hpc.cli.timed_run` left in ``folder``, without its efficiency.

    Raises ``F2SError`` if it is not complete.
    """
    found = launch.finished(folder, NEEDED)
    try:
        found |= json.loads((folder / TIMES).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise F2SError(f"{folder / TIMES}: cannot be read ({error})") from None
    per_step = found["active_cell_steps"] / found["steps"]
    return {"kind": kind, "ranks": found["ranks"], "cells": found["cells"], "steps": found["steps"],
            "step_s": found["step_s"], "busy_s": found["busy_s"],
            "cell_steps_per_s_per_core": per_step / found["step_s"] / found["ranks"], "imbalance": found["imbalance"],
            "memory_per_rank_bytes": found["peak_memory_bytes"] / found["ranks"], "active_cells": per_step}


def rows_of_folder(kind: str, out: pathlib.Path) -> list[dict]:
    """Return the rows, with their efficiency, of the complete runs in ``out/ranks-*``, by ranks.

    Raises ``F2SError`` if there is none.
    """
    rows = []
    for place in out.glob("ranks-*"):
        with contextlib.suppress(F2SError):
            rows.append(row_of(kind, place))
    if not rows:
        raise F2SError(f"{out}: holds no complete run with its times in ranks-*")
    return with_efficiency(sorted(rows, key=lambda row: row["ranks"]))


def with_efficiency(rows: Sequence[dict]) -> list[dict]:
    """Return the rows of one study with their efficiency: active cell-steps per second and core over the first row's.

    This holds for strong and for weak scaling. ``busy_efficiency`` leaves out the time spent in messages and waiting.
    """
    def rate(row: dict, seconds: str) -> float:
        return row["active_cells"] / row["ranks"] / max(row[seconds], 1e-12)

    return [{**row, "efficiency": rate(row, "step_s") / rate(rows[0], "step_s"),
             "busy_efficiency": rate(row, "busy_s") / rate(rows[0], "busy_s")} for row in rows]


def study(runs: Sequence[Run], out: pathlib.Path, say: Callable[[str], None] = print) -> list[dict]:
    """Run the planned ``runs`` in the new folder ``out``; return a row each, with its efficiency.

    What is there after each run is printed and written at once. Raises ``InputError`` before the first run if a folder
    is there already or ``out`` cannot be written, ``F2SError`` for a run that failed.
    """
    for run in runs:
        if run.folder.exists():
            raise InputError(f"{run.folder}: is there already; name a new folder with --out")
    places.check_folder(out, "--out")
    found: dict[str, list[dict]] = {run.kind: [] for run in runs}
    for run in runs:
        say(shlex.join(run.command))
        launch.run(run.command, f"{shlex.join(run.command[:3])} ...")
        found[run.kind].append(row_of(run.kind, run.folder))
        rows = [row for mine in found.values() for row in with_efficiency(mine)]
        write(rows, out)
        say(table(with_efficiency(found[run.kind])[-1:]))
    return rows


def table(rows: Sequence[dict]) -> str:
    """Return the rows as a table."""
    lines = [(f"{'kind':7s} {'ranks':>5} {'cells':>12} {'steps':>6} {'ms/step':>9} {'busy ms':>9} {'M/s/core':>9} "
              f"{'imbalance':>10} {'efficiency':>11} {'busy only':>10} {'MiB/rank':>9}")]
    lines += [(f"{r['kind']:7s} {r['ranks']:5d} {r['cells']:12,} {r['steps']:6d} {1e3 * r['step_s']:9.2f} "
               f"{1e3 * r['busy_s']:9.2f} {1e-6 * r['cell_steps_per_s_per_core']:9.3f} {r['imbalance']:10.3f} "
               f"{r['efficiency']:11.1%} {r['busy_efficiency']:10.1%} "
               f"{r['memory_per_rank_bytes'] / 2**20:9.0f}") for r in rows]
    return "\n".join(lines)


def write(rows: Sequence[dict], out: pathlib.Path) -> list[pathlib.Path]:
    """Write ``scaling.csv``, ``scaling.json`` and ``scaling.png`` into ``out``; return their places."""
    places.make_folder(out, "--out")
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    places.write_text(out / "scaling.csv", text.getvalue(), newline="")
    places.write_text(out / "scaling.json", json.dumps(list(rows), indent=1) + "\n")
    draw(rows, out / "scaling.png")
    return [out / f"scaling.{ending}" for ending in ("csv", "json", "png")]


def draw(rows: Sequence[dict], path: pathlib.Path) -> None:
    """Draw efficiency over ranks, a curve per kind; PNG at ``path``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((6.4, 4.2))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.12, 0.14, 0.84, 0.76))
    styles = {"strong": ("#0072b2", "o"), "weak": ("#d55e00", "s")}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        colour, mark = styles[kind]
        ranks = [row["ranks"] for row in mine]
        axes.plot(ranks, [row["efficiency"] for row in mine], mark + "-", color=colour, label=f"{kind}, by the clock")
        axes.plot(ranks, [row["busy_efficiency"] for row in mine], mark + ":", color=colour, mfc="white",
                  label=f"{kind}, computing only")
    counts = sorted({row["ranks"] for row in rows})
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.set_ylim(0.0, max(1.1, 1.05 * max(row["busy_efficiency"] for row in rows)))
    axes.axhline(1.0, color="#999999", linewidth=0.8)
    axes.set_xlabel("ranks")
    axes.set_ylabel("efficiency against the first row")
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    axes.set_title("Scaling", loc="left", fontsize=11, fontweight="bold")
    figure.savefig(path, dpi=140)
