"""Material tracers: points that move with the material, so that the real shape of every particle is known.

Each sphere is seeded, where and when it is put onto the grid, with points that stand for equal volumes. Every rank
holds the points in its own cells; a point's way does not depend on who holds it, so it has the same bits on any number
of ranks.
"""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import InputError
from f2s_hpc.grid.box import SIDES
from f2s_hpc.io.layout import Block
from f2s_hpc.io.tracers import ParticleTable, TracerCloud
from f2s_hpc.kernels.tracers import move_points
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.cloud import unit_ball
from f2s_hpc.phases import phase
from f2s_hpc.state import State

TOGETHER = 4
"""Remaps between two migrations: a point strays three cells at most, and what it reads there, one cell further
included, is in the ghosts."""

SORTED = 64
"""Remaps between two sortings: points of neighbouring cells lie together in memory, which makes moving them three times
as fast."""

SEEDED = 100_000
"""Points seeded at once, at least those of one sphere: every rank makes all of them, to keep its own."""

PLACES = ("tracer_x", "tracer_y", "tracer_z")
"""Names of the places in a checkpoint (m), in the order of the points' numbers."""


class Tracers:
    """The points of all particles; ``per_particle`` each. The tables of particles are the same on all ranks.

    ``number`` (n,) int64: which points this rank holds, numbered in the order in which they were seeded; ``place``:
    their x, y, z (m); ``count``: points of all ranks. ``first``: number of the first point of each particle.
    """

    def __init__(self, per_particle: int, state: State) -> None:
        self.per_particle = per_particle
        self.cloud = mpi.broadcast(unit_ball(per_particle))  # one rank's round-off for all
        self.number = np.empty(0, dtype=np.int64)
        self.place = [np.empty(0) for _ in range(3)]
        self.particles = ParticleTable.empty()
        self.first = np.empty(0, dtype=np.int64)
        self.count = 0
        self.box = state.part.box
        walls = [state.boundary.kinds[side] in ("symmetry", "fixed") for side in SIDES]
        self._low = tuple(0.0 if wall else -math.inf for wall in walls[::2])
        self._high = tuple(e if wall else math.inf for wall, e in zip(walls[1::2], self.box.extents))
        starts = mpi.all_gather(state.part.start)
        self._starts = [np.unique([start[axis] for start in starts]) for axis in range(3)]
        self._ranks = np.empty([len(s) for s in self._starts], dtype=np.int64)
        for rank, start in enumerate(starts):
            self._ranks[tuple(np.searchsorted(s, a) for s, a in zip(self._starts, start))] = rank

    # --- seed and move ------------------------------------------------------------------------------

    @phase("tracers")
    def seed(self, batch: Batch, time: float) -> None:
        """Seed the spheres of ``batch`` (z from the bottom of the box, m), put onto the grid at ``time`` (s) just now.

        Of a sphere that a side of the box cuts, only the points inside are kept, and it is marked. No communication.
        """
        extents = self.box.extents
        centres = np.stack([batch.x, batch.y, batch.z], axis=1)
        cut = ((centres - batch.r[:, None] < 0.0) | (centres + batch.r[:, None] > extents)).any(axis=1)
        kept = np.empty(batch.count, dtype=np.int64)
        numbers, places, first = [self.number], [[a] for a in self.place], self.count
        at_once = max(1, SEEDED // self.per_particle)
        for spheres in (slice(s, s + at_once) for s in range(0, batch.count, at_once)):
            points = centres[spheres, None, :] + batch.r[spheres, None, None] * self.cloud
            inside = ((points >= 0.0) & (points <= extents)).all(axis=2)
            kept[spheres] = inside.sum(axis=1)
            new = points[inside]
            mine = self._owners(new.T) == mpi.rank()
            numbers.append((self.count + np.arange(len(new)))[mine])
            for axis, parts in enumerate(places):
                parts.append(new[mine, axis])
            self.count += len(new)
        self._keep(np.concatenate(numbers), [np.concatenate(parts) for parts in places])
        self.first = np.concatenate([self.first, first + np.cumsum(kept) - kept])
        self.particles = self.particles.with_more(
            ParticleTable(2.0 * batch.r, centres, np.full(batch.count, time), cut))

    @phase("tracers")
    def move(self, state: State, dt: float, displaced: bool, remaps: int) -> None:
        """Move all points with the nodes, before the remap that follows ``remaps`` others. Collective.

        ``dt``: the step (s) just taken; ``displaced``: others before it since the last remap have moved the nodes.
        """
        part = state.part
        move_points(*self.place, dt / self.box.dx, self.box.dx, self.box.cells, self._low, self._high, part.offset,
                    part.cell_shape[1:], state.flat["mass"], *state.velocity, displaced, *state.displacement)
        if remaps % TOGETHER == 0:
            self.migrate()
        if remaps % SORTED == 0:
            i, j, k = self._cells(self.place)
            order = np.argsort((k * self.box.cells[1] + j) * self.box.cells[0] + i, kind="stable")
            self._keep(self.number[order], [a[order] for a in self.place])

    def _cells(self, place: np.ndarray | list[np.ndarray]) -> list[np.ndarray]:
        """Return the global cell (i, j, k) of each point; of one outside of the box, the nearest."""
        return [np.clip(np.floor(a / self.box.dx).astype(np.int64), 0, n - 1) for a, n in zip(place, self.box.cells)]

    def _owners(self, place: np.ndarray | list[np.ndarray]) -> np.ndarray:
        return self._ranks[tuple(np.searchsorted(starts, cell, side="right") - 1
                                 for starts, cell in zip(self._starts, self._cells(place)))]

    def _keep(self, number: np.ndarray, place: list[np.ndarray]) -> None:
        self.number, self.place = number, [np.ascontiguousarray(a) for a in place]

    def migrate(self) -> None:
        """Give every point to the rank that owns its cell. Collective."""
        if mpi.size() == 1:
            return
        owner = self._owners(self.place)
        if mpi.any_rank(bool((owner != mpi.rank()).any())):
            rows = _exchanged(np.stack([self.number, *self.place], axis=1), owner)
            self._keep(rows[:, 0].astype(np.int64), list(rows.T[1:]))

    # --- files --------------------------------------------------------------------------------------

    def _range(self) -> tuple[int, int]:
        """Return which numbers this rank writes and reads: from the first up to, not with, the second."""
        return tuple(self.count * r // mpi.size() for r in (mpi.rank(), mpi.rank() + 1))

    def _by_number(self, *columns: np.ndarray) -> np.ndarray:
        """Return the places and further columns of the numbers in this rank's range, (n, 3 + columns). Collective."""
        bounds = np.array([self.count * (r + 1) // mpi.size() for r in range(mpi.size())])
        rows = _exchanged(np.stack([self.number, *self.place, *columns], axis=1),
                          np.searchsorted(bounds, self.number, side="right"))
        return rows[np.argsort(rows[:, 0])][:, 1:]

    def blocks(self) -> list[Block]:
        """Return the places as a checkpoint takes them, none while there are no points. Collective."""
        if not self.count:
            return []
        first, _ = self._range()
        return [Block(name, np.ascontiguousarray(column)[None, None, :], (0, 0, first), (1, 1, self.count))
                for name, column in zip(PLACES, self._by_number().T)]

    def attributes(self) -> dict:
        """Return what else a checkpoint must hold."""
        table = self.particles
        return {"per_particle": self.per_particle, "count": self.count, "first": self.first.tolist(),
                "diameter": table.diameter.tolist(), "centre": table.centre.tolist(), "time": table.time.tolist(),
                "cut": table.cut.tolist()}

    def requests(self, shapes: dict[str, tuple[int, int, int]]) -> dict:
        """Return which part of the fields of a checkpoint (of these ``shapes``) this rank is to read."""
        self.count = shapes[PLACES[0]][2] if PLACES[0] in shapes else 0
        first, end = self._range()
        return {name: ((0, 0, first), (1, 1, end - first)) for name in PLACES if name in shapes}

    def restore(self, saved: dict, arrays: dict[str, np.ndarray]) -> None:
        """Take back what :meth:`attributes` and, through :meth:`requests`, :meth:`blocks` gave. Collective."""
        self.first = np.array(saved["first"], dtype=np.int64)
        self.particles = ParticleTable(
            np.array(saved["diameter"], dtype=float), np.array(saved["centre"], dtype=float).reshape(-1, 3),
            np.array(saved["time"], dtype=float), np.array(saved["cut"], dtype=np.bool_))
        if self.count:
            self._keep(np.arange(*self._range()), [arrays[name].reshape(-1) for name in PLACES])
        self.migrate()

    def cloud_at(self, state: State, time: float) -> TracerCloud:
        """Return this rank's share, by number, of what is written at the end of a cycle. Collective."""
        self.migrate()
        i, j, k = (cell - offset for cell, offset in zip(self._cells(self.place), state.part.offset))
        rows = self._by_number(*(state.views[name][k, j, i] for name in ("volume_fraction", "peeq", "temperature")))
        first, end = self._range()
        particle = np.searchsorted(self.first, np.arange(first, end), side="right") - 1
        return TracerCloud(time, particle, rows[:, :3], *rows.T[3:], self.particles, (first, self.count))

    def census(self, state: State) -> dict[str, int]:
        """Return how many points there are, how many lie in void cells, and how many left the box. Collective."""
        self.migrate()
        i, j, k = (cell - offset for cell, offset in zip(self._cells(self.place), state.part.offset))
        outside = np.zeros(self.number.size, dtype=np.bool_)
        for axis, extent in enumerate(self.box.extents):
            outside |= ~((self.place[axis] >= 0.0) & (self.place[axis] <= extent))
        void = ~outside & (state.views["mass"][k, j, i] <= 0.0)
        counts = mpi.total(np.array([void.sum(), outside.sum()], dtype=np.int64))
        return {"tracers": self.count, "tracers_in_void": int(counts[0]), "tracers_outside": int(counts[1])}


def _exchanged(rows: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Return the rows that all ranks have for this one; ``rank``: whose each row is. Collective."""
    order = np.argsort(rank, kind="stable")
    ends = np.searchsorted(rank[order], np.arange(1, mpi.size()))
    return mpi.exchange_rows(np.split(rows[order], ends))


def check_same(asked: int, saved: dict | None) -> None:
    """Raise ``InputError`` when a resumed run asks for another number of points than its checkpoint holds."""
    there = saved["per_particle"] if saved else 0
    if there != asked:
        raise InputError(f"output.tracers: this run follows {there or 'no'} points per particle, not {asked}; that "
                         "cannot change on the way")


def bytes_saved(per_particle: int, particles: int) -> tuple[int, int]:
    """Return the size of the points in a checkpoint and in the file of a cycle (bytes), none cut off by a side."""
    points = per_particle * particles
    return 8 * len(PLACES) * points, math.ceil(TracerCloud.bytes_per_point() * points)
