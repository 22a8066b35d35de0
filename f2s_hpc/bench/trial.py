"""A short real run whose steps are timed, to hold against the prediction of it.

    mpirun -n 2 python -m f2s_hpc.bench.trial SCENE.toml SIMULATED_SECONDS

runs the scene's first cycle for that long and prints one line of JSON: seconds per step, steps, active cells.
"""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.bench.hook import Stopwatches, waiting
from f2s_hpc.bench.launch import reason
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.config.describe import estimated_time_step
from f2s_hpc.config.dump import dump_scene
from f2s_hpc.config.load import load_scene, parse_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.insert import paint_batch, paint_substrate
from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import F2SError
from f2s_hpc.particles.plan import BatchPlan, make_batches
from f2s_hpc.solver.step import Clock, advance
from f2s_hpc.units import count_text
from f2s_hpc.workload.balance import balance_of_run
from f2s_hpc.workload.predict import Network, Rates, predict

STEPS = 40


def typical(seconds: Sequence[float]) -> float:
    """Return the mean of the middle half: other users of the machine slow some steps, and the load drifts."""
    ordered = np.sort(np.asarray(seconds))
    quarter = ordered.size // 4
    return float(ordered[quarter:ordered.size - quarter].mean())


def measure(scene: Scene, duration: float) -> dict:
    """Run the first cycle of ``scene`` for ``duration`` (s) and return what its steps took. Collective.

    ``step_s``: CPU time of the busiest rank plus the messages, so that other users of the machine do not count;
    ``wall_s``: by the clock on the wall, the same where the machine is quiet.
    """
    plan = mpi.run_together(make_batches, scene)
    state, model = build_state(scene, balance_of_run(scene, plan).ranges), build_model(scene)
    ledger, clock = build_ledger(model), Clock()
    paint_substrate(state, scene.domain.substrate_height, scene.substrate.temperature)
    paint_batch(state, model, plan.batches[plan.order[0]], scene.domain.layer_bottom, scene.particles.velocity,
                scene.particles.temperature, ledger, scene.batches.seed)
    clock.limits.put_in(scene.top_speed, scene.domain.cell_size)
    watches, wall, busy, messages = Stopwatches(), [], [], []
    with waiting(watches.wrap):
        while clock.in_cycle < duration * (1.0 - 1e-12):
            start, before = (time.monotonic(), time.thread_time()), clock.steps
            advance(state, model, clock, ledger, duration)
            steps = clock.steps - before
            wall.append((time.monotonic() - start[0]) / steps)
            messages.append(sum(watches.read()[0].values()) / steps)
            busy.append((time.thread_time() - start[1]) / steps - messages[-1])
    active = int(mpi.total(np.int64(clock.active_cell_steps)))
    # the first steps load the kernels
    first = min(3, len(wall) - 1)
    # who comes last waits least, in the step when nobody else is late: that is what the messages cost
    cost = float(mpi.minimum(np.quantile(messages[first:], 0.05)))
    return {"ranks": mpi.size(), "step_s": float(mpi.maximum(typical(busy[first:]))) + cost, "messages_s": cost,
            "wall_s": typical(wall[first:]), "steps": clock.steps, "active_cells": active / clock.steps}


def _mpirun() -> str:
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        raise F2SError("plan --check needs mpirun on PATH")
    return mpirun


def _start_of(scene: Scene, duration: float | None) -> tuple[Scene, float]:
    """Return the scene of the trial runs and their simulated time (s), ``STEPS`` steps if ``duration`` is None."""
    duration = STEPS * estimated_time_step(scene) if duration is None else duration
    return parse_scene(dump_scene(scene), "plan --check", [
        "cycles.count=1", f"cycles.duration={duration!r} s", f"cycles.last_duration={duration!r} s",
        "particles.flight=eulerian"]), duration


def ready(scene: Scene, duration: float | None) -> None:
    """Raise ``F2SError`` for what would keep :func:`compare` from its runs; to be called before rates are measured."""
    _start_of(scene, duration)
    _mpirun()


def _launch(path: pathlib.Path, duration: float, ranks: int) -> dict:
    command = [sys.executable, "-m", "f2s_hpc.bench.trial", str(path), repr(duration)]
    if ranks > 1:
        command = [_mpirun(), "-n", str(ranks), *command]
    done = subprocess.run(command, env=launch_environment(os.environ), capture_output=True, text=True, check=False,
                          stdin=subprocess.DEVNULL)
    if done.returncode:
        raise F2SError(f"the trial run on {count_text(ranks, 'rank')} failed: {reason(done.stderr)}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def compare(scene: Scene, plan: BatchPlan, rates: Rates, network: Network, ranks: Sequence[int],
            duration: float | None = None) -> list[dict]:
    """Run the start of ``scene`` on each number of ranks, and return predicted and measured seconds per step.

    ``duration``: simulated time (s), 40 steps if None. The particles are painted at once: in ballistic flight the start
    of a run would be a substrate at rest. Starts processes of its own; raises ``F2SError``.
    """
    short, duration = _start_of(scene, duration)
    predicted = predict(short, BatchPlan(plan.batches, plan.order[:1]), ranks, rates, network)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "scene.toml"
        path.write_text(dump_scene(short), encoding="utf-8")
        for expected in predicted:
            # the better of two: other users of the machine only ever slow a run
            found = min((_launch(path, duration, expected.ranks) for _ in range(2)), key=lambda run: run["step_s"])
            rows.append({**found, "predicted_step_s": expected.step_s, "predicted_active": expected.active_cells,
                         "ratio": expected.step_s / found["step_s"]})
    return rows


def comparison(rows: Sequence[dict]) -> str:
    """Return predicted against measured steps as a table."""
    lines = [(f"{'ranks':>6} {'steps':>6} {'active cells':>13} {'predicted':>10} {'ms/step':>9} {'messages':>9} "
              f"{'predicted':>10} {'predicted/measured':>19} {'wall ms':>8}")]
    lines += [(f"{r['ranks']:6d} {r['steps']:6d} {r['active_cells']:13,.0f} {r['predicted_active']:10,.0f} "
               f"{1e3 * r['step_s']:9.2f} {1e3 * r['messages_s']:9.2f} {1e3 * r['predicted_step_s']:10.2f} "
              f"{r['ratio']:19.3f} {1e3 * r['wall_s']:8.2f}") for r in rows]
    return "\n".join(lines)


if __name__ == "__main__":
    mpi.install_abort_hook()
    result = measure(mpi.run_together(load_scene, sys.argv[1]), float(sys.argv[2]))
    if mpi.is_root():
        print(json.dumps(result))
    sys.modules["f2s_hpc.grid.halo"].release_all()
