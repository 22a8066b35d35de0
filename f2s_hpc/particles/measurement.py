"""In-flight measurements of single particles (diameter, velocity, place across the jet), and their CSV files.

The format: comment lines that begin with ``#``, a header, then one particle per row. The header names each column with
its unit, as in ``diameter [um],velocity [m/s],lateral position [mm],lateral velocity [m/s]``, in any order and any
unit of that kind; the lateral velocity may be left out.
"""

from __future__ import annotations

import difflib
import importlib.resources
import os
import re
from dataclasses import dataclass

import numpy as np

from f2s_hpc import units
from f2s_hpc.csv_rows import count_error, read_rows, split_rows
from f2s_hpc.errors import InputError

SYNTHETIC = "synthetic"
SYNTHETIC_FILE = "synthetic-in-flight.csv"
LEAST_PARTICLES = 20
"""A fit of three parameters with bands to fewer particles than this would tell nothing."""

# name in the header: dimension, documented unit, attribute
COLUMNS = {"diameter": ("length", "um"), "velocity": ("speed", "m/s"), "lateral position": ("length", "mm"),
           "lateral velocity": ("speed", "m/s")}
OPTIONAL = ("lateral velocity",)
EXAMPLE = ",".join(f"{name} [{unit}]" for name, (_, unit) in COLUMNS.items())
_HEAD = re.compile(r"\s*([A-Za-z_ ]+?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*")


@dataclass(frozen=True, eq=False)
class Measurement:
    """Particles measured in flight, arrays of shape (count,): ``diameter`` (m), ``velocity`` (m/s, along the jet),
    ``lateral_position`` (m, from the measuring device's own zero) and ``lateral_velocity`` (m/s), if it was measured.

    ``name`` says what was measured, or from which file.
    """

    name: str
    diameter: np.ndarray
    velocity: np.ndarray
    lateral_position: np.ndarray
    lateral_velocity: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of particles."""
        return self.diameter.size


def _columns(where: str, header: list[str]) -> list[tuple[str, float]]:
    """Return name and SI factor of each column; raises InputError for a header that is not understood."""
    found = []
    for text in header:
        match = _HEAD.fullmatch(text)
        name = " ".join(match[1].lower().replace("_", " ").split()) if match else text.strip()
        if name not in COLUMNS:
            close = difflib.get_close_matches(name, COLUMNS, 1, 0.6)
            hint = f'did you mean "{close[0]}"?' if close else f"the header must be like {EXAMPLE}"
            raise InputError(f'{where}: unknown column "{text.strip()}"; {hint}')
        dimension, unit = COLUMNS[name]
        if name in [other for other, _ in found]:
            raise InputError(f'{where}: column "{name}" is there twice')
        if not match[2]:
            raise InputError(f'{where}: column "{name}" needs its unit, as in {name} [{unit}]')
        try:
            found.append((name, units.parse(f"1 {match[2]}", dimension)))
        except units.UnitError as error:
            raise InputError(f'{where}: column "{text.strip()}": {error}') from None
    for name, (_, unit) in COLUMNS.items():
        if name not in OPTIONAL and name not in [other for other, _ in found]:
            raise InputError(f'{where}: column "{name} [{unit}]" is missing; the header must be like {EXAMPLE}')
    return found


def _number(text: str, where: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{where}: {name} is {text.strip()!r}, but must be a number")
    if name in ("diameter", "velocity") and value <= 0.0:
        raise InputError(f"{where}: {name} is {text.strip()}, but must be positive")
    return value


def read_measurement(path: str | os.PathLike) -> Measurement:
    """Return the particles of a CSV file in the format above, or of the packaged sample for the name "synthetic".

    Row 1 is the first particle; blank lines and those that begin with ``#`` are skipped. Raises InputError, one line
    that names the file and the row, for a file that cannot be read, a header without the columns or a unit, a value
    that is no number, a diameter or velocity that is not positive, and fewer than ``LEAST_PARTICLES`` particles.
    """
    if os.fspath(path) == SYNTHETIC:
        where, rows = SYNTHETIC_FILE, split_rows(SYNTHETIC_FILE, synthetic_text())
    else:
        where = str(path)
        rows = read_rows(path, f'a CSV file with a header like {EXAMPLE} is needed, or the name "{SYNTHETIC}"')
    if not rows:
        raise InputError(f"{where}: no header; the first line must be like {EXAMPLE}")
    columns = _columns(where, rows[0])
    values = np.empty((len(columns), len(rows) - 1))
    for number, row in enumerate(rows[1:], start=1):
        if len(row) != len(columns):
            raise count_error(f"{where}: row {number}", row, rows[0])
        for column, (text, (name, factor)) in enumerate(zip(row, columns)):
            values[column, number - 1] = factor * _number(text, f"{where}: row {number}", name)
    if len(rows) - 1 < LEAST_PARTICLES:
        raise InputError(f"{where}: {len(rows) - 1} particles; at least {LEAST_PARTICLES} are needed for the fits")
    named = {name.replace(" ", "_"): column for (name, _), column in zip(columns, values)}
    return Measurement(where, **named)


def synthetic_text() -> str:
    """Return the packaged synthetic sample as its CSV text."""
    return (importlib.resources.files("f2s_hpc") / "data" / SYNTHETIC_FILE).read_text(encoding="utf-8")
