"""What is worth a word about a scene that is possible, but may not be what was meant."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc.analysis.depth import weighted_percentiles
from f2s_hpc.config.schema import Scene
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.units import pretty

LEAST_CELLS = 2.0
"""With fewer cells to its diameter a particle is not resolved at all."""
ROUNDED = 0.01
"""A box that whole cells make longer or shorter by a larger share than this is worth a note."""


def scene_notes(scene: Scene, plan: BatchPlan) -> list[str]:
    """Return a line on each: a box that whole cells change much, coarse cells, mirrors that particles fly towards."""
    return [*_rounded_sides(scene), *_coarse_cells(scene, plan), *_slanted_flight(scene)]


def _rounded_sides(scene: Scene) -> list[str]:
    domain, notes = scene.domain, []
    for axis, asked, found, cells in zip("xyz", domain.size, domain.extents, domain.cells):
        if abs(found - asked) > ROUNDED * asked:
            notes.append(f"domain.size along {axis}: {pretty(asked, 'length')} are {asked / domain.cell_size:.3g} "
                         f"cells of {pretty(domain.cell_size, 'length')}; the box has {cells}, so it is "
                         f"{pretty(found, 'length')} there")
    return notes


def _slanted_flight(scene: Scene) -> list[str]:
    """Return a line where particles fly towards a mirror: what they would meet behind it comes from there instead."""
    sides = [f"{axis}_{'low' if part < 0.0 else 'high'}" for axis, part in zip("xy", scene.particles.direction) if part]
    mirrors = [side for side in sides if getattr(scene.domain.faces, side) in ("symmetry", "fixed")]
    if not mirrors:
        return []
    lean = math.degrees(math.atan2(math.hypot(*scene.particles.direction[:2]), abs(scene.particles.direction[2])))
    where = " and ".join(f'domain.faces.{side} = "{getattr(scene.domain.faces, side)}"' for side in mirrors)
    return [(f"particles.direction: leans by {lean:.0f} degrees towards {where}; what reaches a mirror or a wall is "
             "thrown back by it, so keep what lands away from there, or make the side \"free\"")]


def _coarse_cells(scene: Scene, plan: BatchPlan) -> list[str]:
    median = scene.batches.median_diameter
    if scene.batches.source == "files":
        diameters = 2.0 * np.concatenate([batch.r for batch in plan.batches])
        median = float(weighted_percentiles(diameters, diameters**3, (0.5,))[0])
    cells = median / scene.domain.cell_size
    if cells >= LEAST_CELLS * (1.0 - 1e-9):
        return []
    return [(f"domain.cell_size: the median particle ({pretty(median, 'length')}) has {cells:.2g} cells to its "
             f"diameter; below {LEAST_CELLS:g} no impact is resolved, with {pretty(0.2 * median, 'length')} there "
             f"are 5, with {pretty(0.1 * median, 'length')} 10")]
