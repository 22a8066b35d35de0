"""The box: cells, spacing and ghost width, and the part of it that one rank owns. No PETSc here."""

from __future__ import annotations

from dataclasses import dataclass

GHOST = 4
"""Ghost layers: the fifth-order remap of a rank's outermost node reads the mass of the third node below it, which is
the mean of cells that reach one further. (Three would do for cells: flux one cell outside, donor two, normal three.)"""

SIDES = ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high")


@dataclass(frozen=True)
class Box:
    """The whole box: ``cells`` (nx, ny, nz), cubic cells of size ``dx`` (m), origin at (0, 0, 0)."""

    cells: tuple[int, int, int]
    dx: float

    @property
    def extents(self) -> tuple[float, float, float]:
        """Edge lengths of the box in metres."""
        return tuple(n * self.dx for n in self.cells)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a global cell array, indexed [k, j, i]."""
        return self.cells[::-1]

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a global node array, indexed [k, j, i]."""
        return tuple(n + 1 for n in self.shape)


@dataclass(frozen=True)
class Part:
    """The block of cells that one rank owns.

    ``start`` and ``count`` are (x, y, z). Local arrays are indexed [k, j, i] with ``GHOST`` layers
    before the first owned cell; node (i, j, k) is the low corner of cell (i, j, k), and the highest
    nodes of the box belong to the last rank of each axis (``at_high``).
    """

    box: Box
    start: tuple[int, int, int]
    count: tuple[int, int, int]

    @property
    def at_low(self) -> tuple[bool, bool, bool]:
        """Per axis: does the part touch the low side of the box?"""
        return tuple(s == 0 for s in self.start)

    @property
    def at_high(self) -> tuple[bool, bool, bool]:
        """Per axis: does the part touch the high side of the box?"""
        return tuple(s + c == n for s, c, n in zip(self.start, self.count, self.box.cells))

    @property
    def offset(self) -> tuple[int, int, int]:
        """Global index (i, j, k) of the first cell of a local array, a ghost."""
        return tuple(s - GHOST for s in self.start)

    @property
    def node_count(self) -> tuple[int, int, int]:
        """Nodes owned along x, y, z."""
        return tuple(c + int(last) for c, last in zip(self.count, self.at_high))

    @property
    def cell_shape(self) -> tuple[int, int, int]:
        """Shape of a local cell array with ghosts."""
        return tuple(c + 2 * GHOST for c in self.count[::-1])

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a local node array with ghosts; the same on all ranks, one more than the cells."""
        return tuple(c + 2 * GHOST + 1 for c in self.count[::-1])

    @property
    def owned_cells(self) -> tuple[slice, slice, slice]:
        """Slices of the owned cells in a local cell array."""
        return tuple(slice(GHOST, GHOST + c) for c in self.count[::-1])

    @property
    def owned_nodes(self) -> tuple[slice, slice, slice]:
        """Slices of the owned nodes in a local node array."""
        return tuple(slice(GHOST, GHOST + c) for c in self.node_count[::-1])
