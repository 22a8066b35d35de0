"""Profiles as CSV files: of an experiment to compare with, and of a deposit to work on with."""

from __future__ import annotations

import csv
import io
import math
import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from f2s_hpc import places
from f2s_hpc.analysis.profile import Profile
from f2s_hpc.csv_rows import read_rows
from f2s_hpc.errors import InputError

UNITS = {"mm": 1e-3, "um": 1e-6}
_HEADER = 'the first line must be "x_mm,height_mm" or "x_um,height_um"'


def read_profile(path: str | os.PathLike) -> Profile:
    """Return the profile of a CSV file: first line ``x_mm,height_mm`` or ``x_um,height_um``, then a point per row.

    Heights count from the substrate; further columns are ignored; the points are sorted by x. Raises ``InputError``,
    naming file and row, for a file that cannot be read, another first line, no number, or fewer than three points.
    """
    path = pathlib.Path(path)
    rows = read_rows(path, f"it should be a CSV file of a profile, {_HEADER}")
    header = [name.strip() for name in rows[0]] if rows else []
    unit = next((u for u in UNITS if {f"x_{u}", f"height_{u}"} <= set(header)), None)
    if unit is None:
        raise InputError(f"{path}: {_HEADER}, not {','.join(header)!r}")
    columns = [header.index(f"x_{unit}"), header.index(f"height_{unit}")]
    points = np.array([[_number(row, column, header, path, number) for column in columns]
                       for number, row in enumerate(rows[1:], start=1)]).reshape(-1, 2) * UNITS[unit]
    points = points[np.argsort(points[:, 0], kind="stable")]
    if len(points) < 3 or (np.diff(points[:, 0]) <= 0.0).any():
        raise InputError(f"{path}: {len(points)} points; a profile needs at least three, each at an x of its own")
    return Profile(points[:, 0], points[:, 1])


def _number(row: Sequence[str], column: int, header: Sequence[str], path: pathlib.Path, number: int) -> float:
    text = row[column].strip() if column < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: row {number}: {header[column]} is {text!r}, but must be a number")
    return value


def write_columns(path: pathlib.Path, columns: Mapping[str, Sequence]) -> None:
    """Write a CSV file with one named column per entry. Raises ``InputError`` when it cannot be written."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    places.write_text(path, text.getvalue(), newline="")
