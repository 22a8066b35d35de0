"""Settings of verification cases: what may be written for each, checked before anything runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from f2s_hpc import units
from f2s_hpc.config.messages import did_you_mean
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

NUMBER, WHOLE, TEXT, WORD = "number", "whole", "text", "word"
"""Kinds of settings: a number, a whole one, a text that the case reads itself, one of some words."""


@dataclass(frozen=True)
class Setting:
    """A setting of a case: its default as text ("20 m/s", "0.5"), and what may be written in its place.

    ``dimension``: key of ``units.DIMENSIONS`` of a number with a unit. A number must be finite, exceed ``above`` (SI)
    or, if there is a ``least``, be at least that, and at most ``most``. ``words``: texts that may stand for a number,
    or for a WORD all there are.
    """

    default: str
    dimension: str | None = None
    kind: str = NUMBER
    above: float = 0.0
    least: float | None = None
    most: float = math.inf
    words: tuple[str, ...] = ()

    def read(self, name: str, text: str) -> float | str:
        """Return the value of ``text`` in SI. Raises ``InputError``: the setting ``name``, what is wrong and right."""
        if self.kind == TEXT or text in self.words:
            return text
        if self.kind == WORD:
            raise InputError(f'--set {name}={text}: no such {name}; {did_you_mean(text, self.words)}')
        try:
            value = float(text) if self.dimension is None else units.parse(text, self.dimension)
        except units.UnitError as error:
            raise InputError(f"--set {name}: {error}{self._or_words()}") from None
        except ValueError:
            raise InputError(f"--set {name}={text}: {self._wanted()}") from None
        low = value > self.above if self.least is None else value >= self.least
        if not (low and value <= self.most and math.isfinite(value)) or (self.kind == WHOLE and value != round(value)):
            raise InputError(f"--set {name}={text}: {self._wanted()}")
        return round(value) if self.kind == WHOLE else value

    def _wanted(self) -> str:
        """Say what would be right."""
        what = "a whole number" if self.kind == WHOLE else (
            units.with_article(self.dimension) if self.dimension else "a number")
        low = f"above {self._shown(self.above)}" if self.least is None else f"from {self._shown(self.least)} on"
        if math.isfinite(self.most):
            low = low.removesuffix("on") + ("to" if self.least is not None else " and at most")
            low += f" {self._shown(self.most)}"
        return f"write {what} {low}{self._or_words()}"

    def _or_words(self) -> str:
        return "".join(f', or "{word}"' for word in self.words)

    def _shown(self, bound: float) -> str:
        return f"{bound:g}" if self.dimension is None else units.show(bound, self.dimension)


def material(default: str) -> Setting:
    """Return the setting of a material of the library."""
    return Setting(default, kind=WORD, words=library.names())
