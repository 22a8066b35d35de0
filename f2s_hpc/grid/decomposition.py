"""The PETSc DMDAs that distribute the box, and the ghost map read off them.

Two DMDAs, one of cells and one of nodes, with matching ownership: the node DMDA takes the ranges of
the cells, with one node more on the last rank of each axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import InputError, TooManyRanks
from f2s_hpc.grid import petsc
from f2s_hpc.grid.box import GHOST, Box, Part
from f2s_hpc.grid.pages import trim_heap

if TYPE_CHECKING:
    from petsc4py import PETSc

_RANK_STRIDE = float(2**36)


def process_grid(box: Box, ranks: int) -> tuple[int, int, int]:
    """Return the number of ranks along x, y, z with the smallest ghost surface.

    z is cut only when x and y can not give slabs as thick as the ghost width, since columns carry
    the deposit and a cut in z leaves the upper rank idle. Raises ``TooManyRanks`` if no split fits.
    """
    best = None
    for px in range(1, ranks + 1):
        for py in range(1, ranks // px + 1):
            if ranks % (px * py):
                continue
            shape = (px, py, ranks // (px * py))
            if any(p > 1 and n // p < GHOST for n, p in zip(box.cells, shape)):
                continue
            nx, ny, nz = box.cells
            surface = (px - 1) * ny * nz + (py - 1) * nx * nz + (shape[2] - 1) * nx * ny
            rating = (shape[2], surface, px)
            if best is None or rating < best[0]:
                best = (rating, shape)
    if best is None:
        raise TooManyRanks(f"a box of {' x '.join(map(str, box.cells))} cells can not be cut into {ranks} blocks of at "
                           f"least {GHOST} cells a side; use fewer ranks or smaller cells")
    return best[1]


Ranges = tuple[list[int], list[int], list[int]]
"""Cells along x, y, z that each rank of a process grid owns."""


def _even(cells: int, parts: int) -> list[int]:
    share, extra = divmod(cells, parts)
    return [share + (p < extra) for p in range(parts)]


def _weighted(weights: np.ndarray, parts: int) -> list[int]:
    """Return ranges of about equal sums of ``weights`` (one per cell, >= 0), none thinner than the ghosts."""
    cells = weights.size
    total = np.cumsum(weights)
    if parts == 1 or not total[-1] > 0.0:
        return _even(cells, parts)
    ends = np.empty(parts + 1, dtype=np.int64)
    ends[0], ends[-1] = 0, cells
    for part in range(1, parts):
        wanted = total[-1] * part / parts
        above = int(np.searchsorted(total, wanted))
        # the cell that holds the cut goes to the side that comes nearer
        below = total[above - 1] if above else 0.0
        ends[part] = above + (total[above] - wanted < wanted - below)
    for part in range(1, parts):
        ends[part] = max(ends[part], ends[part - 1] + GHOST)
    for part in range(parts - 1, 0, -1):
        ends[part] = min(ends[part], ends[part + 1] - GHOST)
    return np.diff(ends).tolist()


def ownership_ranges(box: Box, grid: tuple[int, int, int],
                     weights: tuple[np.ndarray, np.ndarray] | None = None) -> Ranges:
    """Return the cells along x, y, z that each rank of ``grid`` owns: even, or by ``weights``; allocates nothing.

    ``weights``: expected load of each plane of cells normal to x and to y (any unit). z is always cut evenly.
    Raises ``InputError`` where a slab would be thinner than the ghosts.
    """
    if any(p > 1 and n // p < GHOST for n, p in zip(box.cells, grid)):
        raise InputError(f"process grid {grid} leaves a slab thinner than {GHOST} cells")
    if weights is None:
        return tuple(_even(n, p) for n, p in zip(box.cells, grid))
    return (_weighted(np.asarray(weights[0]), grid[0]), _weighted(np.asarray(weights[1]), grid[1]),
            _even(box.cells[2], grid[2]))


@dataclass(frozen=True)
class GhostMap:
    """Where the ghosts of a location come from.

    ``local``: flat index of each ghost in this rank's array; ``rank`` and ``remote``: its owner and
    the flat index in the owner's array.
    """

    local: np.ndarray
    rank: np.ndarray
    remote: np.ndarray

    def part(self, shape: tuple[int, int, int], count: tuple[int, int, int], layers: int,
             axis: int | None, top: int | None = None) -> GhostMap:
        """Return the ghosts at most ``layers`` deep, all of them or only those straight along ``axis``.

        ``shape``: (nz, ny, nx) of the local array, ``count``: (x, y, z) points owned; ``top``: leave out those at this
        local plane and above.
        """
        places = np.unravel_index(self.local, shape)[::-1]
        kept = np.ones(self.local.size, dtype=bool) if top is None else places[2] < top
        for a, (place, owned) in enumerate(zip(places, count)):
            depth = layers if axis in (None, a) else 0
            kept &= (place >= GHOST - depth) & (place < GHOST + owned + depth)
        return GhostMap(self.local[kept], self.rank[kept], self.remote[kept])


class Decomposition:
    """The distributed box: this rank's :class:`Part` and the ghost maps of cells and nodes.

    ``ranges``: what each rank owns, the same on all ranks; even ranges if not given. Raises ``InputError`` on all
    ranks where a slab is thinner than the ghosts; ``MemoryError`` on ranks that have too little for it.
    """

    def __init__(self, box: Box, grid: tuple[int, int, int] | None = None, ranges: Ranges | None = None) -> None:
        self.box = box
        self.grid = tuple(map(len, ranges)) if ranges else grid or process_grid(box, mpi.size())
        cell_ranges = ranges or ownership_ranges(box, self.grid)
        if any(len(r) > 1 and min(r) < GHOST for r in cell_ranges):
            raise InputError(f"process grid {self.grid} leaves a slab thinner than {GHOST} cells")
        da = self._create(box.cells, cell_ranges)
        (x0, x1), (y0, y1), (z0, z1) = da.getRanges()
        self.part = Part(box, (x0, y0, z0), (x1 - x0, y1 - y0, z1 - z0))
        self.cell_ghosts = self.node_ghosts = GhostMap(*np.zeros((3, 0), dtype=np.int64))
        if mpi.size() > 1:
            self.cell_ghosts = self._ghost_map(da, self.part.cell_shape)
            da.destroy()  # before the next is made: each takes memory for every point (workload.memory.SETTING_UP)
            da = self._create(tuple(n + 1 for n in box.cells), [r[:-1] + [r[-1] + 1] for r in cell_ranges])
            self.node_ghosts = self._ghost_map(da, self.part.node_shape)
        da.destroy()
        # fields would be laid into what is kept of them
        trim_heap()

    def _create(self, sizes: tuple[int, ...], ranges: list[list[int]]) -> PETSc.DMDA:
        PETSc = petsc.load()
        ghosted = PETSc.DM.BoundaryType.GHOSTED
        try:
            return PETSc.DMDA().create(
                dim=3, dof=1, sizes=sizes, proc_sizes=self.grid, boundary_type=(ghosted,) * 3, stencil_width=GHOST,
                stencil_type=PETSc.DMDA.StencilType.BOX, comm=mpi.world(),
                ownership_ranges=[np.array(r, dtype=PETSc.IntType) for r in ranges])
        except PETSc.Error as error:
            if "Malloc" not in str(error):
                raise
            raise MemoryError(f"for {' x '.join(map(str, sizes))} points on {mpi.size()} rank"
                              + "s" * (mpi.size() > 1)) from None

    def _ghost_map(self, da: PETSc.DMDA, shape: tuple[int, int, int]) -> GhostMap:
        """Let the DMDA carry each owned point's (rank, flat index) into the ghosts of its neighbours."""
        (x0, x1), (y0, y1), (z0, z1) = da.getRanges()
        owned = (z1 - z0, y1 - y0, x1 - x0)
        sent, received = da.createGlobalVec(), da.createLocalVec()
        label = sent.getArray().reshape(owned)
        plane = np.arange(shape[1] * shape[2], dtype=np.int64).reshape(shape[1:])
        plane = plane[GHOST:GHOST + owned[1], GHOST:GHOST + owned[2]]
        for k in range(owned[0]):  # (a plane at a time: no array of all)
            label[k] = plane + (k + GHOST) * shape[1] * shape[2] + mpi.rank() * _RANK_STRIDE
        received.set(-1.0)
        da.globalToLocal(sent, received)
        # the DMDA's local array is the low part of ours (nodes have a spare layer on inner ranks)
        natural = tuple(n + 2 * GHOST for n in owned)
        label = received.getArray().reshape(natural)
        label[tuple(slice(GHOST, GHOST + n) for n in owned)] = -1.0
        places = np.flatnonzero(label.reshape(-1) >= 0.0)
        owner, remote = np.divmod(label.reshape(-1)[places].astype(np.int64), np.int64(_RANK_STRIDE))
        flat = np.ravel_multi_index(np.unravel_index(places, natural), shape)
        del label  # (else destroyed vectors stay, and their DMDA with them)
        sent.destroy()
        received.destroy()
        return GhostMap(flat, owner, remote)
