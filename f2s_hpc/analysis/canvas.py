"""The look that all figures of measurements share: sizes, colours, colour limits, and how they are written."""

from __future__ import annotations

import contextlib
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from f2s_hpc.analysis.surface import HALF_FULL
from f2s_hpc.errors import InputError

DPI = 150
INK, GREY, LIGHT = "#1a1a1a", "#666666", "#d9d9d9"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Colours of runs and of experiments, told apart by colour-blind eyes too (Okabe and Ito)."""

SECTION_COLOURS = {"peeq": "viridis", "temperature": "inferno", "von_mises": "magma"}
MICRO = 1e6
_RC = {"font.size": 9.0, "axes.linewidth": 0.7, "axes.edgecolor": INK, "axes.labelcolor": INK, "axes.titlesize": 9.5,
       "axes.titlelocation": "left", "xtick.color": INK, "ytick.color": INK, "xtick.labelsize": 8.0,
       "ytick.labelsize": 8.0, "xtick.major.size": 3.0, "ytick.major.size": 3.0, "legend.fontsize": 8.0,
       "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False}


@contextlib.contextmanager
def canvas(path: str | os.PathLike, width: float, height: float) -> Iterator[Any]:
    """Give a figure of ``width`` x ``height`` (inches) to draw on; write it to the PNG file ``path`` at the end.

    The file is replaced whole, and nothing in it tells when or where it was made. Raises ``InputError`` when it cannot
    be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    path = pathlib.Path(path)
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)
        figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white", layout="constrained")
        yield figure
        save(figure, path, "figure")


def save(figure: Any, path: pathlib.Path, what: str) -> None:
    """Write the PNG under another name, then put it in place; nothing in it tells when or where it was made.

    ``what``: how the message of the ``InputError`` calls it when it cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        figure.savefig(partial, format="png", metadata={"Software": None})
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: the {what} cannot be written ({error.strerror or error})") from None


def limits(values: Sequence[np.ndarray], low: float = 1.0, high: float = 99.0) -> tuple[float, float]:
    """Return common colour limits of several arrays: the ``low`` and ``high`` percentiles of their finite values."""
    pool = np.concatenate([np.ravel(v)[np.isfinite(np.ravel(v))] for v in values]) if values else np.empty(0)
    if pool.size == 0:
        return 0.0, 1.0
    a, b = (float(v) for v in np.percentile(pool, (low, high)))
    return (a, b) if b > a else (a, a + max(1e-3, 1e-3 * abs(a)))


def colour_bar(figure: Any, image: Any, axes: Any, label: str, values: np.ndarray, bounds: tuple[float, float],
               above: bool = False) -> None:
    """Put a colour bar beside ``axes``, or above; its ends are pointed where values lie beyond them."""
    finite = np.ravel(values)[np.isfinite(np.ravel(values))]
    below, beyond = (bool(finite.min() < bounds[0]), bool(finite.max() > bounds[1])) if finite.size else (False, False)
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, beyond), "neither")
    bar = figure.colorbar(image, ax=axes, extend=extend, shrink=0.95, pad=0.02, aspect=25,
                          location="top" if above else "right")
    bar.set_label(label)
    bar.outline.set_linewidth(0.6)


def nearest_material(values: np.ndarray, material: np.ndarray) -> np.ndarray:
    """Return ``values`` of a section with every void cell given the value of the nearest material, for the drawn edge.

    ``material``: bool, of the same shape (up, along).
    """
    from scipy.ndimage import distance_transform_edt

    if not material.any():
        return values
    return values[tuple(distance_transform_edt(~material, return_distances=False, return_indices=True))]


def draw_interface(axes: Any, fraction: np.ndarray, left: float, low: float, step: float) -> None:
    """Cover the void of a section in white up to the interface VF = 0.5, and draw the interface.

    ``fraction``: VF (up, along); ``left``, ``low``: where the section begins (um); ``step``: cell size (um).
    """
    material = fraction >= HALF_FULL
    if material.all() or not material.any():
        return
    # one more cell all round, a copy of the outermost, so that the interface runs on to the frame
    padded = np.pad(np.asarray(fraction, dtype=np.float64), 1, mode="edge")
    x = left + step * (np.arange(padded.shape[1]) - 0.5)
    z = low + step * (np.arange(padded.shape[0]) - 0.5)
    axes.contourf(x, z, padded, levels=[-1.0, HALF_FULL], colors=["white"])
    axes.contour(x, z, padded, levels=[HALF_FULL], colors=[INK], linewidths=0.6)


def equal_size(shape: tuple[int, int], width: float, least: float = 1.6, most: float = 6.0) -> float:
    """Return the height (inches) of a map of ``shape`` (rows, columns) drawn ``width`` inches wide at equal scales."""
    return float(np.clip(width * shape[0] / shape[1], least, most))
