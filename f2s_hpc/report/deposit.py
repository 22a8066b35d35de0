"""A deposit as the measurements take it: arrays and spacing, read from a run folder without holding it all at once."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from f2s_hpc import places
from f2s_hpc.analysis.surface import LANDED, attached_material, landed_surface
from f2s_hpc.config import Scene, parse_scene
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.errors import CheckpointError, F2SError, InputError
from f2s_hpc.fields import STRESS, VELOCITY
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.tracers import TracerCloud, read_tracers
from f2s_hpc.kernels import derived
from f2s_hpc.particles.batch import Batch, flight_speed

_LAYERS_AT_ONCE = 16
Skipped = tuple[int, str]
"""Cycle of a file that cannot be measured (as its number lets expect, for a frame that tells none), and why."""

FRAME_FIELDS = ("volume_fraction", "peeq", "temperature", "von_mises", "speed")


@dataclass(frozen=True, eq=False)
class Deposit:
    """The state at the end of a cycle, SI, arrays (nz, ny, nx) float32.

    ``fraction``: volume fraction; ``peeq``; ``temperature`` (K); ``von_mises`` (Pa); ``landed`` (bool): slower than
    ``LANDED`` of ``flight_speed`` and attached (``surface.attached_material``); ``detached``: volume of what is as
    slow but hangs in the air (m3); ``surface``: height of what has landed above the bottom of the box (m), (ny, nx)
    float64; ``time`` (s); ``source``: the file; ``batches``: the spheres painted, in the order of the cycles;
    ``tracers``: the points of the particles, where the scene asked for them; ``skipped``: which newer or better files
    of the run were passed over, and why.
    """

    folder: pathlib.Path
    scene: Scene
    cycle: int
    time: float
    source: pathlib.Path
    fraction: np.ndarray
    peeq: np.ndarray
    temperature: np.ndarray
    von_mises: np.ndarray
    landed: np.ndarray
    detached: float
    surface: np.ndarray
    batches: list[Batch]
    tracers: TracerCloud | None = None
    skipped: str = ""

    @property
    def dx(self) -> float:
        """Cell size (m)."""
        return self.scene.domain.cell_size

    @property
    def ground(self) -> float:
        """Height of the substrate top above the bottom of the box (m)."""
        return self.scene.domain.substrate_height

    @property
    def diameters(self) -> np.ndarray:
        """Diameters of all spheres painted so far (m)."""
        painted = self.batches[:self.cycle] if self.scene.scheme == "recurring" else self.batches
        return 2.0 * np.concatenate([batch.r for batch in painted]) if painted else np.empty(0)


def checkpoints_by_cycle(folder: str | os.PathLike, skipped: list[Skipped] | None = None) -> dict[int, pathlib.Path]:
    """Return the complete checkpoints of a run that stand at the end of a cycle, the newest of each cycle.

    ``skipped`` is told of those that are damaged. Raises ``InputError`` when the folder cannot be read.
    """
    found = {}
    for path in list_checkpoints(pathlib.Path(folder) / layout.CHECKPOINTS):
        cycle = layout.checkpoint_key(path.name)[0]
        try:
            with runs.CheckpointLayers(path) as file:
                if runs.ends_cycle(file.attributes):
                    found[cycle] = path
        except CheckpointError as error:
            if skipped is not None:
                skipped.append((cycle, str(error)))
    return found


def load_deposit(folder: str | os.PathLike, cycle: int | None = None) -> Deposit:
    """Return the deposit of the run in ``folder`` at the end of ``cycle`` (default: the last one finished).

    From the checkpoint of that cycle where it is still there, else from its frame, which is float32; files that were
    passed over for it stand in ``skipped``. Raises ``InputError`` when the folder holds no run, or neither of the two
    for this cycle, with the reasons.
    """
    folder = places.run_folder(folder)
    skipped: list[Skipped] = []
    checkpoints, frames = checkpoints_by_cycle(folder, skipped), _frames_by_cycle(folder, skipped)
    there = sorted(checkpoints.keys() | frames.keys())
    if not there:
        raise InputError(f"{folder}: holds no checkpoint at the end of a cycle, and no frame"
                         + (_reasons(skipped, ", that can be measured: ") or "; name a run's folder"))
    wanted = there[-1] if cycle is None else cycle
    if wanted not in there:
        raise InputError(f"{folder}: nothing saved of cycle {wanted}; there is {', '.join(map(str, there))}"
                         + _reasons([s for s in skipped if s[0] == wanted], "; skipped: "))
    if wanted in checkpoints:
        found, least = _from_checkpoint(folder, wanted, checkpoints[wanted]), wanted + 1
    else:
        found, least = _from_frame(folder, wanted, frames[wanted]), wanted
    better = [s for s in skipped if s[0] >= least and cycle in (None, s[0])]
    return replace(found, skipped=_reasons(better))


def _reasons(skipped: Sequence[Skipped], opening: str = "") -> str:
    """Return why the last file was skipped, and how many more were; nothing if none was."""
    if not skipped:
        return ""
    return opening + skipped[-1][1] + (f" (and {len(skipped) - 1} more)" if len(skipped) > 1 else "")


def _frames_by_cycle(folder: pathlib.Path, skipped: list[Skipped]) -> dict[int, int]:
    """Return the number of the frame at the end of each cycle; ``skipped`` is told of those that cannot be used."""
    found = {}
    for number in runs.list_frames(folder):
        path = folder / layout.FRAMES / layout.frame_name(number)
        try:
            meta = runs.read_frame_meta(path)
        except F2SError as error:
            skipped.append((number + 1, str(error)))
            continue
        if not meta.provenance.get("ends_cycle", True):  # (these come by output.frame_interval)
            continue
        cycle = int(meta.provenance.get("cycle", 0))
        lacking = [name for name in FRAME_FIELDS if name not in meta.locations]
        if lacking or not meta.provenance.get("scene"):
            wanted = f"; a frame to be measured needs output.fields = {list(FRAME_FIELDS)}" if lacking else ""
            skipped.append((cycle, f"{path}: lacks {', '.join(lacking) or 'its scene'}{wanted}"))
        else:
            found[cycle] = number
    return found


def checkpoint_fields(path: pathlib.Path) -> tuple[dict[str, np.ndarray], dict]:
    """Return ``FRAME_FIELDS`` of a checkpoint, float32 (nz, ny, nx), as a frame would hold them, and its attributes.

    Read in slabs of layers, so that no field is ever held in float64. Raises ``CheckpointError``.
    """
    with runs.CheckpointLayers(path) as file:
        shape = file.shapes["volume_fraction"]
        arrays = {name: np.empty(shape, dtype=np.float32) for name in FRAME_FIELDS}
        for first in range(0, shape[0], _LAYERS_AT_ONCE):
            last = min(first + _LAYERS_AT_ONCE, shape[0])
            for name in ("volume_fraction", "peeq", "temperature"):
                arrays[name][first:last] = file.layers(name, first, last)
            stress, speed = np.zeros((2, last - first, *shape[1:]))
            derived.cell_von_mises(tuple(file.layers(n, first, last).reshape(-1) for n in STRESS), stress.reshape(-1))
            derived.cell_speed(speed.shape, file.layers("mass", first, last).reshape(-1),
                               *(file.layers(n, first, last + 1).reshape(-1) for n in VELOCITY), speed.reshape(-1))
            arrays["von_mises"][first:last], arrays["speed"][first:last] = stress, speed
        return arrays, file.attributes


def _from_checkpoint(folder: pathlib.Path, cycle: int, path: pathlib.Path) -> Deposit:
    arrays, attributes = checkpoint_fields(path)
    clock = attributes["clock"]
    return _deposit(folder, parse_scene(attributes["scene"], str(path)), cycle,
                    clock["cycle_start"] + clock["in_cycle"], path, arrays)


def _from_frame(folder: pathlib.Path, cycle: int, number: int) -> Deposit:
    path = folder / layout.FRAMES / layout.frame_name(number)
    arrays, meta = runs.open_frame(folder, number, FRAME_FIELDS)
    return _deposit(folder, parse_scene(meta.provenance["scene"], str(path)), cycle, meta.time_s, path, arrays)


def _deposit(folder: pathlib.Path, scene: Scene, cycle: int, time: float, path: pathlib.Path,
             arrays: dict[str, np.ndarray]) -> Deposit:
    fraction, dx = arrays["volume_fraction"], scene.domain.cell_size
    batches = _painted(folder, scene)
    slow = arrays.pop("speed") < LANDED * flight_speed(batches, scene.top_speed)
    landed = attached_material(fraction, slow)
    detached = float(fraction[slow & ~landed].sum(dtype=np.float64)) * dx**3
    surface = landed_surface(fraction, landed, dx)
    return Deposit(folder, scene, cycle, time, path, fraction, arrays["peeq"], arrays["temperature"],
                   arrays["von_mises"], landed, detached, surface, batches,
                   read_tracers(folder, cycle) if scene.output.tracers else None)


def _painted(folder: pathlib.Path, scene: Scene) -> list[Batch]:
    """Return the batches in the order of the cycles; empty where the folder has lost them."""
    try:
        plan = RunFolder(folder, scene).read_plan()
    except F2SError:
        return []
    return [plan.batches[number] for number in plan.order]
