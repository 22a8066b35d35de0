"""Batches of spheres: the authors' CSV format, what they must keep to, volumes and speeds.

A batch's z is measured from the bottom of the particle layer, in files and in memory.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation, Overflow
from pathlib import Path

import numpy as np

from f2s_hpc import places
from f2s_hpc.csv_rows import count_error, read_rows
from f2s_hpc.errors import InputError
from f2s_hpc.particles.packing import smallest_gap_ratio, volume_inside
from f2s_hpc.particles.sizes import SMALLEST
from f2s_hpc.units import UnitError, parse, show

COLUMNS = ("x", "y", "z", "r")
VELOCITY_COLUMNS = ("vx", "vy", "vz")
TEMPERATURE_COLUMN = "temperature"
KNOWN_COLUMNS = (*COLUMNS, *VELOCITY_COLUMNS, TEMPERATURE_COLUMN)
LONGEST_QUOTE = 60  # characters of a bad value that a message shows: an unclosed quote swallows the rest of its file
RINGING = 0.6
"""A third of so much of the highest speed is what resting surfaces may ring with."""
LAYER_TOLERANCE = 1e-9  # of the layer height: a sphere written as touching the layer's end does not cross it


@dataclass(frozen=True, eq=False)
class Batch:
    """Spheres that enter together: centres ``x``, ``y``, ``z`` and radii ``r``, each (count,) float64 in metres.

    x and y from the corner of the box, z from the bottom of the particle layer. ``velocity`` (count, 3) float64 in m/s
    is each sphere's own (x, y, z), ``temperature`` (count,) float64 in K its own; None where all have the scene's.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    r: np.ndarray
    velocity: np.ndarray | None = None
    temperature: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of spheres."""
        return self.r.size

    @property
    def speed(self) -> np.ndarray | None:
        """Each sphere's own speed (count,) in m/s; None where all fly with the scene's velocity."""
        return None if self.velocity is None else np.linalg.norm(self.velocity, axis=1)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The arrays that it has, by their names, in the order of the constructor."""
        named = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        return {name: array for name, array in named if array is not None}

    def chosen(self, rows: np.ndarray | slice) -> Batch:
        """Return the batch of some of the spheres: a mask, indices or a slice."""
        return Batch(**{name: array[rows].copy() for name, array in self.columns.items()})

    def velocities(self, velocity: Sequence[float]) -> np.ndarray:
        """Return the velocity of each sphere (count, 3) in m/s: its own, or the scene's ``velocity``."""
        return np.tile(velocity, (self.count, 1)) if self.velocity is None else self.velocity

    def without_velocity(self) -> Batch:
        """Return the batch without velocities of its own."""
        return dataclasses.replace(self, velocity=None)

    def raised(self, height: float) -> Batch:
        """Return the batch with every z raised by ``height`` (m)."""
        return dataclasses.replace(self, z=self.z + height)


def _quoted(text: str) -> str:
    """Return a value for a message: in quotes, and of a very long one its start."""
    text = text.strip()
    return repr(text if len(text) <= LONGEST_QUOTE else text[:LONGEST_QUOTE] + "...")


def _metres(text: str, where: str, column: str) -> float:
    """Return a millimetre number as metres, rounded once (so that written batches read back bit for bit)."""
    try:
        value = float(Decimal(text.strip()).scaleb(-3))
    except (InvalidOperation, Overflow, ValueError):  # (a signalling NaN is no float)
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is {_quoted(text)}, but must be a number in millimetres, like 0.0402")
    return value


def _metres_per_second(text: str, where: str, column: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is {_quoted(text)}, but must be a number in m/s, like -615")
    return value


def _kelvin(text: str, where: str, column: str) -> float:
    """Return a temperature in degC as kelvin, rounded once, not below absolute zero."""
    try:
        value = parse(f"{text} degC", "temperature")
    except UnitError:
        value = math.nan
    if not value >= 0.0:
        raise InputError(f"{where}: {column} is {_quoted(text)}, but must be a number in degC, like 450")
    return value


def _check_header(path: Path, header: list[str]) -> None:
    for name in COLUMNS:
        if name not in header:
            raise InputError(f"{path}: column {name!r} is missing; the first line must be x,y,z,r (millimetres, no #), "
                             f"not {_quoted(','.join(header))}")
    for name in header:
        if name not in KNOWN_COLUMNS or header.count(name) > 1:
            raise InputError(f"{path}: unexpected column {_quoted(name)}; the first line must be x,y,z,r (millimetres),"
                             " after which vx,vy,vz (m/s) and temperature (degC) may come")
    velocities = [name for name in VELOCITY_COLUMNS if name in header]
    if velocities and len(velocities) < 3:
        raise InputError(f"{path}: column {','.join(velocities)} without the others; give all of vx,vy,vz or none")


def read_csv(path: str | os.PathLike, may_be_empty: bool = False) -> Batch:
    """Return the batch of a CSV file: first line ``x,y,z,r``, then one sphere per row, millimetres.

    The further columns ``vx,vy,vz`` (m/s) may give each sphere a velocity of its own, ``temperature`` (degC) its own.
    Row 1 is the first sphere; blank lines are skipped. Raises InputError, naming file and row, for a file that cannot
    be read, a missing or unexpected column, something that is no finite number, r <= 0, or no sphere at all
    unless it ``may_be_empty``.
    """
    path = Path(path)
    rows = read_rows(path, "a CSV file with the columns x,y,z,r is needed")
    if not rows:
        raise InputError(f"{path}: the file is empty; the first line must be x,y,z,r, then one sphere per row")
    header = [name.strip() for name in rows[0]]
    header = [name.lower() if name.lower() in KNOWN_COLUMNS else name for name in header]
    _check_header(path, header)
    order = [name for name in KNOWN_COLUMNS if name in header]
    kinds = dict.fromkeys(COLUMNS, _metres) | dict.fromkeys(VELOCITY_COLUMNS, _metres_per_second) | {
        TEMPERATURE_COLUMN: _kelvin}
    spheres = np.empty((len(rows) - 1, len(order)))
    for number, row in enumerate(rows[1:], start=1):
        where = f"{path}: row {number}"
        if len(row) != len(header):
            raise count_error(where, row, header)
        for column, text in zip(header, row):
            spheres[number - 1, order.index(column)] = kinds[column](text, where, column)
        if spheres[number - 1, 3] <= 0.0:
            radius_text = row[header.index("r")].strip()
            raise InputError(f"{where}: r is {radius_text}, but a radius must be positive (millimetres)")
    if not len(spheres) and not may_be_empty:
        raise InputError(f"{path}: no sphere below the header; one row x,y,z,r per sphere is needed")
    places = (np.ascontiguousarray(column) for column in spheres[:, :4].T)
    return Batch(*places,
                 velocity=np.ascontiguousarray(spheres[:, 4:7]) if VELOCITY_COLUMNS[0] in order else None,
                 temperature=np.ascontiguousarray(spheres[:, -1]) if TEMPERATURE_COLUMN in order else None)


def write_csv(path: str | os.PathLike, batch: Batch) -> None:
    """Write a batch in the authors' format (``x,y,z,r``, millimetres), so that ``read_csv`` returns the same bits.

    Spheres with velocities of their own get the columns ``vx,vy,vz`` (m/s) besides, with temperatures of their own
    ``temperature`` (degC).
    The decimal digits of each number in metres are shifted by three places: up to 17 significant digits, as many
    as needed. Written under another name first, so that no half-written file is left.
    Raises InputError if the place cannot be written.
    """
    spheres = zip(batch.x, batch.y, batch.z, batch.r)
    rows = [",".join(f"{Decimal(repr(float(value))).scaleb(3):f}" for value in sphere) for sphere in spheres]
    header = COLUMNS
    if batch.velocity is not None:
        header += VELOCITY_COLUMNS
        rows = [",".join([row, *map(repr, velocity)]) for row, velocity in zip(rows, batch.velocity.tolist())]
    if batch.temperature is not None:
        header += (TEMPERATURE_COLUMN,)
        celsius = (show(value, "temperature").removesuffix(" degC") for value in batch.temperature.tolist())
        rows = [f"{row},{value}" for row, value in zip(rows, celsius)]
    places.write_text(path, "\n".join([",".join(header), *rows]) + "\n")


def to_lists(batch: Batch) -> dict[str, list]:
    """Return the batch as lists by name, for JSON; :func:`from_lists` returns the same bits."""
    return {name: array.tolist() for name, array in batch.columns.items()}


def from_lists(saved: dict[str, list] | list[list]) -> Batch:
    """Return the batch of :func:`to_lists`, or of the lists in the constructor's order that older checkpoints hold."""
    if not isinstance(saved, dict):
        saved = dict(zip((*COLUMNS, "velocity"), saved))
    return Batch(**{name: np.array(values, dtype=float) for name, values in saved.items()})


def clipped_volume(batch: Batch, box_x: float, box_y: float, box_z: float) -> float:
    """Return the volume (m3) of the spheres inside the box 0..box_x, 0..box_y, 0..box_z (m): :func:`volume_inside`."""
    return volume_inside(batch.x, batch.y, batch.z, batch.r, (box_x, box_y, box_z))


def smallest_gap(batch: Batch) -> float:
    """Return the smallest centre distance over summed radii; below 1 two spheres overlap. Infinite for one sphere."""
    return float(smallest_gap_ratio(batch.x, batch.y, batch.z, batch.r))


def check_inside(batch: Batch, label: str, size_x: float, size_y: float, height: float) -> None:
    """Raise InputError, naming ``label`` and the row, for a sphere that is not in the particle layer, or is none.

    Spheres must lie within 0..height (m) and touch the footprint: a centre less than one radius away from
    0..size_x, 0..size_y (the side walls cut such a sphere).
    """
    slack = LAYER_TOLERANCE * height
    for row in range(batch.count):
        x, y, z, r = (float(values[row]) for values in (batch.x, batch.y, batch.z, batch.r))
        if 2.0 * r < SMALLEST:
            raise InputError(f"{label}: row {row + 1}: a radius of {1e3 * r:g} mm; it must be at least "
                             f"{500.0 * SMALLEST:g} mm")
        if z - r < -slack or z + r > height + slack:
            raise InputError(f"{label}: row {row + 1}: the sphere spans z = {1e3 * (z - r):.6g} to "
                             f"{1e3 * (z + r):.6g} mm, but the particle layer reaches from 0 to {1e3 * height:.6g} mm")
        for axis, centre, size in (("x", x, size_x), ("y", y, size_y)):
            if not -r < centre < size + r:
                raise InputError(f"{label}: row {row + 1}: the sphere at {axis} = {1e3 * centre:.6g} mm with radius "
                                 f"{1e3 * r:.6g} mm lies outside the box, {axis} from 0 to {1e3 * size:.6g} mm")
        if math.hypot(max(-x, x - size_x, 0.0), max(-y, y - size_y, 0.0)) >= r:
            raise InputError(f"{label}: row {row + 1}: the sphere at x, y = {1e3 * x:.6g}, {1e3 * y:.6g} mm with "
                             f"radius {1e3 * r:.6g} mm lies beyond a corner of the box")


def join(batches: Sequence[Batch | None]) -> Batch:
    """Return the spheres of all batches as one, in their order; what is empty or None adds nothing.

    Either all batches with spheres have velocities of their own or none, likewise temperatures: a plan sees to that.
    """
    filled = [batch.columns for batch in batches if batch is not None and batch.count]
    if not filled:
        return Batch(*(np.empty(0) for _ in COLUMNS))
    return Batch(**{name: np.concatenate([columns[name] for columns in filled])
                    for name in dict.fromkeys(name for columns in filled for name in columns)})


def stack(batches: Sequence[Batch], layer_height: float) -> Batch:
    """Return one batch: the given ones above each other, number i raised by i * layer_height (m)."""
    return join([batch.raised(index * layer_height) for index, batch in enumerate(batches)])


def flight_speed(batches: Sequence[Batch], top_speed: float) -> float:
    """Return the speed (m/s), a third of which tells material that has landed from what still flies.

    That of the fastest particle, but at most 1.4 times that of the slowest one that moves, which must not pass for
    landed in its flight (half of the nodes around a cell on its surface are at rest). Surfaces that rest ring with a
    fifth of the fastest one's speed, so that a third of less than ``RINGING`` of that tells nothing; slower particles
    then count as landed where they touch what lies. ``top_speed``: the highest of the scene (m/s), which spheres
    without a velocity of their own have.
    """
    speeds = [batch.speed for batch in batches if batch.velocity is not None]
    moving = [float(s[s > 0.0].min()) for s in speeds if (s > 0.0).any()]
    return max(min(top_speed, 1.4 * min(moving, default=top_speed)), RINGING * top_speed)
