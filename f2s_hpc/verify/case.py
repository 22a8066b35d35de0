"""What a verification case is: its settings, the numbers it measures, and the bars they must meet.

A case is a function that runs the real solver at several resolutions and yields a :class:`Measured` for every
number it compares. Orders of convergence, verdicts, tables and plots follow from these.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from f2s_hpc import units
from f2s_hpc.errors import InputError

SCENE_SECTIONS = ("numerics.", "material.")
"""Sections of a scene whose keys every case takes."""


@dataclass(frozen=True)
class Measured:
    """One number measured at one resolution.

    ``error`` is what the bar applies to: relative to the reference unless the case's text says otherwise. ``bar``: the
    largest error allowed here (None: shown only). ``least_order``: least order of convergence from the next coarser
    resolution of the same quantity. ``compares``: False for quantities whose errors make no curve.
    """

    quantity: str
    resolution: float  # cells per characteristic length of the case
    dx_m: float
    value: float
    reference: float | None
    error: float
    bar: float | None = None
    least_order: float | None = None
    compares: bool = True
    steps: int = 0
    cell_steps: int = 0
    wall_s: float = 0.0


@dataclass(frozen=True)
class Row:
    """A measured number with its case, its observed order, and the verdict (None where nothing is asked)."""

    case: str
    measured: Measured
    order: float | None
    passed: bool | None


@dataclass(frozen=True)
class Case:
    """A verification case.

    ``settings``: name -> default as text, with its unit if it has one ("20 m/s", "0.5"); ``dimensions``: dimension (a
    key of ``units.DIMENSIONS``) of those that have one. ``quick``, ``full``: resolutions, coarse to fine. ``text`` says
    what is compared with what, and the source.
    """

    name: str
    text: str
    run: Callable[[Options], Iterator[Measured]]
    quick: tuple[float, ...]
    full: tuple[float, ...]
    settings: dict[str, str] = field(default_factory=dict)
    dimensions: dict[str, str] = field(default_factory=dict)

    def takes(self, override: str) -> bool:
        """Tell whether ``override`` ("name=value") names a setting of this case."""
        name = override.partition("=")[0].strip()
        return name in (*self.settings, "resolutions") or name.startswith(SCENE_SECTIONS)

    def options(self, full: bool, overrides: list[str]) -> Options:
        """Return the options of a run; ``overrides``: "name=value", "resolutions=8,12,16", "numerics.KEY=value"
        or "material.KEY=value".

        Raises ``InputError`` naming the setting and what would be right.
        """
        texts, levels, numerics = dict(self.settings), self.full if full else self.quick, []
        for override in overrides:
            name, equals, text = override.partition("=")
            name, text = name.strip(), text.strip().strip("\"'")
            if not equals:
                raise InputError(f"--set {override}: write it as NAME=VALUE")
            if name.startswith(SCENE_SECTIONS):
                numerics.append(override)
            elif name == "resolutions":
                levels = _resolutions(text)
            elif name in texts:
                texts[name] = text
            else:
                known = ", ".join([*texts, "resolutions", "numerics.KEY", "material.KEY"])
                raise InputError(f'--set {override}: case "{self.name}" has no setting "{name}" (it has {known})')
        return Options(full, tuple(levels), {name: self._value(name, text) for name, text in texts.items()},
                       tuple(numerics))

    def _value(self, name: str, text: str) -> float | str:
        dimension = self.dimensions.get(name)
        if dimension is not None:
            try:
                return units.parse(text, dimension)
            except units.UnitError as error:
                raise InputError(f"--set {name}: {error}") from None
        try:
            return float(text)
        except ValueError:
            return text


def _resolutions(text: str) -> tuple[float, ...]:
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        levels = ()
    positive = all(0.0 < level < math.inf for level in levels)  # (NaN is neither above nor below)
    if not levels or not positive or any(b <= a for a, b in itertools.pairwise(levels)):
        raise InputError(f'--set resolutions={text}: write rising numbers with commas, for example "8,12,16"')
    return levels


@dataclass(frozen=True)
class Options:
    """Options of one run of a case: full or quick size, resolutions coarse to fine, settings in SI, scene overrides."""

    full: bool
    levels: tuple[float, ...]
    values: dict[str, float | str]
    numerics: tuple[str, ...] = ()  # "numerics.KEY=value", "material.KEY=value", as f2s run --set takes them

    def __getitem__(self, name: str) -> float | str:
        return self.values[name]


def judged(case: str, measured: list[Measured]) -> list[Row]:
    """Return the rows of a case: observed orders between neighbouring resolutions, and verdicts."""
    rows, last = [], {}
    for m in measured:
        before, order = last.get(m.quantity), None
        if before is not None and m.compares and m.error > 0.0 and before.error > 0.0 and m.dx_m != before.dx_m:
            order = math.log(before.error / m.error) / math.log(before.dx_m / m.dx_m)
        last[m.quantity] = m
        checks = []
        if m.bar is not None:
            checks.append(bool(m.error <= m.bar))
        if m.least_order is not None:
            checks.append(order is not None and order >= m.least_order)
        rows.append(Row(case, m, order, all(checks) if checks else None))
    return rows


class Stopwatch:
    """Wall time since it was made (s)."""

    def __init__(self) -> None:
        self.start = time.perf_counter()

    def read(self) -> float:
        """Return the time passed (s)."""
        return time.perf_counter() - self.start
