"""What a report says besides measurements: the scene, the particles, the energy ledger, the run time, the findings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from f2s_hpc.analysis.depth import SHARES, weighted_percentiles
from f2s_hpc.analysis.flattening import MeanDifference, mean_difference
from f2s_hpc.errors import InputError
from f2s_hpc.io import runs as run_files
from f2s_hpc.report.handover import Handover
from f2s_hpc.report.measure import Measurements, deposit_percentiles, median_diameter
from f2s_hpc.report.quantities import Table, percent
from f2s_hpc.units import count_text, pretty, pretty_bytes

Runs = Sequence[tuple[str, Measurements]]

ENERGY_NAMES = {
    "brought_in": "brought in by the particles", "plastic_work": "plastic work",
    "shock_viscosity": "shock viscosity", "hourglass": "hourglass control", "light_nodes": "light nodes",
    "remap_kinetic": "kinetic, lost by the remap", "remap_elastic": "elastic, lost by the remap",
    "half_kicks": "half kicks around remaps", "closing": "cells that close within a step",
    "time_step": "error of the explicit step", "through_faces": "left through the sides", "kinetic": "still kinetic",
    "put_to_sleep": "ringing that was put to sleep",
    "elastic": "stored elastically", "remainder": "unexplained"}

METHODS = (
    ("Heights count from the substrate top as painted. The surface of a column is the top of its highest cell that "
     "is at least half full of landed material, plus what lies in the cell above (sub-cell, from volume fractions). "
     "Landed is what is slower than a third of the particles and attached to the substrate. Dense-equivalent is the "
     "height of all material in the box without pores, by volume fraction; that of the cycle table is by mass at the "
     "density of no pressure, which differs by what heat and stress change of the density."),
    ("Roughness: Gaussian filter of ISO 16610-21 with the cutoff stated; along an axis with symmetry on both "
     "sides the profile is continued as its mirror image, which is exact there, else the weights are renormalised, so "
     "no length is lost. A value holds for its cutoff and length only."),
    ("Porosity is that of the bulk: whole cells above the substrate top, farther than the surface zone from the "
     "surface as seen from above. Exact: one less the mean volume fraction. Image: sections thresholded at 0.5, as "
     "the paper does. Open pores are connected through cell faces to the free space above; sides of the box are no "
     "way out."),
    ("Hand-over: the checkpoint at the end of a cycle is loaded, the next batch put onto the grid, and every saved "
     "field compared with the file in all cells that no new sphere touches (Fig. 6 of the paper). With Eulerian "
     "flight the batch is painted as the run paints it; with ballistic flight, all spheres in flight that lie inside "
     "the box are painted at once, where they are, by the function that the run uses at the end of each flight."),
    ("Flattening: on each section, at distances of the median diameter, basins of PEEQ between ridges are taken as "
     "particles. Measured are those whose boundary is inside the section, not at the free surface, and above the "
     "substrate: W and H are their extents, Eq. (5) is W/H, Eq. (6) W/D with D the cube root of W W H. A section "
     "rarely cuts a particle through its middle, in a micrograph as here."),
)

TRACER_METHOD = (
    "Tracers: each sphere was seeded, where it was put onto the grid, with points of equal volume that move with the "
    "material. W and H are those of the ellipsoid with the second moments of the particle's points in the deposit, W "
    "from the mean square of both horizontal axes: no section, no boundary to be found. Left out are particles that a "
    "side of the box cuts and those of which less than half is in the deposit.")


def subtitle(runs: Runs) -> str:
    """Return one line: cycles, time and particles of each run."""
    return "; ".join(f"{label + ': ' if label else ''}{count_text(m.deposit.diameters.size, 'particle')}, "
                     f"cycle {m.deposit.cycle} of {m.deposit.scene.cycles.count}, {1e6 * m.deposit.time:.3f} µs, "
                     f"cells of {1e6 * m.deposit.dx:g} µm" for label, m in runs)


def _rows(runs: Runs, entries: Sequence[tuple[str, Callable[[Measurements], str]]]) -> Table:
    rows = [[name, *(text(m) for _, m in runs)] for name, text in entries]
    return Table("", ["", *(label or "value" for label, _ in runs)], rows)


def _shown(value: float, dimension: str, digits: int = 4) -> str:
    """Return a quantity with its unit as a page writes it."""
    return pretty(value, dimension, digits).replace(" um", " µm").replace("degC", "°C")


def _own_or_common(own: Sequence[np.ndarray | None], common: float, dimension: str) -> str:
    """Return the range and mean of what the batches' spheres have as their own, else what is common to all."""
    values = np.concatenate([np.empty(0), *(each for each in own if each is not None)])
    if not values.size or values.min() == values.max():
        return _shown(float(values[0]) if values.size else common, dimension)
    low, high, mean = (_shown(float(value), dimension) for value in (values.min(), values.max(), values.mean()))
    return f"{low} to {high}, {mean} in the mean"


def scene_table(runs: Runs) -> Table:
    """Return the scene of each run as a table."""
    def box(m: Measurements) -> str:
        return " x ".join(f"{1e3 * v:.4g}" for v in m.deposit.scene.domain.extents) + " mm"

    return _rows(runs, (
        ("scene", lambda m: m.deposit.scene.title), ("scheme", lambda m: m.deposit.scene.scheme),
        ("flow stress", lambda m: m.deposit.scene.material.flow_stress.model.replace("_", " ")),
        ("box", box), ("cell size", lambda m: _shown(m.deposit.dx, "length")),
        ("cells", lambda m: f"{m.deposit.fraction.size:,}"),
        ("substrate", lambda m: f"{_shown(m.deposit.ground, 'length')} thick, "
                                f"{_shown(m.deposit.scene.substrate.temperature, 'temperature')}"),
        ("particle speed", lambda m: _own_or_common([b.speed for b in m.deposit.batches],
                                                    m.deposit.scene.particles.speed, "speed")),
        ("particle temperature", lambda m: _own_or_common([b.temperature for b in m.deposit.batches],
                                                          m.deposit.scene.particles.temperature, "temperature")),
        ("state shown", lambda m: f"end of cycle {m.deposit.cycle} of {m.deposit.scene.cycles.count}, "
                                  f"{1e6 * m.deposit.time:.3f} µs"),
        ("read from", lambda m: m.deposit.source.name)))


def particle_table(runs: Runs) -> Table:
    """Return number and sizes of the particles put in so far, those in flight too."""
    def size(share: float) -> Callable[[Measurements], str]:
        def text(m: Measurements) -> str:
            d = m.deposit.diameters
            return _shown(float(weighted_percentiles(d, d**3, (share,))[0]), "length", 3) if d.size else "-"
        return text

    return _rows(runs, (
        ("particles put in", lambda m: f"{m.deposit.diameters.size:,}"),
        *((f"D{100 * share:.0f} by volume", size(share)) for share in (0.1, 0.5, 0.9)),
        ("cells per D50", lambda m: f"{median_diameter(m.deposit) / m.deposit.dx:.1f}")))


def _cycle_row(m: Measurements) -> dict[str, str]:
    rows = run_files.read_cycle_table(m.deposit.folder)
    return next((row for row in rows if row.get("cycle") == str(m.deposit.cycle)), {})


def _number(value: object) -> float | None:
    """Return an entry of a run's summary or table as a number; None where it is missing or none, in damaged files."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def energy_table(runs: Runs) -> Table:
    """Return the energy ledger at the end of the cycle, in uJ and in percent of what the particles brought in."""
    known = [{name: _number(row.get(f"energy_{name}_J")) for name in ENERGY_NAMES}
             for row in (_cycle_row(m) for _, m in runs)]
    ledgers = [{name: value for name, value in row.items() if value is not None} for row in known]
    head = [""]
    for label, _ in runs:
        head += [f"{label + ' ' if label else ''}(µJ)", f"{label + ' ' if label else ''}(%)"]
    rows = []
    for name, text in ENERGY_NAMES.items():
        if not any(name in ledger for ledger in ledgers):
            continue
        row = [text]
        for ledger in ledgers:
            value, whole = ledger.get(name), ledger.get("brought_in", 0.0)
            row.append("-" if value is None else f"{1e6 * value:.4g}")
            row.append("-" if value is None or not whole else f"{100 * value / whole:.2f}")
        rows.append(row)
    return Table("Energy ledger", head, rows)


def cost_table(runs: Runs) -> Table:
    """Return what each run cost: wall time, ranks, steps, memory."""
    def summary(m: Measurements) -> dict:
        try:
            return run_files.read_summary(m.deposit.folder)
        except InputError:
            return {}

    rows = {id(m): {**summary(m), **_cycle_row(m)} for _, m in runs}

    def entry(key: str, form: Callable[[float], str]) -> Callable[[Measurements], str]:
        def text(m: Measurements) -> str:
            value = _number(rows[id(m)].get(key))
            return "-" if value is None else form(value)
        return text

    table = _rows(runs, (
        ("wall time", entry("wall_s", lambda v: f"{v / 60:.1f} min" if v >= 60 else f"{v:.1f} s")),
        ("ranks", entry("ranks", lambda v: f"{v:.0f}")), ("steps", entry("steps", lambda v: f"{v:,.0f}")),
        ("million active cell-steps per second", entry("active_cell_steps_per_s", lambda v: f"{1e-6 * v:.2f}")),
        ("peak memory of all ranks", entry("peak_memory_bytes", pretty_bytes)),
        ("mass drift", entry("mass_drift_relative", lambda v: f"{v:.1e}"))))
    return Table(table.title, ["", *table.head[1:]], table.rows)


def handover_text(found: Handover | None) -> str:
    """Return what the check of the hand-over found, as one sentence."""
    if found is None:
        return "not checked: no checkpoint at the end of a cycle that another one follows, or left out"
    where = (f"cycle {found.cycle} to {found.cycle + 1}, {count_text(found.particles, 'particle')} painted, "
             f"{found.new_cells:,} of {found.cells:,} cells touched by them")
    if not found.checked and not found.different:
        return f"not checked: after cycle {found.cycle} no new sphere touches a cell of the box"
    if found.exact:
        return f"{where}: everywhere else not one bit of any saved field changed; the difference is zero"
    worst = ", ".join(f"{name} {value:.3g}" for name, value in found.differences.items() if value > 0.0)
    return f"{where}: {found.different} values changed elsewhere, by up to {worst or '0 (sign of zero)'}"


def flattening_verdict(names: Sequence[str], first: Measurements, second: Measurements) -> str:
    """Return which of two runs flattens its particles more, by both equations, or that the scatter hides it.

    By their tracers where both have them, else by their sections.
    """
    by_tracers = first.traced is not None and second.traced is not None
    flats = [m.traced.flattening if by_tracers else m.flattening for m in (first, second)]
    tests: dict[str, MeanDifference | None] = {
        text: mean_difference(getattr(flats[0], key), getattr(flats[1], key))
        for key, text in (("equation_5", "W/H, Eq. (5)"), ("equation_6", "W/D, Eq. (6)"))}
    if any(test is None for test in tests.values()):
        return (f"Which flattens more cannot be told: {flats[0].count} and {flats[1].count} particles were "
                f"{'measured by their tracers' if by_tracers else 'found in the sections'}.")
    numbers = "; ".join(
        f"mean {text}: {test.first:.3f} against {test.second:.3f} (difference {test.difference:+.3f}, 90 % interval "
        f"{test.low:+.3f} to {test.high:+.3f})" for text, test in tests.items())
    decided = {np.sign(test.difference) for test in tests.values() if test.decided}
    if len(decided) != 1:
        return f"Neither {names[0]} nor {names[1]} flattens more beyond the scatter: {numbers}."
    more = names[1] if decided.pop() > 0 else names[0]
    both = all(test.decided for test in tests.values())
    return f"{more} flattens more{'' if both else ' (by one of the two equations)'}: {numbers}."


def traced_finding(found: Measurements) -> str:
    """Return the flattening by tracers beside that from sections, as one sentence."""
    flat = found.traced.flattening
    if not flat.count:
        return "No particle that was traced is whole and in the deposit"
    have = "has" if flat.count == 1 else "have"
    text = (f"by tracers {count_text(flat.count, 'particle')} {have} a mean W/H of {np.nanmean(flat.equation_5):.3f} "
            f"and W/D of {np.nanmean(flat.equation_6):.3f}")
    fit = found.traced.fits["exact_6"]
    if fit is not None:
        low, high = (float(fit.line(edge(flat.true_diameter[np.isfinite(flat.width)]))) for edge in (np.min, np.max))
        text += f", W over the diameter before impact going from {low:.2f} (smallest) to {high:.2f} (largest)"
        if found.paper_height is not None:
            text += ", in the paper's Fig. 17 by Eq. (6) from about 1.2 to 1.4"
    tests = [mean_difference(getattr(flat, key), getattr(found.flattening, key)) for key in ("equation_5",
                                                                                             "equation_6")]
    if all(tests):
        text += (f"; {found.flattening.count} particles in sections show " + " and ".join(
            f"{test.second:.3f} (off by {test.difference:+.3f}, 90 % interval {test.low:+.3f} to {test.high:+.3f})"
            for test in tests))
    return text


def findings(runs: Runs) -> list[str]:
    """Return the sentences that a reader should see first."""
    texts = []
    for label, m in runs:
        h = m.heights
        text = (f"{label + ': ' if label else ''}{1e6 * h['dense']:.1f} µm dense-equivalent, {1e6 * h['mean']:.1f} µm "
                f"mean surface, {1e6 * h['maximum']:.1f} µm maximum height")
        if m.paper_height is not None:
            text += (f"; the paper gives {1e6 * m.paper_height:.0f} µm "
                     f"(mean surface {percent(h['mean'], m.paper_height)})")
        if m.porosity is not None:
            text += (f"; porosity {100 * m.porosity.exact:.2f} % exact, {100 * m.porosity.image.mean:.2f} % by image "
                     "analysis")
        if m.areal is not None:
            text += f"; Sa {1e6 * m.areal.Sa:.2f} µm at a cutoff of {1e6 * m.areal.cutoff:g} µm"
        if m.overlap is not None:
            text += (f"; overlap with the experiment {100 * m.overlap.over_union:.1f} %, which covers "
                     f"{100 * m.overlap.covered:.0f} % of the simulated width and is simulated over "
                     f"{100 * m.overlap.second_covered:.0f} % of its own")
        texts.append(f"{text}.")
        if m.traced is not None:
            texts.append(f"{label + ': ' if label else ''}{traced_finding(m)}.")
    if len(runs) == 2:
        texts.append(flattening_verdict([label for label, _ in runs], runs[0][1], runs[1][1]))
        medians = [float(deposit_percentiles(m, "peeq")[SHARES.index(0.5)]) for _, m in runs]
        one, two = ("-" if math.isnan(median) else f"{median:.3f}" for median in medians)
        texts.append(f"Median PEEQ of the deposit: {one} ({runs[0][0]}) and {two} ({runs[1][0]}, "
                     f"{percent(medians[1], medians[0])}).")
    return texts
