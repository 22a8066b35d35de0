"""The particle stream for people: the fits as a table, and figures 8 and 10 of Ge et al. 2026 as PNG files."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from f2s_hpc.analysis.canvas import DPI, INK, save
from f2s_hpc.analysis.table import aligned
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.sizes import PERCENTILES
from f2s_hpc.particles.stream import NumberFit, PolynomialFit, StreamFit

_GREY, _POINT, _CURVE = "#555555", "#7a9cc6", "#b3331d"
_CURVE_POINTS = 201
_HEAD = ("fit", "coefficient", "value", "standard error", "unit", "R2", "90 % band")

# value and unit to print, from SI
_SPEED, _PER_MM, _PER_MM2 = (1.0, "m/s"), (1e-3, "m/s/mm"), (1e-6, "m/s/mm2")


def format_stream(fit: StreamFit) -> str:
    """Return the fits as text: a table of coefficients, then what it means and the keys for a scene.

    The band is the half width of the 90 % prediction band in the middle of the range, that of the number on the axis.
    """
    number, measured = fit.number, fit.measurement
    bin_width = 1e3 * (number.edges[1] - number.edges[0])
    rows = [("number over lateral position", "peak", f"{1e-3 * number.peak:.5g}", f"{1e-3 * number.errors[0]:.2g}",
             "1/mm", f"{number.r2:.3f}", f"+-{float(number.band(number.centre)):.3g}"),
            ("  peak sech(u / width)", "centre", f"{1e3 * number.centre:.4f}", f"{1e3 * number.errors[1]:.2g}", "mm",
             "", "particles"),
            ("  u = x - centre", "width", f"{1e3 * number.width:.4f}", f"{1e3 * number.errors[2]:.2g}", "mm", "",
             f"per {bin_width:.3g} mm")]
    terms = (("axis", *_SPEED), ("slope", *_PER_MM), ("curvature", *_PER_MM2))
    rows += _rows(("velocity over lateral position", "  axis + slope u + curvature u2"), fit.speed, terms)
    rows += _rows(("velocity over diameter", "  intercept + slope d"), fit.size,
                  (("intercept", *_SPEED), ("slope", 1e-6, "m/s/um")))
    if fit.lateral is not None:
        rows += _rows(("lateral velocity", "  axis + slope u + curvature u2"), fit.lateral, terms)
        rows += [("lateral velocity, all particles", "mean", f"{fit.lateral_mean:.4g}",
                  f"{fit.lateral_mean_error:.2g}", "m/s", "", ""),
                 ("", "std deviation", f"{fit.lateral_spread:.4g}", "", "m/s", "", "")]
    sizes = fit.sizes
    for share, (value, error) in zip(PERCENTILES, sizes.percentiles):
        rows.append(("" if share > PERCENTILES[0] else "diameter, by volume", f"D{100 * share:.0f}",
                     f"{1e6 * value:.2f}", f"{1e6 * error:.2g}", "um", "", ""))
    rows += [("diameter, by number", "mean", f"{1e6 * sizes.mean[0]:.2f}", f"{1e6 * sizes.mean[1]:.2g}", "um", "", ""),
             ("volume of a particle, by number", "mean", f"{1e18 * sizes.mean_volume[0]:.0f}",
              f"{1e18 * sizes.mean_volume[1]:.2g}", "um3", "", "")]
    low, high = sizes.smallest, sizes.largest
    at = ", ".join(f"{float(fit.size.at(d)):.1f} m/s at {1e6 * d:.1f} um" for d in (low, high))
    first = (f"{measured.name}: {measured.count} particles, diameters {1e6 * low:.1f} to {1e6 * high:.1f} um, "
             f"velocities {measured.velocity.min():.1f} to {measured.velocity.max():.1f} m/s")
    lines = [first, "", *aligned([_HEAD, *rows], left=(0, 1, 4, 5, 6), rule=True), "",
             f"velocity by the line over the diameter: {at}",
             f"diameter and squared distance from the axis: correlation {fit.mixing:.3f} (at 0 both laws add)",
             "bands: 90 % prediction bands, half width in the middle of the range, of the number on the axis"
             + ("" if number.dispersion == 1.0 else
                f"; counts scatter {number.dispersion:.2f} times as much as by chance alone (Poisson)")]
    return "\n".join(lines)


def _rows(labels: tuple[str, str], fit: PolynomialFit, terms: Sequence[tuple[str, float, str]]) -> list[tuple]:
    rows = []
    for index, (name, scale, unit) in enumerate(terms):
        label = labels[index] if index < len(labels) else ""
        first = (f"{fit.r2:.3f}", f"+-{float(fit.band(0.5 * sum(fit.x_range))):.3g} m/s") if index == 0 else ("", "")
        rows.append((label, name, f"{scale * fit.coefficients[index]:.5g}", f"{scale * fit.errors[index]:.2g}", unit,
                     *first))
    return rows


def draw_stream(fit: StreamFit, path: str | os.PathLike) -> None:
    """Draw the measured particles, the fitted curves and their 90 % prediction bands into the PNG file ``path``.

    Panels as in figure 8 of Ge et al. 2026: (a) number and (b) velocity over lateral position, (c) velocity over
    diameter, (d) lateral velocity over lateral position, where it was measured. The same input gives the same bytes.
    Raises ``F2SError`` when the file cannot be written.
    """
    measured, centre = fit.measurement, fit.number.centre
    with _plain_style():
        figure, axes = _figure((9.6, 6.8), 2, 2)
        position = measured.lateral_position
        _draw_number(axes[0, 0], fit.number)
        _draw_scatter(axes[0, 1], 1e3 * position, measured.velocity, fit.speed, lambda x: 1e-3 * x - centre,
                      ("(b) Velocity over lateral position", "lateral position (mm)", "velocity (m/s)"))
        _draw_scatter(axes[1, 0], 1e6 * measured.diameter, measured.velocity, fit.size, lambda d: 1e-6 * d,
                      ("(c) Velocity over diameter", "diameter (µm)", "velocity (m/s)"))
        if fit.lateral is None:
            axes[1, 1].axis("off")
            axes[1, 1].text(0.5, 0.5, "lateral velocity was not measured", ha="center", color=_GREY,
                            transform=axes[1, 1].transAxes)
        else:
            _draw_scatter(axes[1, 1], 1e3 * position, measured.lateral_velocity, fit.lateral,
                          lambda x: 1e-3 * x - centre,
                          ("(d) Lateral velocity over lateral position", "lateral position (mm)",
                           "lateral velocity (m/s)"))
        figure.suptitle(f"{measured.name}: {measured.count} particles; curves with 90 % prediction bands",
                        x=0.01, ha="left", fontsize=10, color=INK)
        save(figure, pathlib.Path(path), "plot")


def draw_batches(batches: Sequence[Batch], size_x: float, speed: float, path: str | os.PathLike) -> None:
    """Draw number and speed of each batch's particles over x into the PNG file ``path`` (figure 10b, c of the paper).

    ``size_x``: extent of the box along x (m); ``speed`` (m/s): of particles without a velocity of their own.
    Raises ``F2SError`` when the file cannot be written.
    """
    with _plain_style():
        figure, axes = _figure((9.6, 3.6), 1, 2)
        edges = np.linspace(0.0, 1e3 * size_x, 26)
        for number, batch in enumerate(batches, start=1):
            axes[0, 0].stairs(np.histogram(1e3 * batch.x, edges)[0], edges, color=f"C{(number - 1) % 10}",
                              label=f"batch {number}: {batch.count}")
            speeds = np.full(batch.count, speed) if batch.velocity is None else batch.speed
            axes[0, 1].plot(1e3 * batch.x, speeds, ".", markersize=2.0, color=f"C{(number - 1) % 10}")
        if len(batches) <= 10:
            axes[0, 0].legend(fontsize=7, frameon=False)
        _label(axes[0, 0], "(a) Number over x", "x (mm)", f"particles per {1e3 * (edges[1] - edges[0]):.3g} µm")
        _label(axes[0, 1], "(b) Speed over x", "x (mm)", "speed (m/s)")
        save(figure, pathlib.Path(path), "plot")


def _draw_number(axes: Any, fit: NumberFit) -> None:
    middle = 0.5 * (fit.edges[:-1] + fit.edges[1:])
    axes.bar(1e3 * middle, fit.counts, width=0.9e3 * (fit.edges[1] - fit.edges[0]), color=_POINT, linewidth=0)
    x = np.linspace(fit.edges[0], fit.edges[-1], _CURVE_POINTS)
    _draw_curve(axes, 1e3 * x, fit.at(x), fit.band(x))
    axes.set_ylim(bottom=0.0)
    _label(axes, f"(a) Number over lateral position, R2 = {fit.r2:.3f}", "lateral position (mm)",
           f"particles per {1e3 * (fit.edges[1] - fit.edges[0]):.3g} mm")


def _draw_scatter(axes: Any, x: np.ndarray, y: np.ndarray, fit: PolynomialFit, to_fit: Callable,
                  labels: tuple[str, str, str]) -> None:
    axes.plot(x, y, ".", markersize=2.0, color=_POINT, rasterized=True)
    shown = np.linspace(x.min(), x.max(), _CURVE_POINTS)
    _draw_curve(axes, shown, fit.at(to_fit(shown)), fit.band(to_fit(shown)))
    _label(axes, f"{labels[0]}, R2 = {fit.r2:.3f}", *labels[1:])


def _draw_curve(axes: Any, x: np.ndarray, y: np.ndarray, band: np.ndarray) -> None:
    axes.fill_between(x, y - band, y + band, color=_CURVE, alpha=0.15, linewidth=0)
    axes.plot(x, y, color=_CURVE, linewidth=1.4)


def _label(axes: Any, title: str, across: str, up: str) -> None:
    axes.set_title(title, fontsize=9, color=INK, loc="left")
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _plain_style() -> Any:
    """Return a context in which the user's own matplotlib settings do not reach the picture."""
    import matplotlib as mpl
    return mpl.rc_context(mpl.rcParamsDefault | {"font.size": 8.5, "axes.labelcolor": INK, "xtick.color": INK,
                                                 "ytick.color": INK, "axes.edgecolor": INK})


def _figure(size: tuple[float, float], rows: int, columns: int) -> tuple[Any, Any]:
    from matplotlib.figure import Figure
    figure = Figure(figsize=size, dpi=DPI, facecolor="white", layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
