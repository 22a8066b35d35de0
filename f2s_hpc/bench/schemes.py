"""The recurring scheme against the standard one on the same particles: the paper's Table 3, and both results."""

from __future__ import annotations

import pathlib
import shlex
from collections.abc import Sequence

from f2s_hpc.bench import launch
from f2s_hpc.config import load_scene
from f2s_hpc.errors import F2SError

SCENES = {"recurring": "section4", "standard": "section4-standard"}

PAPER = {"cells": (2_737_800, 9_579_712), "startup_s": (51 * 60, 393 * 60), "startup_memory_bytes": (2.3e9, 6.7e9),
         "executing_s": (310 * 60, 668 * 60), "peak_memory_bytes": (6.7e9, 17e9), "total_s": (361 * 60, 1061 * 60)}
"""Ge et al. 2026 (Free2Spray), Table 3: recurring, standard; 3 um, 16 processes."""

RESULTS = {"dense_height_m": 1e6, "height_mean_m": 1e6, "height_p95_m": 1e6, "peeq_p50": 1.0, "peeq_p95": 1.0,
           "temperature_p50_degC": 1.0, "temperature_p95_degC": 1.0}

NEEDED = ("ranks", "cells", "startup_s", "wall_s", "startup_memory_bytes", "peak_memory_bytes", *RESULTS)

LAYER = "0.2 mm"
"""Height that a batch may have to fit into the layers of both scenes."""


def batch_files(out: pathlib.Path) -> list[str]:
    """Write the generated batches of the recurring scene below ``out``, unless they are there; return their files.

    Both schemes read them. Raises ``F2SError`` if they can not be made, or only a part of them is there.
    """
    folder, wanted = out / "batches", load_scene(SCENES["recurring"]).batches.count
    if not folder.exists():
        launch.run(launch.f2s("particles", SCENES["recurring"], "--out", str(folder),
                              settings=[f"domain.particle_layer_height={LAYER}"]), "making the batches")
    files = sorted(str(path) for path in folder.glob("batch-*.csv"))
    if len(files) != wanted:
        raise F2SError(f"{folder}: holds {len(files)} batches of {wanted}; remove it, and they are made anew")
    return files


def particles_of(scheme: str, files: Sequence[str]) -> list[str]:
    """Return the settings that let a scheme spray the batches in ``files``, in their order, over and over."""
    cycles = load_scene(SCENES["recurring"], []).cycles.count
    listed = files if scheme == "recurring" else [files[n % len(files)] for n in range(cycles)]
    return [f"batches.files=[{', '.join(repr(str(file)) for file in listed)}]", "batches.shuffle=false"]


def command_of(scheme: str, files: Sequence[str], overrides: Sequence[str], ranks: int, folder: pathlib.Path,
               launcher: str) -> list[str]:
    """Return the command of one run."""
    settings = [*particles_of(scheme, files), *overrides]
    return launch.on_ranks(launcher, ranks, launch.f2s("run", SCENES[scheme], "--out", str(folder), settings=settings))


def measure(scheme: str, files: Sequence[str], overrides: Sequence[str], ranks: int, out: pathlib.Path, launcher: str,
            say=print) -> dict:
    """Run a scheme, or take what its folder below ``out`` already holds; return its summary.

    Raises ``F2SError`` if it fails or is not complete.
    """
    folder = out / scheme
    if not folder.exists():
        command = command_of(scheme, files, overrides, ranks, folder, launcher)
        say(shlex.join(command))
        launch.run(command, f"the run of the {scheme} scheme", quiet=False)
    summary = launch.finished(folder, NEEDED)
    summary["executing_s"] = max(summary["wall_s"] - summary["startup_s"], 0.0)
    summary["total_s"] = summary["startup_s"] + summary["executing_s"]
    return summary


def _time(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"


def _memory(size: float) -> str:
    return f"{size / 1e9:.2f} GB"


ROWS = (("cells", "elements", "{:,}".format), ("startup_s", "preparation time", _time),
        ("startup_memory_bytes", "preparation memory", _memory), ("executing_s", "execution time", _time),
        ("peak_memory_bytes", "execution memory", _memory), ("total_s", "total time", _time))


def cost_table(recurring: dict, standard: dict) -> str:
    """Return what both cost, with their ratio and the paper's."""
    lines = [f"{'':20s} {'recurring':>12} {'standard':>12} {'ratio':>7}   {'paper':>10} {'paper':>10} {'ratio':>7}"]
    for key, name, shown in ROWS:
        a, b = PAPER[key]
        lines.append(f"{name:20s} {shown(recurring[key]):>12} {shown(standard[key]):>12} "
                     f"{recurring[key] / standard[key]:7.1%}   {shown(a):>10} {shown(b):>10} {a / b:7.1%}")
    lines.append(f"(here {recurring['ranks']} ranks, in the paper 16; preparation: until the first step is done)")
    return "\n".join(lines)


def result_table(recurring: dict, standard: dict) -> str:
    """Return the results of both and their differences."""
    lines = [f"{'':22s} {'recurring':>12} {'standard':>12} {'difference':>10}"]
    for key, scale in RESULTS.items():
        a, b = recurring[key] * scale, standard[key] * scale
        lines.append(f"{key:22s} {a:12.4f} {b:12.4f} {a / b - 1.0:+10.2%}")
    lines.append("(heights in um; by depth: f2s compare)")
    return "\n".join(lines)
