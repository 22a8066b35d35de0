"""Memory of a rank, predicted: the interpreter with its libraries, and what grows with the cells.

    baseline + fields (cells with ghosts) + temporaries per cell + maps per ghost that another rank owns

or, in a box that is mostly void, what the start takes. The constants are measured (tests/test_memory.py holds them
against real runs). What nothing touches takes no memory: with ballistic flight that is all above the deposit, else
particles pass through all of the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from f2s_hpc import fields
from f2s_hpc.analysis import picture, surface
from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import GHOST, Box, Part
from f2s_hpc.grid.decomposition import Ranges
from f2s_hpc.grid.halo import PACKED
from f2s_hpc.particles.plan import BatchPlan

BASELINE = 250 * 2**20
"""Interpreter, numpy, numba with all compiled kernels, PETSc, MPI and HDF5, before any field is allocated (bytes).

235 to 265 MiB, by machine and rank, with the same packages."""

TEMPORARY = 8
"""Per local cell: the mass of spheres that are put onto the grid (bytes).

What a cycle is measured and a frame is written with takes less than the fields of the step that are given back then."""

SETTING_UP = 16, 40
"""Per local cell, on one rank and on several, before there are fields: the DMDA and labels of its points (bytes)."""

MAP = 33
"""Per ghost of another rank and exchanged field: indices of the star forests here and there, and buffers (bytes)."""

SHARED = 6
"""Maps of each ghost where all fields share them: on cells and on nodes, deep, in one layer and along an axis."""

TRACER, SENT = 205, 145
"""Per tracer point of this rank: its number and place, and what is made while it is sorted or written (bytes); more
where there are other ranks, which it is handed over to."""

GROUNDED, LABEL = 2, 4
"""On rank 0, while a cycle is measured or drawn: what is solid and what of it is grounded, per cell of the whole box in
the planes that are touched, and the labels of ``surface.LABELLED_AT_ONCE`` cells (bytes)."""

PICTURE, DRAWN = 50 * 2**20, 10
"""What matplotlib takes on rank 0 while it draws the picture, and each cell of the rows that are read for it at once
(bytes)."""


@dataclass(frozen=True)
class RankMemory:
    """Memory of a rank (bytes): ``baseline`` that every process takes, and what ``arrays`` and ``maps`` add."""

    baseline: int
    arrays: int
    maps: int
    cells: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.baseline + self.arrays + self.maps

    @property
    def per_cell(self) -> float:
        """Bytes per owned cell above the baseline."""
        return (self.arrays + self.maps) / self.cells


def touched_planes(scene: Scene, plan: BatchPlan) -> int:
    """Return how many planes of cells a run touches: up to the end's deposit and a largest particle on top of it."""
    nx, ny, nz = scene.domain.cells
    if not scene.ballistic:
        return nz
    dx, height = scene.domain.cell_size, scene.domain.substrate_height
    speed, end, started, volume, largest = -scene.particles.velocity[2], scene.cycles.total_time, 0.0, 0.0, 0.0
    for number, duration in zip(plan.order, scene.cycles.durations):
        batch = plan.batches[number]
        lands = batch.z + scene.domain.layer_bottom - batch.r - height < speed * (end - started)
        volume += 4.0 / 3.0 * np.pi * float((batch.r[lands] ** 3).sum())
        largest = max(largest, 2.0 * float(batch.r[lands].max(initial=0.0)))
        started += duration
    top = height + volume / (nx * ny * dx * dx) + largest
    return min(int(np.ceil(top / dx)) + GHOST, nz)


def of_fields(scene: Scene, part: Part, planes: int) -> int:
    """Return the bytes of all fields of a rank, ghosts included, in the lowest ``planes`` of the box or its end."""
    needed = scene.needed_fields
    share = min(1.0, (planes + 3 * GHOST) / part.cell_shape[0])
    cells, nodes = math.prod(part.cell_shape), math.prod(part.node_shape)
    return round(8 * share * sum(nodes if f.location == fields.NODE else cells for f in needed))


def _mapped(scene: Scene, neighbours: tuple[int, int, int], count: tuple[int, int, int]) -> int:
    """Return the ghosts that all star forests map, for a rank with so many neighbours along x, y, z."""
    ghosts = math.prod(n + GHOST * m for n, m in zip(count, neighbours)) - math.prod(count)
    if ghosts > PACKED:
        return ghosts * SHARED
    needed = scene.needed_fields
    # maps for all that has ghosts; for velocity and what moves with the cells deep, in one layer and along each axis
    moving = sum(f.advected and f.location == fields.CELL for f in needed)
    return ghosts * (2 * (len(fields.VELOCITY) + moving) + sum(f.ghosted for f in needed))


def on_root(scene: Scene, rank: RankMemory, plan: BatchPlan) -> int:
    """Return what measuring and drawing take on rank 0 beyond the memory of the step (bytes): they grow with the whole
    box, and the fields of the step are given back first. ``rank``: what rank 0 has.
    """
    needed, (nx, ny, nz) = scene.needed_fields, scene.domain.cells
    cells = nx * ny * touched_planes(scene, plan)
    more = GROUNDED * cells + LABEL * min(cells, surface.LABELLED_AT_ONCE)
    if scene.output.picture or scene.output.picture_each_cycle:
        more += PICTURE + DRAWN * nx * min(ny, picture.ROWS_AT_ONCE) * nz
    return max(more - rank.arrays * sum(not f.saved for f in needed) // len(needed), 0)


def of_ranks(scene: Scene, ranges: Ranges, planes: int) -> list[RankMemory]:
    """Return the memory of each kind of rank: one for each size and number of neighbours in ``ranges``."""
    box = Box(scene.domain.cells, scene.domain.cell_size)
    kinds = [sorted({(n, (p > 0) + (p < len(counts) - 1)) for p, n in enumerate(counts)}) for counts in ranges]
    found = []
    for x in kinds[0]:
        for y in kinds[1]:
            for z in kinds[2]:
                count, neighbours = zip(x, y, z)
                part = Part(box, (0, 0, 0), count)
                cells = math.prod(part.cell_shape)
                arrays = max(of_fields(scene, part, planes) + TEMPORARY * cells,
                             SETTING_UP[sum(neighbours) > 0] * cells)
                found.append(RankMemory(BASELINE, arrays, MAP * _mapped(scene, neighbours, count), math.prod(count)))
    return found


def of_fullest(scene: Scene, ranges: Ranges, plan: BatchPlan) -> RankMemory:
    """Return the memory of the rank that needs most."""
    fullest = max(of_ranks(scene, ranges, touched_planes(scene, plan)), key=lambda rank: rank.total)
    if not scene.output.tracers:
        return fullest
    points = scene.output.tracers * sum(plan.batches[b].count for b in plan.order)
    share = fullest.cells / math.prod(scene.domain.cells)
    each = TRACER + (SENT if share < 1.0 else 0)
    return replace(fullest, arrays=fullest.arrays + round(each * points * share))
