"""Strong and weak scaling: real runs on more and more ranks, their table, CSV, JSON and a plot of the efficiency."""

from __future__ import annotations

import csv
import json
import math
import pathlib
import shlex
import sys
from collections.abc import Sequence

from f2s_hpc.bench import launch
from f2s_hpc.config import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.io import runs

COLUMNS = ("kind", "ranks", "cells", "steps", "step_s", "busy_s", "cell_steps_per_s_per_core", "imbalance",
           "efficiency", "busy_efficiency")
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


def command_of(scene: str, overrides: Sequence[str], duration: str, ranks: int, folder: pathlib.Path,
               launcher: str) -> list[str]:
    """Return the command of one run of the study: ``launcher`` N f2s run ..., one short cycle and no output."""
    settings = [*overrides, *QUIET, f"cycles.duration={duration}", f"cycles.last_duration={duration}"]
    run = [sys.executable, "-m", "f2s_hpc.cli.timed_run", "run", scene, "--out",
           str(folder)]
    return [*shlex.split(launcher), str(ranks), *run, *(word for s in settings for word in ("--set", s))]


def measure(command: Sequence[str], folder: pathlib.Path) -> dict:
    """Run one command and return its summary with the times that it took; raises ``F2SError`` if it fails."""
    launch.run(command, f"{shlex.join(command[:3])} ...")
    times = json.loads((folder / "times.json").read_text(encoding="utf-8"))
    return runs.read_summary(folder) | times


def _row(kind: str, found: dict) -> dict:
    per_step = found["active_cell_steps"] / found["steps"]
    return {"kind": kind, "ranks": found["ranks"], "cells": found["cells"], "steps": found["steps"],
            "step_s": found["step_s"], "busy_s": found["busy_s"],
            "cell_steps_per_s_per_core": per_step / found["step_s"] / found["ranks"], "imbalance": found["imbalance"],
            "active_cells": per_step}


def with_efficiency(rows: Sequence[dict]) -> list[dict]:
    """Return the rows of one study with their efficiency: active cell-steps per second and core over the first row's.

    This holds for strong and for weak scaling. ``busy_efficiency`` leaves out the time spent in messages and waiting.
    """
    def rate(row: dict, seconds: str) -> float:
        return row["active_cells"] / row["ranks"] / max(row[seconds], 1e-12)

    return [{**row, "efficiency": rate(row, "step_s") / rate(rows[0], "step_s"),
             "busy_efficiency": rate(row, "busy_s") / rate(rows[0], "busy_s")} for row in rows]


def study(kind: str, scene: str, overrides: Sequence[str], duration: str, ranks: Sequence[int], out: pathlib.Path,
          launcher: str, say=print) -> list[dict]:
    """Run the study ``kind`` (strong, weak) in the new folder ``out``; return a row per number of ranks.

    Raises ``InputError`` for a wrong scene or folder, ``F2SError`` for a run that failed.
    """
    rows = []
    for count, command in zip(ranks, _commands(kind, scene, overrides, duration, ranks, out, launcher)):
        folder = out / f"{kind}-{count}"
        if folder.exists():
            raise InputError(f"{folder}: is there already; name a new folder with --out")
        say(shlex.join(command))
        rows.append(_row(kind, measure(command, folder)))
    return with_efficiency(rows)


def _commands(kind: str, scene: str, overrides: Sequence[str], duration: str, ranks: Sequence[int], out: pathlib.Path,
              launcher: str) -> list[list[str]]:
    loaded = load_scene(scene, overrides)
    return [command_of(scene, [*overrides, *(weak_settings(loaded, count) if kind == "weak" else [])], duration, count,
                       out / f"{kind}-{count}", launcher) for count in ranks]


def commands(kind: str, scene: str, overrides: Sequence[str], duration: str, ranks: Sequence[int], out: pathlib.Path,
             launcher: str) -> list[str]:
    """Return the commands that :func:`study` would run, as lines of a shell."""
    return [shlex.join(words) for words in _commands(kind, scene, overrides, duration, ranks, out, launcher)]


def table(rows: Sequence[dict]) -> str:
    """Return the rows as a table."""
    lines = [(f"{'kind':7s} {'ranks':>5} {'cells':>12} {'steps':>6} {'ms/step':>9} {'busy ms':>9} {'M/s/core':>9} "
              f"{'imbalance':>10} {'efficiency':>11} {'busy only':>10}")]
    lines += [(f"{r['kind']:7s} {r['ranks']:5d} {r['cells']:12,} {r['steps']:6d} {1e3 * r['step_s']:9.2f} "
               f"{1e3 * r['busy_s']:9.2f} {1e-6 * r['cell_steps_per_s_per_core']:9.3f} {r['imbalance']:10.3f} "
               f"{r['efficiency']:11.1%} {r['busy_efficiency']:10.1%}") for r in rows]
    return "\n".join(lines)


def write(rows: Sequence[dict], out: pathlib.Path) -> list[pathlib.Path]:
    """Write ``scaling.csv``, ``scaling.json`` and ``scaling.png`` into ``out``; return their places."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "scaling.csv", "w", newline="", encoding="ascii") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    (out / "scaling.json").write_text(json.dumps(list(rows), indent=1) + "\n", encoding="utf-8")
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
