"""Ghost exchange: all fields of a list in one message per neighbour.

The fields of a rank live in one pool of memory, each a contiguous array of its own, as the kernels
want them. A PETSc star forest over that pool maps every ghost of every listed field to its owner,
so an exchange costs one message per neighbour however many fields it carries, and touches only the
ghosts: an empty box costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from f2s_hpc import mpi
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.decomposition import Decomposition

_ALIGNMENT = 8
_living: list[Pool] = []


class Pool:
    """The memory of all fields of this rank: one array, zero at the start, one view per field.

    Pages that nothing touches are never made real by the operating system, so the empty part of a
    tall box costs no memory.
    """

    def __init__(self, decomposition: Decomposition, names: Sequence[str]) -> None:
        self.decomposition = decomposition
        self.names = tuple(names)
        self.offsets: dict[str, int] = {}
        part = decomposition.part
        end = 0
        for number, name in enumerate(self.names):
            # the odd multiples of a cache line keep equal indices of different fields out of one cache set
            self.offsets[name] = end + 9 * _ALIGNMENT * (number % 7)
            end = -(-(self.offsets[name] + int(np.prod(self._shape(part, name)))) // _ALIGNMENT) * _ALIGNMENT
        self.memory = np.zeros(end)
        self.views = {name: self._view(part, name) for name in self.names}
        self._offsets_of = mpi.all_gather(self.offsets)
        self._forests: dict[tuple, PETSc.SF] = {}
        _living.append(self)

    @staticmethod
    def _shape(part, name: str) -> tuple[int, int, int]:
        return part.cell_shape if BY_NAME[name].location == CELL else part.node_shape

    def _view(self, part, name: str) -> np.ndarray:
        shape = self._shape(part, name)
        start = self.offsets[name]
        return self.memory[start:start + int(np.prod(shape))].reshape(shape)

    def exchange(self, names: tuple[str, ...], layers: int = GHOST, axis: int | None = None) -> None:
        """Fill the ghosts of the named fields that other ranks own: ``layers`` deep, all or those along ``axis``."""
        if mpi.size() == 1:
            return
        key = (names, layers, axis)
        forest = self._forests.get(key)
        if forest is None:
            forest = self._forests[key] = self._build(*key)
        forest.bcastBegin(mpi.DOUBLE, self.memory, self.memory, mpi.REPLACE)
        forest.bcastEnd(mpi.DOUBLE, self.memory, self.memory, mpi.REPLACE)

    def _build(self, names: tuple[str, ...], layers: int, axis: int | None) -> PETSc.SF:
        local, remote = [], []
        for name in names:
            on_cells = BY_NAME[name].location == CELL
            part = self.decomposition.part
            ghosts = (self.decomposition.cell_ghosts if on_cells else self.decomposition.node_ghosts).part(
                part.cell_shape if on_cells else part.node_shape, part.count if on_cells else part.node_count, layers,
                axis)
            offset_at = np.array([offsets[name] for offsets in self._offsets_of], dtype=np.int64)
            local.append(self.offsets[name] + ghosts.local)
            remote.append(np.stack([ghosts.rank, offset_at[ghosts.rank] + ghosts.remote], axis=1))
        forest = PETSc.SF().create(comm=mpi.world())
        forest.setGraph(self.memory.size, np.concatenate(local).astype(PETSc.IntType),
                        np.concatenate(remote).astype(PETSc.IntType))
        forest.setUp()
        return forest

    def destroy(self) -> None:
        """Free the PETSc objects (collective)."""
        for forest in self._forests.values():
            forest.destroy()
        self._forests.clear()


def release_all() -> None:
    """Free the PETSc objects of every pool; collective, to be called before the interpreter ends.

    PETSc collects what is left at exit with collective calls of its own, which hang when the ranks' Python
    dropped their objects in different orders.
    """
    while _living:
        _living.pop().destroy()
