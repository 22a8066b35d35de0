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

from f2s_hpc.errors import InputError
from f2s_hpc.verify.setting import Setting

MATERIAL = "material."
SCENE_SECTIONS = ("numerics.", MATERIAL)
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


def _nothing_to_check(options: Options) -> None:
    """Take any options."""


@dataclass(frozen=True)
class Case:
    """A verification case.

    ``quick``, ``full``: resolutions, coarse to fine; ``least``: the coarsest that it can do, ``fewest``: how many it
    needs, ``whole``: only whole ones. ``check`` raises ``InputError`` for options that it can not run with, before
    anything runs. ``text`` says what is compared with what, and the source.
    """

    name: str
    text: str
    run: Callable[[Options], Iterator[Measured]]
    quick: tuple[float, ...]
    full: tuple[float, ...]
    settings: dict[str, Setting] = field(default_factory=dict)
    least: float = 1.0
    fewest: int = 1
    whole: bool = False
    check: Callable[[Options], None] = _nothing_to_check

    def takes(self, override: str) -> bool:
        """Tell whether ``override`` ("name=value") names a setting of this case."""
        name = override.partition("=")[0].strip()
        return name in (*self.settings, "resolutions") or name.startswith(SCENE_SECTIONS)

    def options(self, full: bool, overrides: list[str]) -> Options:
        """Return the options of a run; ``overrides``: "name=value", "resolutions=8,12,16", "numerics.KEY=value"
        or "material.KEY=value".

        Raises ``InputError`` naming the setting and what would be right.
        """
        values = {name: setting.read(name, setting.default) for name, setting in self.settings.items()}
        defaults, levels, scene = dict(values), self.full if full else self.quick, []
        for override in overrides:
            name, equals, text = override.partition("=")
            name, text = name.strip(), text.strip().strip("\"'")
            if not equals:
                raise InputError(f"--set {override}: write it as NAME=VALUE")
            if name.startswith(SCENE_SECTIONS):
                scene.append(override)
            elif name == "resolutions":
                levels = self._resolutions(text)
            elif name in values:
                values[name] = self.settings[name].read(name, text)
            else:
                known = ", ".join([*values, "resolutions", "numerics.KEY", "material.KEY"])
                raise InputError(f'--set {override}: case "{self.name}" has no setting "{name}" (it has {known})')
        changed = frozenset(name for name, value in values.items() if value != defaults[name])
        return Options(full, tuple(levels), values, tuple(scene), changed)

    def _resolutions(self, text: str) -> tuple[float, ...]:
        try:
            levels = tuple(float(part) for part in text.split(","))
        except ValueError:
            levels = ()
        possible = all(0.0 < level < math.inf for level in levels)  # (NaN is neither above nor below)
        if not levels or not possible or any(b <= a for a, b in itertools.pairwise(levels)):
            raise InputError(f'--set resolutions={text}: write rising numbers with commas, for example "8,12,16"')
        if levels[0] < self.least:
            raise InputError(f"--set resolutions={text}: {self.name} needs {self.least:g} or more, not {levels[0]:g}")
        broken = [level for level in levels if self.whole and level != round(level)]
        if broken:
            raise InputError(f"--set resolutions={text}: {self.name} needs whole numbers, not {broken[0]:g}")
        if len(levels) < self.fewest:
            raise InputError(f"--set resolutions={text}: {self.name} needs {self.fewest} resolutions or more")
        return levels


@dataclass(frozen=True)
class Options:
    """Options of one run of a case: full or quick size, resolutions coarse to fine, settings in SI, scene overrides.

    ``changed``: the settings that have another value than their default.
    """

    full: bool
    levels: tuple[float, ...]
    values: dict[str, float | str]
    overrides: tuple[str, ...] = ()  # "numerics.KEY=value", "material.KEY=value", as f2s run --set takes them
    changed: frozenset[str] = frozenset()

    def __getitem__(self, name: str) -> float | str:
        return self.values[name]

    def as_published(self, *free: str) -> bool:
        """Tell whether this is the problem that a published reference is of: all settings but the ``free`` ones are the
        case's own, and no constant of its material is replaced. Numerics may be: they are what is judged.
        """
        return self.changed <= set(free) and not any(o.strip().startswith(MATERIAL) for o in self.overrides)


def judged(case: str, measured: list[Measured]) -> list[Row]:
    """Return the rows of a case: observed orders between neighbouring resolutions, and verdicts.

    Where a bar or an order is asked for, a value or an error that is not finite has missed it.
    """
    rows, last = [], {}
    for m in measured:
        before, order = last.get(m.quantity), None
        if before is not None and m.compares and 0.0 < m.error < math.inf and 0.0 < before.error < math.inf and (
                m.dx_m != before.dx_m):
            order = math.log(before.error / m.error) / math.log(before.dx_m / m.dx_m)
        last[m.quantity] = m
        checks = []
        if m.bar is not None:
            checks.append(bool(m.error <= m.bar))
        if m.least_order is not None:
            checks.append(order is not None and order >= m.least_order)
        finite = math.isfinite(m.value) and math.isfinite(m.error)
        rows.append(Row(case, m, order, finite and all(checks) if checks else None))
    return rows


class Stopwatch:
    """Wall time since it was made (s)."""

    def __init__(self) -> None:
        self.start = time.perf_counter()

    def read(self) -> float:
        """Return the time passed (s)."""
        return time.perf_counter() - self.start
