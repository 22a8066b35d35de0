"""Single particles: against a published series, converging with the cell size, and where their energy goes.

Reference of the Johnson-Cook series: Abaqus/Explicit, coupled Eulerian-Lagrangian, copper on copper, D = 25 um, 24
cells per diameter, 80 ns (surrogate data set of Virtual-Twin-Cold-Spray; not validated by experiment). Its substrate is
15 D wide and deep; ours is 4 D wide and 3 D deep. Measured at 520 m/s and 8 cells per diameter, twice that size changes
flattening by 1.0 %, crater depth by 0.8 % and PEEQ p95 by 1.1 %: less than the bars and the step to the next mesh.

Its PEEQ is the output variable PEEQVAVG, an average over the cell, and its percentiles are weighted by volume fraction
over the cells at least 1 % full (its results file says both). In a cell that the surface cuts void counts as zero in
that average: the same file has PEEQVAVG lower and temperature, which is not averaged, higher when all cells count the
same instead, and its hottest cell has some 10 % more plastic work than its largest PEEQVAVG. So ours is measured alike.
That series does not say whether heat was conducted. Its temperatures say no: at 300 m/s the 95th percentile rises by
113 K there, by 119 K in an adiabatic Lagrangian solution, by 136 K here if adiabatic and by 68 K with conduction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from f2s_hpc.errors import InputError
from f2s_hpc.solver.ledger import ENERGY_TERMS
from f2s_hpc.verify import energy
from f2s_hpc.verify.case import Case, Measured, Options
from f2s_hpc.verify.setting import TEXT, WHOLE, Setting, material
from f2s_hpc.verify.splat import Impact, Splat, mean_splat, splat, splat_scene, splats

# speed (m/s): flattening, crater depth / D, particle PEEQ p95, particle temperature p95 (K)
PUBLISHED = {
    300.0: (0.3098, 0.177, 0.956, 410.8), 410.0: (0.3773, 0.282, 1.273, 468.1), 520.0: (0.4210, 0.395, 1.570, 512.8),
    630.0: (0.3859, 0.510, 1.804, 549.2), 740.0: (0.2961, 0.629, 1.971, 572.4), 850.0: (0.2201, 0.750, 2.140, 596.2),
}
PUBLISHED_CELLS = 24.0  # per diameter
ROOM = 298.15
JOHNSON_COOK = Impact("copper-johnson-cook", 25e-6, 520.0, ROOM, 80e-9)
GE = Impact("copper-ge", 30e-6, 615.0, 723.15, 80e-9)

ADIABATIC = "numerics.conduction=false"

MOST_PLACES = 32
PLACES = {"places": Setting("4", kind=WHOLE, least=1, most=MOST_PLACES)}
"""Setting of the cases that take a mean over places of the surface between two faces of the cells."""

LEAST_CELLS = 8.0
"""Cells per diameter from which on the energy that nothing explains has its bar, and numerical parts must fall."""

HALVED = 2
"""Resolutions, the coarsest of those, that the energy cases run with half the step too."""

SMALL, _CANCELLED = 0.003, 1e-3
"""Shares of the impact energy: below the first a numerical part may be above that of coarser cells, and where the error
of the step is below the second with the whole and with half the step, it is not judged whether it falls."""

LOSSES = ("hourglass", "light_nodes", "remap_kinetic", "remap_elastic", "closing")
NUMERICAL_TERMS = (*LOSSES, "half_kicks")
"""Energy terms that no physical process takes; the work of the shock viscosity joins them where it is not heated.
``LOSSES`` must fall with the cells. Half kicks give what remaps make of the forces, for which heat pays; they are shown
without a bar (Ge model, single place: 0.316, 0.320, 0.25 and 0.19 % at 8, 12, 18 and 24 cells per diameter)."""


def impact_of(options: Options, **changed: float) -> Impact:
    """Return the impact of the options; ``changed`` gives what they do not hold or what replaces it."""
    return Impact(**{name: options.values[name] for name in Impact.__dataclass_fields__ if name in options.values}
                  | changed)


def settings_of(base: Impact) -> dict[str, Setting]:
    """Return the settings of a case that varies ``base``."""
    return {
        "material": material(base.material), "diameter": Setting(f"{1e6 * base.diameter:g} um", "length"),
        "speed": Setting(f"{base.speed:g} m/s", "speed"),
        "temperature": Setting(f"{base.temperature:g} K", "temperature"),
        "duration": Setting(f"{1e9 * base.duration:g} ns", "time"),
        "half_width": Setting(f"{base.half_width:g}", above=0.5), "depth": Setting(f"{base.depth:g}", least=0.0)}


def places_of(options: Options) -> int:
    """Return how many places a case takes the mean over: one if it has no such setting."""
    return options.values.get("places", 1)


def check_scenes(options: Options, **changed: float) -> None:
    """Raise ``InputError`` if the scene of one of the resolutions is not possible; ``changed`` as in ``impact_of``."""
    for level in options.levels:
        splat_scene(impact_of(options, **changed), level, options.overrides)


# --- against the published series -------------------------------------------------------------------------------


def _speeds(options: Options) -> list[float]:
    """Return the speeds to run (m/s): the ones of the setting, or all published ones at full size."""
    text = options["speeds"]
    if text == "default":
        return list(PUBLISHED) if options.full else [520.0]
    try:
        speeds = [float(part) for part in str(text).split(",")]
    except ValueError:
        speeds = []
    if not speeds or any(speed not in PUBLISHED for speed in speeds):
        known = ", ".join(f"{speed:g}" for speed in PUBLISHED)
        raise InputError(f"--set speeds={text}: write published speeds in m/s with commas, out of {known}")
    return speeds


def check_published(options: Options) -> None:
    """Raise ``InputError`` for other speeds than the published ones, or scenes that are not possible."""
    for speed in _speeds(options):
        check_scenes(options, speed=speed)


def run_published(options: Options) -> Iterator[Measured]:
    """Yield flattening, crater depth / D and particle PEEQ p95 at each published speed; temperature has no bar.

    Another material, size or temperature than the published one has no reference.
    """
    as_published = options.as_published("speeds", "places")
    for speed in _speeds(options):
        flattening, crater, peeq, temperature = PUBLISHED[speed]
        for level in options.levels:
            impact = impact_of(options, speed=speed)
            runs = splats(impact, level, (ADIABATIC, *options.overrides), places_of(options))
            result = mean_splat(runs)
            # the bar is for the published resolution; what is coarser shows the way there
            bar = 0.06 if level >= PUBLISHED_CELLS else None
            rise = result.temperature_p95 - impact.temperature
            for name, value, reference, asked in (
                    ("flattening", result.flattening(PUBLISHED_CELLS), flattening, bar),
                    ("crater depth / D", result.crater / options["diameter"], crater, bar),
                    ("PEEQ p95", result.peeqvavg_p95, peeq, bar),
                    ("temperature rise p95", rise, temperature - ROOM, None)):
                compared = (reference, abs(value / reference - 1.0), asked) if as_published else (None, 0.0, None)
                yield Measured(f"{name}, {speed:g} m/s", level, result.dx, value, *compared,
                               compares=as_published and name != "temperature rise p95", **result.cost)
            yield Measured(f"PEEQ p95 of the material, {speed:g} m/s", level, result.dx, result.peeq_p95, None, 0.0,
                           compares=False, **result.cost)
            yield _unexplained(runs, result, level, f", {speed:g} m/s")


def _unexplained(runs: Sequence[Splat], result: Splat, level: float, of: str = "") -> Measured:
    """Return the row of the energy that nothing explains in the worst of ``runs``; a bar from ``LEAST_CELLS`` on."""
    return energy.row([run.balance for run in runs], level, result.dx, result.cost, of,
                      energy.BAR if level >= LEAST_CELLS else None)


# --- convergence ------------------------------------------------------------------------------------------------


LEAST_ORDER = 0.5
"""Bar of the order with which a particle's shape converges."""

ORDERS = (-2.0, 4.0)
"""Range in which the order is looked for: below zero the values run away as the cells get smaller."""


class Fit(NamedTuple):
    """The fit f = f0 + C h^p. ``limit``: f0, NaN where there is none; ``order``: p; ``at_edge``: of its range."""

    limit: float
    order: float
    at_edge: bool


def extrapolated(spacings: Sequence[float], values: Sequence[float]) -> Fit:
    """Return the fit f = f0 + C h^p to values at three or more spacings.

    For each p in ``ORDERS`` the best f0 and C follow from linear least squares; the p with the smallest rest wins
    (Richardson extrapolation where three values leave no rest). For p = 0 the power is the logarithm, its limit. There
    is no limit f0 where p is not above zero, nor at an edge of the range: values that turn back end there.
    """
    h, f = np.array(spacings) / max(spacings), np.array(values)
    orders = np.linspace(*ORDERS, 601).round(2)
    rests, solutions = [], []
    for order in orders:
        # (h^p - 1) / p is h^p but for a constant and a factor, and regular at p = 0
        power = np.log(h) if order == 0.0 else (h**order - 1.0) / order
        table = np.stack([np.ones_like(h), power], axis=1)
        solutions.append(np.linalg.lstsq(table, f, rcond=None)[0])
        rests.append(float(np.square(table @ solutions[-1] - f).sum()))
    best = int(np.argmin(rests))
    order, at_edge = float(orders[best]), best in (0, orders.size - 1)
    constant, factor = solutions[best]
    limit = float(constant - factor / order) if order > 0.0 and not at_edge else math.nan
    return Fit(limit, order, at_edge)


def _lengths(result: Splat, diameter: float) -> dict[str, float]:
    return {"width / D": result.width / diameter, "height / D": result.height / diameter, "PEEQ p95": result.peeq_p95}


def _scatters(runs: Sequence[Splat], mean: Splat, level: float, of: str = "") -> Iterator[Measured]:
    """Yield how far single runs are from their ``mean`` over all places, at most (relative); nothing with one place."""
    if len(runs) < 2:
        return
    for name, middle in _lengths(mean, 1.0).items():
        farthest = max(abs(_lengths(run, 1.0)[name] / middle - 1.0) for run in runs)
        yield Measured(f"{name}{of}: scatter by place", level, mean.dx, farthest, 0.0, farthest, compares=False,
                       **mean.cost)


def run_convergence(options: Options) -> Iterator[Measured]:
    """Yield width, height and PEEQ p95 from coarse to fine, against the finest run, and limit and order of the fit.

    The bar is on the order of the fit: errors against the finest run fall even where the values run away.
    """
    runs = [splats(impact_of(options), level, options.overrides, places_of(options)) for level in options.levels]
    results = [mean_splat(single) for single in runs]
    for single, mean, level in zip(runs, results, options.levels):
        yield from _scatters(single, mean, level)
        yield _unexplained(single, mean, level)
    series = [_lengths(result, options["diameter"]) for result in results]
    for name in series[0]:
        finest = series[-1][name]
        for result, values, level in zip(results[:-1], series, options.levels):
            yield Measured(name, level, result.dx, values[name], finest, abs(values[name] / finest - 1.0),
                           **result.cost)
        last = {"resolution": options.levels[-1], "dx_m": results[-1].dx, "compares": False, **results[-1].cost}
        yield Measured(f"{name}: finest", value=finest, reference=None, error=0.0, **last)
        fit = extrapolated([r.dx for r in results], [values[name] for values in series])
        if math.isfinite(fit.limit):
            yield Measured(f"{name}: limit of the fit", value=fit.limit, reference=finest,
                           error=abs(finest / fit.limit - 1.0), **last)
        # at an edge the order is that of the range, not of the values: none is known
        known = 0.0 if fit.at_edge else fit.order
        said = ", at the edge of its range" if fit.at_edge else ", no limit" if fit.order <= 0.0 else ""
        yield Measured(f"{name}: order of the fit{said}", value=fit.order, reference=LEAST_ORDER,
                       error=max(0.0, LEAST_ORDER - known), bar=0.0, **last)


# --- the paper's own cells --------------------------------------------------------------------------------------

PAPER_DIAMETERS = {"D10": 19e-6, "D50": 30e-6, "D90": 52e-6}
PAPER_CELLS = (4e-6, 3e-6)


def _paper_impacts(options: Options) -> Iterator[tuple[str, Impact, list[float]]]:
    """Yield name, impact, and cells per diameter, coarse to fine: the paper's cells and those of the options."""
    for name, diameter in PAPER_DIAMETERS.items() if options.full else [("D10", PAPER_DIAMETERS["D10"])]:
        # a larger particle takes longer to come to rest, in proportion
        impact = impact_of(options, diameter=diameter, duration=options["duration"] * diameter / GE.diameter)
        yield name, impact, sorted({*(diameter / dx for dx in PAPER_CELLS), *options.levels[:-1]})


def check_paper_cells(options: Options) -> None:
    """Raise ``InputError`` if one of the scenes is not possible."""
    for _, impact, levels in _paper_impacts(options):
        for level in (*levels, options.levels[-1]):
            splat_scene(impact, level, options.overrides)


def run_paper_cells(options: Options) -> Iterator[Measured]:
    """Yield the error of the paper's 4 um and 3 um cells for its D10, D50 and D90 particles, against finer cells.

    ``options.levels``: cells per diameter of the finer run that serves as reference (the last one), and of runs beside
    those with the paper's cells.
    """
    fine, places = options.levels[-1], places_of(options)
    for name, impact, levels in _paper_impacts(options):
        reference = _lengths(mean_splat(splats(impact, fine, options.overrides, places)), impact.diameter)
        for level in levels:
            runs = splats(impact, level, options.overrides, places)
            result = mean_splat(runs)
            for quantity, value in _lengths(result, impact.diameter).items():
                yield Measured(f"{quantity}, {name}", level, result.dx, value, reference[quantity],
                               abs(value / reference[quantity] - 1.0), **result.cost)
            yield from _scatters(runs, result, level, f", {name}")
            yield _unexplained(runs, result, level, f", {name}")


# --- energy -----------------------------------------------------------------------------------------------------


def _loss_bar(cells_per_diameter: float) -> float | None:
    if cells_per_diameter >= 12.0:
        return 0.08
    return 0.15 if cells_per_diameter >= 8.0 else None


def run_energy(options: Options) -> Iterator[Measured]:
    """Yield the shares of the impact energy: step and remainder, each numerical part, and the whole numerical loss."""
    impact, coarser = impact_of(options), {}
    halved = [level for level in options.levels if level >= LEAST_CELLS][:HALVED]
    for level in options.levels:
        result = splat(impact, level, options.overrides)
        share = {name: result.balance["energy"][name] / result.balance["energy"]["brought_in"]
                 for name in ENERGY_TERMS}
        yield from _shares(result, level, share, coarser)
        coarser = share if level >= LEAST_CELLS else {}
        if level in halved:
            yield from _remainder_falls(impact, result, level, options)


def _shares(result: Splat, level: float, share: dict[str, float], coarser: dict[str, float]) -> Iterator[Measured]:
    yield _unexplained([result], result, level)
    for name in (*NUMERICAL_TERMS, "shock_viscosity", "plastic_work", "heat"):
        numerical = name in NUMERICAL_TERMS
        # no numerical part may be above that of the coarser cells, unless both are small
        bar = max(abs(coarser[name]), SMALL) if name in LOSSES and coarser else None
        yield Measured(name, level, result.dx, share[name], 0.0 if numerical else None,
                       abs(share[name]) if numerical else 0.0, bar, compares=numerical, **result.cost)
    loss = result.balance["numerical_loss_fraction"]
    yield Measured("numerical loss", level, result.dx, loss, 0.0, loss, _loss_bar(level), **result.cost)


def _remainder_falls(impact: Impact, result: Splat, level: float, options: Options) -> Iterator[Measured]:
    """Yield the remainder with half the Courant number over that with the whole one; it must be below one.

    Where the parts of either sign cancel to under a thousandth in both, a ratio says nothing and is not judged.
    """
    limits = ("courant", "remap_courant", "strain_per_step", "strain_per_remap")
    halves = (f"numerics.{name}={0.5 * getattr(result.settings, name)!r}" for name in limits)
    halved = splat(impact, level, (*options.overrides, *halves))
    before, after = (abs(energy.unexplained(run.balance)) for run in (result, halved))
    ratio = after / before if before else math.inf if after else 0.0
    judged = max(before, after) > _CANCELLED
    yield Measured(f"{energy.QUANTITY}, half the step over whole", level, result.dx, ratio, None, ratio,
                   1.0 if judged else None, compares=False, **halved.cost)


_JC, _GE = settings_of(JOHNSON_COOK), settings_of(GE)
_SERIES = {name: s for name, s in _JC.items() if name != "speed"} | {"speeds": Setting("default", kind=TEXT)} | PLACES
_LEAST = 2.0

CASES = (
    Case("impact-jc",
         "25 um copper sphere on copper, Johnson-Cook, 80 ns, at the published speeds (--set speeds=300,520): "
         "flattening (second-moment height), crater depth / D on the axis and 95th percentile of PEEQ (averaged over "
         "cells, as there), against Abaqus CEL with 24 cells per diameter; adiabatic. Mean over places of the surface "
         "between two faces of the cells.",
         run_published, (6.0, 8.0, 12.0), (12.0, 18.0, 24.0), _SERIES, _LEAST, check=check_published),
    Case("impact-ge",
         "30 um copper sphere at 615 m/s and 450 degC on copper, Ge model: width and height (second moments) and PEEQ "
         "p95 of the particle, against the finest run; limit and order of the fit f0 + C dx^p over all resolutions. "
         "Means over places of the surface between two faces of the cells, and how far single places are from them. "
         "The bar is on that order: 0.5 or more (error: what is missing). A fit at an edge of its range, -2 to 4, is "
         "missed.",
         run_convergence, (6.0, 8.0, 12.0), (6.0, 8.0, 12.0, 16.0, 24.0), _GE | PLACES, _LEAST, 3,
         check=check_scenes),
    Case("impact-paper-cells",
         "Copper spheres of the paper's D10, D50 and D90 at 615 m/s and 450 degC, Ge model, with the paper's own cells "
         "of 4 and 3 um, and the stated cells per diameter: error of width, height and PEEQ p95 against the finest of "
         "these, of means over places of the surface in a cell, and how far single places are from them.",
         run_paper_cells, (8.0, 12.0), (16.0, 24.0), {n: s for n, s in _GE.items() if n != "diameter"} | PLACES,
         _LEAST, check=check_paper_cells),
    Case("energy-jc",
         "Energy of the 25 um Johnson-Cook sphere at 520 m/s, in shares of the impact energy: error of the explicit "
         "step with the remainder that no term explains (with half the step too), each numerical part, which from 8 "
         "cells on must not be above that of the coarser mesh or 0.3 %, and the whole numerical loss.",
         run_energy, (6.0, 8.0, 12.0), (8.0, 12.0, 18.0, 24.0), _JC, _LEAST, check=check_scenes),
    Case("energy-ge",
         "Energy of the 30 um Ge-model sphere at 615 m/s and 450 degC, in shares of the impact energy, likewise.",
         run_energy, (6.0, 8.0, 12.0), (8.0, 12.0, 18.0, 24.0), _GE, _LEAST, check=check_scenes),
)
