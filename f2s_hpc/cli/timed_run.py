"""``f2s`` with its steps timed: what ``scripts/scaling.py`` starts under mpirun.

    mpirun -n 4 python -m f2s_hpc.cli.timed_run run SCENE --out DIR ...

is ``f2s run SCENE --out DIR ...`` and writes ``DIR/times.json``: seconds per step by the clock, and computing only.
"""

from __future__ import annotations

import json
import pathlib
import sys
import time

from f2s_hpc import mpi
from f2s_hpc.bench.hook import Stopwatches, waiting
from f2s_hpc.bench.scaling import TIMES
from f2s_hpc.bench.trial import typical
from f2s_hpc.cli.main import main
from f2s_hpc.cycles import simulation

WARM = 3


def timed(arguments: list[str]) -> int:
    """Run the command, its steps timed; return the exit code."""
    plain, watches = simulation.advance, Stopwatches()
    wall, busy = [], []

    def advance(state, model, clock, *rest) -> None:
        watches.read()
        start, before = (time.monotonic(), time.thread_time()), clock.steps
        plain(state, model, clock, *rest)
        steps = clock.steps - before
        wall.append((time.monotonic() - start[0]) / steps)
        busy.append((time.thread_time() - start[1] - sum(watches.read()[0].values())) / steps)

    simulation.advance = advance
    with waiting(watches.wrap):
        code = main(arguments)
    if code == 0:
        first = min(WARM, len(wall) - 1)
        times = {"step_s": float(mpi.maximum(typical(wall[first:]))),
                 "busy_s": float(mpi.maximum(typical(busy[first:])))}
        if mpi.is_root():
            folder = pathlib.Path(arguments[arguments.index("--out") + 1])
            (folder / TIMES).write_text(json.dumps(times) + "\n", encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(timed(sys.argv[1:]))
