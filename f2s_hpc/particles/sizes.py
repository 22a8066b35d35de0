"""Particle sizes: a Rosin-Rammler volume distribution, truncated to the sieved range of the powder, and measured ones.

Untruncated, the volume share of particles below diameter d is 1 - exp(-(d / scale)^exponent). A
powder sheet gives three percentiles for two parameters, so they are met in the least-squares sense.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from f2s_hpc.errors import InputError

PERCENTILES = (0.10, 0.50, 0.90)
TABLE_POINTS = 16385
MET = 1e-3
"""A relative deviation of a percentile that is none."""
FLAT = 7.0
"""How much farther the logarithm of the scale may go where the first range was too small."""
SMALLEST, WIDEST = 1e-12, 1e6
"""Least diameter (m), and the largest over it: the widest range to the largest exponent tried is still a number."""


@dataclass(frozen=True)
class MeasuredSizes:
    """Diameters of particles measured one by one; of each number its value and its standard error.

    ``percentiles``: three pairs, D10, D50 and D90 by volume (m); ``mean``: diameter (m) and ``mean_volume`` (m3), each
    particle counting once; ``smallest``, ``largest`` (m).
    """

    percentiles: tuple[tuple[float, float], ...]
    mean: tuple[float, float]
    mean_volume: tuple[float, float]
    smallest: float
    largest: float

    @classmethod
    def of(cls, diameter: np.ndarray) -> MeasuredSizes:
        """Return what the measured ``diameter`` (m, (count,), two at least) say.

        A percentile is read off the line through (cumulative volume less half the particle's own, diameter). Its error
        is that of Woodruff (1952): half the way between the percentiles at q - s and q + s, with s that of the
        volume share below it, s^2 = sum of v^2 (1 below or 0 above - q)^2 over the squared sum of v.
        """
        d = np.sort(diameter)
        share = (d / d[-1]) ** 3
        share /= share.sum()
        below = np.cumsum(share) - 0.5 * share
        percentiles = []
        for q in PERCENTILES:
            value = float(np.interp(q, below, d))
            s = np.sqrt(np.square(share * ((d <= value) - q)).sum())
            low, high = np.interp((q - s, q + s), below, d)
            percentiles.append((value, 0.5 * float(high - low)))
        volume = np.pi / 6.0 * d**3
        mean, mean_volume = ((float(v.mean()), float(v.std(ddof=1) / np.sqrt(v.size))) for v in (d, volume))
        return cls(tuple(percentiles), mean, mean_volume, float(d[0]), float(d[-1]))


@dataclass(frozen=True)
class RosinRammler:
    """Truncated Rosin-Rammler distribution of particle volume over diameter.

    ``scale`` (m) and ``exponent`` (-) as in 1 - exp(-(d / scale)^exponent); ``minimum`` and ``maximum`` (m)
    are the smallest and largest diameter.
    """

    scale: float
    exponent: float
    minimum: float
    maximum: float

    def __post_init__(self) -> None:
        if not (self.scale > 0 and self.exponent > 0 and 0 < self.minimum < self.maximum):
            raise InputError(f"particle sizes: {self} needs scale > 0, exponent > 0 and 0 < minimum < maximum")

    def volume_percentile(self, q: ArrayLike) -> np.ndarray:
        """Return the diameter (m) below which the volume share ``q`` (0..1, any shape) lies."""
        start, end = self._exponents_at_ends()
        power = start - np.log1p(np.asarray(q, dtype=np.float64) * np.expm1(start - end))
        return np.clip(self.scale * power ** (1.0 / self.exponent), self.minimum, self.maximum)

    def _exponents_at_ends(self) -> tuple[float, float]:
        return (self.minimum / self.scale) ** self.exponent, (self.maximum / self.scale) ** self.exponent

    @classmethod
    def fit(cls, d10: float, d50: float, d90: float, minimum: float, maximum: float) -> RosinRammler:
        """Return the distribution whose truncated volume percentiles come closest to D10, D50, D90 (m).

        Least squares in the logarithm of the diameters, so each percentile counts by its relative
        deviation; ``misfit`` tells what is left. Raises InputError unless minimum < D10 < D50 < D90 < maximum, and
        for a range that numbers cannot hold.
        """
        if not 0 < minimum < d10 < d50 < d90 < maximum:
            sizes = ", ".join(f"{1e6 * value:g}" for value in (minimum, d10, d50, d90, maximum))
            raise InputError("particle sizes: diameter_min < diameter_d10 < diameter_d50 < diameter_d90 < diameter_max "
                             f"is needed, not {sizes} um")
        if minimum < SMALLEST or maximum > WIDEST * minimum:
            raise InputError(f"particle sizes: diameters from {1e6 * minimum:g} to {1e6 * maximum:g} um; diameter_min "
                             f"must be at least {1e6 * SMALLEST:g} um, and diameter_max at most {WIDEST:,.0f} times "
                             "as large; are their units right?")
        # scipy takes a quarter of a second to load: only who generates particles pays
        from scipy.optimize import least_squares

        wanted = np.log([d10, d50, d90])

        def deviation(parameters: np.ndarray) -> np.ndarray:
            trial = cls(float(np.exp(parameters[0])), float(np.exp(parameters[1])), minimum, maximum)
            return np.log(trial.volume_percentile(PERCENTILES)) - wanted

        spread = np.log(np.log(0.1) / np.log(0.9)) / np.log(d90 / d10)
        bounds = ([np.log(minimum), np.log(0.05)], [np.log(maximum) + 1.0, np.log(50.0)])
        first = np.clip([np.log(d50), np.log(spread)], np.add(bounds[0], 1e-6), np.subtract(bounds[1], 1e-6))
        best = least_squares(deviation, first, bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        if best.x[0] > bounds[1][0] - 1e-3:
            # cut off so far below its scale, the powder is flat up to the largest diameter
            bounds[1][0] += FLAT
            best = least_squares(deviation, best.x, bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        elif best.x[0] < bounds[0][0] + 1e-3:
            # cut off so far above its scale, the powder falls from the smallest diameter on
            bounds[0][0] -= FLAT
            best = least_squares(deviation, best.x, bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        return cls(float(np.exp(best.x[0])), float(np.exp(best.x[1])), minimum, maximum)

    def misfit(self, d10: float, d50: float, d90: float) -> tuple[float, float, float]:
        """Return the relative deviations (this distribution's percentile / wanted - 1) of D10, D50, D90."""
        own = self.volume_percentile(PERCENTILES)
        return float(own[0] / d10 - 1.0), float(own[1] / d50 - 1.0), float(own[2] / d90 - 1.0)

    def message(self, d10: float, d50: float, d90: float) -> str:
        """Return one sentence: the fitted parameters and the percentiles they give against the wanted ones."""
        own = " / ".join(f"{1e6 * value:.1f}" for value in self.volume_percentile(PERCENTILES))
        wanted = " / ".join(f"{1e6 * value:.1f}" for value in (d10, d50, d90))
        met = max(map(abs, self.misfit(d10, d50, d90))) < MET
        return (f"particle sizes: Rosin-Rammler with scale {1e6 * self.scale:.2f} um and exponent {self.exponent:.3f} "
                f"has D10 / D50 / D90 of {own} um, wanted {wanted} um"
                + ("" if met else " (two parameters cannot meet all three)"))

    def mean_particle_volume(self) -> float:
        """Return the mean volume (m3) of a particle, each counting once: what divides a volume into a number.

        V = pi/6 / E[d^-3], the mean E over the volume distribution, because its number density is that density over
        d^3. Integrated over the logarithm u of d / scale: in t = exp(exponent u) the volume density is exp(-t), which
        has its peak at u = 0, one over the exponent wide, and is no number any more beyond t = start + 745.
        """
        from scipy.integrate import quad  # (loading scipy costs a third of a start)

        start, end = self._exponents_at_ends()
        k = self.exponent
        low, high = (np.log(t) / k for t in (start, min(end, start + 700.0)))
        peaks = [float(np.clip(place / k, low, high)) for place in (-20.0, -5.0, -1.0, 0.0, 1.0, 2.0)]
        inner = sorted({place for place in peaks if low < place < high})
        above, _ = quad(lambda u: k * np.exp(k * u + start - np.exp(k * u) - 3.0 * u), low, high, epsabs=0.0,
                        epsrel=1e-11, limit=500, points=inner or None)
        return float(np.pi / 6.0 * self.scale**3 * -np.expm1(start - end) / above)

    def sample_by_number(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` diameters (m), drawn particle by particle.

        The number density is the volume density over d^3, so that the drawn particles' volume follows
        this distribution; inverse of the cumulative number on a fine table in log(d).
        """
        from scipy.integrate import cumulative_trapezoid

        d = np.geomspace(self.minimum, self.maximum, TABLE_POINTS)
        power = (d / self.scale) ** self.exponent
        number_per_log_d = power * np.exp(power[0] - power) / d**3
        cumulative = cumulative_trapezoid(number_per_log_d, np.log(d), initial=0.0)
        diameters = np.interp(generator.random(count) * cumulative[-1], cumulative, d)
        return np.clip(diameters, self.minimum, self.maximum)
