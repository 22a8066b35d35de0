"""``f2s plan``: what a scene will take on any number of ranks."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from f2s_hpc import mpi, places, units
from f2s_hpc.bench import rates as measured
from f2s_hpc.bench import trial
from f2s_hpc.config import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.grid.box import Box
from f2s_hpc.grid.decomposition import process_grid
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver.dwell import STAGE_SHARE, most_stages
from f2s_hpc.workload import predict

MOST_RANKS = 4096
DEFAULT_RANKS = (1, 2, 4, 16, 64)
CHECKED_RANKS = (1, 2)
"""Numbers of ranks that ``--check`` starts."""


def _ranks(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        ranks = [int(part) for part in text.split(",")]
    except ValueError:
        ranks = [0]
    if not all(1 <= count <= MOST_RANKS for count in ranks):
        raise InputError(f"f2s plan: --ranks {text}: whole numbers from 1 to {MOST_RANKS:,}, separated by commas, "
                         "are needed")
    return ranks


def _fitting(scene: Scene, ranks: list[int] | None, checked: bool) -> list[int]:
    """Return the numbers of ranks to plan for: those asked for, or those of the default into which the box can be cut.

    Raises ``InputError`` if one that was asked for, or that ``--check`` starts, does not fit. Called before the rates
    are measured, which takes its time.
    """
    box, wanted = Box(scene.domain.cells, scene.domain.cell_size), DEFAULT_RANKS if ranks is None else ranks
    found, left_out = [], []
    for count in dict.fromkeys(wanted):
        try:
            process_grid(box, count)
            found.append(count)
        except InputError:
            if ranks is not None:
                raise
            left_out.append(count)
    if checked:
        for count in CHECKED_RANKS:
            process_grid(box, count)
    if left_out:
        print(f"note: the box is too small for {', '.join(map(str, left_out))} ranks; left out")
    return found


def _check_time(parsed: argparse.Namespace) -> float | None:
    if parsed.check_time is None:
        return None
    if not parsed.check:
        raise InputError("f2s plan: --check-time says how long --check runs; give --check too")
    duration = _time("--check-time", parsed.check_time)
    if not 0.0 < duration < float("inf"):
        raise InputError(f"f2s plan: --check-time {parsed.check_time}: it must be above 0")
    return duration


def _dwells(scene: Scene, found: Sequence[predict.Prediction]) -> list[str]:
    """Return a line on what the dwells of a scene take, which the predictions leave out; nothing without any."""
    count, material = scene.cycles.count - 1, scene.material
    if scene.cycles.dwell is None or not count:
        return []
    stages = most_stages(scene.cycles.dwell, material.conductivity / (
        material.density * material.specific_heat * scene.domain.cell_size**2))
    times = ", ".join(f"{predict.duration_text(count * stages * STAGE_SHARE * p.step_s)} on "
                      f"{units.count_text(p.ranks, 'rank')}" for p in found)
    return [(f"{units.count_text(count, 'dwell')} of {units.pretty(scene.cycles.dwell, 'time')} come on top of these "
             f"times, each of at most {stages:,} stages of conduction: in all some {times}, or less")]


def _time(option: str, text: str) -> float:
    try:
        return units.parse(text, "time")
    except units.UnitError as error:
        raise InputError(f"f2s plan: {option} {text}: {error}") from None


def run(parsed: argparse.Namespace) -> int:
    """Predict, and check if asked; return the exit code."""
    if mpi.size() > 1:
        raise InputError("f2s plan runs alone, not under mpirun; --ranks names the ranks to plan for")
    ranks = _ranks(parsed.ranks)
    latency = _time("--latency", parsed.latency)
    if not (latency >= 0.0 and 0.0 < parsed.bandwidth < float("inf")):
        raise InputError("f2s plan: --latency must not be negative and --bandwidth must be above 0")
    duration = _check_time(parsed)
    if parsed.json:
        places.check_file(parsed.json, "--json")
    scene = load_scene(parsed.scene, parsed.overrides)
    ranks = _fitting(scene, ranks, parsed.check)
    if parsed.check:
        trial.ready(scene, duration)
    plan = make_batches(scene)
    network = predict.Network(latency, 1e9 * parsed.bandwidth)
    rates = measured.rates_for(scene, plan, parsed.rates, print)
    print(f"rates of {rates.where}: {1e3 * rates.per_step:.2f} ms per step, "
          + ", ".join(f"{1e9 * cost:.0f} ns per {kind} cell" for kind, cost in rates.per_cell.items())
          + f", a ghost {rates.ghost_share:.0%} of that, {rates.end_share:.0%} at the ends of rows, packing "
          f"{1e-9 * rates.packing:.1f} GB/s")
    print(f"network: latency {1e6 * latency:g} us, {parsed.bandwidth:g} GB/s per rank "
          f"(stated, not measured), {len(rates.exchanges) / rates.steps:.1f} exchanges and {rates.reductions} "
          "reduction per step")
    found = predict.predict(scene, plan, ranks, rates, network)
    print(predict.table(found))
    for note in _dwells(scene, found):
        print(f"note: {note}")
    rows = trial.compare(scene, plan, rates, network, CHECKED_RANKS, duration) if parsed.check else []
    if rows:
        print(trial.comparison(rows))
    if parsed.json:
        record = {"predictions": [asdict(p) for p in found], "check": rows}
        places.write_text(parsed.json, json.dumps(record, indent=1) + "\n")
    return 0
