"""Work-precision plots: error against wall time, one of a case, and small multiples of all."""

from __future__ import annotations

import math
import pathlib
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from f2s_hpc.analysis.canvas import GREY, INK, save

_DPI = 160
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555", "#b8a800")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_MOST_CURVES = len(_COLOURS)
_COLUMNS = 3
_ROUND_OFF = 1e-14
"""An error this small is round-off; drawn, it would press all others of its plot together."""

Rows = Sequence[Mapping[str, Any]]


def curves(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    """Return, per quantity that compares, its rows with finite errors that say something, if finer took longer.

    Those that say something lie above round-off; it takes two.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["compares"] and _ROUND_OFF < row["error"] < math.inf and row["wall_s"] > 0.0:
            found.setdefault(row["quantity"], []).append(row)
    return {quantity: points for quantity, points in found.items()
            if len(points) > 1 and points[-1]["wall_s"] > 1.2 * points[0]["wall_s"]}


def draw_case(rows: Rows, path: pathlib.Path, title: str, subtitle: str) -> bool:
    """Draw error against wall time of one case, a curve per quantity that compares (the first eight); PNG at ``path``.

    ``rows``: mappings with quantity, resolution, value, reference, error, bar, wall_s, compares. The points of the
    highest curve carry their cells; bars stand as a dotted line or as dashes (:func:`_draw_bars`). Where no quantity
    makes a curve, errors or values over the resolution (:func:`_over_resolution`). Returns False, and writes nothing,
    if no row has a number that is finite.
    """
    lines, across, up = curves(rows), "wall_s", "error"
    if not lines:
        across = "resolution"
        lines, up = _over_resolution(rows)
    if not lines:
        return False
    figure = _figure((7.2, 4.8))
    axes = figure.add_axes((0.1, 0.125, 0.55, 0.71))
    _draw(axes, lines, across == "wall_s", across, up)
    if across == "resolution":
        marks = sorted({p[across] for points in lines.values() for p in points})
        axes.set_xticks(marks, labels=[f"{mark:g}" for mark in marks])
    axes.set_xlabel("wall time (s)" if across == "wall_s" else "resolution (cells, or what the case's text says)",
                    color=INK)
    axes.set_ylabel(up, color=INK)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(0.665, 0.845), frameon=False,
                  fontsize=8.5, labelcolor=INK, handlelength=1.8)
    figure.text(0.02, 0.965, title, fontsize=12, fontweight="bold", color=INK, va="top", parse_math=False)
    figure.text(0.02, 0.905, textwrap.shorten(subtitle, 105, placeholder=" ..."), fontsize=8.5, color=GREY, va="top",
                parse_math=False)
    save(figure, path, "plot")
    return True


def _over_resolution(rows: Rows) -> tuple[dict[str, list[Mapping[str, Any]]], str]:
    """Return, per quantity, the rows to draw over the resolution, and whether their "error" or "value" is to be drawn.

    What more quantities have: an error above round-off, or a value that nothing is compared with. Quantities with one
    point only are left out if others have more.
    """
    def grouped(chosen: Rows) -> dict[str, list[Mapping[str, Any]]]:
        found: dict[str, list[Mapping[str, Any]]] = {}
        for row in chosen:
            if math.isfinite(row["resolution"]):
                found.setdefault(row["quantity"], []).append(row)
        return {q: points for q, points in found.items() if len(points) > 1} or found

    values = [row for row in rows if math.isfinite(row["value"])]
    errors = grouped([row for row in rows if _ROUND_OFF < row["error"] < math.inf])
    shown = grouped([row for row in values if row["reference"] is None])
    if len(errors) >= max(len(shown), 1):
        return errors, "error"
    return shown or grouped(values), "value"


def draw_overview(rows: Rows, path: pathlib.Path) -> bool:
    """Draw the curves of every case as small multiples into one PNG; False if there is nothing to draw."""
    cases = {case: curves([row for row in rows if row["case"] == case])
             for case in dict.fromkeys(row["case"] for row in rows)}
    cases = {case: lines for case, lines in cases.items() if lines}
    if not cases:
        return False
    columns = min(_COLUMNS, len(cases))
    count = math.ceil(len(cases) / columns)
    figure = _figure((4.2 * columns, 3.3 * count + 0.4))
    grid = figure.subplots(count, columns, squeeze=False)
    for axes, (case, lines) in zip(grid.flat, cases.items()):
        _draw(axes, lines, marks=False)
        axes.set_title(case, fontsize=10, fontweight="bold", color=INK, loc="left", pad=4)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best", fontsize=6.5, frameon=True, framealpha=0.8, edgecolor="none", labelcolor=INK,
                        handlelength=1.4, borderpad=0.2, labelspacing=0.25)
    for axes in list(grid.flat)[len(cases):]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("error", color=INK, fontsize=9)
    for column in range(columns):
        last = max(r for r in range(count) if r * columns + column < len(cases))
        grid[last, column].set_xlabel("wall time (s)", color=INK, fontsize=9)
    figure.suptitle("Error against wall time", x=0.01, ha="left", fontsize=12, fontweight="bold", color=INK)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.985), h_pad=1.2, w_pad=1.0)
    save(figure, path, "plot")
    return True


def _figure(size: tuple[float, float]) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=size, dpi=_DPI, facecolor="white")


def _draw(axes: Any, lines: Mapping[str, list[Mapping[str, Any]]], marks: bool, across: str = "wall_s",
          up: str = "error") -> None:
    """Draw curves and bars; ``marks``: write the cells at the points of the curve that ends highest.

    ``across``, ``up``: the numbers of the rows on the axes.
    """
    shown = dict(list(lines.items())[:_MOST_CURVES])
    for number, (quantity, points) in enumerate(shown.items()):
        walls, errors = [p[across] for p in points], [p[up] for p in points]
        colour = _COLOURS[number]
        axes.loglog(walls, errors, color=colour, marker=_MARKERS[number], markersize=4.5, linewidth=1.3,
                    label="\n".join(textwrap.wrap(quantity, 30)), clip_on=False, zorder=3)
    if up == "error":
        _draw_bars(axes, shown, across)
    elif any(p[up] <= 0.0 for points in shown.values() for p in points):
        axes.set_yscale("linear")
    if marks:
        highest = max(shown.values(), key=lambda points: points[-1]["error"])
        for p in highest:
            axes.annotate(f"{p['resolution']:g}", (p["wall_s"], p["error"]), xytext=(0, 6),
                          textcoords="offset points", fontsize=7.5, color=GREY, ha="center")
    _dress(axes)


def _draw_bars(axes: Any, lines: Mapping[str, list[Mapping[str, Any]]], across: str = "wall_s") -> None:
    """Draw the bars: a dotted line where one holds for every point shown, else a dash at each point it is asked of."""
    bars = [p["bar"] for points in lines.values() for p in points]
    asked = [(p[across], p["bar"]) for points in lines.values() for p in points if p["bar"]]
    if not asked:
        return
    style = {"color": INK, "linewidth": 1.0, "label": "bar", "zorder": 2}
    if len(set(bars)) == 1:
        axes.axhline(bars[0], linestyle=(0, (1, 2)), **style)
    else:
        axes.loglog(*zip(*asked), linestyle="none", marker="_", markersize=16, markeredgewidth=1.2, **style)


def _dress(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.margins(0.08, 0.12)
    for axis in (axis for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() == "log"):
        low, high = sorted(axis.get_view_interval())
        decades = math.log10(high / low) if low > 0.0 else 2.0
        axis.set_major_locator(LogLocator(10.0, subs=(1.0,) if decades > 1.7 else (1.0, 2.0, 5.0), numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if value >= 1e-3 else f"{value:.0e}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axes.tick_params(labelsize=8, colors=INK, which="both")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
