"""Ghost exchange: all fields of a list in one message per neighbour.

The fields of a rank live in one pool of memory, each a contiguous array of its own, as the kernels
want them. PETSc star forests map ghosts to their owners: for few ghosts one over that pool, of every listed field, so
that an exchange costs one message per neighbour however many fields it carries; for many one that all fields share.
Only ghosts are touched, and of those only the ones below the highest material: an empty box costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.grid import petsc
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.decomposition import Decomposition, GhostMap
from f2s_hpc.grid.pages import anonymous_pages, give_back, real_bytes
from f2s_hpc.phases import phase

if TYPE_CHECKING:
    from petsc4py import PETSc

PACKED = 16384
"""Ghosts of a rank (of one field) up to which all fields of an exchange go in one message per neighbour.

That saves latency, and costs a map of every ghost of every field. With more ghosts messages are so long that latency
is nothing, and each field has its own; all fields on cells (or nodes) then share one map."""

HEADROOM = 4
"""Planes above the highest active one whose ghosts are exchanged at least; activity grows by two in a step."""

STRIDE = 8
"""Planes by which the exchange grows at once, so that its maps are made anew a few times in a run."""

_ALIGNMENT = 8
_living: list[dict[tuple, PETSc.SF]] = []  # the star forests of every pool, not its memory


class Pool:
    """The memory of all fields of this rank: one array, zero at the start, one view per field.

    Pages that nothing touches are never made real by the operating system, so the empty part of a
    tall box costs no memory. ``top``: only ghosts below this plane of cells (global k) are exchanged; None: all.
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
        self._pages = anonymous_pages(end)
        self.memory = np.frombuffer(self._pages, dtype=float)
        self.top: int | None = None
        self.views = {name: self._view(part, name) for name in self.names}
        self._offsets_of = mpi.all_gather(self.offsets)
        self._forests: dict[tuple, PETSc.SF] = {}
        self._transfers: dict[tuple, list[tuple[PETSc.SF, np.ndarray]]] = {}
        _living.append(self._forests)

    @staticmethod
    def _shape(part, name: str) -> tuple[int, int, int]:
        return part.cell_shape if BY_NAME[name].location == CELL else part.node_shape

    def _view(self, part, name: str) -> np.ndarray:
        shape = self._shape(part, name)
        start = self.offsets[name]
        return self.memory[start:start + int(np.prod(shape))].reshape(shape)

    def real_bytes(self) -> int:
        """Return the memory that the fields of this rank really take now (bytes)."""
        return real_bytes(self.memory)

    def release(self, names: Iterable[str]) -> None:
        """Give the memory of the named fields back until they are written again; what they hold is lost."""
        for name in names:
            self.release_rows(name, 0, self.views[name][..., 0].size)

    def release_rows(self, name: str, first: int, end: int) -> None:
        """Give the memory of some rows of a field back, [k, j] counted in one go; what they hold is lost or was zero.

        The memory of pages that belong to other rows too is kept.
        """
        row = 8 * self.views[name].shape[2]
        give_back(self._pages, 8 * self.offsets[name] + first * row, 8 * self.offsets[name] + end * row)

    def cover(self, plane: int) -> None:
        """Exchange the ghosts up to ``plane`` (global k) and somewhat above: the highest plane with material.

        Everything above is void, on all ranks, and ghosts there are zero already. Collective, the same on all ranks.
        """
        if self.top is None or plane + 1 + HEADROOM > self.top:
            self._restart(plane + 1 + HEADROOM + STRIDE)

    def cover_all(self) -> None:
        """Exchange all ghosts until :meth:`cover` is called. Collective."""
        if self.top is not None:
            self._restart(None)

    def _restart(self, top: int | None) -> None:
        self.top = top
        self.destroy()

    def exchange(self, names: tuple[str, ...], layers: int = GHOST, axis: int | None = None) -> None:
        """Fill the ghosts of the named fields that other ranks own: ``layers`` deep, all or those along ``axis``."""
        if mpi.size() > 1:
            self._fetch((names, layers, axis))

    @phase("ghosts")
    def _fetch(self, key: tuple[tuple[str, ...], int, int | None]) -> None:
        """Do the exchange of ``key``: names, layers, axis."""
        transfers = self._transfers.get(key)
        if transfers is None:
            transfers = self._transfers[key] = self._plan(*key)
        for forest, memory in transfers:
            forest.bcastBegin(mpi.DOUBLE, memory, memory, mpi.REPLACE)
        for forest, memory in transfers:
            forest.bcastEnd(mpi.DOUBLE, memory, memory, mpi.REPLACE)

    def _plan(self, names: tuple[str, ...], layers: int, axis: int | None) -> list[tuple[PETSc.SF, np.ndarray]]:
        """Return the star forests of an exchange and the memory that each works on: one for all fields, or one each."""
        ghosts = {location: self._ghosts(location, layers, axis) for location in {BY_NAME[n].location for n in names}}
        most = max(found.local.size for found in ghosts.values())
        # (PETSc of the distributions counts with 32-bit integers, and all fields of a rank may be more than that)
        places = np.iinfo(petsc.load().IntType).max
        if mpi.maximum(np.int64(most)) <= PACKED and mpi.maximum(np.int64(self.memory.size)) <= places:
            return [(self._forest(("packed", names, layers, axis), self.memory.size, *self._packed(names, ghosts)),
                     self.memory)]
        found = []
        for name in names:
            location = BY_NAME[name].location
            mine = ghosts[location]
            forest = self._forest(("shared", location, layers, axis), self.views[name].size, mine.local,
                                  np.stack([mine.rank, mine.remote], axis=1))
            found.append((forest, self.views[name].reshape(-1)))
        return found

    def _ghosts(self, location: str, layers: int, axis: int | None) -> GhostMap:
        part, cells = self.decomposition.part, location == CELL
        owners = self.decomposition.cell_ghosts if cells else self.decomposition.node_ghosts
        # nodes have one plane more than cells
        top = None if self.top is None else self.top + (not cells) - part.offset[2]
        return owners.part(part.cell_shape if cells else part.node_shape, part.count if cells else part.node_count,
                           layers, axis, top)

    def _packed(self, names: tuple[str, ...], ghosts: dict[str, GhostMap]) -> tuple[np.ndarray, np.ndarray]:
        """Return where the ghosts of all named fields lie in the pool, and rank and place there of their owners."""
        local, remote = [], []
        for name in names:
            found = ghosts[BY_NAME[name].location]
            offset_at = np.array([offsets[name] for offsets in self._offsets_of], dtype=np.int64)
            local.append(self.offsets[name] + found.local)
            remote.append(np.stack([found.rank, offset_at[found.rank] + found.remote], axis=1))
        return np.concatenate(local), np.concatenate(remote)

    def _forest(self, key: tuple, size: int, local: np.ndarray, remote: np.ndarray) -> PETSc.SF:
        """Return the star forest of ``key``, made from ``local`` and ``remote`` unless there is one."""
        forest = self._forests.get(key)
        if forest is None:
            PETSc = petsc.load()
            forest = self._forests[key] = PETSc.SF().create(comm=mpi.world())
            forest.setGraph(size, local.astype(PETSc.IntType), remote.astype(PETSc.IntType))
            forest.setUp()
        return forest

    def destroy(self) -> None:
        """Free the PETSc objects (collective)."""
        _destroy(self._forests)
        self._transfers.clear()


def _destroy(forests: dict[tuple, PETSc.SF]) -> None:
    for forest in forests.values():
        forest.destroy()
    forests.clear()


def release_all() -> None:
    """Free the PETSc objects of every pool; collective, to be called before the interpreter ends.

    PETSc collects what is left at exit with collective calls of its own, which hang when the ranks' Python
    dropped their objects in different orders.
    """
    while _living:
        _destroy(_living.pop())
