"""``f2s plan``: what a scene will take on any number of ranks."""

from __future__ import annotations

import argparse
import json

from f2s_hpc import mpi, places, units
from f2s_hpc.bench import rates as measured
from f2s_hpc.bench import trial
from f2s_hpc.config import load_scene
from f2s_hpc.errors import InputError
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.workload import predict

MOST_RANKS = 4096


def _ranks(text: str) -> list[int]:
    try:
        ranks = [int(part) for part in text.split(",")]
    except ValueError:
        ranks = [0]
    if not all(1 <= count <= MOST_RANKS for count in ranks):
        raise InputError(f"f2s plan: --ranks {text}: whole numbers from 1 to {MOST_RANKS:,}, separated by commas, "
                         "are needed")
    return ranks


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
    duration = _time("--check-time", parsed.check_time) if parsed.check_time else None
    if parsed.json:
        places.check_file(parsed.json, "--json")
    scene = load_scene(parsed.scene, parsed.overrides)
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
    rows = trial.compare(scene, plan, rates, network, (1, 2), duration) if parsed.check else []
    if rows:
        print(trial.comparison(rows))
    if parsed.json:
        record = {"predictions": [p.row() for p in found], "check": rows}
        places.write_text(parsed.json, json.dumps(record, indent=1) + "\n")
    return 0
