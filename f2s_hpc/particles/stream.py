"""Fits to particles measured in flight: the four panels of figure 8 of Ge et al. 2026 (section 5.1), as numbers; sizes.

Number over lateral position is a sech, velocity over lateral position and lateral velocity over it are quadratic,
velocity over diameter is linear. Each fit states its coefficients with standard errors, R2, the spread about the curve
and 90 % *prediction* bands: where a further particle (or, for the number, a further measurement's bin) would fall with
a chance of 90 %, uncertainty of the curve included. Lateral positions count from the jet's axis, which is the centre of
the fitted sech, but for the sech itself, which tells where the axis is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares
from scipy.special import xlogy
from scipy.stats import chi2
from scipy.stats import t as student

from f2s_hpc.config.stream import FORMAT
from f2s_hpc.errors import InputError
from f2s_hpc.particles.lateral import SechProfile, gudermannian
from f2s_hpc.particles.measurement import Measurement
from f2s_hpc.particles.sizes import PERCENTILES, MeasuredSizes

CONFIDENCE = 0.90
LEAST_BINS, MOST_BINS = 8, 60

LEAST_SPAN, MOST_SPAN = 1e-9, 1e3
"""Range of lateral positions (m) beyond which their unit is wrong."""

LEAST_EXPECTED = 5.0
"""Particles expected in a pool of bins whose scatter is judged."""

LEAST_TOLD = 1e-9
"""A bin in which fewer particles are expected tells nothing of the curve."""

NARROWEST, FLATTEST = 1e-3, 3.0
"""Width, in measured ranges, that a sech is looked for from, and the widest that counts as one: it falls by 1.4 % from
its peak to the end of the range."""


@dataclass(frozen=True, eq=False)
class PolynomialFit:
    """Least squares y = sum over i of c_i x^i.

    ``coefficients``, ``errors`` (degree + 1,): c_i and their standard errors, SI; ``r2``: share of the variance that
    the curve explains; ``spread``: standard deviation about the curve, in units of y, with count - degree - 1 in the
    denominator; ``count``: number of particles; ``x_range``: smallest and largest x.
    """

    coefficients: np.ndarray
    errors: np.ndarray
    r2: float
    spread: float
    count: int
    x_range: tuple[float, float]
    inverse: np.ndarray = field(repr=False)
    scale: float = field(repr=False)

    def at(self, x: ArrayLike) -> np.ndarray:
        """Return the curve at ``x``."""
        return np.polynomial.polynomial.polyval(np.asarray(x, dtype=np.float64), self.coefficients)

    def band(self, x: ArrayLike) -> np.ndarray:
        """Return the half width of the 90 % prediction band at ``x``.

        t s sqrt(1 + a (A^T A)^-1 a^T) with a the row (1, x, x^2, ...) of the design matrix A, s the spread and t the
        0.95 quantile of Student's distribution with count - degree - 1 degrees of freedom.
        """
        row = _powers(x, self.scale, self.coefficients.size)
        leverage = np.square(row @ self.inverse).sum(axis=-1)
        freedom = self.count - self.coefficients.size
        return student.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * self.spread * np.sqrt(1.0 + leverage)


@dataclass(frozen=True, eq=False)
class NumberFit:
    """Number of particles per bin of lateral position, N(x) = peak sech((x - centre) / width).

    ``peak`` (particles per m on the axis), ``centre``, ``width`` (m) and ``errors`` (the three standard errors, in
    this order); ``r2`` over the bins; ``edges`` (bins + 1,) and ``counts`` (bins,) are what was fitted.
    ``dispersion``: variance of the bins over that of a Poisson count, which widens errors and bands: chi2 / ``freedom``
    (bins, pooled where few are expected, less 3) where chance alone gives so much less than once in twenty times,
    else 1.
    """

    peak: float
    centre: float
    width: float
    errors: np.ndarray
    r2: float
    dispersion: float
    freedom: int
    edges: np.ndarray
    counts: np.ndarray
    covariance: np.ndarray = field(repr=False)

    @property
    def profile(self) -> SechProfile:
        """The distribution, to draw from."""
        return SechProfile(self.centre, self.width)

    def at(self, x: ArrayLike) -> np.ndarray:
        """Return the expected number in a bin around ``x`` (m) as wide as those fitted."""
        half = 0.5 * (self.edges[1] - self.edges[0])
        x = np.asarray(x, dtype=np.float64)
        return _expected(np.array([self.peak, self.centre, self.width]), x - half, x + half)

    def band(self, x: ArrayLike) -> np.ndarray:
        """Return the half width of the 90 % prediction band of a bin's count around ``x`` (m).

        q sqrt(dispersion N + J C J^T): the count's own scatter and that of the curve, J the slopes of the curve by
        peak, centre and width, C their covariance; q the 0.95 quantile, normal where the dispersion is that of chance,
        else Student's with ``freedom``.
        """
        half = 0.5 * (self.edges[1] - self.edges[0])
        x = np.asarray(x, dtype=np.float64)
        slopes = _slopes(np.array([self.peak, self.centre, self.width]), x - half, x + half)
        own = np.einsum("...i,ij,...j->...", slopes, self.covariance, slopes)
        freedom = self.freedom if self.dispersion > 1.0 else np.inf
        return student.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * np.sqrt(self.dispersion * self.at(x) + own)


@dataclass(frozen=True, eq=False)
class StreamFit:
    """All fits to one measurement; ``lateral`` and what follows it are None where no lateral velocity was measured.

    ``number``: over lateral position; ``speed``: velocity (m/s) over the distance from the axis (m), quadratic;
    ``size``: velocity over diameter (m), linear; ``lateral``: lateral velocity over the distance from the axis,
    quadratic; ``lateral_mean``, ``lateral_spread`` (m/s): its mean and standard deviation over all particles, and
    ``lateral_mean_error`` the standard error of that mean. ``sizes``: the diameters; ``mixing``: their correlation with
    the squared distance from the axis: where it is 0 the laws over place and over diameter add.
    """

    measurement: Measurement
    number: NumberFit
    speed: PolynomialFit
    size: PolynomialFit
    lateral: PolynomialFit | None
    lateral_mean: float | None
    lateral_mean_error: float | None
    lateral_spread: float | None
    sizes: MeasuredSizes
    mixing: float

    @property
    def lateral_signed(self) -> bool:
        """Was the lateral velocity measured with its sign, so that it tells inwards from outwards?"""
        return self.lateral is not None and bool((self.measurement.lateral_velocity < 0.0).any())


def _powers(x: ArrayLike, scale: float, terms: int) -> np.ndarray:
    return (np.asarray(x, dtype=np.float64)[..., None] / scale) ** np.arange(terms)


def fit_polynomial(x: np.ndarray, y: np.ndarray, degree: int, label: str) -> PolynomialFit:
    """Return the ordinary least-squares polynomial of ``y`` (count,) over ``x`` (count,), by a QR factorisation.

    Raises InputError, naming ``label``, when x has fewer than degree + 1 different values or there is no particle to
    spare for the spread.
    """
    terms = degree + 1
    if x.size <= terms or np.unique(x).size < terms:
        raise InputError(f"{label}: {np.unique(x).size} different values; a polynomial of degree {degree} needs at "
                         f"least {terms}, and more than {terms} particles")
    scale = float(np.abs(x).max())
    design = _powers(x, scale, terms)
    q, r = qr(design, mode="economic")
    scaled = solve_triangular(r, q.T @ y)
    inverse = solve_triangular(r, np.eye(terms))  # (A^T A)^-1 = inverse inverse^T
    left = y - design @ scaled
    spread = float(np.sqrt(left @ left / (x.size - terms)))
    units = scale ** -np.arange(terms, dtype=float)
    errors = spread * np.sqrt(np.square(inverse).sum(axis=1)) * units
    return PolynomialFit(scaled * units, errors, _r2(y, left), spread, int(x.size),
                         (float(x.min()), float(x.max())), inverse, scale)


def _r2(y: np.ndarray, left: np.ndarray) -> float:
    total = float(np.square(y - y.mean()).sum())
    return 1.0 - float(left @ left) / total if total > 0.0 else 1.0


def _expected(parameters: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the number between ``low`` and ``high``: peak width (gd(u_high) - gd(u_low)), exact for any bin width."""
    peak, centre, width = parameters
    return peak * width * (gudermannian((high - centre) / width) - gudermannian((low - centre) / width))


def _slopes(parameters: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the derivatives of :func:`_expected` by peak, centre and width, shape (..., 3)."""
    peak, centre, width = parameters
    u, v = (low - centre) / width, (high - centre) / width
    first, last = 1.0 / np.cosh(u), 1.0 / np.cosh(v)
    angle = gudermannian(v) - gudermannian(u)
    return np.stack([width * angle, peak * (first - last), peak * (angle - v * last + u * first)], axis=-1)


def bin_count(count: int) -> int:
    """Return how many bins ``count`` particles are sorted into: 2 count^(1/3) (Rice's rule), within 8 and 60."""
    return int(np.clip(np.ceil(2.0 * count ** (1.0 / 3.0)), LEAST_BINS, MOST_BINS))


def fit_number(position: np.ndarray, label: str, bins: int | None = None) -> NumberFit:
    """Return the sech fitted to the counts of ``position`` (m, (count,)) in equal bins over the measured range.

    Maximum likelihood for Poisson counts (the least sum of squared deviance residuals), with the sech integrated over
    each bin: neither the width of the bins nor the end of the range biases the result. Standard errors from the
    Fisher information J^T diag(1/N) J, times the dispersion. Raises InputError, naming ``label``, when all positions
    are equal or no sech can be told from the counts.
    """
    low, high = float(position.min()), float(position.max())
    if not high > low:
        raise InputError(f"{label}: every lateral position is {1e3 * low:g} mm; a distribution needs a range")
    if not LEAST_SPAN <= high - low <= MOST_SPAN:
        raise InputError(f"{label}: the lateral positions go from {1e3 * low:.4g} to {1e3 * high:.4g} mm; a range from "
                         f"{1e3 * LEAST_SPAN:g} to {1e3 * MOST_SPAN:g} mm is possible: is their unit right?")
    bins = bin_count(position.size) if bins is None else bins
    counts, edges = np.histogram(position, bins=bins, range=(low, high))
    counts = counts.astype(float)
    span = high - low
    start = np.array([counts.max() * bins / span, float(np.median(position)), 0.55 * float(position.std())])

    def deviance(scaled: np.ndarray) -> np.ndarray:
        number = np.maximum(_expected(scaled * units, edges[:-1], edges[1:]), 1e-300)
        twice = 2.0 * (number - counts + xlogy(counts, np.maximum(counts, 1.0) / number))
        return np.sign(counts - number) * np.sqrt(np.maximum(twice, 0.0))

    units = np.array([start[0], span, span])
    bounds = ([1e-6, (low - span) / span, NARROWEST], [1e3, (high + span) / span, 10.0])
    if start[2] <= NARROWEST * span:
        raise InputError(f"{label}: nearly all lateral positions are in one place, and a few as far as "
                         f"{1e3 * low:.4g} and {1e3 * high:.4g} mm; are these right?")
    best = least_squares(deviance, start / units, bounds=bounds, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    # whether the search ends on a bound or just before it is a matter of rounding
    if (best.active_mask != 0).any() or best.x[2] > FLATTEST:
        raise InputError(f"{label}: the counts over the lateral position have no peak that a sech could describe "
                         f"({position.size} particles from {1e3 * low:.4g} to {1e3 * high:.4g} mm)")
    parameters = best.x * units
    number = _expected(parameters, edges[:-1], edges[1:])
    slopes = _slopes(parameters, edges[:-1], edges[1:]) * units
    dispersion, freedom = _dispersion(counts, number)
    told = number > LEAST_TOLD
    fisher = slopes[told].T @ (slopes[told] / number[told, None])
    covariance = dispersion * np.linalg.pinv(fisher, hermitian=True) * np.outer(units, units)
    errors = np.sqrt(np.diag(covariance))
    if not (np.isfinite(errors).all() and np.linalg.matrix_rank(fisher, hermitian=True) == fisher.shape[0]):
        raise InputError(f"{label}: the counts over the lateral position do not tell a sech's peak, centre and width "
                         f"({position.size} particles from {1e3 * low:.4g} to {1e3 * high:.4g} mm, in {bins} bins)")
    return NumberFit(*(float(p) for p in parameters), errors, _r2(counts, counts - number), dispersion, freedom,
                     edges, counts, covariance)


def _dispersion(counts: np.ndarray, number: np.ndarray) -> tuple[float, int]:
    """Return the dispersion of ``counts`` about the ``number`` expected (see ``NumberFit``) and its degrees of freedom.

    Neighbouring bins are pooled until ``LEAST_EXPECTED`` are expected in each: chi2 is no chi2 where one stray particle
    counts with the inverse of next to nothing.
    """
    pools = [[0.0, 0.0]]
    for found, expected in zip(counts, number):
        if pools[-1][1] >= LEAST_EXPECTED:
            pools.append([0.0, 0.0])
        pools[-1][0] += found
        pools[-1][1] += expected
    if len(pools) > 1 and pools[-1][1] < LEAST_EXPECTED:
        rest = pools.pop()
        pools[-1] = [pools[-1][0] + rest[0], pools[-1][1] + rest[1]]
    freedom = len(pools) - 3
    if freedom < 1:
        return 1.0, 0
    found, expected = np.array(pools).T
    scatter = float((np.square(found - expected) / expected).sum())
    return (scatter / freedom if scatter > chi2.ppf(0.95, freedom) else 1.0), freedom


def fit_stream(measurement: Measurement) -> StreamFit:
    """Return all fits to ``measurement``. Raises InputError, naming it, when one of them can not be made."""
    name = measurement.name
    number = fit_number(measurement.lateral_position, name)
    distance = measurement.lateral_position - number.centre
    speed = fit_polynomial(distance, measurement.velocity, 2, f"{name}: lateral position")
    size = fit_polynomial(measurement.diameter, measurement.velocity, 1, f"{name}: diameter")
    sizes = MeasuredSizes.of(measurement.diameter)
    mixing = float(np.corrcoef(measurement.diameter, distance**2)[0, 1])
    drift = measurement.lateral_velocity
    if drift is None:
        return StreamFit(measurement, number, speed, size, None, None, None, None, sizes, mixing)
    spread = float(drift.std(ddof=1))
    return StreamFit(measurement, number, speed, size,
                     fit_polynomial(distance, drift, 2, f"{name}: lateral position"),
                     float(drift.mean()), spread / np.sqrt(drift.size), spread, sizes, mixing)


def _polynomial_record(fit: PolynomialFit, names: Sequence[str]) -> dict:
    record = {name: {"value": float(c), "standard_error": float(e)}
              for name, c, e in zip(names, fit.coefficients, fit.errors)}
    return record | {"r2": fit.r2, "spread_m_s": fit.spread, "prediction_half_width_mid_m_s": float(
        fit.band(0.5 * sum(fit.x_range)))}


def _sizes_record(fit: StreamFit) -> dict:
    sizes = fit.sizes
    pairs = {f"d{100 * share:.0f}_m": pair for share, pair in zip(PERCENTILES, sizes.percentiles)}
    pairs |= {"mean_m": sizes.mean, "mean_volume_m3": sizes.mean_volume}
    return {"law": "d10, d50, d90 by volume; means by number",
            "min_m": {"value": sizes.smallest}, "max_m": {"value": sizes.largest},
            **{name: {"value": value, "standard_error": error} for name, (value, error) in pairs.items()},
            "correlation_with_squared_distance": fit.mixing}


def as_record(fit: StreamFit) -> dict:
    """Return the fits as what ``f2s stream --json`` writes: SI numbers, the unit in each name."""
    number = fit.number
    names = ("peak_per_m", "centre_m", "width_m")
    values = (number.peak, number.centre, number.width)
    record = {
        "format": FORMAT, "measurement": fit.measurement.name, "particles": fit.measurement.count,
        "bands": f"{100 * CONFIDENCE:g} % prediction bands",
        "diameter": _sizes_record(fit),
        "number_over_lateral_position": {
            "law": "peak sech((x - centre) / width)", "bins": int(number.counts.size), "r2": number.r2,
            "dispersion": number.dispersion,
            **{n: {"value": v, "standard_error": float(e)} for n, v, e in zip(names, values, number.errors)}},
        "velocity_over_lateral_position": {"law": "axis + slope u + curvature u^2, u = x - centre",
                                           **_polynomial_record(fit.speed, ("axis_m_s", "slope_1_s",
                                                                            "curvature_1_m_s"))},
        "velocity_over_diameter": {"law": "intercept + slope d",
                                   **_polynomial_record(fit.size, ("intercept_m_s", "slope_1_s"))}}
    if fit.lateral is not None:
        record["lateral_velocity"] = {
            "law": "axis + slope u + curvature u^2, u = x - centre",
            "signed": fit.lateral_signed,
            "mean_m_s": {"value": fit.lateral_mean, "standard_error": fit.lateral_mean_error},
            "standard_deviation_m_s": fit.lateral_spread,
            **_polynomial_record(fit.lateral, ("axis_m_s", "slope_1_s", "curvature_1_m_s"))}
    return record
