"""The state of a run on one rank: the arrays of every declared field, and which of them are active."""

from __future__ import annotations

import numpy as np

from f2s_hpc import fields, mpi
from f2s_hpc.grid.boundary import Boundary
from f2s_hpc.grid.box import GHOST, Part
from f2s_hpc.grid.decomposition import Decomposition
from f2s_hpc.grid.halo import Pool
from f2s_hpc.kernels import activity
from f2s_hpc.phases import phase

ROOM = 3
"""Rows around active ones that keep their memory: kernels write up to two beyond, and nodes have one row more."""


class State:
    """The fields ``needed`` (:func:`f2s_hpc.fields.needed`) of this rank, with ghosts.

    ``views[name]``: local array [k, j, i] of a field; ``flat[name]``: the same memory as one row, as
    kernels take it. ``runs``: active rows; ``columns``: active columns for the y and z sweeps. ``active_rows``: False
    makes all rows active always, to measure what leaving them out saves.

    ``floor``: the cells below this plane of the box (global k) are asleep: the step leaves them as they are. To it they
    are what the ghosts of a neighbour at rest would be, so windows start at the floor, and the layers that kernels read
    below it stay in the lists. 0: nothing sleeps.
    """

    def __init__(self, decomposition: Decomposition, sides: dict[str, str], needed: tuple[fields.Field, ...],
                 active_rows: bool = True) -> None:
        self.decomposition = decomposition
        self.active_rows = active_rows
        self.part: Part = decomposition.part
        self.fields = needed
        self.pool = Pool(decomposition, [f.name for f in self.fields])
        self.views = self.pool.views
        self.flat = {name: view.reshape(-1) for name, view in self.views.items()}
        self.boundary = Boundary(self.part, sides)
        names = set(self.views)
        self.moving_cells = tuple(f.name for f in self.fields if f.advected and f.location == fields.CELL)
        self.carried_cells = tuple(n for n in self.moving_cells if n not in ("mass", "volume_fraction"))
        self.tags = tuple(f.name for f in self.fields if f.tag)
        self.swept_cells = tuple(n for n in self.carried_cells if n not in self.tags)
        self.strained_cells = ("volume_fraction", *(n for n in self.carried_cells if n in (*fields.STRESS,
                                                                                          "internal_energy")))
        self.saved = tuple(f.name for f in self.fields if f.saved)
        self.ghosted = tuple(f.name for f in self.fields if f.ghosted)
        self.empty = np.zeros(1)
        self.energy = self.flat["internal_energy"] if "internal_energy" in names else self.empty
        self.lost = self.flat["lost_energy"] if "lost_energy" in names else self.empty
        self.stress = tuple(self.flat[n] for n in fields.STRESS)
        self.velocity = tuple(self.flat[n] for n in fields.VELOCITY)
        self.force = tuple(self.flat[n] for n in fields.FORCE)
        self.sweep = tuple(self.flat[n] for n in fields.SWEEP)
        self.displacement = tuple(self.flat.get(n, self.empty) for n in fields.DISPLACEMENT)
        self._prepare_activity()

    # --- active blocks -----------------------------------------------------------------------------

    def _prepare_activity(self) -> None:
        nz, ny, nx = self.part.cell_shape
        shape = (nz, ny, activity.block_count(nx))
        self.active = np.ones(shape, dtype=np.uint8)
        self._previous = np.ones(shape, dtype=np.uint8)
        self._untouched = True
        self.floor, self.awake = 0, self.active
        self._holds = np.zeros(shape, dtype=np.uint8)
        self.fast_rows = np.zeros((nz + 1, ny + 1), dtype=np.uint8)
        self._runs = activity.empty_list(1024, 4)
        self._columns = [activity.empty_list(1024, 5), activity.empty_list(1024, 5)]
        self.run_count, self.column_counts = 0, [0, 0]
        location = {f.name: f.location for f in self.fields}
        self.cell_offsets = self.offsets(n for n in self.views if location[n] == fields.CELL)
        self.node_offsets = self.offsets(n for n in self.views if location[n] == fields.NODE)

    def offsets(self, names) -> np.ndarray:
        """Return where the named fields start in the pool's memory (int64)."""
        return np.array([self.pool.offsets[n] for n in names], dtype=np.int64)

    def everything_active(self) -> None:
        """Forget what was active, before material put in is exchanged; the next update looks everywhere. Collective."""
        self.active[:] = 1
        self.pool.cover_all()

    @staticmethod
    def _filled(array: np.ndarray) -> np.ndarray:
        """Return which planes [k] hold something of ``array``."""
        return np.array([plane.any() for plane in array])

    def around(self, array: np.ndarray) -> np.ndarray:
        """Return, as ``active`` is, the blocks of all planes [k] that hold something of ``array``, and those near ends.

        Near the low and high end of the box are the ghosts, and what they mirror.
        """
        return self.of_planes(self._filled(array))

    def of_planes(self, planes: np.ndarray) -> np.ndarray:
        """Return, as ``active`` is, all blocks of the ``planes`` (bool [k]), and those near the ends of the box."""
        planes = planes.copy()
        planes[:2 * GHOST] = planes[-2 * GHOST:] = True
        return np.repeat(planes, self.active[0].size).reshape(self.active.shape).astype(np.uint8)

    def settle(self) -> None:
        """Find the active blocks anew, wherever material is, and fill all ghosts; for material that was put in.

        Empty planes are read, not written, so that they take no memory.
        """
        if self._untouched:
            self.active[:] = 0
        self._exchange_mass(self._filled(self.views["mass"]))
        # (looked for again: by now ghosts hold what other ranks put in)
        self._find_active(self.around(self.views["mass"]))
        self.exchange(self.ghosted)

    def settle_planes(self, planes: slice) -> None:
        """Do the same for material that was put into ``planes`` (local k) only, between two steps.

        Fills the ghosts that the next step reads; those of what was not put in stay as they are.
        """
        filled = self.active_planes()
        filled[planes] = True
        self._exchange_mass(filled)
        self._find_active(self.of_planes(filled))
        self.exchange(("volume_fraction",))
        self.exchange(self.carried_cells, layers=1)
        self.exchange(fields.VELOCITY)

    def _exchange_mass(self, filled: np.ndarray) -> None:
        """Fetch the ghosts of mass from the neighbours, up to the highest of the ``filled`` planes (bool [k])."""
        highest = np.flatnonzero(filled).max(initial=0)
        self.pool.cover(int(mpi.maximum(np.int64(highest + self.part.offset[2]))))
        self.pool.exchange(("mass",))

    def _find_active(self, where: np.ndarray) -> None:
        """Fill the ghosts of mass behind the sides and find the active blocks, looking ``where`` (as ``active``)."""
        self.boundary.fill(self.pool.memory, self.pool.offsets, ("mass",), where)
        self.update_activity(where)

    @phase("activity")
    def update_activity(self, look: np.ndarray | None = None) -> None:
        """Find the active blocks from the present mass; zero what has just fallen outside them.

        ``look``: where to look for material (as ``active``); where it was active before, if not given.
        """
        nz, ny, nx = self.part.cell_shape
        self._untouched = False
        if self.active_rows:
            self._previous[:] = self.active
            look = self.active if look is None else look
            activity.mark_material(self.flat["mass"], (nz, ny, nx), GHOST, look, self._holds)
            activity.grow_active(self._holds, self.active)
            self.boundary.activate(self.active)
            activity.retire(self._previous, self.active, (ny, nx), self.pool.memory, self.cell_offsets,
                            self.node_offsets)
        else:
            self.active[:] = 1
        if self.floor:
            self.awake[:] = self.active
            self.awake[:max(self.first_plane - GHOST, 0)] = 0
        self._runs, self.run_count = self._listed(self.awake, self._runs)
        for axis in (1, 2):
            count = activity.list_columns(self.awake, nx, axis, self._columns[axis - 1])
            if count > len(self._columns[axis - 1]):
                self._columns[axis - 1] = activity.empty_list(2 * count, 5)
                count = activity.list_columns(self.awake, nx, axis, self._columns[axis - 1])
            self.column_counts[axis - 1] = count

    def _listed(self, active: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the runs of ``active`` blocks, in ``runs`` if that is long enough, and their number."""
        row_length = self.part.cell_shape[2]
        count = activity.list_runs(active, row_length, runs)
        if count > len(runs):
            runs = activity.empty_list(2 * count, 4)
            activity.list_runs(active, row_length, runs)
        return runs, count

    def active_planes(self) -> np.ndarray:
        """Return which planes of cells (bool, local k) hold active blocks, asleep or not."""
        return self.active.any(axis=(1, 2))

    def highest_plane(self) -> int:
        """Return the highest plane of cells (global k) that is active and awake on this rank; -1 if none is."""
        return int(self._runs[self.run_count - 1, 0]) + self.part.offset[2] if self.run_count else -1

    def release_work(self) -> None:
        """Give back the memory of the fields that hold nothing between two remaps, until the next step.

        What a cycle ends with, measuring and writing, then fits into the memory of the step.
        """
        self.pool.release(f.name for f in self.fields if not f.saved)

    def release_empty(self) -> None:
        """Give back the memory of rows far from all active ones: they are zero, but what flew past made them real.

        Not collective.
        """
        near = self.active.any(axis=2)
        for _ in range(ROOM):
            near[1:] |= near[:-1].copy()
            near[:-1] |= near[1:].copy()
            near[:, 1:] |= near[:, :-1].copy()
            near[:, :-1] |= near[:, 1:].copy()
        for name, view in self.views.items():
            more = [(0, n - m) for n, m in zip(view.shape, near.shape)]
            rows = np.pad(near, more, mode="edge")
            edges = np.flatnonzero(np.diff(rows.reshape(-1), prepend=True, append=True))
            for first, end in edges.reshape(-1, 2):
                self.pool.release_rows(name, int(first), int(end))

    @property
    def floor_plane(self) -> int | None:
        """Local index of the floor, also where this rank does not have it; None when nothing sleeps."""
        return GHOST + self.floor - self.part.start[2] if self.floor else None

    @property
    def first_plane(self) -> int:
        """Local index of the first plane of cells that this rank owns and steps; beyond its last if all sleep."""
        return max(self.floor_plane, GHOST) if self.floor else GHOST

    def set_floor(self, floor: int) -> None:
        """Let all cells below plane ``floor`` (global k) sleep and no others; the nodes on it are held.

        Those that wake go on from the fields as they are.
        """
        self.floor = floor
        self.awake = self.active.copy() if floor else self.active
        self.boundary.hold_floor(self.floor_plane)
        self.update_activity()

    @property
    def runs(self) -> tuple[np.ndarray, int]:
        """Active runs and their number, as kernels take them, but for what sleeps."""
        return self._runs, self.run_count

    @property
    def all_runs(self) -> tuple[np.ndarray, int]:
        """Active runs and their number, with those that sleep."""
        return self._listed(self.active, activity.empty_list(1024, 4)) if self.floor else self.runs

    def columns(self, axis: int) -> tuple[np.ndarray, int]:
        """Active columns for a sweep along ``axis`` (1 or 2) and their number."""
        return self._columns[axis - 1], self.column_counts[axis - 1]

    def active_cells(self) -> int:
        """Return how many owned cells are active and awake on this rank."""
        runs = self._runs[:self.run_count].astype(np.int64)
        k0, k1, j0, j1, i0, i1 = self.cell_window()
        inside = (runs[:, 0] >= k0) & (runs[:, 0] < k1) & (runs[:, 1] >= j0) & (runs[:, 1] < j1)
        length = np.minimum(runs[:, 3], i1) - np.maximum(runs[:, 2], i0)
        return int(np.maximum(length, 0)[inside].sum())

    # --- index windows ------------------------------------------------------------------------------

    def cell_window(self, low: tuple[int, int, int] = (0, 0, 0),
                    high: tuple[int, int, int] = (0, 0, 0)) -> tuple[int, int, int, int, int, int]:
        """Return (k0, k1, j0, j1, i0, i1) of the owned cells awake, wider by ``low`` and ``high`` (x, y, z) cells."""
        return self._window(self.part.count, low, high)

    def owned_window(self) -> tuple[int, int, int, int, int, int]:
        """Return (k0, k1, j0, j1, i0, i1) of all owned cells, those that sleep too."""
        return (GHOST, *self.cell_window()[1:])

    def node_window(self, low: tuple[int, int, int] = (0, 0, 0),
                    high: tuple[int, int, int] = (0, 0, 0)) -> tuple[int, int, int, int, int, int]:
        """Return (k0, k1, j0, j1, i0, i1) of the owned nodes awake, wider by ``low`` and ``high`` (x, y, z) nodes."""
        return self._window(self.part.node_count, low, high)

    def _window(self, count, low, high):
        firsts = (GHOST, GHOST, self.first_plane)
        pairs = [(first - a, GHOST + n + b) for first, n, a, b in zip(firsts, count, low, high)]
        return tuple(bound for pair in pairs[::-1] for bound in pair)

    # --- ghosts -------------------------------------------------------------------------------------

    def exchange(self, names: tuple[str, ...], layers: int = GHOST, axis: int | None = None,
                 asleep: bool = False) -> None:
        """Fill the ghosts of the named fields: from the neighbours, then behind the sides where blocks are active.

        ``layers``: how deep; ``axis``: only those straight along this axis (0, 1, 2), as a sweep along it reads them;
        ``asleep``: also behind the sides of what sleeps.
        """
        self.pool.exchange(names, layers, axis)
        self.boundary.fill(self.pool.memory, self.pool.offsets, names,
                           self.active if asleep else self.awake, (0, 1, 2) if axis is None else (axis,), layers)

    def owned(self, name: str) -> np.ndarray:
        """Return the owned part of a field, a view [k, j, i]."""
        part = self.part
        return self.views[name][part.owned_cells if fields.BY_NAME[name].location == fields.CELL
                                else part.owned_nodes]
