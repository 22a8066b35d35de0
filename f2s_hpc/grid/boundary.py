"""The physical sides of the box: what lies behind them and what they hold.

symmetry   mirror image behind the face, no normal velocity on it
fixed      mirror image behind the face, no velocity on it
free       nothing behind the face: no traction, material may leave, nothing enters
outflow    the same as free, by the name that Eulerian codes give it (copying the last layer outwards instead lets its
           stress push or pull at the box: energy from nowhere, up to 16 times the impact's)
absorbing  more of the material behind the face, which takes waves away (:mod:`f2s_hpc.solver.absorbing`): any velocity
           on the face, and nothing through it in the remap
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from f2s_hpc.fields import BY_NAME, CELL, NODE
from f2s_hpc.grid.box import GHOST, SIDES, Part
from f2s_hpc.kernels.activity import BLOCK
from f2s_hpc.kernels.sides import COPY, EVEN, MIRROR, NONE, VOID, fill_ghosts

_CELL_RULE = {"symmetry": MIRROR, "fixed": MIRROR, "free": VOID, "outflow": VOID, "absorbing": EVEN}
_NODE_RULE = {"symmetry": MIRROR, "fixed": MIRROR, "free": COPY, "outflow": COPY, "absorbing": EVEN}


class Boundary:
    """The sides of the box that this rank touches.

    ``kinds``: per side of :data:`f2s_hpc.grid.box.SIDES` one of the five kinds above.
    ``weights``: per axis, the share of each local node plane that lies inside the box.
    ``free_motion[axis, component, plane]``: 0 where a wall holds that velocity component, or the floor (a local plane
    of nodes, None if there is none) on which what is awake stands.
    ``inward[axis, plane]``: on absorbing sides +1 (low) or -1 (high), else 0.
    ``absorbing``: the absorbing sides touched here.
    """

    def __init__(self, part: Part, kinds: dict[str, str]) -> None:
        self.part = part
        self.kinds = {side: kinds[side] for side in SIDES}
        self.touched = [side for axis in range(3) for side in SIDES[2 * axis:2 * axis + 2]
                        if (part.at_high if side.endswith("high") else part.at_low)[axis]]
        planes = part.node_shape[::-1]
        self.weights = tuple(np.ones(n) for n in planes)
        self.free_motion = np.ones((3, 3, max(planes)))
        self.inward = np.zeros((3, max(planes)))
        self.absorbing = [side for side in self.touched if self.kinds[side] == "absorbing"]
        self._rules = {location: self._rules_of(location) for location in (CELL, NODE)}
        self._groups: dict[tuple, list[tuple]] = {}
        self.floor: int | None = None
        self._held_before = np.empty(3)
        for side in self.touched:
            axis, kind = SIDES.index(side) // 2, self.kinds[side]
            wall = self.wall_plane(side)
            if kind in ("symmetry", "fixed", "absorbing"):
                self.weights[axis][wall] = 0.5
            if kind == "symmetry":
                self.free_motion[axis, axis, wall] = 0.0
            elif kind == "fixed":
                self.free_motion[axis, :, wall] = 0.0
            elif kind == "absorbing":
                self.inward[axis, wall] = -1.0 if side.endswith("high") else 1.0

    def wall_plane(self, side: str) -> int:
        """Return the local index of the node (and face) plane that lies on ``side``."""
        axis = SIDES.index(side) // 2
        return GHOST + (self.part.count[axis] if side.endswith("high") else 0)

    def fill(self, memory: np.ndarray, offsets: dict[str, int], names: tuple[str, ...], active: np.ndarray,
             axes: tuple[int, ...] = (0, 1, 2), layers: int = GHOST) -> None:
        """Fill ghosts of the named fields behind the touched sides where blocks are ``active``: x, then y, then z.

        ``offsets``: where each field starts in ``memory``; ``active``: uint8 [k, j, block]; ``axes``, ``layers``:
        behind which sides, and how deep.
        """
        for location, starts, signs in self._grouped(offsets, names):
            on_nodes = location != CELL
            shape = self.part.node_shape if on_nodes else self.part.cell_shape
            for axis, (rules, walls) in enumerate(self._rules[location]):
                if axis in axes and rules != (NONE, NONE):
                    fill_ghosts(memory, starts, shape, axis, rules, walls, layers, on_nodes, signs[axis], active, BLOCK)

    def activate(self, active: np.ndarray) -> None:
        """Make ``active`` (uint8 [k, j, block]) behind mirroring sides what is active before them.

        Ghosts are filled in active blocks only, and the growth of those before a side need not reach behind it.
        """
        for side in self.touched:
            if _CELL_RULE[self.kinds[side]] == VOID:
                continue
            axis, wall, high = SIDES.index(side) // 2, self.wall_plane(side), side.endswith("high")
            along, cells = np.moveaxis(active, 2 - axis, 0), BLOCK if axis == 0 else 1
            for layer in range(GHOST):
                before, behind = (wall - 1 - layer, wall + layer) if high else (wall + layer, wall - 1 - layer)
                along[behind // cells] |= along[before // cells]

    def continue_outwards(self, memory: np.ndarray, offset: int, active: np.ndarray, outwards: bool) -> None:
        """Repeat the last layer of the cell field at ``offset`` behind open sides, or (not ``outwards``) put void back.

        The interface of a sliver next to an open side must not turn its back on it, or the sliver would never leave.
        """
        start, sign = np.array([offset], dtype=np.int64), np.ones(1)
        for axis, (_, edges) in enumerate(self._rules[CELL]):
            rules = tuple((COPY if outwards else VOID) if side in self.open_sides(axis) else NONE
                          for side in SIDES[2 * axis:2 * axis + 2])
            if rules != (NONE, NONE):
                fill_ghosts(memory, start, self.part.cell_shape, axis, rules, edges, GHOST, False, sign, active, BLOCK)

    def _rules_of(self, location: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """Return, per axis, the rules and the edge layers of the low and the high side; NONE where there is no side."""
        found = []
        for axis in range(3):
            rules, edges = [], []
            for side in SIDES[2 * axis:2 * axis + 2]:
                rule = (_NODE_RULE if location != CELL else _CELL_RULE)[self.kinds[side]]
                rules.append(rule if side in self.touched else NONE)
                edges.append(self.wall_plane(side) - (location == CELL and side.endswith("high")))
            found.append((tuple(rules), tuple(edges)))
        return found

    def _grouped(self, offsets: dict[str, int], names: tuple[str, ...]) -> list[tuple]:
        """Return, per location, the offsets of the fields of ``names`` there, and their mirror signs per axis."""
        key = (id(offsets), names)
        if key not in self._groups:
            groups = []
            for location in (CELL, NODE):
                there = [n for n in names if BY_NAME[n].location == location]
                if there:
                    signs = np.array([BY_NAME[n].mirror_sign for n in there], dtype=float).T.copy()
                    groups.append((location, np.array([offsets[n] for n in there], dtype=np.int64), signs))
            self._groups[key] = groups
        return self._groups[key]

    def hold_floor(self, plane: int | None) -> None:
        """Hold the nodes of the local ``plane`` normal to z, as a fixed wall does, instead of the floor before.

        None, or a plane that this rank does not have: no floor.
        """
        if self.floor is not None:
            self.free_motion[2, :, self.floor] = self._held_before
        self.floor = plane if plane is not None and 0 <= plane < self.part.node_shape[0] else None
        if self.floor is not None:
            self._held_before = self.free_motion[2, :, self.floor].copy()
            self.free_motion[2, :, self.floor] = 0.0

    def pulled(self) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """Return how many layers of cells (x, y, z) around the low and high sides pull at this rank's nodes.

        Behind an absorbing side none: what is there acts by its traction alone.
        """
        return tuple(tuple(int(side not in self.absorbing) for side in SIDES[end::2]) for end in (0, 1))

    def mirror_sweeps(self, memory: np.ndarray, offsets: Sequence[int], active: np.ndarray) -> None:
        """Let the faces behind absorbing sides sweep what mirrors do; ``offsets``: of the sweeps along x, y, z."""
        sign = np.array([-1.0])
        for axis in range(3):
            sides = SIDES[2 * axis:2 * axis + 2]
            if not set(sides) & set(self.absorbing):
                continue
            rules = tuple(MIRROR if side in self.absorbing else NONE for side in sides)
            fill_ghosts(memory, np.array([offsets[axis]], dtype=np.int64), self.part.node_shape, axis, rules,
                        tuple(self.wall_plane(side) for side in sides), GHOST, True, sign, active, BLOCK)

    def hold(self, velocity: Sequence[np.ndarray]) -> None:
        """Set to zero the velocity components that the touched walls and the floor hold."""
        if self.floor is not None:
            for array in velocity:
                array[self.floor] = 0.0
        for side in self.touched:
            axis, wall = SIDES.index(side) // 2, self.wall_plane(side)
            for component, array in enumerate(velocity):
                if self.free_motion[axis, component, wall] == 0.0:
                    array[(slice(None),) * (2 - axis) + (wall,)] = 0.0

    def fixed_planes(self) -> list[tuple[int, int]]:
        """Return axis and local plane of nodes of each fixed wall that this rank touches, and of the floor."""
        planes = [(SIDES.index(side) // 2, self.wall_plane(side)) for side in self.touched
                  if self.kinds[side] == "fixed"]
        return planes if self.floor is None else [*planes, (2, self.floor)]

    def open_sides(self, axis: int) -> list[str]:
        """Return the touched sides normal to ``axis`` through which material may leave."""
        return [side for side in self.touched
                if SIDES.index(side) // 2 == axis and self.kinds[side] in ("free", "outflow")]
