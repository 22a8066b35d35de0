"""The counting process: steps of a saved patch up to a remap in plain Python, their tallies as JSON on standard output.

    NUMBA_DISABLE_JIT=1 python -m f2s_hpc.bench.count PATCH.npz

A process of its own, since numba is switched off for good when it is first imported.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

import numpy as np

from f2s_hpc.bench import counting, states
from f2s_hpc.bench.hook import hooked


def count(path: str) -> dict[str, dict]:
    """Return the steps of the patch in the file ``path`` up to its next remap, and the tally of each kernel."""
    setup = states.tiled(states.load(path), states.default_model(), (1, 1))
    counting.stand_in_for_libraries()
    counter = counting.Counter(setup.state.pool.memory, setup.state.active_cells())
    with hooked(counter.wrap), np.errstate(all="ignore"):
        steps = setup.advance_to_remap()
    return {name: asdict(tally) for name, tally in counter.tallies.items()} | {"active": counter.active, "steps": steps}


if __name__ == "__main__":
    print(json.dumps(count(sys.argv[1])))
