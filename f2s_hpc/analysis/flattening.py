"""Flattening ratios of particles by Eqs. (5) and (6) of Ge et al. 2026, and their line of regression with bands.

Eq. (5): W_p / H_p. Eq. (6): W_p / D with D = (W_p^2 H_p)^(1/3), the diameter before impact by conservation of volume;
where the diameter itself is known, W_p / D is exact, and given beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from f2s_hpc.errors import InputError

LEAST_POINTS = 10
"""A particle with fewer material points has no shape."""

LEVEL = 0.9
"""Confidence level of all bands and intervals, as in Fig. 17."""


@dataclass(frozen=True)
class Flattening:
    """Sizes (m) and ratios of particles, each (p,); NaN where a particle could not be measured.

    ``width`` W_p, ``height`` H_p; ``equation_5`` W_p / H_p; ``diameter`` D of Eq. (6) from W_p and H_p;
    ``equation_6`` W_p / D; ``true_diameter``: the diameter before impact where it is known (else NaN), and
    ``exact_6`` W_p over it.
    """

    width: np.ndarray
    height: np.ndarray
    equation_5: np.ndarray
    diameter: np.ndarray
    equation_6: np.ndarray
    true_diameter: np.ndarray
    exact_6: np.ndarray

    @property
    def count(self) -> int:
        """Number of particles that were measured."""
        return int(np.isfinite(self.equation_5).sum())


@dataclass(frozen=True)
class Regression:
    """Line y = ``intercept`` + ``slope`` x through points, and half widths of its bands.

    ``slope_error``: standard error; ``residual``: standard deviation of the points about the line (n - 2);
    ``n``: number of points; ``centre``, ``spread``: mean of x and sum of (x - mean)^2.
    """

    slope: float
    intercept: float
    slope_error: float
    residual: float
    n: int
    centre: float
    spread: float

    def line(self, x: np.ndarray) -> np.ndarray:
        """Return the line at ``x``."""
        return self.intercept + self.slope * np.asarray(x)

    def confidence(self, x: np.ndarray) -> np.ndarray:
        """Return the half width of the band that holds the true line at ``x`` with probability ``LEVEL``."""
        return self._half_width(x, 0.0)

    def prediction(self, x: np.ndarray) -> np.ndarray:
        """Return the half width of the band that holds a further particle at ``x`` with probability ``LEVEL``."""
        return self._half_width(x, 1.0)

    def _half_width(self, x: np.ndarray, own: float) -> np.ndarray:
        quantile = stats.t.ppf(0.5 + 0.5 * LEVEL, self.n - 2)
        return quantile * self.residual * np.sqrt(own + 1.0 / self.n + (np.asarray(x) - self.centre) ** 2 / self.spread)


@dataclass(frozen=True)
class MeanDifference:
    """Difference of two means with its interval: ``difference`` (second less first), ``low``, ``high`` at ``LEVEL``."""

    first: float
    second: float
    difference: float
    low: float
    high: float

    @property
    def decided(self) -> bool:
        """Tell whether the interval leaves out zero."""
        return self.low > 0.0 or self.high < 0.0


def flattening_from_sizes(width: np.ndarray, height: np.ndarray, diameter: np.ndarray | None = None) -> Flattening:
    """Return the ratios of particles of ``width`` and ``height`` (m), (p,), and true ``diameter`` (m) where known.

    Raises ``InputError`` when the arrays differ in length.
    """
    width, height = np.asarray(width, dtype=float), np.asarray(height, dtype=float)
    true = np.full(width.shape, np.nan) if diameter is None else np.asarray(diameter, dtype=float)
    if not width.shape == height.shape == true.shape or width.ndim != 1:
        raise InputError(f"flattening: widths {width.shape}, heights {height.shape} and diameters {true.shape} must "
                         "be lists of one length")
    equivalent = np.cbrt(width**2 * height)
    return Flattening(width, height, width / height, equivalent, width / equivalent, true, width / true)


def flattening_from_points(particle_index: np.ndarray, position: np.ndarray, diameter: np.ndarray) -> Flattening:
    """Return the flattening of each particle from a cloud of its material points, in three dimensions.

    ``particle_index``: to which particle each point belongs, integers 0 to p - 1, (n,); ``position``: (x, y, z) of the
    points (m), (n, 3), z along the impact; ``diameter``: of the particles before impact (m), (p,).

    The points must stand for equal volumes, as points seeded evenly in the spheres do. Width and height are those of
    the ellipsoid with the same second moments, semi-axis a = sqrt(5 <(x - <x>)^2>), so they are exact for ellipsoids,
    do not depend on the number of points as the outermost ones do, and a thin jet does not count as the particle:
    H_p = 2 sqrt(5 var z), W_p = 2 sqrt(5 (var x + var y) / 2). A particle with fewer than ``LEAST_POINTS`` points is
    NaN. Raises ``InputError`` for arrays that do not fit together.
    """
    index, position = np.asarray(particle_index), np.asarray(position, dtype=float)
    diameter = np.asarray(diameter, dtype=float)
    if position.ndim != 2 or position.shape != (index.size, 3) or index.ndim != 1 or diameter.ndim != 1:
        raise InputError(f"flattening: particle_index {index.shape}, position {position.shape} and diameter "
                         f"{diameter.shape} must be (n,), (n, 3) and (p,)")
    if index.size and (index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= diameter.size):
        raise InputError(f"flattening: particle_index must be integers from 0 to {diameter.size - 1}")
    count = np.bincount(index, minlength=diameter.size)
    enough = count >= LEAST_POINTS
    divisor = np.where(enough, count, 1)
    variance = np.empty((3, diameter.size))
    for axis in range(3):
        mean = np.bincount(index, position[:, axis], diameter.size) / divisor
        variance[axis] = np.bincount(index, (position[:, axis] - mean[index]) ** 2, diameter.size) / divisor
    width = np.where(enough, 2.0 * np.sqrt(2.5 * (variance[0] + variance[1])), np.nan)
    height = np.where(enough, 2.0 * np.sqrt(5.0 * variance[2]), np.nan)
    return flattening_from_sizes(width, np.where(height > 0.0, height, np.nan), diameter)


def regression(x: np.ndarray, y: np.ndarray) -> Regression | None:
    """Return the line through the finite points (x, y) with bands at ``LEVEL``; None for fewer than four.

    Ordinary least squares; the bands follow Student's t with n - 2 degrees of freedom.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    keep = np.isfinite(x) & np.isfinite(y)
    x, y = x[keep], y[keep]
    if x.size < 4 or np.ptp(x) == 0.0:
        return None
    fit = stats.linregress(x, y)
    residue = y - fit.intercept - fit.slope * x
    return Regression(float(fit.slope), float(fit.intercept), float(fit.stderr),
                      float(np.sqrt((residue**2).sum() / (x.size - 2))), x.size, float(x.mean()),
                      float(((x - x.mean()) ** 2).sum()))


def mean_difference(first: np.ndarray, second: np.ndarray) -> MeanDifference | None:
    """Return the difference of the means of two samples with its interval (Welch's t); None below two values each.

    Not-a-numbers are left out.
    """
    first, second = (np.asarray(a, dtype=float)[np.isfinite(a)] for a in (first, second))
    if min(first.size, second.size) < 2 or first.var() + second.var() == 0.0:
        return None
    test = stats.ttest_ind(second, first, equal_var=False)
    interval = test.confidence_interval(LEVEL)
    return MeanDifference(float(first.mean()), float(second.mean()), float(second.mean() - first.mean()),
                          float(interval.low), float(interval.high))
