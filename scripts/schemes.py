#!/usr/bin/env python
"""The recurring scheme against the standard one on the same particles: the paper's Table 3, and the results of both.

    . scripts/env.sh
    python scripts/schemes.py                                  3 um on 2 ranks, as the paper: some hours
    python scripts/schemes.py --set "domain.cell_size=6 um" --out runs/schemes-6
    python scripts/schemes.py --batches a.csv,b.csv            batches of your own (x,y,z,r in mm)
    f2s compare runs/schemes-6/recurring runs/schemes-6/standard      profiles, PEEQ and temperature by depth

Folders that are there already are not run again.
"""

from __future__ import annotations

import argparse
import pathlib
import shlex
import sys

from f2s_hpc.bench import schemes
from f2s_hpc.errors import F2SError


def main(words: list[str]) -> int:
    """Run both, print the tables; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ranks", type=int, default=2, help="of both runs (2)")
    parser.add_argument("--set", dest="overrides", metavar="KEY=VALUE", action="append", default=[],
                        help="for both runs")
    parser.add_argument("--batches", metavar="FILE[,FILE..]", help="default: those of section4, generated")
    parser.add_argument("--out", default="runs/schemes", help="folder of both runs (runs/schemes)")
    parser.add_argument("--launcher", default="mpirun -n", help='what starts ranks ("mpirun -n")')
    parser.add_argument("--dry-run", action="store_true", help="print the commands only")
    chosen = parser.parse_args(words)
    out = pathlib.Path(chosen.out)
    files = chosen.batches.split(",") if chosen.batches else None
    if chosen.dry_run:
        for scheme in schemes.SCENES:
            print(shlex.join(schemes.command_of(scheme, files or ["..."], chosen.overrides, chosen.ranks, out / scheme,
                                                chosen.launcher)))
        return 0
    try:
        files = files or schemes.batch_files(out)
        found = [schemes.measure(scheme, files, chosen.overrides, chosen.ranks, out, chosen.launcher)
                 for scheme in schemes.SCENES]
    except F2SError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(schemes.cost_table(*found))
    print()
    print(schemes.result_table(*found))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
