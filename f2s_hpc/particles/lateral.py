"""Where particles fly across the jet: the sech distribution of number over lateral position.

Ge et al. 2026, section 5.1 and figure 8a; section 5.2.1 and figure 10 place the particles of a track by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from f2s_hpc.errors import InputError


def gudermannian(u: ArrayLike) -> np.ndarray:
    """Return gd(u), the integral of sech from 0 to u: 2 atan(tanh(u / 2)); tends to +-pi/2."""
    return 2.0 * np.arctan(np.tanh(0.5 * np.asarray(u, dtype=np.float64)))


@dataclass(frozen=True)
class SechProfile:
    """Number density over lateral position x, n(x) ~ sech((x - centre) / width); ``centre``, ``width`` in m.

    At 1.317 widths from the centre the density is half that of the centre; half of all particles fly within 0.881
    widths of it. Raises InputError for a width that is not positive.
    """

    centre: float
    width: float

    def __post_init__(self) -> None:
        if not self.width > 0.0:
            raise InputError(f"lateral distribution: a width of {1e3 * self.width:g} mm; it must be positive")

    def share(self, low: ArrayLike, high: ArrayLike) -> np.ndarray:
        """Return the share (0..1) of an unbounded jet's particles between ``low`` and ``high`` (m, any shapes)."""
        return (self._angle(high) - self._angle(low)) / np.pi

    def cdf(self, x: ArrayLike, low: float, high: float) -> np.ndarray:
        """Return the share of the particles in ``low``..``high`` (m) that lie below ``x`` (m, any shape).

        (gd(u) - gd(u_low)) / (gd(u_high) - gd(u_low)) with u = (x - centre) / width.
        """
        start, end = self._angle(low), self._angle(high)
        return (self._angle(np.clip(x, low, high)) - start) / (end - start)

    def quantile(self, q: ArrayLike, low: float, high: float) -> np.ndarray:
        """Return the position (m) in ``low``..``high`` below which the share ``q`` (0..1, any shape) lies.

        The inverse of :meth:`cdf`: x = centre + width asinh(tan(angle)), as gd(u) = atan(sinh(u)).
        """
        start, end = self._angle(low), self._angle(high)
        angle = start + np.asarray(q, dtype=np.float64) * (end - start)
        return np.clip(self.centre + self.width * np.arcsinh(np.tan(angle)), low, high)

    def sample(self, count: int, low: float, high: float, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` positions (m) drawn from the part of the profile in ``low``..``high`` (m)."""
        if not self._angle(high) > self._angle(low):
            raise InputError(f"batches.jet_centre: no particle flies between {1e3 * low:g} and {1e3 * high:g} mm; "
                             f"the jet's axis is at {1e3 * self.centre:g} mm, its width {1e3 * self.width:g} mm")
        return self.quantile(generator.random(count), low, high)

    def _angle(self, x: ArrayLike) -> np.ndarray:
        return gudermannian((np.asarray(x, dtype=np.float64) - self.centre) / self.width)

