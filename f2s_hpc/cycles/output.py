"""What a run leaves on disk: checkpoints, frames, the cycle table, the summary, the picture."""

from __future__ import annotations

import csv
import json
import os
import pathlib
import platform
from collections.abc import Sequence

import numpy as np

import f2s_hpc
from f2s_hpc import mpi
from f2s_hpc.config.dump import dump_scene, scene_hash
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.io import checkpoint, layout, runs, tracers, vtkhdf
from f2s_hpc.io.layout import Block
from f2s_hpc.io.tracers import TracerCloud
from f2s_hpc.particles.batch import BatchPlan, read_csv, write_csv
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State

PICTURE = "deposit.png"
SCENE_FILE = "scene.toml"
BATCHES = "batches"


def _block(state: State, name: str, data: np.ndarray, on_nodes: bool) -> Block:
    box = state.part.box
    return Block(name, data, state.part.start[::-1], box.node_shape if on_nodes else box.shape)


class RunFolder:
    """The folder of a run; all methods are collective unless they say otherwise."""

    def __init__(self, path: str | os.PathLike, scene: Scene) -> None:
        self.path = pathlib.Path(path)
        self.scene = scene

    def provenance(self) -> dict:
        """Return what every file should say about its origin."""
        return {"code": "f2s_hpc", "version": f2s_hpc.__version__, "scene_hash": scene_hash(self.scene),
                "scene": dump_scene(self.scene), "host": platform.node(), "ranks": mpi.size()}

    def write_input(self, plan: BatchPlan) -> None:
        """Write the resolved scene and the batches into the folder: all that a resumed run needs to know."""
        if mpi.is_root():
            (self.path / SCENE_FILE).write_text(dump_scene(self.scene), encoding="utf-8")
            folder = self.path / BATCHES
            folder.mkdir()
            for number, batch in enumerate(plan.batches):
                write_csv(folder / f"batch-{number + 1:03d}.csv", batch)
            (folder / "order.json").write_text(json.dumps({"order": plan.order}) + "\n", encoding="utf-8")
        mpi.barrier()

    def read_plan(self) -> BatchPlan:
        """Return the batches that :meth:`write_input` saved; raises ``InputError`` on all ranks."""
        def read() -> BatchPlan:
            folder = self.path / BATCHES
            batches = [read_csv(path) for path in sorted(folder.glob("batch-*.csv"))]
            try:
                order = json.loads((folder / "order.json").read_text(encoding="utf-8"))["order"]
            except (OSError, ValueError, KeyError) as error:
                raise InputError(f"{folder / 'order.json'}: {error}; it belongs to the run folder") from None
            if not batches or max(order) >= len(batches):
                raise InputError(f"{folder}: holds {len(batches)} batches, order.json asks for {max(order) + 1}")
            return BatchPlan(batches, order)

        return mpi.run_together(read)

    def write_frame(self, state: State, model: Model, number: int, time: float, cycle: int) -> list[str]:
        """Write a frame of the scene's output fields, and renew the index; return lines on frames left out of it."""
        blocks = [_block(state, name, measure.derived_field(state, model, name), measure.location(name) != CELL)
                  for name in self.scene.output.fields]
        folder = self.path / layout.FRAMES
        vtkhdf.write_frame(folder, number, time, blocks, (0.0, 0.0, 0.0), (model.dx,) * 3,
                           self.provenance() | {"cycle": cycle})
        return vtkhdf.update_index(folder)

    def write_tracers(self, cloud: TracerCloud, cycle: int) -> None:
        """Write the points of the particles at the end of ``cycle``; nothing while there are none."""
        if cloud.share[1]:
            tracers.write_tracers(self.path, cycle, cloud, self.provenance())

    def write_checkpoint(self, state: State, cycle: int, attributes: dict, more: Sequence[Block] = ()) -> pathlib.Path:
        """Write every saved field, ``more`` and ``attributes``; keep the newest few."""
        blocks = [_block(state, name, state.owned(name), BY_NAME[name].location != CELL) for name in state.saved]
        folder = self.path / layout.CHECKPOINTS
        path = checkpoint.write_checkpoint(folder, cycle, [*blocks, *more], attributes)
        checkpoint.prune(folder, self.scene.output.keep_checkpoints)
        return path

    def write_tables(self, rows: list[dict], summary: dict) -> None:
        """Write ``summary.csv`` (a row per cycle) and ``summary.json``; rank 0 only, each replaced whole."""
        if mpi.is_root():
            if rows:
                flat = [_flat(row) for row in rows]
                partial = self.path / f".{layout.SUMMARY_CSV}.partial"
                with partial.open("w", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, fieldnames=list(flat[-1]))
                    writer.writeheader()
                    writer.writerows(flat)
                partial.replace(self.path / layout.SUMMARY_CSV)
            partial = self.path / f".{layout.SUMMARY_JSON}.partial"
            partial.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
            partial.replace(self.path / layout.SUMMARY_JSON)
        mpi.barrier()

    def draw(self, summary: dict) -> pathlib.Path | None:
        """Draw the picture from the newest frame that holds what it needs; rank 0 only."""
        path = None
        if mpi.is_root() and self.scene.output.picture:
            from f2s_hpc.analysis import picture  # (what it loads should not lie beside the fields of a run)

            numbers = runs.list_frames(self.path)
            needed = ["volume_fraction", "peeq", "temperature", "speed"]
            if numbers and set(needed) <= set(self.scene.output.fields):
                fields, _ = runs.open_frame(self.path, numbers[-1], needed)
                path = self.path / PICTURE
                height = 1e6 * summary["dense_height_m"]
                picture.draw(fields, self.scene.domain.cell_size, self.scene.domain.substrate_height, self.scene.title,
                             f"{summary['particles']} particles, {1e6 * summary['time_s']:.2f} us, dense height "
                             f"{height:.1f} um, cells of {1e6 * self.scene.domain.cell_size:g} um", path,
                             slow_speed=measure.SLOW * self.scene.top_speed)
        mpi.barrier()
        return path


def _flat(row: dict) -> dict:
    """Return a row of the cycle table with the energy terms as columns of their own."""
    flat = {}
    for key, value in row.items():
        if isinstance(value, dict):
            flat.update({f"{key}_{name}_J": repr(v) for name, v in value.items()})
        else:
            flat[key] = "" if value is None else repr(value) if isinstance(value, float) else value
    return flat
