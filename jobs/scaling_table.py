"""Table of a scaling study from what its runs left: ``python jobs/scaling_table.py strong|weak FOLDER``.

Reads ``summary.json`` and ``times.json`` in ``FOLDER/ranks-*``, prints a table and writes ``scaling.csv``, ``.json``
and ``.png`` into ``FOLDER``. Times are per step, the mean of the middle half of the steps: neither the start nor
compilation is in them. The efficiency is the active cell-steps per second and rank over those of the run with the
fewest ranks; this holds for strong and weak scaling alike.
"""

from __future__ import annotations

import pathlib
import sys

from f2s_hpc.bench import scaling
from f2s_hpc.errors import F2SError


def main(arguments: list[str]) -> int:
    """Print and write the table; return the exit code."""
    if len(arguments) != 2 or arguments[0] not in ("strong", "weak"):
        print("usage: python jobs/scaling_table.py strong|weak FOLDER", file=sys.stderr)
        return 2
    folder = pathlib.Path(arguments[1])
    try:
        rows = scaling.rows_of_folder(arguments[0], folder)
        print(scaling.table(rows))
        print("also in " + ", ".join(str(path) for path in scaling.write(rows, folder)))
    except F2SError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
