"""Compare two runs, field by field, bit by bit: frames, view, tracers, common checkpoints and the cycle table.

Serial, from the files. How a run was computed (ranks, wall time, memory, speed) is not a result and is
left out; what it computed must be equal in every bit for the runs to be ``identical``.
"""

from __future__ import annotations

import math
import os
import pathlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc import places
from f2s_hpc.errors import CheckpointError, F2SError, InputError
from f2s_hpc.io import layout
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.manifest import read_manifest
from f2s_hpc.io.runs import (
    list_frames,
    open_checkpoint_serial,
    open_frame,
    read_cycle_table,
    read_frame_meta,
    within_dwell,
)
from f2s_hpc.io.tracers import list_tracers, read_columns, tracer_path

NOT_A_RESULT = re.compile(r"wall_s|startup_s|.*_per_s|ranks|.*memory.*|eta.*|active_.*|imbalance|phases.*")
NOT_A_RESULT_ATTRIBUTE = re.compile(NOT_A_RESULT.pattern + r"|.*(wall|rank|host|unix|elapsed|resum|version|created).*"
                                    r"|seed|batches\.(cycles|sha256)")
INTEGER = re.compile(r"[+-]?[0-9]+")
VALUES_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Difference:
    """How one field, number or column differs between the two runs.

    ``place`` is such as "frame 3"; ``cycle`` the cycle, where known. ``maximum`` is the largest absolute
    difference (infinite where only one run is NaN, or text differs), ``relative`` the same over the range of
    the field in both runs; ``values`` counts the values compared, ``different`` those that are not equal in
    every bit, ``bits`` the bits that differ.
    """

    place: str
    cycle: int | None
    name: str
    maximum: float
    relative: float
    values: int
    different: int
    bits: int


@dataclass
class Comparison:
    """All that was compared. ``missing``: in one run only. ``notes``: told, but no difference in results."""

    first: pathlib.Path
    second: pathlib.Path
    differences: list[Difference] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Tell whether every saved bit is equal (NaN equal to the same NaN) and nothing is missing."""
        return bool(self.differences) and not self.missing and all(d.different == 0 for d in self.differences)


def compare_arrays(place: str, cycle: int | None, name: str, a: np.ndarray, b: np.ndarray) -> Difference:
    """Return how two arrays of one floating type differ; other shapes or types differ everywhere."""
    a, b = np.ravel(a), np.ravel(b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return Difference(place, cycle, name, math.inf, math.inf, max(a.size, b.size), max(a.size, b.size), 0)
    integer = np.dtype(f"u{a.dtype.itemsize}")
    maximum, low, high, different, bits = 0.0, math.inf, -math.inf, 0, 0
    for first in range(0, a.size, VALUES_AT_ONCE):
        x, y = a[first:first + VALUES_AT_ONCE], b[first:first + VALUES_AT_ONCE]
        flipped = x.view(integer) ^ y.view(integer)
        flipped = flipped[flipped != 0]
        different += flipped.size
        bits += int(np.unpackbits(flipped.view(np.uint8)).sum())
        finite = np.concatenate([x[np.isfinite(x)], y[np.isfinite(y)]])
        if finite.size:
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
        unequal = (x != y) & ~(np.isnan(x) & np.isnan(y))
        if unequal.any():
            gap = np.abs(x[unequal].astype(np.float64) - y[unequal].astype(np.float64))
            maximum = max(maximum, float(np.where(np.isnan(gap), math.inf, gap).max()))
    return Difference(place, cycle, name, maximum, _relative(maximum, high - low), a.size, different, bits)


def _relative(maximum: float, extent: float) -> float:
    if maximum == 0.0:
        return 0.0
    return maximum / extent if extent > 0.0 else math.inf


def _compare_numbers(place: str, cycle: int | None, name: str, a: object, b: object) -> Difference:
    """Compare two single values: numbers, or text that may be a number."""
    try:
        if isinstance(a, (int, str)) and isinstance(b, (int, str)) and str(a) == str(b):
            return Difference(place, cycle, name, 0.0, 0.0, 1, 0, 0)
        x, y = float(a), float(b)
    except (TypeError, ValueError):
        same = a == b
        return Difference(place, cycle, name, 0.0 if same else math.inf, 0.0 if same else math.inf, 1, int(not same), 0)
    found = compare_arrays(place, cycle, name, np.array([x]), np.array([y]))
    scale = max(abs(x), abs(y))
    # Integers beyond 2^53 may differ and still be the same float.
    different = int(found.different > 0 or (isinstance(a, int) and a != b))
    return Difference(place, cycle, name, found.maximum, _relative(found.maximum, scale), 1, different, found.bits)


def _numbers(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Yield (dotted key, number) of every result in nested attributes; integers may be written as text."""
    if isinstance(value, dict):
        for key, entry in value.items():
            dotted = f"{path}.{key}" if path else str(key)
            if not any(NOT_A_RESULT_ATTRIBUTE.fullmatch(name) for name in (str(key), dotted)):
                yield from _numbers(entry, dotted)
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            yield from _numbers(entry, f"{path}[{number}]")
    elif isinstance(value, (int, float)):
        yield path, value
    elif isinstance(value, str) and INTEGER.fullmatch(value):
        yield path, int(value)


def _numbers_of_both(result: Comparison, found: list[set[int]], path: Callable[[pathlib.Path, int], pathlib.Path]
                     ) -> list[int]:
    """Return the numbers that both runs have, ascending; note the others, whose ``path`` is given, as missing."""
    for number in sorted(found[0] ^ found[1]):
        result.missing.append(f"{path(result.second if number in found[0] else result.first, number)}")
    return sorted(found[0] & found[1])


def _compare_frames(result: Comparison, series: str) -> None:
    """Compare the frames of one of ``layout.SERIES``."""
    folders = (result.first, result.second)
    found = [set(list_frames(folder, series)) for folder in folders]
    for number in _numbers_of_both(result, found, lambda folder, n: folder / series / layout.frame_name(n)):
        place = f"{'frame' if series == layout.FRAMES else series} {number}"
        try:
            metas = [read_frame_meta(folder / series / layout.frame_name(number)) for folder in folders]
            cycle = metas[0].provenance.get("cycle")
            for key in ("time_s", "cells", "origin", "spacing"):
                one, two = (np.atleast_1d(np.array(getattr(meta, key), dtype=np.float64)) for meta in metas)
                result.differences.append(compare_arrays(place, cycle, key, one, two))
            for key in _common(result, place, metas[0].locations, metas[1].locations):
                one, two = (open_frame(folder, number, [key], series)[0][key] for folder in folders)
                result.differences.append(compare_arrays(place, cycle, key, one, two))
        except F2SError as error:
            result.missing.append(str(error))


def _compare_tracers(result: Comparison) -> None:
    """Compare the points of the particles at the ends of cycles."""
    folders = (result.first, result.second)
    found = [set(list_tracers(folder)) for folder in folders]
    for cycle in _numbers_of_both(result, found, tracer_path):
        place = f"tracers of cycle {cycle}"
        try:
            tables = []
            for folder in folders:
                columns, time = read_columns(tracer_path(folder, cycle))
                tables.append({"time_s": np.array([time])} | columns)
            for key in _common(result, place, *tables):
                result.differences.append(compare_arrays(place, cycle, key, tables[0][key], tables[1][key]))
        except F2SError as error:
            result.missing.append(str(error))


def _common(result: Comparison, place: str, one: dict, two: dict) -> list[str]:
    """Return the keys of both; note the others as missing."""
    for key in [*(k for k in one if k not in two), *(k for k in two if k not in one)]:
        result.missing.append(f"{result.second if key in one else result.first}: {place}: {key}")
    return [key for key in one if key in two]


def _complete_checkpoints(folder: pathlib.Path, notes: list[str]) -> dict[tuple[int, int], pathlib.Path]:
    """Return the complete checkpoints of a run by (cycle, step); the last rewrite of each.

    But for those of a dwell after it: where a run was stopped is no result.
    """
    found = {}
    for path in list_checkpoints(folder / layout.CHECKPOINTS):
        key = layout.checkpoint_key(path.name)[:2]
        try:
            read_manifest(path)
            if key in found and within_dwell(open_checkpoint_serial(path, [])[1]):
                continue
        except CheckpointError as error:
            notes.append(str(error))
            continue
        found[key] = path
    return found


def _compare_checkpoints(result: Comparison) -> None:
    """Compare the checkpoints that both runs still hold; the newest must be the same one.

    Older ones may be gone from one run only: a stop adds a checkpoint, and only the last few are kept.
    """
    one, two = (_complete_checkpoints(folder, result.notes) for folder in (result.first, result.second))
    if (one or two) and max(one, default=None) != max(two, default=None):
        result.missing.append(f"newest checkpoint (cycle, step): {max(one, default='none')} in {result.first}, "
                              f"{max(two, default='none')} in {result.second}")
    for key in sorted(one.keys() ^ two.keys()):
        result.notes.append(f"checkpoint of cycle {key[0]} step {key[1]} only in {(one.get(key) or two[key]).parent}")
    for key in sorted(one.keys() & two.keys()):
        place, cycle = f"checkpoint cycle {key[0]} step {key[1]}", key[0]
        try:
            manifests = [read_manifest(path) for path in (one[key], two[key])]
            for name in _common(result, place, manifests[0].fields, manifests[1].fields):
                arrays = [open_checkpoint_serial(path, [name])[0][name] for path in (one[key], two[key])]
                result.differences.append(compare_arrays(place, cycle, name, *arrays))
            saved = [dict(_numbers(open_checkpoint_serial(path, [])[1])) for path in (one[key], two[key])]
            for name in _common(result, place, *saved):
                result.differences.append(_compare_numbers(place, cycle, name, saved[0][name], saved[1][name]))
        except F2SError as error:
            result.missing.append(str(error))


def _compare_tables(result: Comparison) -> None:
    """Compare the rows of summary.csv; its first column tells the cycle when it is named ``cycle``."""
    tables = [read_cycle_table(folder) for folder in (result.first, result.second)]
    if len(tables[0]) != len(tables[1]):
        result.missing.append(f"{layout.SUMMARY_CSV}: {len(tables[0])} rows in {result.first}, "
                              f"{len(tables[1])} in {result.second}")
    for number, (one, two) in enumerate(zip(*tables, strict=False)):
        label = one.get("cycle") or ""
        cycle = int(label) if label.isdigit() else None
        place = f"table row {number + 1}"
        rows = [{key: value for key, value in row.items() if key and not NOT_A_RESULT.fullmatch(key)}
                for row in (one, two)]
        for key in _common(result, place, *rows):
            result.differences.append(_compare_numbers(place, cycle, key, rows[0][key], rows[1][key]))


def compare_runs(first: str | os.PathLike, second: str | os.PathLike) -> Comparison:
    """Compare two run folders: frames, view, tracers, common checkpoints, result columns of the cycle table.

    Raises ``InputError`` when one of them is not a folder, or holds no run.
    """
    result = Comparison(pathlib.Path(first), pathlib.Path(second))
    for folder in (result.first, result.second):
        places.run_folder(folder)
        if not (list_frames(folder) or list_checkpoints(folder / layout.CHECKPOINTS) or read_cycle_table(folder)):
            raise InputError(f"{folder}: holds no frames, checkpoints or {layout.SUMMARY_CSV}; name a run's folder")
    for series in layout.SERIES:
        _compare_frames(result, series)
    _compare_tracers(result)
    _compare_checkpoints(result)
    _compare_tables(result)
    return result


def format_comparison(result: Comparison) -> str:
    """Return the comparison as text: what differs, what is missing, and the verdict as the last line."""
    differing = [d for d in result.differences if d.different]
    lines = []
    if differing:
        lines.append(f"{'where':<32} {'cycle':>5}  {'what':<28} {'max abs':>11} {'rel. range':>11} "
                     f"{'differing values':>24}")
    for d in differing:
        cycle = "-" if d.cycle is None else d.cycle
        lines.append(f"{d.place:<32} {cycle:>5}  {d.name:<28} {d.maximum:>11.4g} {d.relative:>11.4g} "
                     f"{f'{d.different} of {d.values}':>24}")
    lines += [f"missing: {text}" for text in result.missing]
    lines += [f"note: {text}" for text in result.notes]
    compared, values = f"{len(result.differences)} fields and numbers", sum(d.values for d in result.differences)
    if result.identical:
        lines.append(f"identical in every saved bit ({compared}, {values} values)")
    else:
        lines.append(f"not identical: {len(differing)} of {compared} ({values} values) differ, "
                     f"{len(result.missing)} missing")
    return "\n".join(lines)
