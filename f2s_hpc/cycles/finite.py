"""What is not a number must not be saved: it would be all that a stopped run could continue from."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import UnstableStep
from f2s_hpc.state import State


def refuse_what_is_not_finite(state: State) -> None:
    """Raise ``UnstableStep`` on all ranks, naming field and cell, if a saved field is not finite somewhere.

    Rates that limit the step tell of velocity and stress at once; a wrong temperature or PEEQ shows in none of them.
    """
    mine = None
    for name in state.saved:
        owned = state.owned(name)
        for k in range(owned.shape[0]):
            # (a sum is not finite if one of its terms is not)
            if not math.isfinite(owned[k].sum()):
                bad = np.argwhere(~np.isfinite(owned[k]))
                if bad.size:
                    place = (k, *bad[0])[::-1]
                    mine = (name, tuple(int(n) + start for n, start in zip(place, state.part.start)))
                    break
        if mine is not None:
            break
    found = [entry for entry in mpi.all_gather(mine) if entry is not None]
    if found:
        name, cell = min(found, key=lambda entry: (state.saved.index(entry[0]), entry[1][::-1]))
        raise UnstableStep(f"{name} is not finite at cell (i, j, k) = {cell}")
