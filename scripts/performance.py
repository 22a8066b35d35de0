#!/usr/bin/env python
"""Cost of whole runs on one core: a sphere as other codes ran it, start-up, empty height of a box; a minute or two.

    . scripts/env.sh
    python scripts/performance.py
    mpirun -n 2 f2s run wide-100k --out runs/wide
    python scripts/performance.py --wide runs/wide            cost per particle against section4 with the same
                                                              cells and a patch of itself, on as many ranks
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import tempfile

from f2s_hpc.bench import performance
from f2s_hpc.errors import F2SError

PARTS = {"splat": performance.splat, "startup": performance.startup, "height": performance.empty_height}


def main(words: list[str]) -> int:
    """Run what is asked for, print a line each; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=",".join(PARTS), metavar="NAME[,NAME..]", help="of: " + ", ".join(PARTS))
    parser.add_argument("--wide", metavar="DIR", help="a finished run of wide-100k")
    parser.add_argument("--launcher", default="mpirun -n", help='what starts ranks ("mpirun -n")')
    chosen = parser.parse_args(words)
    names = [] if chosen.wide else [name for name in chosen.parts.split(",") if name]
    for name in names:
        if name not in PARTS:
            print(f"--parts {name}: there are {', '.join(PARTS)}", file=sys.stderr)
            return 2
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name in names:
                print(PARTS[name](pathlib.Path(folder)), flush=True)
            if chosen.wide:
                print(performance.per_particle(pathlib.Path(chosen.wide), pathlib.Path(folder),
                                               chosen.launcher))
    except F2SError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
