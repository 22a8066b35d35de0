"""Checkpoints: every saved bit of a run in one HDF5 file, written and read on any number of ranks.

Writing: another name, collective float64 writes, flush and close, read back and compare checksums,
rename, and last the manifest. A checkpoint without a matching manifest does not count, so a crash at
any moment leaves the older one in force. Every function here is called by all ranks together; a
failure on one of them raises ``CheckpointError`` on all.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import pathlib
from collections.abc import Mapping, Sequence

import h5py
import numpy as np

from f2s_hpc import mpi, places
from f2s_hpc.errors import CheckpointError, F2SError, InputError
from f2s_hpc.grid.pages import sparse_zeros
from f2s_hpc.io import layout
from f2s_hpc.io.layout import ATTRIBUTES, FIELDS_GROUP, Block, attempt_on_root, attempt_together, box_selection
from f2s_hpc.io.manifest import (
    Manifest,
    as_text,
    manifest_path,
    partial_checksums,
    read_manifest,
    text_digest,
    write_manifest,
)

Box = tuple[tuple[int, int, int], tuple[int, int, int]]


def write_checkpoint(folder: str | os.PathLike, cycle: int, blocks: Sequence[Block], attributes: dict,
                     archived: bool = False) -> pathlib.Path:
    """Write a checkpoint of ``blocks`` and ``attributes`` into ``folder``; return its path.

    ``attributes`` holds what JSON can hold (numpy numbers and arrays included); rank 0's are saved,
    floats and integers bit for bit. ``attributes["step"]`` (default 0) orders the checkpoints of one
    cycle. An older checkpoint of the same cycle and step stays untouched beside the new one. :func:`prune` never
    deletes one that is ``archived``.
    Raises ``CheckpointError`` on all ranks, leaving no file, when anything fails.
    """
    folder = pathlib.Path(folder)
    wrong = layout.check_blocks(blocks)
    if wrong is not None:
        raise CheckpointError(f"cannot write a checkpoint in {folder}: {wrong}")

    def begin() -> tuple[pathlib.Path, str]:
        text = layout.encode_json(attributes)
        folder.mkdir(parents=True, exist_ok=True)
        step, attempt = int(attributes.get("step", 0)), 1
        while (path := folder / layout.checkpoint_name(cycle, step, attempt)).exists():
            attempt += 1
        return path, text

    context = f"cannot write a checkpoint in {folder}"
    path, text = attempt_on_root(begin, context, CheckpointError)
    partial = layout.partial_path(path)
    expected = [as_text(value) for value in mpi.total(partial_checksums(blocks))]
    layout.write_shared(partial, [f"{FIELDS_GROUP}/{block.name}" for block in blocks], blocks, {ATTRIBUTES: text},
                        _head, "f8", False, CheckpointError)
    attempt_on_root(lambda: layout.make_durable(partial), context, CheckpointError)
    shapes = {block.name: tuple(map(int, block.global_shape)) for block in blocks}
    try:
        found = _file_checksums(partial, shapes)
        for block, old, new in zip(blocks, expected, found, strict=True):
            if old != new:
                raise CheckpointError(f"{context}: field {block.name!r} does not read back as written")
    except CheckpointError:
        attempt_on_root(lambda: partial.unlink(missing_ok=True), context, CheckpointError)
        raise

    def finish() -> None:
        try:
            layout.publish(partial, path)
            write_manifest(path, blocks, expected, text, archived)
        except OSError:
            for file in (manifest_path(path), path, partial):
                file.unlink(missing_ok=True)
            raise

    attempt_on_root(finish, context, CheckpointError)
    return path


def _head(file: h5py.File) -> None:
    file.attrs["format"] = np.int64(layout.FORMAT_VERSION)
    file.create_group(FIELDS_GROUP)


def _file_checksums(path: pathlib.Path, shapes: Mapping[str, tuple[int, int, int]]) -> list[str]:
    """Return the checksum of each field in the file; every rank reads a slab of planes by itself."""
    def slabs() -> np.ndarray:
        sums = np.zeros(len(shapes), dtype=np.uint64)
        with h5py.File(path, "r") as file:
            if set(file[FIELDS_GROUP]) != set(shapes):
                raise ValueError("the manifest tells of other fields than it holds")
            for number, (name, shape) in enumerate(shapes.items()):
                dataset = file[f"{FIELDS_GROUP}/{name}"]
                if dataset.shape != shape or dataset.dtype != np.float64:
                    raise ValueError(f"field {name!r} has shape {dataset.shape} {dataset.dtype}, not {shape} float64")
                first, last = (shape[0] * r // mpi.size() for r in (mpi.rank(), mpi.rank() + 1))
                for low, high in layout.slabs(dataset, first, last):
                    block = Block(name, dataset[low:high], (low, 0, 0), shape)
                    sums[number:number + 1] += partial_checksums([block])
        return sums

    sums = attempt_together(slabs, f"{path}: damaged checkpoint", CheckpointError)
    return [as_text(value) for value in mpi.total(sums)]


def verify_checkpoint(path: str | os.PathLike) -> Manifest:
    """Read the whole checkpoint, all ranks sharing the work, and compare it with its manifest.

    Raises ``CheckpointError`` on all ranks when it is missing, unfinished or damaged.
    """
    path = pathlib.Path(path)
    manifest = attempt_on_root(lambda: read_manifest(path), f"cannot read {path}", CheckpointError)
    found = _file_checksums(path, {name: record.shape for name, record in manifest.fields.items()})
    for (name, record), checksum in zip(manifest.fields.items(), found, strict=True):
        if record.checksum != checksum:
            raise CheckpointError(f"{path}: damaged checkpoint: field {name!r} has another checksum")
    _read_attributes(path, manifest)
    return manifest


def _read_attributes(path: pathlib.Path, manifest: Manifest) -> dict:
    def read() -> dict:
        with h5py.File(path, "r") as file:
            text = layout.read_text(file, ATTRIBUTES)
        if text_digest(text) != manifest.attributes_sha256:
            raise ValueError("the attributes have another checksum")
        return json.loads(text)

    return attempt_on_root(read, f"{path}: damaged checkpoint", CheckpointError)


def _tile(requests: Mapping[str, Box], manifest: Manifest) -> bool:
    """Tell whether the requests of all ranks cover every field exactly once."""
    for name, record in manifest.fields.items():
        boxes = np.array(mpi.all_gather(requests.get(name, ((0, 0, 0), (0, 0, 0)))), dtype=np.int64)
        first, count = boxes[:, 0], boxes[:, 1]
        if count.prod(axis=1).sum() != np.prod(record.shape, dtype=np.int64):
            return False
        for one in range(len(boxes)):
            meet = (first[one] < first + count) & (first < first[one] + count[one])
            if (meet.all(axis=1) & (np.arange(len(boxes)) != one)).any():
                return False
    return True


def read_checkpoint(path: str | os.PathLike, requests: Mapping[str, Box]) -> tuple[dict[str, np.ndarray], dict]:
    """Return this rank's boxes of the fields, float64 [k, j, i], and the attributes (same on all ranks).

    ``requests`` maps a field to (start, shape), both (k, j, i). Planes of zeros take no memory. When the boxes of all
    ranks tile every field, the checksums are taken of what was read; else the file is verified by a pass of its own.
    Raises ``CheckpointError`` on all ranks when the file is damaged, or a field or box is not in it.
    """
    path = pathlib.Path(path)
    manifest = attempt_on_root(lambda: read_manifest(path), f"cannot read {path}", CheckpointError)
    attributes = _read_attributes(path, manifest)
    layout.raise_together(_unfit(path, requests, manifest), CheckpointError)
    tiled = _tile(requests, manifest)
    if not tiled:
        verify_checkpoint(path)

    def read() -> dict[str, np.ndarray]:
        with h5py.File(path, "r") as file:
            return {name: _read_box(file[f"{FIELDS_GROUP}/{name}"], start, shape)
                    for name, (start, shape) in requests.items()}

    arrays = attempt_together(read, f"{path}: damaged checkpoint", CheckpointError)
    if tiled:
        blocks = [Block(name, arrays[name], requests[name][0], record.shape)
                  for name, record in manifest.fields.items() if name in requests]
        sums = dict(zip((block.name for block in blocks), partial_checksums(blocks), strict=True))
        shares = np.array([sums.get(name, np.uint64(0)) for name in manifest.fields], dtype=np.uint64)
        for (name, record), checksum in zip(manifest.fields.items(), mpi.total(shares), strict=True):
            if record.checksum != as_text(checksum):
                raise CheckpointError(f"{path}: damaged checkpoint: field {name!r} has another checksum")
    return arrays, attributes


def _read_box(dataset: h5py.Dataset, start: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """Return the box of ``shape`` at ``start``; what is void in it takes as little memory as in a run."""
    found = sparse_zeros(shape)
    for low, high in layout.slabs(dataset, start[0], start[0] + shape[0], math.prod(shape[1:])):
        part = dataset[box_selection((low, *start[1:]), (high - low, *shape[1:]))]
        for k in np.flatnonzero(part.view(np.uint64).any(axis=(1, 2))):  # (-0 is something too)
            found[low - start[0] + k] = part[k]
    return found


def _unfit(path: pathlib.Path, requests: Mapping[str, Box], manifest: Manifest) -> str | None:
    for name, (start, shape) in requests.items():
        record = manifest.fields.get(name)
        if record is None:
            return f"{path}: no field {name!r}; it holds {', '.join(manifest.fields)}"
        if min(start) < 0 or any(a + n > whole for a, n, whole in zip(start, shape, record.shape, strict=True)):
            return (f"{path}: field {name!r} is {record.shape} (z, y, x); the box of {tuple(shape)} at {tuple(start)} "
                    "is not in it: another scene or cell size")
    return None


def list_checkpoints(folder: str | os.PathLike) -> list[pathlib.Path]:
    """Return the checkpoint files of ``folder``, oldest first, finished or not. No MPI.

    Raises ``InputError`` when the folder is not ours to read.
    """
    found = [(key, path) for path in places.entries(folder) if (key := layout.checkpoint_key(path.name)) is not None]
    return [path for _, path in sorted(found)]


def _listed(folder: pathlib.Path) -> list[pathlib.Path]:
    if places.kind(folder) != places.FOLDER:
        raise InputError(f"{folder}: no such folder; is {folder.parent} the folder of a run?")
    return list_checkpoints(folder)


def set_aside_after(path: pathlib.Path) -> list[pathlib.Path]:
    """Give every checkpoint newer than ``path``, which verifies, the ending of damaged ones; return those.

    They would count among those kept. What cannot be read, or renamed, stays. Collective, done by rank 0.
    """
    def rename() -> list[pathlib.Path]:
        moved = []
        for other in list_checkpoints(path.parent):
            newer = layout.checkpoint_key(other.name) > layout.checkpoint_key(path.name)
            if newer and os.access(other, os.R_OK):
                with contextlib.suppress(OSError):
                    for file in (manifest_path(other), other):
                        if file.exists():
                            file.rename(file.with_name(file.name + layout.DAMAGED))
                    moved.append(other)
        return moved

    return mpi.run_together(rename)


def newest_valid_checkpoint(folder: str | os.PathLike) -> tuple[pathlib.Path, list[str]]:
    """Return the newest checkpoint that verifies, and a line about each newer one that does not.

    Raises ``CheckpointError`` on all ranks when there is none, saying what was wrong with each; ``InputError`` when
    there is no such folder, or it is not ours to read.
    """
    folder = pathlib.Path(folder)
    skipped: list[str] = []
    for path in reversed(mpi.run_together(_listed, folder)):
        if not mpi.run_together(os.access, path, os.R_OK):
            skipped.append(f"skipped {path}: cannot be read (Permission denied)")
            continue
        try:
            verify_checkpoint(path)
            return path, skipped
        except CheckpointError as error:
            skipped.append(f"skipped {error}")
    raise CheckpointError("; ".join([f"{folder}: no valid checkpoint to continue from", *skipped]))


def saved_shapes(path: str | os.PathLike) -> dict[str, tuple[int, int, int]]:
    """Return the shape of every field of a checkpoint. Collective; raises ``CheckpointError`` on all ranks."""
    path = pathlib.Path(path)
    manifest = attempt_on_root(lambda: read_manifest(path), f"cannot read {path}", CheckpointError)
    return {name: record.shape for name, record in manifest.fields.items()}


def _complete(path: pathlib.Path) -> bool:
    try:
        read_manifest(path)
    except CheckpointError:
        return False
    return True


def _ends_of_cycles(paths: Sequence[pathlib.Path]) -> list[pathlib.Path]:
    """Return the checkpoints at the ends of cycles, in order: the first of those that have as many cycles done."""
    first: dict[int, pathlib.Path] = {}
    for path in paths:  # (in order)
        first.setdefault(layout.checkpoint_key(path.name)[0], path)
    return [path for cycle, path in first.items() if cycle]


def prune(folder: str | os.PathLike, keep: int, every: int = 0) -> list[str]:
    """Delete all but the ``keep`` newest complete checkpoints; return the names of those deleted.

    The newest at the end of a cycle stays too, which analyses start from, those of each ``every``-th cycle, and those
    that were written to be kept. Nothing is deleted unless the newest one verifies. Also sweeps away what a crash left
    behind: unfinished files, and checkpoints older than the kept ones that never got a manifest.
    """
    folder = pathlib.Path(folder)
    if keep < 1:
        raise ValueError(f"keep = {keep}: at least one checkpoint must stay")
    context = f"cannot clean {folder}"

    def complete_ones() -> list[pathlib.Path]:
        return [path for path in list_checkpoints(folder) if _complete(path)]

    complete = attempt_on_root(complete_ones, context, CheckpointError)
    if not complete:
        return []
    try:
        verify_checkpoint(complete[-1])
    except F2SError:
        return []

    def remove() -> list[str]:
        oldest = layout.checkpoint_key(complete[-keep:][0].name)
        ends = _ends_of_cycles(complete)
        archive = {path for path in ends if every and layout.checkpoint_key(path.name)[0] % every == 0} | set(ends[-1:])
        archive |= {path for path in complete if read_manifest(path).archived}
        doomed = [path for path in list_checkpoints(folder)
                  if layout.checkpoint_key(path.name) < oldest and path not in archive]
        for path in doomed:
            # The manifest goes first: without it the checkpoint no longer counts.
            manifest_path(path).unlink(missing_ok=True)
            os.replace(path, path.with_name(f".{path.name}{layout.DELETED}"))
        for ending in (layout.DELETED, layout.PARTIAL):
            for path in folder.glob(f".checkpoint_*{ending}"):
                path.unlink(missing_ok=True)
        return [path.name for path in doomed]

    return attempt_on_root(remove, context, CheckpointError)
