"""What is worth a word about a scene that is possible, but may not be what was meant."""

from __future__ import annotations

import math
import os
import platform
from collections import Counter

import numpy as np

from f2s_hpc.analysis.depth import weighted_percentiles
from f2s_hpc.config.schema import Scene, by_resolution
from f2s_hpc.particles.batch import Batch, clipped_volume
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.units import count_text, pretty

LEAST_CELLS = 2.0
"""With fewer cells to its diameter a particle is not resolved at all."""
ROUNDED = 0.01
"""A box that whole cells make longer or shorter by a larger share than this is worth a note."""


LATE = 0.1
"""If a larger share of a batch than this comes too late, its cycle is worth a note."""
LOST = 0.05
"""If a larger share of the powder than this leaves through a side on its way down, that is worth a note."""


def scene_notes(scene: Scene, plan: BatchPlan) -> list[str]:
    """Return a line on each: a box that whole cells change much, coarse cells, numerics for another powder, sides
    that particles fly towards, a box too low for the deposit, cycles too short for the flight.
    """
    return [*_rounded_sides(scene), *_coarse_cells(scene, plan), *_other_powder(scene, plan),
            *_slanted_flight(scene, plan), *_short_of_room(scene, plan)]


def median_diameter(scene: Scene, plan: BatchPlan) -> float:
    """Return the diameter (m) below which half the volume of the powder lies, of files by what they hold."""
    if scene.batches.source != "files":
        return scene.batches.median_diameter
    diameters = 2.0 * np.concatenate([batch.r for batch in plan.batches])
    return float(weighted_percentiles(diameters, diameters**3, (0.5,))[0])


def _short_of_room(scene: Scene, plan: BatchPlan) -> list[str]:
    """Return a line where the deposit reaches up to where batches start, and where cycles end before they are down."""
    domain, cycles = scene.domain, scene.cycles
    x, y, _ = domain.extents
    volumes = [clipped_volume(batch, *domain.extents) for batch in plan.batches]
    *before, last = (volumes[b] / (x * y) for b in plan.order)
    notes, grown = [], domain.substrate_height + sum(before)
    if before and grown > domain.layer_bottom:
        notes.append(
            f"domain.size: the batches before the last make {pretty(sum(before), 'length', 3)} of dense height, the "
            f"substrate has {pretty(domain.substrate_height, 'length', 3)}, and batches start from "
            f"{pretty(domain.layer_bottom, 'length', 3)} on, so that some must start higher, and a run ends when one "
            "finds no room below the top: make the box "
            f"{pretty(grown + domain.particle_layer_height, 'length', 3)} high or more")
    late, enough = max(_late(scene, batch, domain.layer_bottom, cycles.duration) for batch in plan.batches)
    if before and late > LATE:
        notes.append(f"cycles.duration: {100 * late:.0f} % of a batch are in the particle layer still after "
                     f"{pretty(cycles.duration, 'time', 3)}, when the next one starts there; "
                     f"{pretty(enough, 'time', 3)} let all leave it")
    late, enough = _late(scene, plan.batches[plan.order[-1]], grown + last, cycles.durations[-1])
    if late > LATE:
        notes.append(f"cycles.{'last_duration' if before else 'duration'}: {100 * late:.0f} % of the last batch fly "
                     f"still after {pretty(cycles.durations[-1], 'time', 3)}; {pretty(enough, 'time', 3)} let all come "
                     "down, and they need more to come to rest")
    return notes


def _late(scene: Scene, batch: Batch, height: float, time: float) -> tuple[float, float]:
    """Return the share of a batch whose centres are above ``height`` (m) after ``time`` (s), and the time all need.

    Only those count that fly downwards.
    """
    speed = -batch.velocities(scene.particles.velocity)[:, 2]
    down = speed > 0.0
    needed = (batch.z[down] + scene.domain.layer_bottom - height) / speed[down]
    return float((needed > time).mean()) if down.any() else 0.0, float(needed.max(initial=0.0))


def node_and_cores() -> tuple[str, int]:
    """Return the name of this rank's node and the number of its cores."""
    return platform.node(), os.cpu_count() or 1


def crowded_nodes(ranks: list[tuple[str, int]]) -> list[str]:
    """Return a line on the node with most ranks per core, if that is more than one; ``ranks``: what each told."""
    (node, cores), count = max(Counter(ranks).items(), key=lambda item: item[1] / item[0][1])
    if count <= cores:
        return []
    return [f"{count} ranks share {count_text(cores, 'core')} of {node}; a run is fastest with one rank per core"]


def _rounded_sides(scene: Scene) -> list[str]:
    domain, notes = scene.domain, []
    for axis, asked, found, cells in zip("xyz", domain.size, domain.extents, domain.cells):
        if abs(found - asked) > ROUNDED * asked:
            notes.append(f"domain.size along {axis}: {pretty(asked, 'length')} are {asked / domain.cell_size:.3g} "
                         f"cells of {pretty(domain.cell_size, 'length')}; the box has {cells}, so it is "
                         f"{pretty(found, 'length')} there")
    return notes


def _slanted_flight(scene: Scene, plan: BatchPlan) -> list[str]:
    """Return a line where particles fly towards a mirror, which throws them back, and where they are lost at a side."""
    direction, faces, crossing = scene.particles.direction, scene.domain.faces, _crossing(scene, plan)
    towards = {f"{axis}_{'low' if part < 0.0 else 'high'}" for axis, part in zip("xy", direction) if part}
    lean = math.degrees(math.atan2(math.hypot(*direction[:2]), abs(direction[2])))
    notes = []
    for side, share in crossing.items():
        face, part = f'domain.faces.{side} = "{getattr(faces, side)}"', f"{100.0 * share:.0f} % of the powder"
        if getattr(faces, side) in ("symmetry", "fixed"):
            if side in towards:
                notes.append(f"particles.direction: leans by {lean:.0f} degrees towards {face}; what reaches a mirror "
                             f"or a wall is thrown back by it, {part} on the way down, so keep what lands away from "
                             'there, or make the side "free"')
        elif getattr(faces, side) != "absorbing" and share > LOST:
            notes.append(f"{part} leave the box through {face} before they come down, and are lost: make the box "
                         "wider, or the particle layer lower")
    return notes


def _crossing(scene: Scene, plan: BatchPlan) -> dict[str, float]:
    """Return by each side in turn the share of the powder's volume whose centres cross it above the substrate."""
    domain, shares = scene.domain, dict.fromkeys(("x_low", "x_high", "y_low", "y_high"), 0.0)
    cycles = Counter(plan.order)
    total = sum(float((plan.batches[b].r**3).sum()) * times for b, times in cycles.items())
    for b, times in cycles.items():
        batch = plan.batches[b]
        velocity = batch.velocities(scene.particles.velocity)
        down = np.maximum(-velocity[:, 2], 1e-12)
        time = (batch.z + domain.layer_bottom - domain.substrate_height) / down
        for axis, start, length in (("x", batch.x, domain.extents[0]), ("y", batch.y, domain.extents[1])):
            end = start + velocity[:, "xy".index(axis)] * time
            for side, gone in (("low", (end < 0.0) & (start >= 0.0)), ("high", (end > length) & (start <= length))):
                shares[f"{axis}_{side}"] += float((batch.r[gone]**3).sum()) * times / total
    return shares


def _coarse_cells(scene: Scene, plan: BatchPlan) -> list[str]:
    median = median_diameter(scene, plan)
    cells = median / scene.domain.cell_size
    if cells >= LEAST_CELLS * (1.0 - 1e-9):
        return []
    return [(f"domain.cell_size: the median particle ({pretty(median, 'length')}) has {cells:.2g} cells to its "
             f"diameter; below {LEAST_CELLS:g} no impact is resolved, with {pretty(0.2 * median, 'length')} there "
             f"are 5, with {pretty(0.1 * median, 'length')} 10")]


def _other_powder(scene: Scene, plan: BatchPlan) -> list[str]:
    """Return a line where numerics follow a median diameter of the scene that the files do not have."""
    median, said, dx = median_diameter(scene, plan), scene.batches.median_diameter, scene.domain.cell_size
    wanted, chosen = by_resolution(median, dx), by_resolution(said, dx)
    other = [name for name, value in chosen.items() if getattr(scene.numerics, name) == value != wanted[name]]
    if scene.batches.source != "files" or not other:
        return []
    numbers = [", ".join(f"{name} = {values[name]:g}" for name in other) for values in (chosen, wanted)]
    return [(f"numerics: {numbers[0]} suit batches.diameter_d50 ({pretty(said, 'length')}), but the median particle of "
             f"the files has {pretty(median, 'length', 3)}; for that write {numbers[1]}")]
