"""The picture of a deposit: a section coloured by PEEQ and by temperature, and the height map, in one PNG."""

from __future__ import annotations

import os
import pathlib
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from f2s_hpc.analysis.canvas import INK, MICRO, draw_interface, nearest_material, save
from f2s_hpc.analysis.surface import HALF_FULL, grounded_cells, landed_surface
from f2s_hpc.errors import InputError
from f2s_hpc.units import ZERO_CELSIUS

NEEDED = ("volume_fraction", "peeq", "temperature", "speed")
SLOW_SPEED = 50.0
"""m/s; what is faster than this is taken to be in flight, unless the caller knows better."""
ROWS_AT_ONCE = 64
"""Rows of the fields that are read at once: chunks of a frame have as many at most, and each is read whole."""

_DPI = 160
_WIDTH, _NARROWEST = 10.0, 8.0
_HEIGHTS = (6.6, 8.2)
_LEAST_SIDE = 1.3
_LONGEST = 6.5
# All lengths of the layout are in inches.
_MARGIN, _HEAD, _FOOT = 0.15, 0.68, 0.42
_LEFT, _RIGHT, _BELOW, _ABOVE, _ABOVE_WIDE = 0.62, 0.16, 0.52, 0.66, 0.42
_WIDE = 4.6
_ARRANGEMENTS = (((0,), (1,), (2,)), ((0, 1), (2,)), ((0, 1, 2),))
_BAR, _BAR_GAP, _BAR_WIDE = 0.11, 0.07, 2.8
_GREY = "#555555"


@dataclass(frozen=True)
class Section:
    """The plane that is shown: along the longer side of the footprint, cropped to the deposit.

    ``axis``: "x" or "y", the horizontal one; ``index``: the cell of the plane across it; ``along`` and
    ``up``: the cells that are shown.
    """

    axis: str
    index: int
    along: slice
    up: slice

    def cut(self, field: np.ndarray) -> np.ndarray:
        """Return the shown part of ``field`` (nz, ny, nx) as (up, along)."""
        return field[self.up, self.index, self.along] if self.axis == "x" else field[self.up, self.along, self.index]


@dataclass(frozen=True)
class Panel:
    """Where a panel stands: left, bottom, width, height (inches from the figure's lower left corner)."""

    left: float
    bottom: float
    width: float
    height: float


def draw(fields: Mapping[str, np.ndarray], dx: float, substrate_height: float, title: str, subtitle: str,
         path: str | os.PathLike, slow_speed: float = SLOW_SPEED) -> None:
    """Draw the deposit into the PNG file ``path``, replaced whole: the same input gives the same bytes.

    Panels: a vertical section by PEEQ, the same by temperature (degC), and the map of the surface height above
    the substrate top; lengths in um, equal aspect. Void is white, the interface is VF = 0.5. The section runs
    along the longer side of the footprint (x when square) through the middle of the box, or, when that holds
    less than half the deposit of the fullest plane (a particle on a symmetry side), through the fullest plane.
    Colours span the 1st to 99th percentile of the material shown.

    ``fields``: ``volume_fraction``, ``peeq``, ``temperature`` (K), ``speed`` (m/s), each (nz, ny, nx), an array or what
    is cut like one (``io.runs.FrameField``) and is then never held whole; ``dx``, ``substrate_height`` in m;
    ``slow_speed`` (m/s): what is faster, or not attached, is no part of the surface.
    Raises ``InputError`` when a field is missing or of another shape, ``F2SError`` when the file cannot be written.
    """
    shape = _checked_shape(fields)
    surface, amount, filled = survey(fields, dx, substrate_height, slow_speed)
    section = choose_section(amount, filled, surface, dx, substrate_height)
    across = shape[1] if section.axis == "x" else shape[2]
    length, height = section.along.stop - section.along.start, section.up.stop - section.up.start
    full = shape[2] if section.axis == "x" else shape[1]
    size, panels = place(height / length, across / full)
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update({
            "font.size": 9.0, "axes.linewidth": 0.7, "axes.edgecolor": INK, "axes.labelcolor": INK,
            "xtick.color": INK, "ytick.color": INK, "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
            "xtick.direction": "out", "ytick.direction": "out", "xtick.major.size": 3.0, "ytick.major.size": 3.0,
            "xtick.major.width": 0.7, "ytick.major.width": 0.7, "axes.unicode_minus": True})
        figure = Figure(figsize=size, dpi=_DPI, facecolor="white")
        _write_head(figure, title, subtitle)
        fraction = section.cut(fields["volume_fraction"])
        peeq, celsius = section.cut(fields["peeq"]), section.cut(fields["temperature"]) - ZERO_CELSIUS
        _draw_section(figure, panels[0], section, fraction, peeq, dx, substrate_height,
                      ("(a) Equivalent plastic strain", "(a) PEEQ", "viridis"))
        _draw_section(figure, panels[1], section, fraction, celsius, dx, substrate_height,
                      ("(b) Temperature (°C)", "(b) $T$ (°C)", "inferno"))
        _draw_map(figure, panels[2], section, surface, dx, substrate_height)
        _write_legend(figure, section, dx)
        save(figure, pathlib.Path(path), "picture")


def _checked_shape(fields: Mapping[str, np.ndarray]) -> tuple[int, int, int]:
    """Return (nz, ny, nx) of the fields; raises ``InputError`` when one is missing or differs."""
    for name in NEEDED:
        if name not in fields:
            raise InputError(f"picture: no field {name!r}; output.fields must hold {', '.join(NEEDED)}")
    shape = fields[NEEDED[0]].shape
    for name in NEEDED:
        if fields[name].ndim != 3 or fields[name].shape != shape:
            raise InputError(f"picture: field {name!r} has shape {fields[name].shape}, {NEEDED[0]} {shape}; "
                             "all must be cells, (nz, ny, nx)")
    return shape


def survey(fields: Mapping[str, np.ndarray], dx: float, substrate_height: float,
           slow_speed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what is seen from above, and how high the box is filled; arguments as of :func:`draw`.

    The height of the landed material (m, (ny, nx)), how much material (in full cells) lies in each column above the
    substrate's top, (ny, nx), and which layers have cells half full, bool (nz). The fields are read in slabs of rows;
    of the whole box only what is slow and solid, and of that what is grounded, is held: 2 bytes per cell below the
    highest (``workload.memory.GROUNDED``).
    """
    nz, ny, nx = fields["volume_fraction"].shape
    slabs = [slice(first, min(first + ROWS_AT_ONCE, ny)) for first in range(0, ny, ROWS_AT_ONCE)]
    surface, amount, filled = np.empty((ny, nx)), np.empty((ny, nx)), np.zeros(nz, dtype=bool)
    solid = np.zeros((nz, ny, nx), dtype=bool)
    for rows in slabs:
        fraction = fields["volume_fraction"][:, rows]
        amount[rows], planes = material_above(fraction, dx, substrate_height)
        filled |= planes
        half_full = fraction >= HALF_FULL
        half_full &= fields["speed"][:, rows] < slow_speed
        for k in np.flatnonzero(planes):  # (layers that stay void are no memory)
            solid[k, rows] = half_full[k]
    firm = grounded_cells(solid)
    del solid
    for rows in slabs:
        fraction = fields["volume_fraction"][:, rows]
        # of the skin (``surface.with_skin``) only what lies on the highest firm cell counts
        skin = (fields["speed"][:, rows] < slow_speed) & (fraction < HALF_FULL)
        surface[rows] = landed_surface(fraction, firm[:, rows] | skin, dx)
    return surface, amount, filled


def material_above(fraction: np.ndarray, dx: float, substrate_height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how much material (in full cells) lies in each column above the substrate's top, (ny, nx) float64, and
    which layers have cells half full, bool (nz). ``fraction``: volume fraction (nz, ny, nx).
    """
    ground = min(int(np.ceil(substrate_height / dx - 1e-6)), fraction.shape[0])
    return fraction[ground:].sum(axis=0, dtype=np.float64), (fraction >= HALF_FULL).any(axis=(1, 2))


def choose_section(amount: np.ndarray, filled: np.ndarray, surface: np.ndarray, dx: float,
                   substrate_height: float) -> Section:
    """Return the plane and the part of it to show; ``amount``, ``filled`` and ``surface`` as :func:`survey` returns.

    Upwards the view ends a little above the highest surface; downwards it shows the whole substrate unless that is much
    thicker than the deposit; a strip that is too long to read is cut to a window around its deposit.
    """
    nz, (ny, nx) = filled.size, amount.shape
    axis = "x" if ny <= 1.5 * nx else "y"
    ground = substrate_height / dx
    deposit = amount if axis == "x" else amount.T
    planes = deposit.sum(axis=1)
    middle = planes.size // 2
    index = middle if planes[middle] >= 0.5 * planes.max() else int(np.argmax(planes))

    top = float(surface.max()) / dx
    if top - ground < 2.0:  # nothing has landed yet: show what is in flight
        layers = np.flatnonzero(filled)
        top = max(top, float(layers[-1] + 1)) if layers.size else float(nz)
    low = max(0.0, ground - max(0.4 * min(nx, ny), top - ground))
    high = min(float(nz), top + max(2.0, 0.08 * (top - low)))
    up = slice(int(low), max(int(np.ceil(high)), int(low) + 1))

    length = deposit.shape[1]
    window = 5 * (up.stop - up.start)
    if length <= _LONGEST / 5 * window:
        return Section(axis, index, slice(0, length), up)
    weight = deposit.sum(axis=0)
    centre = (np.arange(length) + 0.5) @ weight / weight.sum() if weight.sum() > 0.0 else 0.5 * length
    start = min(max(int(centre - 0.5 * window), 0), length - window)
    return Section(axis, index, slice(start, start + window), up)


def place(section_ratio: float, map_ratio: float) -> tuple[tuple[float, float], list[Panel]]:
    """Return the size of the figure and the places of its three panels (inches).

    ``section_ratio``, ``map_ratio``: height over width of the sections and of the map. Of three arrangements
    (side by side, sections beside the map, one above the other) the one with clearly the widest panels is taken. All
    panels are equally wide, so section and map have one scale, unless a map in its own column would be small.
    """
    ratios = (section_ratio, section_ratio, map_ratio)
    for tallest in _HEIGHTS:
        fitting = {columns: _panel_width(columns, ratios, tallest) for columns in _ARRANGEMENTS}
        # side by side reads best, so another one must gain clearly
        columns = max(fitting, key=lambda c: fitting[c] * (1.3 if len(c) == 3 else 1.0))
        width = fitting[columns]
        if width * min(1.0, *ratios) >= _LEAST_SIDE:
            break
    room = tallest - _HEAD - _FOOT
    widths = [width] * len(columns)
    spare = _WIDTH - 2 * _MARGIN - len(columns) * (width + _LEFT + _RIGHT)
    if columns[-1] == (2,) and width < 2.5:
        widths[-1] = max(width, min(3.4, width + spare, (room - _ABOVE - _BELOW) / map_ratio))
    above = [_ABOVE_WIDE if w >= _WIDE else _ABOVE for w in widths]
    tall = [sum(w * ratios[p] + a + _BELOW for p in column) for column, w, a in zip(columns, widths, above)]
    content = sum(w + _LEFT + _RIGHT for w in widths) + 2 * _MARGIN
    size = (min(_WIDTH, max(content, _NARROWEST)), max(tall) + _HEAD + _FOOT)
    panels: dict[int, Panel] = {}
    left = 0.5 * (size[0] - content) + _MARGIN
    for column, w, a in zip(columns, widths, above):
        bottom = size[1] - _HEAD
        for p in column:
            bottom -= a + w * ratios[p]
            panels[p] = Panel(left + _LEFT, bottom, w, w * ratios[p])
            bottom -= _BELOW
        left += w + _LEFT + _RIGHT
    return size, [panels[p] for p in range(3)]


def _panel_width(columns: tuple[tuple[int, ...], ...], ratios: tuple[float, ...], tallest: float) -> float:
    """Return the largest panel width (inches) with which ``columns`` of panels fit the figure."""
    widest = (_WIDTH - 2 * _MARGIN) / len(columns) - _LEFT - _RIGHT
    above = _ABOVE_WIDE if widest >= _WIDE else _ABOVE
    room = tallest - _HEAD - _FOOT
    return min(widest, *((room - len(c) * (above + _BELOW)) / sum(ratios[p] for p in c) for c in columns))


def _axes(figure: Any, panel: Panel) -> Any:
    width, height = figure.get_size_inches()
    return figure.add_axes((panel.left / width, panel.bottom / height, panel.width / width, panel.height / height))


def _ticks(axis: Any, inches: float) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins=max(2, min(9, int(1.7 * inches))), steps=[1, 2, 2.5, 5, 10]))


def _limits(values: np.ndarray, least: float) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the finite ``values``, at least ``least`` apart."""
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 0.0, least
    low, high = (float(v) for v in np.percentile(values, (1.0, 99.0)))
    return (low, high) if high - low >= least else (low, low + least)


def _draw_section(figure: Any, panel: Panel, section: Section, fraction: np.ndarray, values: np.ndarray, dx: float,
                  substrate_height: float, look: tuple[str, str, str]) -> None:
    """Draw ``values`` (up, along) inside the interface VF = 0.5, and its colour bar; z from the substrate top."""
    material = fraction >= HALF_FULL
    limits = _limits(values[material], 1e-3)
    axes = _axes(figure, panel)
    left, right = section.along.start * dx * MICRO, section.along.stop * dx * MICRO
    low, high = ((n * dx - substrate_height) * MICRO for n in (section.up.start, section.up.stop))
    image = axes.imshow(nearest_material(values, material), origin="lower", extent=(left, right, low, high),
                        cmap=look[2], vmin=limits[0], vmax=limits[1], interpolation="nearest", aspect="auto")
    draw_interface(axes, fraction, left, low, dx * MICRO)
    if not material.any():
        image.set_visible(False)
    axes.axhline(0.0, color="white", linewidth=1.8, alpha=0.8)
    axes.axhline(0.0, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_xlabel(f"${section.axis}$ (µm)", labelpad=2)
    axes.set_ylabel("$z$ above substrate (µm)" if panel.height >= 1.5 else "$z$ (µm)", labelpad=2)
    _ticks(axes.xaxis, panel.width)
    _ticks(axes.yaxis, max(panel.height, 2.0))
    _colour_bar(figure, panel, image, look[0] if panel.width >= 2.0 else look[1], values[material], limits)


def _draw_map(figure: Any, panel: Panel, section: Section, surface: np.ndarray, dx: float,
              substrate_height: float) -> None:
    """Draw the surface height above the substrate top, seen from above, and where the section lies."""
    across = "y" if section.axis == "x" else "x"
    covered = surface > 0.0
    height = np.ma.masked_array((surface - substrate_height) * MICRO, mask=~covered)
    if section.axis == "y":
        height = height.T
    axes = _axes(figure, panel)
    limits = _limits(height.compressed(), 0.5)
    length, width = (n * dx * MICRO for n in height.shape[::-1])
    image = axes.imshow(height, origin="lower", extent=(0.0, length, 0.0, width), cmap="cividis", vmin=limits[0],
                        vmax=limits[1], interpolation="nearest", aspect="auto")
    ends = [section.along.start * dx * MICRO, section.along.stop * dx * MICRO]
    plane = [(section.index + 0.5) * dx * MICRO] * 2
    axes.plot(ends, plane, color="white", linewidth=2.0, alpha=0.8, solid_capstyle="butt")
    axes.plot(ends, plane, color=INK, linewidth=1.0, linestyle=(0, (6, 2, 1, 2)))
    axes.set_xlim(0.0, length)
    axes.set_ylim(0.0, width)
    axes.set_xlabel(f"${section.axis}$ (µm)", labelpad=2)
    axes.set_ylabel(f"${across}$ (µm)", labelpad=2)
    _ticks(axes.xaxis, panel.width)
    _ticks(axes.yaxis, max(panel.height, 1.8))
    label = "(c) Height above substrate (µm)" if panel.width >= 2.2 else "(c) $h$ (µm)"
    _colour_bar(figure, panel, image, label, height.compressed(), limits)


def _colour_bar(figure: Any, panel: Panel, image: Any, label: str, values: np.ndarray,
                limits: tuple[float, float]) -> None:
    """Put the panel's name and its colour bar above it: on one line where the panel is wide."""
    width, height = figure.get_size_inches()
    bottom, top = panel.bottom + panel.height + _BAR_GAP, panel.bottom + panel.height
    wide = panel.width >= _WIDE
    long = _BAR_WIDE if wide else panel.width
    left = panel.left + panel.width - long
    place_of = (left / width, bottom / height, long / width, _BAR / height)
    below, beyond = (values.size > 0 and bool(v) for v in (values.min(initial=limits[0]) < limits[0],
                                                          values.max(initial=limits[1]) > limits[1]))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, beyond), "neither")
    bar = figure.colorbar(image, cax=figure.add_axes(place_of), orientation="horizontal", extend=extend,
                          extendfrac=0.08 / long)
    bar.outline.set_linewidth(0.6)
    bar.ax.xaxis.set_ticks_position("top")
    bar.ax.tick_params(pad=1, length=2.5)
    _ticks(bar.ax.xaxis, 1.25 * long)
    name_at = bottom + _BAR + (0.0 if wide else 0.26)
    figure.text(panel.left / width, (top + 0.09 if wide else name_at) / height, label, fontsize=9.5, color=INK,
                va="bottom", ha="left")


def _write_head(figure: Any, title: str, subtitle: str) -> None:
    """Write the title and the subtitle, each cut to one line."""
    width, height = figure.get_size_inches()
    left = _MARGIN + 0.05
    for text, size, weight, colour, down in ((title, 12.5, "bold", INK, 0.2), (subtitle, 9.5, "normal", _GREY, 0.47)):
        letters = int((width - 2 * left) * 72 / (size * (0.66 if weight == "bold" else 0.58)))
        figure.text(left / width, 1.0 - down / height, textwrap.shorten(text, letters, placeholder=" ..."),
                    fontsize=size, fontweight=weight, color=colour, va="center", ha="left", parse_math=False)


def _write_legend(figure: Any, section: Section, dx: float) -> None:
    """Say at the foot what the lines are."""
    from matplotlib.lines import Line2D

    across = "y" if section.axis == "x" else "x"
    plane = f"{(section.index + 0.5) * dx * MICRO:.4g}"
    lines = [Line2D([], [], color=INK, linewidth=0.8, label="interface, volume fraction 0.5"),
             Line2D([], [], color=INK, linewidth=0.9, linestyle=(0, (5, 3)), label="substrate top, $z$ = 0"),
             Line2D([], [], color=INK, linewidth=1.0, linestyle=(0, (6, 2, 1, 2)),
                    label=f"plane of the sections (a) and (b), ${across}$ = {plane} µm")]
    height = figure.get_size_inches()[1]
    figure.legend(handles=lines, loc="center", bbox_to_anchor=(0.5, 0.5 * _FOOT / height), ncols=3, frameon=False,
                  fontsize=8.5, handlelength=2.8, labelcolor=INK)
