"""What a run leaves on disk: checkpoints, frames, the cycle table, the summary, the picture."""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import json
import math
import os
import pathlib
import platform
import re
import shutil
from collections.abc import Sequence

import numpy as np

import f2s_hpc
from f2s_hpc import mpi
from f2s_hpc.analysis import picture
from f2s_hpc.analysis.surface import LANDED
from f2s_hpc.config.dump import dump_scene, scene_hash
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.progress import tell
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.io import checkpoint, layout, runs, tracers, vtkhdf
from f2s_hpc.io.layout import Block
from f2s_hpc.io.tracers import TracerCloud
from f2s_hpc.origin import versions
from f2s_hpc.particles.batch import flight_speed, read_csv, write_csv
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.phases import phase
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State
from f2s_hpc.units import count_text

PICTURE = "deposit.png"
BATCHES, ORDER = "batches", "order.json"
BATCH_NAME = re.compile(r"batch-(\d+)\.csv")


def batch_name(number: int) -> str:
    """Return the name of the file that holds batch ``number``, counted from 1."""
    return f"batch-{number:03d}.csv"


def _block(state: State, name: str, data: np.ndarray, on_nodes: bool) -> Block:
    box = state.part.box
    return Block(name, data, state.part.start[::-1], box.node_shape if on_nodes else box.shape)


class RunFolder:
    """The folder of a run; all methods are collective unless they say otherwise."""

    def __init__(self, path: str | os.PathLike, scene: Scene) -> None:
        self.path = pathlib.Path(path)
        self.scene = scene

    @functools.cached_property
    def versions(self) -> dict:
        """Which code is at work, and on which libraries."""
        return {"version": f2s_hpc.__version__, **mpi.run_together(versions)}

    @functools.cached_property
    def identity(self) -> dict:
        """Which run this is and where it is at work, as every file says it: the host is that of rank 0."""
        return {"scene_hash": scene_hash(self.scene), "seed": self.scene.batches.seed, "host": platform.node(),
                "ranks": mpi.size()}

    def provenance(self) -> dict:
        """Return what every file should say about its origin; rank 0 alone looks it up, all know it."""
        return {"code": "f2s_hpc", **self.versions, **self.identity, "scene": dump_scene(self.scene)}

    def write_other_cycles(self, plan: BatchPlan | None) -> None:
        """Write the scene anew for a run whose number of cycles changes, and its batches where it has a new ``plan``.

        Batches of before keep their names and bits.
        """
        layout.attempt_on_root(lambda: self._write_input(plan), f"{self.path}: its scene and batches cannot be written",
                               InputError)

    def write_input(self, plan: BatchPlan) -> None:
        """Write the resolved scene and the batches into the folder: all that a resumed run needs to know.

        Raises ``InputError`` on all ranks, and takes the new folder away again, when they cannot be written.
        """
        try:
            layout.attempt_on_root(lambda: self._write_input(plan), f"{self.path}: its scene and batches cannot be "
                                   "written", InputError)
        except InputError:
            if mpi.is_root():
                self._take_away()
            mpi.barrier()
            raise

    def _write_input(self, plan: BatchPlan | None) -> None:
        if plan is not None:
            folder = self.path / BATCHES
            folder.mkdir(exist_ok=True)
            names = [batch_name(number) for number in range(1, len(plan.batches) + 1)]
            for name, batch in zip(names, plan.batches):
                write_csv(folder / name, batch)
            layout.write_text_file(folder / ORDER, json.dumps({"order": plan.order, "batches": names}) + "\n")
        layout.write_text_file(self.path / layout.SCENE_FILE, dump_scene(self.scene))

    def _take_away(self) -> None:
        """Remove what a run that could not begin has made: else its folder would pass for one that holds a run."""
        shutil.rmtree(self.path / BATCHES, ignore_errors=True)
        for name in (layout.SCENE_FILE, layout.LOCK):
            with contextlib.suppress(OSError):
                (self.path / name).unlink(missing_ok=True)
        for folder in (self.path / layout.CHECKPOINTS, self.path / layout.FRAMES, self.path):
            with contextlib.suppress(OSError):
                folder.rmdir()

    def read_plan(self) -> BatchPlan:
        """Return the batches that :meth:`write_input` saved; raises ``InputError`` on all ranks."""
        def read() -> BatchPlan:
            folder = self.path / BATCHES
            order, names = _read_order(folder)
            for name in names:
                if not (folder / name).is_file():
                    raise InputError(f"{folder / name}: no such file; it belongs to the run folder, put it back")
            if len(order) < self.scene.cycles.count:
                raise InputError(f"{folder / ORDER}: names the batches of {len(order)} cycles, but the run has "
                                 f"{self.scene.cycles.count}")
            if max(order) >= len(names):
                raise InputError(f"{folder}: holds {len(names)} batches, {ORDER} asks for {max(order) + 1}")
            return BatchPlan([read_csv(folder / name, may_be_empty=True) for name in names], order)

        return layout.attempt_on_root(read, f"{self.path / BATCHES}: cannot be read", InputError)

    def write_frame(self, state: State, model: Model, number: int, time: float, cycle: int,
                    ends_cycle: bool) -> list[str]:
        """Write a frame of the scene's output fields, and renew the index; return lines on frames left out of it."""
        blocks = [_block(state, name, measure.derived_field(state, model, name), measure.location(name) != CELL)
                  for name in self.scene.output.fields]
        folder = self.path / layout.FRAMES
        # a resumed run writes anew what had come after its checkpoint, maybe at other times
        layout.attempt_on_root(lambda: runs.drop_frames_after(self.path, number), f"{folder}: cannot be tidied")
        vtkhdf.write_frame(folder, number, time, blocks, (0.0, 0.0, 0.0), (model.dx,) * 3,
                           self.provenance() | {"cycle": cycle, "ends_cycle": ends_cycle})
        return vtkhdf.update_index(folder)

    @phase("output")
    def write_view(self, state: State, model: Model, number: int, time: float) -> None:
        """Write the scene's view as number ``number`` of its series; :meth:`update_view` renews the index."""
        begin, count = (np.array(n)[::-1] for n in zip(*self.scene.output.view.cells(self.scene.domain)))
        start = np.array(state.part.start[::-1])
        blocks = []
        for name in self.scene.output.fields:
            data, more = measure.derived_field(state, model, name), int(measure.location(name) != CELL)
            low = np.clip(begin - start, 0, data.shape)
            high = np.clip(begin + count + more - start, low, data.shape)
            part = data[tuple(slice(a, b) for a, b in zip(low, high))]
            # (a rank without a part of it takes part in the writing)
            place = start + low - begin if part.size else (0, 0, 0)
            blocks.append(Block(name, part, tuple(int(n) for n in place), tuple(int(n) for n in count + more)))
        folder, dx = self.path / layout.VIEW, model.dx
        vtkhdf.write_frame(folder, number, time, blocks, tuple(float(n) * dx for n in begin[::-1]), (dx,) * 3,
                           self.provenance())

    def update_view(self, last: int) -> list[str]:
        """Renew the index over the pictures of :meth:`write_view` up to ``last``; return lines on what it lacks.

        What a session left that went on past its last checkpoint and was killed is removed.
        """
        folder = self.path / layout.VIEW
        layout.attempt_on_root(lambda: runs.drop_frames_after(self.path, last, layout.VIEW),
                               f"{folder}: cannot be tidied")
        return vtkhdf.update_index(folder)

    def write_tracers(self, cloud: TracerCloud, cycle: int) -> None:
        """Write the points of the particles at the end of ``cycle``; nothing while there are none."""
        if cloud.share[1]:
            tracers.write_tracers(self.path, cycle, cloud, self.provenance())

    def write_checkpoint(self, state: State, cycle: int, attributes: dict, more: Sequence[Block] = ()) -> pathlib.Path:
        """Write every saved field, ``more`` and ``attributes``; keep the newest few."""
        blocks = [_block(state, name, state.owned(name), BY_NAME[name].location != CELL) for name in state.saved]
        folder = self.path / layout.CHECKPOINTS
        every = self.scene.output.archive_every
        archived = bool(every) and cycle % every == 0 and runs.ends_cycle(attributes)
        path = checkpoint.write_checkpoint(folder, cycle, [*blocks, *more], attributes, archived)
        checkpoint.prune(folder, self.scene.output.keep_checkpoints, self.scene.output.archive_every)
        return path

    @phase("output")
    def write_tables(self, rows: list[dict], summary: dict) -> None:
        """Write ``summary.csv`` (a row per cycle) and ``summary.json``, each replaced whole.

        When they cannot be written: before the end, and after a failure that is to be told itself, that is a printed
        note (the checkpoint holds the rows, and the next table all of them); at the end ``F2SError`` on all ranks.
        """
        def write() -> None:
            if rows:
                flat = [_flat(row) for row in rows]
                text = io.StringIO(newline="")
                writer = csv.DictWriter(text, fieldnames=list(flat[-1]))
                writer.writeheader()
                writer.writerows(flat)
                layout.write_text_file(self.path / layout.SUMMARY_CSV, text.getvalue())
            text = json.dumps(_without_nan(summary), indent=2, allow_nan=False)
            layout.write_text_file(self.path / layout.SUMMARY_JSON, text + "\n")

        try:
            layout.attempt_on_root(write, f"{self.path}: the cycle table cannot be written")
        except F2SError as error:
            if summary["status"] not in ("running", "failed"):
                raise
            _note(error)

    @phase("output")
    def draw(self, rows: list[dict], plan: BatchPlan) -> pathlib.Path | None:
        """Draw the picture from the newest frame; return its path, None where there is none. ``rows``: the cycle table.

        What keeps a picture from being made is a printed note: the run itself has its results.
        """
        if not (self.scene.output.picture or self.scene.output.picture_each_cycle):
            return None
        if not set(picture.NEEDED) <= set(self.scene.output.fields):
            _note(f"no picture; output.fields lacks {' or '.join(picture.NEEDED)}")
            return None
        path = self.path / PICTURE
        try:
            layout.attempt_on_root(lambda: self._draw(rows, plan, path), f"{path}: cannot be drawn")
        except F2SError as error:
            _note(f"no picture; {error}")
            return None
        return path

    def _draw(self, rows: list[dict], plan: BatchPlan, path: pathlib.Path) -> None:
        numbers = runs.list_frames(self.path)
        if not numbers:
            raise F2SError(f"{self.path / layout.FRAMES} holds no frame")
        # (an older run may have been resumed with other fields than its frames have)
        fields, meta = runs.frame_fields(self.path, numbers[-1], picture.NEEDED)
        domain = self.scene.domain
        picture.draw(fields, domain.cell_size, domain.substrate_height, self.scene.title,
                     f"{_frame_text(meta.time_s, rows)}, cells of {1e6 * domain.cell_size:g} µm", path,
                     slow_speed=LANDED * flight_speed(plan.batches, self.scene.top_speed))


def _frame_text(time: float, rows: list[dict]) -> str:
    """Return what a frame at ``time`` (s) shows; its numbers are known where a row of the cycle table is of that time.

    It may be older than the state: a run that stops within a cycle writes no frame.
    """
    elapsed = f"{1e6 * time:.2f} µs"
    row = next((row for row in rows if math.isclose(row["time_s"], time, rel_tol=1e-9)), None)
    if row is None:
        return f"within cycle {1 + sum(row['time_s'] < time for row in rows)}, {elapsed}"
    landed = count_text(row["particles"] - row.get("particles_in_flight", 0), "particle")
    return f"{landed}, {elapsed}, dense height {1e6 * row['dense_height_m']:.1f} µm"


def _without_nan(value: object) -> object:
    """Return numbers and what holds them with None for what is not finite: JSON has no word for it."""
    if isinstance(value, dict):
        return {name: _without_nan(part) for name, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _note(text: object) -> None:
    if mpi.is_root():
        tell(f"note: {text}")


def _read_order(folder: pathlib.Path) -> tuple[list[int], list[str]]:
    """Return the batch of each cycle and the names of the batches' files, in their order; raises ``InputError``."""
    place = folder / ORDER
    try:
        saved = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not JSON ({error})"
        raise InputError(f"{place}: {reason}; it belongs to the run folder") from None
    order, names = (saved.get("order"), saved.get("batches")) if isinstance(saved, dict) else (None, None)
    if not isinstance(order, list) or not order or not all(type(n) is int and n >= 0 for n in order):
        raise InputError(f'{place}: "order" must be a list of the batch of each cycle, counted from 0')
    if names is None:
        # (folders were written without the names: all up to the last number must be there)
        matches = [BATCH_NAME.fullmatch(path.name) for path in folder.iterdir()]
        found = {int(match[1]): match[0] for match in matches if match}
        last = max([*found, max(order) + 1])
        names = [found.get(number, batch_name(number)) for number in range(1, last + 1)]
    if not isinstance(names, list) or not all(isinstance(name, str) and BATCH_NAME.fullmatch(name) for name in names):
        raise InputError(f'{place}: "batches" must be a list of files such as batch-001.csv')
    return order, names


def _flat(row: dict) -> dict:
    """Return a row of the cycle table with the energy terms and the phases as columns of their own."""
    flat = {}
    for key, value in row.items():
        if isinstance(value, dict):
            for name, part in value.items():
                flat |= ({f"{key}_{name}_{more}": repr(v) for more, v in part.items()} if isinstance(part, dict) else
                         {f"{key}_{name}_J": repr(part)})
        else:
            flat[key] = "" if value is None else repr(value) if isinstance(value, float) else value
    return flat
