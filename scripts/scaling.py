#!/usr/bin/env python
"""Strong and weak scaling of real runs: table, CSV, JSON and a plot of the efficiency.

    . scripts/env.sh
    python scripts/scaling.py                                  1, 2, 4, ... ranks up to the cores, section4 at 6 um
    python scripts/scaling.py --ranks 1,2,4 --kind strong --scene section4 --set domain.cell_size="3 um"
    python scripts/scaling.py --launcher "srun --mpi=pmix -n" --ranks 32,64,128 --out runs/scaling

Each run is one short cycle without output. Times are per step, the mean of the middle half of the steps: by the clock,
and the computing alone of the busiest rank, which tells the solver from the network (and from other users).
"""

from __future__ import annotations

import argparse
import os
import pathlib
import shlex
import sys

from f2s_hpc.bench import scaling
from f2s_hpc.errors import F2SError, InputError

STUDY = ["domain.cell_size=6 um", "batches.count=1", "particles.flight=eulerian"]
"""Particles are on the grid from the start, so that a short run is a typical one."""


def _arguments(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=("strong", "weak", "both"), default="both",
                        help="of one size on more and more ranks, of as much for each rank, or both (default)")
    parser.add_argument("--ranks", metavar="N[,N..]", help="default: 1, 2, 4, ... up to the cores")
    parser.add_argument("--scene", help="default: section4 at 6 um")
    parser.add_argument("--set", dest="overrides", metavar="KEY=VALUE", action="append", default=[],
                        help="replace one value of the scene")
    parser.add_argument("--duration", default="30 ns", help="simulated time of each run (30 ns, some 38 steps at 6 um)")
    parser.add_argument("--out", default="runs/scaling", help="new folder (runs/scaling)")
    parser.add_argument("--launcher", default="mpirun -n", help='what starts ranks ("mpirun -n")')
    parser.add_argument("--dry-run", action="store_true", help="print the commands only")
    return parser.parse_args(words)


def _ranks(text: str | None) -> list[int]:
    if text is None:
        return scaling.rank_list(len(os.sched_getaffinity(0)))
    try:
        ranks = [int(part) for part in text.replace(" ", ",").split(",") if part]
    except ValueError:
        ranks = []
    if not ranks or min(ranks) < 1:
        raise InputError(f"--ranks {text}: whole numbers from 1, separated by commas, are needed")
    return list(dict.fromkeys(ranks))


def main(words: list[str]) -> int:
    """Run the studies, print and write; return the exit code."""
    chosen = _arguments(words)
    try:
        ranks, out = _ranks(chosen.ranks), pathlib.Path(chosen.out)
        scene, overrides = chosen.scene or "section4", [*([] if chosen.scene else STUDY), *chosen.overrides]
        kinds = ("strong", "weak") if chosen.kind == "both" else (chosen.kind,)
        runs = scaling.planned(kinds, scene, overrides, chosen.duration, ranks, out, chosen.launcher)
        if chosen.dry_run:
            for run in runs:
                print(shlex.join(run.command))
            return 0
        rows = scaling.study(runs, out)
        print(scaling.table(rows))
        print("also in " + ", ".join(str(path) for path in scaling.write(rows, out)))
    except F2SError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
