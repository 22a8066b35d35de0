"""Ballistic flight: a particle that nothing has touched is an analytic sphere, painted when about to meet something.

Until then it moves on a straight line and costs nothing: no flying cells, no diffusion by the remap in flight. It is
put onto the grid as soon as material, a side that its path leads to, or a sphere it will catch up with comes within
reach, a few cells, so that it enters the scheme before any force acts on it. Material that flies along with it does
not count, until what has stopped it comes within reach: in a dense spray the spheres of a batch are all within reach
of each other, and the first impact would call all of them down.
"""

from __future__ import annotations

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.cycles.insert import OVERFILL, fullest_cells, shareable_volume
from f2s_hpc.errors import UnstableStep
from f2s_hpc.fields import VELOCITY
from f2s_hpc.kernels import paint
from f2s_hpc.particles.batch import Batch, clipped_volume, from_lists, join, to_lists
from f2s_hpc.particles.meeting import REACH, waits
from f2s_hpc.particles.packing import settle_in_order
from f2s_hpc.state import State

LOOK = 2
"""Remaps between two looks; what can be flown until the next one is added to the reach."""

CLEARANCE = 0.25
"""Step (in cells) by which a new sphere is raised until nothing is in its place."""

SAME = 5e-3
"""Material whose velocity differs from a sphere's by less than this share of its speed flies along with it.

At 600 m/s that is 3 m/s, 1 um in the time of a cycle; what an impact has reached differs by far more.
"""

NO_ROOM = ("a particle meets material at the top of the box, where it does not fit in; make domain.size higher, or "
           "cycles.duration longer if batches follow each other before they have left the particle layer")


class Flight:
    """The spheres in flight: the same on every rank, in the order in which they came.

    ``spheres``: places at time ``start`` (s) of each; ``velocity`` (n, 3) in m/s; ``contact``: time (s) at which each
    comes within reach of another sphere in flight, infinite for most; ``lifted``: which are higher than they were asked
    to be.
    """

    def __init__(self, dx: float, extents: tuple[float, float, float]) -> None:
        self.dx, self.extents = dx, extents
        self.spheres = join([])
        self.velocity = np.empty((0, 3))
        self.start = np.empty(0)
        self.contact = np.empty(0)
        self.lifted = np.empty(0, dtype=np.bool_)
        self.calls = 0
        self.raised = 0  # spheres that were lifted on their way, and not at its start

    @property
    def count(self) -> int:
        """Number of spheres in flight."""
        return self.spheres.count

    def at(self, time: float) -> Batch:
        """Return the spheres where they are at ``time`` (s), each with its own velocity."""
        s, moved = self.spheres, self.velocity * (time - self.start)[:, None]
        return Batch(s.x + moved[:, 0], s.y + moved[:, 1], s.z + moved[:, 2], s.r, self.velocity, s.temperature)

    def volume(self, time: float) -> float:
        """Return the volume (m3) of the spheres in flight at ``time`` (s), cut by the walls of the box."""
        if not self.count:
            return 0.0
        now, (width, depth, _) = self.at(time), self.extents
        # cut by the side walls only, so all stand on the ground
        return clipped_volume(Batch(now.x, now.y, now.r, now.r), width, depth, 2.0 * now.r.max())

    def launch(self, state: State, batch: Batch, velocity: tuple[float, float, float], time: float) -> int:
        """Let a batch (z from the bottom of the box, m) fly from ``time`` (s) on; return how many had to start higher.

        A sphere that would start inside material or inside another in flight starts as much higher as frees it; of
        two in the batch that overlap, the later one does. Collective.
        """
        flying = self.at(time)
        placed, raised = self._free_places(state, batch.without_velocity(), flying)
        self.spheres = join([self.spheres, placed])
        self.velocity = np.concatenate([self.velocity, batch.velocities(velocity)])
        self.start = np.concatenate([self.start, np.full(batch.count, time)])
        self.lifted = np.concatenate([self.lifted, raised])
        self.contact = time + waits(self.at(time), self.dx)
        return int(raised.sum())

    def _free_places(self, state: State, batch: Batch, flying: Batch) -> tuple[Batch, np.ndarray]:
        batch = batch.chosen(slice(None))
        raised = np.zeros(batch.count, dtype=np.bool_)
        settled = np.zeros(batch.count, dtype=np.bool_)
        nobody, shareable = np.zeros(batch.count, dtype=np.bool_), shareable_volume(self.dx)
        while not settled.all():
            waiting = ~settled
            hit = fullest_cells(state, batch, waiting, nobody) > 0.0
            paint.spheres_meet(batch.x, batch.y, batch.z, batch.r, waiting & ~hit, flying.x, flying.y, flying.z,
                               flying.r, hit)
            settle_in_order(batch.x, batch.y, batch.z, batch.r, shareable, settled, hit)
            shareable = 0.0  # what is raised is raised until it is free
            batch.z[hit] += CLEARANCE * self.dx
            raised |= hit
        return batch, raised

    def arrivals(self, state: State, time: float, dt: float) -> tuple[Batch, tuple[float, float, float]] | None:
        """Take the spheres that are about to meet something out of the flight; return them and the first's velocity.

        None if there are none. Where all have that velocity the batch names none of its own. Collective.

        Looks every ``LOOK`` calls. ``dt``: time between the last two remaps (s), from which the way to the next look
        follows. Looks no higher than the highest active plane. Raises ``UnstableStep`` if a sphere meets material where
        it does not fit into the box.
        """
        self.calls += 1
        if self.count == 0 or (self.calls - 1) % LOOK:
            return None
        ahead = 2.0 * LOOK * dt  # the step may grow
        now = self.at(time)
        reach = REACH * self.dx + ahead * np.linalg.norm(self.velocity, axis=1)
        near = np.zeros(self.count)
        k0, k1, *across = state.owned_window()
        window = (k0, min(k1, int(np.flatnonzero(state.active_planes()).max(initial=-1)) + 1), *across)
        paint.spheres_near_material(now.x, now.y, now.z, now.r + reach, self.velocity, SAME, state.part.offset, self.dx,
                                    window, *(state.views[n] for n in ("mass", *VELOCITY)), near)
        inside = now.z + now.r <= self.extents[2]
        touches = mpi.maximum(near) > 0.0
        if (touches & ~inside).any():
            raise UnstableStep(NO_ROOM)
        meets = touches | (inside & ((self.contact <= time + ahead) | self._at_side(now, reach)))
        meets &= ~self._overlapping(now, meets)
        if not meets.any():
            return None
        self._make_room(state, now, meets)
        return self._take(now, meets)

    def _take(self, now: Batch, chosen: np.ndarray) -> tuple[Batch, tuple[float, float, float]]:
        keep, taken = ~chosen, now.chosen(chosen)
        self.spheres = self.spheres.chosen(keep)
        for name in ("velocity", "start", "contact", "lifted"):
            setattr(self, name, getattr(self, name)[keep])
        same = (taken.velocity == taken.velocity[0]).all()
        return taken.without_velocity() if same else taken, tuple(taken.velocity[0])

    def _overlapping(self, now: Batch, chosen: np.ndarray) -> np.ndarray:
        """Hold back and raise each chosen sphere that has run into a lower one: those do that meet above the box."""
        held = np.zeros(self.count, dtype=np.bool_)
        rows = np.flatnonzero(chosen)
        places = np.stack([now.x, now.y, now.z], axis=1)[rows]
        if rows.size < 2 or (self.velocity == self.velocity[0]).all():
            return held
        from scipy.spatial import cKDTree  # (for jets only)

        for a, b in sorted(cKDTree(places).query_pairs(2.0 * now.r[rows].max())):
            low, high = sorted((rows[a], rows[b]), key=lambda s: (now.z[s], s))
            across = np.hypot(now.x[low] - now.x[high], now.y[low] - now.y[high])
            both = now.r[low] + now.r[high]
            short = now.z[low] + np.sqrt(max(both * both - across * across, 0.0)) - now.z[high]
            if short > 0.0 and not held[low]:
                self.spheres.z[high] += short
                held[high] = True
        self._count(held)
        return held

    def _count(self, lifted: np.ndarray) -> None:
        """Count those of the ``lifted`` spheres that had not been before."""
        self.raised += int((lifted & ~self.lifted).sum())
        self.lifted |= lifted

    def _make_room(self, state: State, now: Batch, chosen: np.ndarray) -> None:
        """Raise each chosen sphere that would overfill a cell, and what flies where it goes, until all have room.

        A painted sphere that flies along has blurred edges, and its neighbours are painted into the same cells later.
        Changes ``now`` too. Collective; raises ``UnstableStep`` where a sphere would not fit into the box.
        """
        before, crowded = now.z.copy(), chosen.copy()
        while True:
            crowded &= fullest_cells(state, now, crowded, chosen) > OVERFILL
            if not crowded.any():
                break
            now.z[crowded] += CLEARANCE * self.dx
            crowded |= chosen & self._push_up(now, crowded)
        self.spheres.z[:] += now.z - before
        lifted = now.z > before
        self._count(lifted)
        if (now.z + now.r > self.extents[2])[chosen & lifted].any():
            raise UnstableStep(NO_ROOM)

    def _push_up(self, now: Batch, moved: np.ndarray) -> np.ndarray:
        """Raise every sphere that one of the ``moved`` has been raised into, and so on; return which were."""
        pushed, todo = np.zeros(self.count, dtype=np.bool_), list(np.flatnonzero(moved))
        while todo:
            low = todo.pop(0)
            both = now.r + now.r[low]
            across = np.hypot(now.x - now.x[low], now.y - now.y[low])
            beside = now.z[low] + np.sqrt(np.maximum(both * both - across * across, 0.0))
            short = np.where(across < both, beside - now.z, 0.0)
            # (spheres that a batch has in touch may overlap by round-off)
            hit = np.flatnonzero((short > 1e-6 * both) & (now.z > now.z[low]))
            now.z[hit] += short[hit]
            pushed[hit] = True
            todo.extend(h for h in hit if h not in todo)
        return pushed

    def _at_side(self, now: Batch, reach: np.ndarray) -> np.ndarray:
        """Tell which spheres are within reach of a side that they fly towards; the bottom counts, the top does not.

        So are those that a side cuts and that fly off it: what is put onto the grid later would be more of them.
        """
        found = np.zeros(self.count, dtype=np.bool_)
        for axis, place in enumerate((now.x, now.y, now.z)):
            v = self.velocity[:, axis]
            found |= (v < 0.0) & (place - now.r - reach < 0.0)
            if axis < 2:
                found |= (v > 0.0) & (place + now.r + reach > self.extents[axis])
                found |= (v != 0.0) & ((place - now.r < 0.0) | (place + now.r > self.extents[axis]))
        return found

    def attributes(self) -> dict:
        """Return what a checkpoint must hold."""
        return {"spheres": to_lists(self.spheres), "velocity": self.velocity.tolist(),
                "start": self.start.tolist(), "contact": [float(c) if np.isfinite(c) else None for c in self.contact],
                "lifted": self.lifted.tolist(), "calls": self.calls, "raised": self.raised}

    def restore(self, saved: dict) -> None:
        """Take back what :meth:`attributes` returned."""
        self.spheres = from_lists(saved["spheres"])
        self.velocity = np.array(saved["velocity"], dtype=float).reshape(-1, 3)
        self.start = np.array(saved["start"], dtype=float)
        self.contact = np.array([np.inf if c is None else c for c in saved["contact"]], dtype=float)
        # (older checkpoints do not tell)
        self.lifted = np.array(saved.get("lifted", [False] * self.count), dtype=np.bool_)
        self.calls, self.raised = saved["calls"], saved["raised"]

    def take_inside(self, time: float) -> tuple[Batch, tuple[float, float, float]] | None:
        """Take the spheres that lie inside the box at ``time`` (s) out of the flight, where they are.

        Returns what :meth:`arrivals` does. For checks: a run takes only those that are about to meet something.
        """
        now = self.at(time)
        inside = now.z + now.r <= self.extents[2]
        return self._take(now, inside) if inside.any() else None
