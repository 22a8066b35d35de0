"""The proof that a checkpoint is whole: a small JSON file, written last, with a checksum per field.

The checksum of a field is the sum modulo 2^64, over its cells, of mix(bits of the value XOR mix(global
index + 1)). A sum does not depend on order, so any number of ranks finds the same one; ``mix`` is
invertible, so any single changed value changes it.
"""

from __future__ import annotations

import hashlib
import json
import pathlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

import f2s_hpc
from f2s_hpc import places
from f2s_hpc.errors import CheckpointError, InputError
from f2s_hpc.io import layout
from f2s_hpc.io.layout import Block

CELLS_AT_ONCE = 1 << 18
MASK = (1 << 64) - 1


@dataclass(frozen=True)
class FieldRecord:
    """Shape (nz, ny, nx) and checksum (16 hexadecimal digits) of one field."""

    shape: tuple[int, int, int]
    checksum: str


@dataclass(frozen=True)
class Manifest:
    """What a checkpoint file must be: its size in bytes and the checksums of all that it holds."""

    path: pathlib.Path
    cycle: int
    step: int
    size: int
    fields: dict[str, FieldRecord]
    attributes_sha256: str
    scene_hash: str | None
    code_version: str
    archived: bool = False  # kept for good


def mix(bits: np.ndarray) -> np.ndarray:
    """Return well mixed bits, one to one, uint64 (SplitMix64; Steele, Lea and Flood 2014)."""
    mixed = bits * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(30)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    mixed ^= mixed >> np.uint64(27)
    mixed *= np.uint64(0x94D049BB133111EB)
    mixed ^= mixed >> np.uint64(31)
    return mixed


def partial_checksums(blocks: Sequence[Block]) -> np.ndarray:
    """Return this rank's share of the checksum of each block's field, uint64 (n,).

    The shares of all ranks add up, modulo 2^64, to the checksum of the field.
    """
    sums = [0] * len(blocks)
    groups: dict[tuple, list[int]] = {}
    for number, block in enumerate(blocks):
        groups.setdefault((tuple(block.start), block.data.shape, tuple(block.global_shape)), []).append(number)
    for (start, shape, global_shape), members in groups.items():
        if 0 in shape:
            continue
        _, ny, nx = global_shape
        planes = max(1, CELLS_AT_ONCE // (shape[1] * shape[2]))
        row = np.arange(start[2], start[2] + shape[2], dtype=np.uint64)
        column = np.arange(start[1], start[1] + shape[1], dtype=np.uint64)[:, None] * np.uint64(nx)
        for first in range(0, shape[0], planes):
            k = np.arange(first, min(first + planes, shape[0]), dtype=np.uint64) + np.uint64(start[0])
            place = mix(k[:, None, None] * np.uint64(ny * nx) + column + row + np.uint64(1))
            for number in members:
                data = np.ascontiguousarray(blocks[number].data[first:first + planes], dtype=np.float64)
                share = np.add.reduce(mix(data.view(np.uint64) ^ place).ravel(), dtype=np.uint64)
                sums[number] = (sums[number] + int(share)) & MASK
    return np.array(sums, dtype=np.uint64)


def as_text(checksum: np.uint64) -> str:
    """Return a checksum as 16 hexadecimal digits."""
    return f"{int(checksum):016x}"


def text_digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def manifest_path(checkpoint: pathlib.Path) -> pathlib.Path:
    """Return the manifest's name beside a checkpoint file."""
    return checkpoint.with_suffix(".json")


def write_manifest(path: pathlib.Path, blocks: Sequence[Block], checksums: Sequence[str], attributes: str,
                   archived: bool = False) -> None:
    """Write the manifest of the finished checkpoint ``path``; ``attributes`` is its JSON text. Rank 0.

    ``archived``: the checkpoint shall be kept for good.
    """
    cycle, step, _ = layout.checkpoint_key(path.name)
    values = json.loads(attributes)
    record = {
        "format": layout.FORMAT_VERSION,
        "file": path.name,
        "cycle": cycle,
        "step": step,
        "size": path.stat().st_size,
        "fields": {block.name: asdict(FieldRecord(tuple(map(int, block.global_shape)), checksum))
                   for block, checksum in zip(blocks, checksums, strict=True)},
        "attributes_sha256": text_digest(attributes),
        "scene_hash": values.get("scene_hash"),
        "code_version": values.get("code_version", f2s_hpc.__version__),
        "archived": archived,
        "complete": True,
    }
    layout.write_text_file(manifest_path(path), layout.encode_json(record) + "\n")


def _kind(path: pathlib.Path) -> str:
    try:
        return places.kind(path)
    except InputError as error:
        raise CheckpointError(str(error)) from None


def read_manifest(path: pathlib.Path) -> Manifest:
    """Return the manifest of checkpoint ``path`` and test the file's size against it. No MPI.

    Raises ``CheckpointError`` when the manifest is missing, unreadable or of another file, or when the
    checkpoint is missing or of another size.
    """
    place = manifest_path(path)
    if _kind(place) == places.NOTHING:
        raise CheckpointError(f"{path}: no manifest {place.name}, so the checkpoint was never finished")
    try:
        record = json.loads(place.read_text(encoding="utf-8"))
        complete, version = record["complete"], record["format"]
        fields = {name: FieldRecord(tuple(entry["shape"]), entry["checksum"])
                  for name, entry in record["fields"].items()}
        found = Manifest(path, record["cycle"], record["step"], record["size"], fields,
                         record["attributes_sha256"], record["scene_hash"], record["code_version"],
                         record.get("archived") is True)
        name = record["file"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{place}: damaged manifest ({type(error).__name__}: {error})") from None
    if not fields:
        raise CheckpointError(f"{place}: damaged manifest: it tells of no field")
    if version != layout.FORMAT_VERSION:
        raise CheckpointError(f"{place}: checkpoint format {version}, this version reads {layout.FORMAT_VERSION}")
    if complete is not True or name != path.name:
        raise CheckpointError(f"{place}: not the manifest of a complete {path.name}")
    if _kind(path) != places.FILE:
        raise CheckpointError(f"{path}: the manifest is there, the checkpoint file is missing")
    if path.stat().st_size != found.size:
        raise CheckpointError(f"{path}: {path.stat().st_size} bytes, the manifest says {found.size}")
    return found
