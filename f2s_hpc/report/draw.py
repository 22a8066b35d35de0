"""The figures of one or two measured deposits, as PNG files."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from f2s_hpc.analysis import canvas, figures, porosity, profile, section_figures
from f2s_hpc.analysis.picture import Section
from f2s_hpc.report.deposit import Deposit
from f2s_hpc.report.measure import Measurements, filter_ends, particles_of_plane

FIELDS = ("peeq", "temperature", "von_mises")


def draw_all(folder: pathlib.Path, runs: Sequence[tuple[str, Measurements]]) -> dict[str, list[pathlib.Path]]:
    """Draw every figure into ``folder``; return their files by name, one for both runs or one each, in order.

    Figures of single runs share their colour limits, so that two can be compared. Raises ``F2SError`` when a file
    cannot be written.
    """
    drawn: dict[str, list[pathlib.Path]] = {}

    def place(name: str, number: int | None = None) -> pathlib.Path:
        path = folder / f"{name}{'' if number is None or len(runs) == 1 else f'-{number + 1}'}.png"
        drawn.setdefault(name, []).append(path)
        return path

    first = runs[0][1]
    across = profile.across(first.settings.along)
    figures.profiles(place("profile"), [_laid_over(label, m) for label, m in runs], _spread(first), first.experiment,
                     across, first.paper_height)
    figures.depth_bands(place("depth"), [(label, m.distributions) for label, m in runs])
    if any(m.flattening.count for _, m in runs):
        figures.flattening_figure(place("flattening"), [(label, m.flattening, m.fits) for label, m in runs])
    if all(m.deposit.diameters.size for _, m in runs):
        figures.particle_sizes(place("particles"), [(label, m.deposit.diameters) for label, m in runs])
    heights = canvas.limits([1e6 * (m.deposit.surface - m.deposit.ground) for _, m in runs], *figures.HEIGHT_SHARES)
    bounds = _section_bounds([m for _, m in runs])
    for number, (_, m) in enumerate(runs):
        deposit, section = m.deposit, m.section
        frame = _frame(deposit, section)
        fraction = section.cut(deposit.fraction)
        figures.height_map(place("height-map", number), deposit.surface, deposit.dx, deposit.ground, heights)
        section_figures.section_fields(place("sections", number), fraction,
                                       {name: section.cut(getattr(deposit, name)) for name in FIELDS}, frame, bounds)
        _boundaries(place("boundaries", number), m, frame, fraction)
        if m.traced is not None and m.traced.flattening.count:
            figures.flattening_figure(place("flattening-tracers", number), [
                ("by tracers", m.traced.flattening, m.traced.fits), ("in sections", m.flattening, m.fits)], "")
        if m.porosity is not None:
            _pores(place("pores", number), m, frame, fraction)
        if m.rough_along is not None:
            _roughness(place("roughness", number), m)
    return drawn


def _laid_over(label: str, found: Measurements) -> tuple[str, profile.Profile]:
    """Return name and profile as they are compared with the experiment: moved where that was asked for."""
    shift = found.overlap.shift if found.overlap is not None else 0.0
    if shift == 0.0:
        return label, found.profile
    return (f"{label or 'mean profile'}, moved by {1e6 * shift:.1f} µm",
            replace(found.profile, x=found.profile.x + shift))


def _frame(deposit: Deposit, section: Section) -> section_figures.Frame:
    return section_figures.Frame(section.axis, section.along.start * deposit.dx,
                                 section.up.start * deposit.dx - deposit.ground, deposit.dx,
                                 (section.index + 0.5) * deposit.dx)


def _spread(found: Measurements) -> np.ndarray:
    deposit = found.deposit
    axis = 0 if found.settings.along == "y" else 1
    spread = np.array([deposit.surface.min(axis=axis), deposit.surface.max(axis=axis)]) - deposit.ground
    return np.concatenate([spread[:, ::-1], spread], axis=1) if found.settings.symmetric else spread


def _section_bounds(runs: Sequence[Measurements]) -> dict[str, tuple[float, float]]:
    """Return colour limits (units as shown) that hold for the sections of all runs."""
    bounds = {}
    for name in FIELDS:
        values = [figures.shown(name, m.section.cut(getattr(m.deposit, name))[m.section.cut(m.deposit.fraction) >= 0.5])
                  for m in runs]
        bounds[name] = canvas.limits(values)
    return bounds


def _boundaries(path: pathlib.Path, found: Measurements, frame: section_figures.Frame, fraction: np.ndarray) -> None:
    deposit, section = found.deposit, found.section
    axis = 1 if section.axis == "x" else 2
    whole = particles_of_plane(deposit, axis, section.index, found.settings.prominence)
    cut = (section.up, section.along)
    shown = type(whole)(whole.labels[cut], whole.width, whole.height, whole.boundaries[cut])
    section_figures.particle_boundaries(path, fraction, section.cut(deposit.peeq), shown, frame)


def _pores(path: pathlib.Path, found: Measurements, frame: section_figures.Frame, fraction: np.ndarray) -> None:
    deposit, section = found.deposit, found.section
    top = porosity.bulk_top(deposit.surface, deposit.dx, found.porosity.zone)
    bulk = section.cut(porosity.bulk_share(deposit.fraction.shape, deposit.dx, deposit.ground, top)) >= 0.5
    _, pores = porosity.image_porosity(fraction, bulk, found.settings.smallest_pore)
    section_figures.pores(path, fraction, bulk, pores, frame)


def _roughness(path: pathlib.Path, found: Measurements) -> None:
    deposit, along = found.deposit, found.settings.along
    surface = deposit.surface if along == "x" else deposit.surface.T
    ends = dict(zip("xy", filter_ends(deposit)))[along]
    figures.roughness_line(path, surface[surface.shape[0] // 2] - deposit.ground, deposit.dx, found.settings.cutoff,
                           ends, along)
