"""Speed of each kernel and of the whole step against what the machine can do (roofline), per state and size."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from f2s_hpc import mpi, places
from f2s_hpc._cache import cache_directory, source_hash
from f2s_hpc.bench import states
from f2s_hpc.bench.hook import EXCHANGE, Stopwatches, hooked
from f2s_hpc.bench.launch import reason
from f2s_hpc.bench.machine import multiply_add_peak, triad_bandwidth
from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.verify.box import Setup

WHOLE_STEP, PYTHON = "whole step", "Python between kernels"
SIZES = {"S": (1, 1), "M": (2, 2), "L": (4, 4), "XL": (8, 8)}
"""Mirror images (x, y) of the patch of 16 x 16 x 32 cells: 1.7 to 109 MB of fields."""

STRETCHES = 8
"""Stretches from remap to remap measured at least. A kernel's figure is its least one."""


@dataclass(frozen=True)
class Row:
    """One kernel, or the whole step, in one state at one size; per active cell and step of one core.

    ``roofline``: the time that bandwidth or peak allow over the time taken, None where no traffic was counted.
    """

    state: str
    size: str
    ranks: int
    active_cells: int
    field_bytes: int
    kernel: str
    calls: float
    nanoseconds: float
    million_cell_steps_per_s: float
    bytes: float | None = None
    operations: float | None = None
    gigabytes_per_s: float | None = None
    gigaflops: float | None = None
    roofline: float | None = None


@dataclass(frozen=True)
class Machine:
    """Measured limits of one core (of the slowest rank, all ranks measuring at once)."""

    bandwidth: float  # bytes/s, triad
    peak: float  # operations/s, fused multiply-adds


def measure_machine() -> Machine:
    """Return the limits of one core. Collective."""
    mpi.barrier()
    bandwidth = float(mpi.minimum(triad_bandwidth()))
    mpi.barrier()
    return Machine(bandwidth, float(mpi.minimum(multiply_add_peak())))


def count_work(name: str, saved: dict[str, np.ndarray]) -> dict[str, dict]:
    """Return the tallies of a step of the saved patch, counted in a process of its own or read from the cache.

    Rank 0 counts. The cache lies beside the compiled kernels, in a folder named by the hash of their sources; its name
    has that of the sources which say what a step calls and how that is counted.
    """
    def count() -> dict[str, dict]:
        cached = pathlib.Path(cache_directory()) / f"work-{name}-{source_hash('bench', 'solver')}.json"
        with contextlib.suppress(OSError, ValueError):
            return json.loads(cached.read_text(encoding="utf-8"))
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "patch.npz"
            np.savez(path, **saved)
            # a process started by a process of mpirun or srun must not take itself for one of its ranks
            alone = {n: v for n, v in launch_environment(os.environ).items() if not n.startswith("SLURM_")}
            done = subprocess.run([sys.executable, "-m", "f2s_hpc.bench.count", str(path)], capture_output=True,
                                  text=True, env=alone | {"NUMBA_DISABLE_JIT": "1"}, check=False,
                                  stdin=subprocess.DEVNULL)
        if done.returncode:
            raise F2SError(f"counting the operations of a step ended with {done.returncode}: {reason(done.stderr)}")
        with contextlib.suppress(InputError):  # (counted anew the next time)
            places.make_folder(cached.parent, "F2S_CACHE_DIR")
            places.write_text(cached, done.stdout)
        return json.loads(done.stdout)

    return mpi.run_together(count)


def time_steps(setup: Setup, least_seconds: float = 1.0) -> tuple[dict[str, float], dict[str, float], float, int, int]:
    """Return per step: least seconds and calls of each kernel, least seconds of the whole; then active cells, steps.

    Seconds are CPU time over the steps from remap to remap, of those stretches that have the most common number of
    steps: of the kernels on the rank that spends most in them without waiting, of the whole on the slowest in each
    stretch. Calls are that rank's, the mean of those stretches. Takes at least ``STRETCHES`` of them and
    ``least_seconds``. Collective.
    """
    watches = Stopwatches()
    found: list[tuple[int, float, dict[str, float], dict[str, int]]] = []
    spent, before = 0.0, (setup.clock.active_cell_steps, setup.clock.steps)
    with hooked(watches.wrap):
        setup.advance_to_remap()
        watches.read()
        while len(found) < STRETCHES or spent < least_seconds:
            mpi.barrier()
            start = time.thread_time()
            steps = setup.advance_to_remap()
            one = float(mpi.maximum(time.thread_time() - start))
            found.append((steps, one, *watches.read()))
            spent += one
    common = int(np.bincount([steps for steps, *_ in found]).argmax())
    alike = [stretch for stretch in found if stretch[0] == common]
    names = {name for stretch in alike for name in stretch[2]}
    least = {name: min(seconds.get(name, np.inf) for _, _, seconds, _ in alike) / common for name in names}
    calls = {name: sum(stretch[3].get(name, 0) for stretch in alike) / (len(alike) * common) for name in names}
    busy = sum(seconds for name, seconds in least.items() if name != EXCHANGE)
    _, least, calls = max(mpi.all_gather((busy, least, calls)), key=lambda rank: rank[0])
    active, taken = setup.clock.active_cell_steps - before[0], setup.clock.steps - before[1]
    return (least, calls, min(one for _, one, _, _ in alike) / common, round(int(mpi.total(np.int64(active))) / taken),
            common)


def rows_of(state: str, size: str, setup: Setup, work: dict[str, dict] | None, machine: Machine) -> list[Row]:
    """Return the rows of one state at one size, the whole step first, then the kernels by their time. Collective."""
    least, calls, whole, active, steps = time_steps(setup)
    field_bytes = sum(mpi.all_gather(setup.state.pool.memory.nbytes))
    share = active / mpi.size()
    rows, total_bytes, total_operations = [], 0.0, 0.0

    def row(name: str, number: float, seconds: float, traffic: float | None, operations: float | None) -> Row:
        cost = seconds / share
        limits = (state, size, mpi.size(), active, field_bytes, name, number, 1e9 * cost, 1e-6 / cost if cost else 0.0)
        if traffic is None or cost == 0.0:
            return Row(*limits)
        roof = max(traffic / machine.bandwidth, operations / machine.peak)
        return Row(*limits, traffic, operations, 1e-9 * traffic / cost, 1e-9 * operations / cost, roof / cost)

    for name in sorted(least, key=lambda n: -least[n]):
        tally = (work or {}).get(name)
        if tally is None or not tally["bulk"]:
            rows.append(row(name, calls[name], least[name], None, None))
            continue
        visits = tally["calls"] / tally["cells"] / work["steps"]
        traffic, operations = tally["bytes"] * visits, tally["operations"] * visits
        total_bytes, total_operations = total_bytes + traffic, total_operations + operations
        rows.append(row(name, calls[name], least[name], traffic, operations))
    rows.append(row(PYTHON, 1, max(whole - sum(least.values()), 0.0), None, None))
    counted = (total_bytes, total_operations) if work else (None, None)
    return [row(WHOLE_STEP, 1 / steps, whole, *counted), *rows]


def run(names: Sequence[str], sizes: Sequence[str], counted: bool = True, say=print) -> tuple[Machine, list[Row]]:
    """Measure the chosen states at the chosen sizes, printing a table each. Collective; raises ``InputError``."""
    for chosen, known, what in ((names, states.STATES, "state"), (sizes, SIZES, "size")):
        for name in chosen:
            if name not in known:
                raise InputError(f"no {what} {name!r}; there are {', '.join(known)}")
    machine = measure_machine()
    say(f"one core of {mpi.size()} at work: triad {1e-9 * machine.bandwidth:.1f} GB/s (3 x 96 MB, 32 bytes per "
        f"element), fused multiply-adds {1e-9 * machine.peak:.1f} GF/s")
    rows: list[Row] = []
    model = states.default_model()
    for name in names:
        saved = states.save(states.STATES[name](model))
        work = count_work(name, saved) if counted else None
        for size in sizes:
            found = rows_of(name, size, states.tiled(saved, model, SIZES[size]), work, machine)
            rows.extend(found)
            say(table(found))
    say(overview([row for row in rows if row.kernel == WHOLE_STEP]))
    return machine, rows


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def table(rows: Sequence[Row]) -> str:
    """Return the rows of one state and size as a table."""
    first = rows[0]
    title = (f"\n{first.state}, size {first.size}: {first.active_cells:,} active cells, "
             f"{1e-6 * first.field_bytes:.1f} MB of fields, {first.ranks} rank{'s' if first.ranks > 1 else ''}")
    head = (f"{'per active cell-step and core':30s} {'calls':>6} {'ns':>8} {'M/s':>8} {'bytes':>7} {'flops':>7} "
            f"{'GB/s':>6} {'GF/s':>6} {'roofline':>8}")
    lines = [title, head]
    lines += [f"{r.kernel:30s} {r.calls:6.2f} {r.nanoseconds:8.2f} {r.million_cell_steps_per_s:8.2f} "
              f"{_number(r.bytes, '.0f'):>7} {_number(r.operations, '.0f'):>7} {_number(r.gigabytes_per_s, '.1f'):>6} "
              f"{_number(r.gigaflops, '.1f'):>6} {_number(r.roofline, '.1%'):>8}" for r in rows]
    return "\n".join(lines)


def overview(rows: Sequence[Row]) -> str:
    """Return the whole steps of all states and sizes as one table."""
    head = (f"\n{'whole step':10s} {'size':>4} {'active cells':>13} {'fields MB':>10} {'M cell-steps/s/core':>20} "
            f"{'roofline':>9}")
    lines = [head]
    lines += [f"{r.state:10s} {r.size:>4} {r.active_cells:13,} {1e-6 * r.field_bytes:10.1f} "
              f"{r.million_cell_steps_per_s:20.3f} {_number(r.roofline, '.1%'):>9}" for r in rows]
    return "\n".join(lines)


def write_json(path: str | os.PathLike, machine: Machine, rows: Sequence[Row]) -> None:
    """Write machine and rows as one JSON file; raises ``InputError`` if the place cannot be written."""
    record = {"machine": asdict(machine), "ranks": mpi.size(), "rows": [asdict(row) for row in rows]}
    places.write_text(path, json.dumps(record, indent=1) + "\n")
