"""Figures of heights, roughness, distributions by depth and flattening. All from arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from f2s_hpc.analysis import canvas as look
from f2s_hpc.analysis.canvas import MICRO, canvas
from f2s_hpc.analysis.depth import DepthDistribution
from f2s_hpc.analysis.flattening import Flattening, Regression
from f2s_hpc.analysis.profile import Profile
from f2s_hpc.analysis.roughness import mean_line
from f2s_hpc.units import ZERO_CELSIUS, count_text

LEAST_FILL = 0.03
HEIGHT_SHARES = (2.0, 98.0)
"""Percentiles of the height between which a map has its colours: a single splash should not take them all."""

FIELD_LABELS = {"peeq": "PEEQ", "temperature": "temperature (°C)", "von_mises": "von Mises stress (MPa)"}


def shown(name: str, values: np.ndarray) -> np.ndarray:
    """Return a field in the unit of its label: degC and MPa."""
    if name == "temperature":
        return values - ZERO_CELSIUS
    return 1e-6 * values if name == "von_mises" else values


def height_map(path: str | os.PathLike, surface: np.ndarray, dx: float, ground: float,
               bounds: tuple[float, float] | None = None) -> None:
    """Draw the height above the substrate top, seen from above; ``bounds`` (um) are the colour limits.

    ``surface``: heights above the bottom of the box (m), (ny, nx); ``dx``, ``ground`` in m.
    """
    height = (surface - ground) * MICRO
    bounds = bounds or look.limits([height], *HEIGHT_SHARES)
    wide = 4.8
    with canvas(path, wide, look.equal_size(surface.shape, wide - 1.3) + 0.7) as figure:
        axes = figure.add_subplot()
        image = axes.imshow(height, origin="lower", cmap="cividis", vmin=bounds[0], vmax=bounds[1],
                            extent=(0.0, surface.shape[1] * dx * MICRO, 0.0, surface.shape[0] * dx * MICRO))
        axes.set(xlabel="x (µm)", ylabel="y (µm)")
        look.colour_bar(figure, image, axes, "height above substrate (µm)", height, bounds)


def profiles(path: str | os.PathLike, simulated: Sequence[tuple[str, Profile]], spread: np.ndarray | None = None,
             experiment: Profile | None = None, across: str = "x", paper_height: float | None = None) -> None:
    """Draw profiles across the track, the measured one as points, and the range along it of the first.

    ``simulated``: (name, profile); ``spread``: lowest and highest height (m) at each place of the first, (2, n).
    """
    with canvas(path, 6.4, 3.0) as figure:
        axes = figure.add_subplot()
        for number, (name, profile) in enumerate(simulated):
            if number == 0 and spread is not None:
                axes.fill_between(profile.x * MICRO, *(spread * MICRO), color=look.SERIES[0], alpha=0.15, linewidth=0,
                                  label="lowest to highest along the track")
            axes.plot(profile.x * MICRO, profile.height * MICRO, color=look.SERIES[number],
                      label=name or "mean profile")
        if experiment is not None:
            axes.plot(experiment.x * MICRO, experiment.height * MICRO, color=look.INK, linestyle="none", marker="o",
                      markersize=2.5, label="experiment")
        if paper_height is not None:
            axes.axhline(paper_height * MICRO, color=look.GREY, linestyle="--", linewidth=0.9,
                         label=f"paper, {paper_height * MICRO:.0f} µm")
        axes.axhline(0.0, color=look.INK, linewidth=0.6)
        axes.set(xlabel=f"{across} (µm)", ylabel="height above substrate (µm)")
        axes.margins(x=0.0)
        axes.set_ylim(top=1.28 * axes.get_ylim()[1])
        axes.legend(ncols=2, loc="upper center")


def roughness_line(path: str | os.PathLike, height: np.ndarray, dx: float, cutoff: float, ends: str,
                   axis: str = "y") -> None:
    """Draw one profile (m) with its mean line above, and what is left, the roughness, below."""
    line = mean_line(height, dx, cutoff, ends)
    place = (np.arange(height.size) + 0.5) * dx * MICRO
    residue = (height - line) * MICRO
    with canvas(path, 6.4, 3.4) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(place, height * MICRO, color=look.SERIES[0], label="middle profile of the surface")
        above.plot(place, line * MICRO, color=look.INK, linestyle="--", linewidth=1.0,
                   label=f"mean line, Gaussian filter, cutoff {cutoff * MICRO:g} µm")
        low, high = above.get_ylim()
        above.set(ylabel="height (µm)", ylim=(low, high + 0.35 * (high - low)))
        above.legend(ncols=2, loc="upper center")
        below.fill_between(place, residue, color=look.SERIES[0], alpha=0.35, linewidth=0)
        below.plot(place, residue, color=look.SERIES[0], linewidth=0.9)
        below.axhline(0.0, color=look.INK, linewidth=0.6)
        below.set(xlabel=f"{axis} (µm)", ylabel="roughness (µm)")
        below.margins(x=0.0)


def depth_bands(path: str | os.PathLike, runs: Sequence[tuple[str, dict[str, DepthDistribution]]]) -> None:
    """Draw PEEQ, temperature and von Mises stress against the height above the substrate: median and bands.

    The bands hold 90 and 50 % of the material of the first run; of further runs, median and 90 % as lines. Layers less
    full than ``LEAST_FILL`` of the fullest are left out: a few splashes have no distribution.
    """
    with canvas(path, 8.2, 3.9) as figure:
        panels = figure.subplots(1, 3, sharey=True)
        for axes, name in zip(panels, FIELD_LABELS):
            for number, (label, distributions) in enumerate(runs):
                found, colour = distributions[name], look.SERIES[number]
                full = found.volume > LEAST_FILL * found.volume.max(initial=0.0)
                values, z = shown(name, found.percentiles[full]), found.middle[full] * MICRO
                if number == 0:
                    axes.fill_betweenx(z, values[:, 0], values[:, 4], color=colour, alpha=0.15, linewidth=0,
                                       label="5 to 95 % of the volume")
                    axes.fill_betweenx(z, values[:, 1], values[:, 3], color=colour, alpha=0.3, linewidth=0,
                                       label="25 to 75 %")
                else:
                    axes.plot(values[:, 0], z, color=colour, linewidth=0.7, linestyle=":")
                    axes.plot(values[:, 4], z, color=colour, linewidth=0.7, linestyle=":",
                              label=f"5 and 95 %, {label}")
                axes.plot(values[:, 2], z, color=colour, linewidth=1.6, label=f"median{', ' + label if label else ''}")
            axes.axhline(0.0, color=look.INK, linewidth=0.8, linestyle=(0, (5, 3)))
            axes.set_xlabel(FIELD_LABELS[name])
        panels[0].set_ylabel("height above substrate (µm)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3 if len(runs) == 1 else 2)


def flattening_figure(path: str | os.PathLike,
                      runs: Sequence[tuple[str, Flattening, dict[str, Regression | None]]],
                      source: str = "in sections") -> None:
    """Draw the flattening ratios by Eq. (5) over W_p and by Eq. (6) over D, with line and 90 % bands, as Fig. 17.

    The shaded band is that of the line (confidence), the thin lines that of a further particle (prediction).
    ``source``: where the particles were measured; with many, their points are smaller.
    """
    with canvas(path, 8.2, 3.6 if len(runs) == 1 else 4.2) as figure:
        panels = figure.subplots(1, 2)
        for number, (label, found, fits) in enumerate(runs):
            colour = look.SERIES[number]
            for axes, (x, key) in zip(panels, ((found.width, "equation_5"), (found.diameter, "equation_6"))):
                name, many = f"{label}, " if label else "", count_text(found.count, "particle")
                axes.scatter(x * MICRO, getattr(found, key), s=14 if found.count < 500 else 5, color=colour,
                             alpha=0.6, linewidth=0, label=f"{name}{many} {source}".strip())
                fit = fits[key]
                if fit is None:
                    continue
                at = np.linspace(np.nanmin(x), np.nanmax(x), 60)
                line, sure, single = fit.line(at), fit.confidence(at), fit.prediction(at)
                axes.plot(at * MICRO, line, color=colour, linewidth=1.5, label=f"{name}linear fit")
                axes.fill_between(at * MICRO, line - sure, line + sure, color=colour, alpha=0.18, linewidth=0,
                                  label=f"{name}90 % band of the line")
                for side in (-1.0, 1.0):
                    axes.plot(at * MICRO, line + side * single, color=colour, linewidth=0.7, linestyle="--",
                              label=f"{name}90 % band of a particle" if side > 0 else None)
        for axes in panels:
            axes.set_ylim(bottom=max(0.0, axes.get_ylim()[0]))
        panels[0].set(xlabel="width of the particle $W_p$ (µm)", ylabel="$W_p / H_p$", title="(a) Eq. (5)")
        panels[1].set(xlabel="diameter $D = (W_p^2 H_p)^{1/3}$ (µm)", ylabel="$W_p / D$", title="(b) Eq. (6)")
        handles, labels = panels[0].get_legend_handles_labels()
        # a column per run: labels are as long as the names of the runs
        figure.legend(handles, labels, loc="outside lower center", ncols=4 if len(runs) == 1 else len(runs))


def particle_sizes(path: str | os.PathLike, runs: Sequence[tuple[str, np.ndarray]]) -> None:
    """Draw the share of the volume put in that is in particles below each diameter; ``runs``: (name, diameters (m))."""
    with canvas(path, 4.8, 2.8) as figure:
        axes = figure.add_subplot()
        for number, (label, diameters) in enumerate(runs):
            ordered = np.sort(diameters)
            share = 100.0 * np.cumsum(ordered**3) / max((ordered**3).sum(), 1e-300)
            axes.step(ordered * MICRO, share, where="post", color=look.SERIES[number],
                      linestyle="--" if number else "-", label=label or None)
        for percent in (10, 50, 90):
            axes.axhline(percent, color=look.LIGHT, linewidth=0.7, zorder=0)
        axes.set(xlabel="particle diameter (µm)", ylabel="volume below (%)", ylim=(0.0, 101.0))
        if any(label for label, _ in runs):
            axes.legend()
