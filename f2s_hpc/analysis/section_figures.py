"""Figures of a vertical section: fields, particle boundaries by PEEQ, and pores. All from arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from f2s_hpc.analysis import canvas as look
from f2s_hpc.analysis.boundaries import SectionParticles
from f2s_hpc.analysis.canvas import MICRO, canvas
from f2s_hpc.analysis.figures import FIELD_LABELS, shown
from f2s_hpc.analysis.surface import HALF_FULL

_PORE_COLOURS = ("#ffffff", "#c9c9c9", "#e8d9b5", "#d55e00")


@dataclass(frozen=True)
class Frame:
    """Where a section lies (m): ``axis`` "x" or "y" along it, its ``left`` and its ``low`` end (z from the substrate
    top), the cell size ``dx``, and ``across``, the place of the plane."""

    axis: str
    left: float
    low: float
    dx: float
    across: float

    def extent(self, shape: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of a section of ``shape`` (up, along), in um."""
        return tuple(MICRO * v for v in (self.left, self.left + shape[1] * self.dx, self.low,
                                         self.low + shape[0] * self.dx))

    def place(self) -> str:
        """Return where the plane is, as text."""
        return f"{'y' if self.axis == 'x' else 'x'} = {self.across * MICRO:.4g} µm"


def section_fields(path: str | os.PathLike, fraction: np.ndarray, fields: Mapping[str, np.ndarray], frame: Frame,
                   bounds: Mapping[str, tuple[float, float]] | None = None) -> None:
    """Draw fields of a section one above the other (SI in; shown in degC and MPa), inside the interface VF = 0.5.

    ``fraction``: VF (up, along); ``fields``: by name ("peeq", "temperature", "von_mises"), same shape; ``bounds``:
    colour limits in the unit shown, for figures to be compared.
    """
    material = fraction >= HALF_FULL
    beside = fraction.shape[0] > 0.5 * fraction.shape[1]
    if beside:
        wide = 10.0
        size = wide, look.equal_size(fraction.shape, wide / len(fields) - 0.6, 1.5, 5.0) + 1.3
    else:
        size = 6.4, len(fields) * (look.equal_size(fraction.shape, 4.9, 0.9, 3.4) + 0.3) + 0.5
    with canvas(path, *size) as figure:
        grid = (1, len(fields)) if beside else (len(fields), 1)
        panels = figure.subplots(*grid, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, (name, field) in zip(panels, fields.items()):
            values = shown(name, field.astype(float))
            limits = (bounds or {}).get(name) or look.limits([values[material]])
            image = axes.imshow(look.nearest_material(values, material), origin="lower",
                                extent=frame.extent(fraction.shape), cmap=look.SECTION_COLOURS[name], vmin=limits[0],
                                vmax=limits[1])
            _interface(axes, fraction, frame)
            look.colour_bar(figure, image, axes, FIELD_LABELS[name], values[material], limits, beside)
        for axes in panels if beside else panels[-1:]:
            axes.set_xlabel(f"{frame.axis} (µm), section at {frame.place()}")
        for axes in panels[:1] if beside else panels:
            axes.set_ylabel("z above substrate (µm)" if beside else "z (µm)")


def particle_boundaries(path: str | os.PathLike, fraction: np.ndarray, peeq: np.ndarray, found: SectionParticles,
                        frame: Frame) -> None:
    """Draw PEEQ of a section in grey with enhanced contrast, ridges between particles, and the measured particles."""
    material = fraction >= HALF_FULL
    wide = 6.2
    tall = look.equal_size(fraction.shape, wide - 1.0, 1.5, 3.6)
    with canvas(path, wide, tall + 0.95) as figure:
        axes = figure.add_subplot()
        grey = _equalised(peeq, material, round(-frame.low / frame.dx))
        axes.imshow(look.nearest_material(grey, material), origin="lower", extent=frame.extent(fraction.shape),
                    cmap="gray", vmin=0.0, vmax=1.0)
        _overlay(axes, found.boundaries, look.SERIES[1], frame, 0.9)
        measured = found.labels > 0
        _overlay(axes, measured, look.SERIES[0], frame, 0.35)
        _interface(axes, fraction, frame)
        left, _, low, _ = frame.extent(fraction.shape)
        for number in np.unique(found.labels[measured]):  # a long section is cut to what can be seen
            rows, columns = np.nonzero(found.labels == number)
            axes.text(left + (columns.mean() + 0.5) * frame.dx * MICRO, low + (rows.mean() + 0.5) * frame.dx * MICRO,
                      str(number), fontsize=7, ha="center", va="center", color="white", fontweight="bold")
        axes.set(xlabel=f"{frame.axis} (µm)", ylabel="z (µm)", title=f"PEEQ, contrast equalised; section at "
                                                                       f"{frame.place()}")
        _legend(figure, ((look.SERIES[1], "ridge of PEEQ"), (look.SERIES[0], "measured particle")))


def pores(path: str | os.PathLike, fraction: np.ndarray, bulk: np.ndarray, found: np.ndarray, frame: Frame) -> None:
    """Draw a section as image analysis sees it: material, the bulk that counts (``bulk``) and the pores (``found``)."""
    from matplotlib.colors import ListedColormap

    kind = np.where(fraction >= HALF_FULL, 1, 0)
    kind[bulk & (kind == 1)] = 2
    kind[found] = 3
    wide = 6.2
    tall = look.equal_size(fraction.shape, wide - 1.0, 1.5, 3.6)
    with canvas(path, wide, tall + 0.95) as figure:
        axes = figure.add_subplot()
        axes.imshow(kind, origin="lower", extent=frame.extent(fraction.shape), cmap=ListedColormap(_PORE_COLOURS),
                    vmin=-0.5, vmax=3.5, interpolation="nearest")
        axes.axhline(0.0, color=look.INK, linewidth=0.8, linestyle=(0, (5, 3)))
        axes.set(xlabel=f"{frame.axis} (µm)", ylabel="z (µm)", title=f"volume fraction, threshold 0.5; section at "
                                                                       f"{frame.place()}")
        _legend(figure, ((_PORE_COLOURS[2], "bulk"), (_PORE_COLOURS[3], "pore"),
                         (_PORE_COLOURS[1], "material that does not count")))


def _legend(figure: Any, entries: tuple[tuple[str, str], ...]) -> None:
    from matplotlib.patches import Patch

    figure.legend(handles=[Patch(color=colour, label=text) for colour, text in entries], loc="outside lower center",
                  ncols=len(entries))


def _overlay(axes: Any, mask: np.ndarray, colour: str, frame: Frame, alpha: float) -> None:
    from matplotlib.colors import to_rgb

    picture = np.zeros((*mask.shape, 4))
    picture[mask] = (*to_rgb(colour), alpha)
    axes.imshow(picture, origin="lower", extent=frame.extent(mask.shape), interpolation="nearest")


def _equalised(values: np.ndarray, material: np.ndarray, ground: int) -> np.ndarray:
    """Return the rank of each value among those of the deposit, above row ``ground``, 0 to 1.

    This is the contrast enhancement of Fig. 16 (b); the substrate would take up half of the grey levels.
    """
    inside = np.sort(values[max(ground, 0):][material[max(ground, 0):]])
    return np.searchsorted(inside, values, side="right") / max(inside.size, 1)


def _interface(axes: Any, fraction: np.ndarray, frame: Frame) -> None:
    """Cover the void in white up to the interface VF = 0.5, draw it, and the substrate top."""
    left, right, low, high = frame.extent(fraction.shape)
    look.draw_interface(axes, fraction, left, low, frame.dx * MICRO)
    axes.axhline(0.0, color="white", linewidth=1.6, alpha=0.7)
    axes.axhline(0.0, color=look.INK, linewidth=0.8, linestyle=(0, (5, 3)))
    axes.set(xlim=(left, right), ylim=(low, high))
