#!/usr/bin/env python
"""Speed of every kernel and of the whole step, against bandwidth and peak measured in the same run.

    . scripts/env.sh
    python scripts/bench_kernels.py                          three states, four sizes: some two minutes
    python scripts/bench_kernels.py --states deposit --sizes M --json bench.json
    mpirun -n 2 python scripts/bench_kernels.py --sizes L    each rank its share of the box

Bytes and flops are counted, in a process that takes one step in plain Python (f2s_hpc/bench/counting.py says how);
the first run after a change of a kernel takes a minute longer for it. --no-count leaves them out.
"""

from __future__ import annotations

import argparse
import sys

from f2s_hpc import mpi, places
from f2s_hpc.bench import kernels, states
from f2s_hpc.errors import F2SError


def main(arguments: list[str]) -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", default=",".join(states.STATES), metavar="NAME[,NAME..]",
                        help="of: " + ", ".join(states.STATES))
    parser.add_argument("--sizes", default=",".join(kernels.SIZES), metavar="SIZE[,SIZE..]",
                        help="S, M, L, XL: 8,192 to 524,288 cells")
    parser.add_argument("--json", metavar="FILE", help="write all rows as JSON")
    parser.add_argument("--no-count", action="store_true", help="times only: no bytes, flops and roofline")
    chosen = parser.parse_args(arguments)
    mpi.install_abort_hook()
    try:
        if chosen.json:
            mpi.run_together(places.check_file, chosen.json, "--json")
        machine, rows = kernels.run(chosen.states.split(","), chosen.sizes.split(","), not chosen.no_count, mpi.say)
        if chosen.json and mpi.is_root():
            kernels.write_json(chosen.json, machine, rows)
    except F2SError as error:
        if mpi.is_root():
            print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
