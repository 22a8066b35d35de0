"""The text that ``f2s check`` prints: the resolved scene and what running it will take."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from f2s_hpc import fields
from f2s_hpc.config.dump import dump_scene, scene_hash
from f2s_hpc.config.schema import Scene
from f2s_hpc.units import count_text, pretty, pretty_bytes


def quiet_time_step(scene: Scene) -> float:
    """Return courant dx / c_L, s: the step while nothing moves."""
    return scene.numerics.courant * scene.domain.cell_size / scene.material.longitudinal_sound_speed


def estimated_time_step(scene: Scene) -> float:
    """Return the mean step of a run, s: impacts shorten it to two thirds, as measured in section4."""
    return quiet_time_step(scene) / 1.5


def frame_count(scene: Scene) -> int:
    """Return the number of frames that a whole run writes: after each cycle, and at the extra interval."""
    interval = scene.output.frame_interval
    between = math.floor(scene.cycles.total_time / interval + 1e-9) if interval else 0
    if scene.output.frames != "cycle":
        return between
    ends = np.cumsum(scene.cycles.durations)
    if interval:  # one that falls on the end of a cycle is that cycle's own
        between -= int((abs(ends - np.rint(ends / interval) * interval) < 1e-9 * interval).sum())
    return len(ends) + between


def frame_bytes(scene: Scene) -> int:
    """Return the size of one frame before compression: 4 bytes per cell and field."""
    return 4 * math.prod(scene.domain.cells) * len(scene.output.fields)


def _view_line(scene: Scene) -> list[tuple[str, str]]:
    """Return what the view of a scene takes; nothing without one."""
    view = scene.output.view
    if view.interval is None:
        return []
    count = math.floor(scene.cycles.total_time / view.interval + 1e-9)
    cells = tuple(n for _, n in view.cells(scene.domain))
    size = 4 * math.prod(cells) * len(scene.output.fields)
    return [("view", f"{count:,} of {_grid(cells)} cells, {pretty_bytes(count * size)} in all, before compression")]


def _archive(scene: Scene) -> str:
    """Return how many checkpoints are kept for good; nothing where none is."""
    every = scene.output.archive_every
    return f" and {scene.cycles.count // every:,} for good" if every else ""


def _dwell_line(scene: Scene) -> list[tuple[str, str]]:
    """Return what happens between the cycles; nothing without a dwell."""
    if scene.cycles.dwell is None:
        return []
    backing = scene.substrate.backing
    sink = ("no heat leaves the box" if backing is None else
            f"heat leaves through the bottom to {pretty(scene.substrate.temperature, 'temperature')}"
            + (f" behind {pretty(backing, 'length')} more of substrate" if backing else ""))
    return [("dwell", f"{pretty(scene.cycles.dwell, 'time')} of conduction alone between two cycles; {sink}")]


def checkpoint_bytes(scene: Scene) -> int:
    """Return the size of one checkpoint: 8 bytes per cell or node and saved field."""
    cells = math.prod(scene.domain.cells)
    nodes = math.prod(n + 1 for n in scene.domain.cells)
    needed = scene.needed_fields
    saved = [f for f in needed if f.saved]
    return 8 * sum(nodes if f.location == fields.NODE else cells for f in saved)


def particle_count(scene: Scene) -> int | None:
    """Return how many particles the whole run paints; None where only the CSV files tell."""
    batches = scene.batches
    if batches.source == "files":
        return None
    per_batch = len(batches.spheres) if batches.source == "spheres" else batches.particles
    return per_batch * (batches.number if scene.scheme == "standard" else scene.cycles.count)


def _grid(cells: Sequence[int]) -> str:
    return " x ".join(str(n) for n in cells)


def _particles_line(scene: Scene, particles: int | None, painted_volume: float | None) -> str:
    batches = scene.batches
    text = {"files": f"{count_text(batches.number, 'batch file')}",
            "spheres": f"{count_text(len(batches.spheres), 'listed sphere')}",
            "generated": f"batches to generate: {batches.number:,} of {count_text(batches.particles, 'particle')}, "
                         f"seed {batches.seed}{_spread(scene)}"}[batches.source]
    total = particle_count(scene) if particles is None else particles
    text += "" if total is None else f"; {count_text(total, 'particle')} in the whole run"
    if painted_volume is not None:
        area = scene.domain.extents[0] * scene.domain.extents[1]
        text += (f"; painted volume {pretty(painted_volume, 'volume')}, "
                 f"{pretty(painted_volume / area, 'length')} of dense height")
    return text


def _spread(scene: Scene) -> str:
    batches = scene.batches
    if batches.distribution == "uniform":
        return ""
    return (f", sech over x of width {pretty(batches.jet_width, 'length')} about "
            f"{pretty(batches.jet_centre, 'length')}")


def _speed(scene: Scene) -> str:
    low, high = scene.speed_range
    law = " and ".join(name for name, there in (("x", scene.particles.speed_curvature),
                                                ("diameter", scene.particles.speed_per_diameter)) if there)
    text = pretty(high, "speed") if low == high else f"{low:.1f} to {high:.1f} m/s over {law}, by the speed law"
    across = scene.top_lateral_velocity
    return f"{text}; up to {pretty(across, 'speed')} along x" if across else text


def _temperature_line(scene: Scene) -> list[tuple[str, str]]:
    if not scene.particles.temperature_per_diameter:
        return []
    low, high = sorted(scene.particles.temperature_at(diameter) for diameter in scene.batches.diameter_range)
    return [("temperature", f"{pretty(low, 'temperature', 4)} to {pretty(high, 'temperature', 4)} over diameter")]


def _parts(cells_per_rank: Sequence[tuple[int, int, int]]) -> list[tuple[str, str]]:
    counts = [math.prod(cells) for cells in cells_per_rank]
    small, large = min(cells_per_rank, key=math.prod), max(cells_per_rank, key=math.prod)
    spread = _grid(small) if small == large else f"{_grid(small)} to {_grid(large)}"
    return [("cells per rank", f"{spread}  ({min(counts):,} to {max(counts):,})")]


def describe(scene: Scene, ranks: int, cells_per_rank: list[tuple[int, int, int]],
             painted_volume: float | None = None, particles: int | None = None,
             more: Sequence[tuple[str, str]] = ()) -> str:
    """Return the text of ``f2s check``: the resolved scene, then sizes, time step and output.

    ``cells_per_rank`` are the cells (x, y, z) owned by each rank. ``painted_volume`` (m3) and ``particles`` of the
    whole run are printed where known; ``more``: further lines, each a name and a text.
    """
    step = estimated_time_step(scene)
    total = scene.cycles.total_time
    frames, checkpoints = frame_count(scene), scene.output.keep_checkpoints
    cells = math.prod(scene.domain.cells)
    box = " x ".join(pretty(length, "length", 6) for length in scene.domain.extents)
    rows = [
        ("box", box),
        ("cells", f"{_grid(scene.domain.cells)} = {cells:,} of {pretty(scene.domain.cell_size, 'length')}"),
        ("ranks", f"{ranks}"),
        *_parts(cells_per_rank),
        ("particles", _particles_line(scene, particles, painted_volume)),
        ("speed", _speed(scene)),
        *_temperature_line(scene),
        ("cycles", f"{count_text(scene.cycles.count, 'cycle')}, {pretty(total, 'time')} in all"),
        *_dwell_line(scene),
        ("time step", (f"about {pretty(step, 'time', 3)} (longitudinal waves at "
                       f"{scene.material.longitudinal_sound_speed:.0f} m/s)")),
        ("steps", f"about {math.ceil(total / step):,}"),
        ("frames", (f"{frames:,} of {pretty_bytes(frame_bytes(scene))}, "
                    f"{pretty_bytes(frames * frame_bytes(scene))} in all, before compression")),
        *_view_line(scene),
        ("checkpoints", (f"the last {checkpoints} kept{_archive(scene)}, {pretty_bytes(checkpoint_bytes(scene))} each"
                         if scene.output.checkpoints else "none")),
        *more,
        ("configuration", f"sha256 {scene_hash(scene)[:16]}"),
    ]
    width = max(len(name) for name, _ in rows) + 2
    return dump_scene(scene) + "\n" + "\n".join(f"# {name:<{width}}{text}" for name, text in rows) + "\n"
