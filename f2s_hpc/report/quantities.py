"""The measurements as a list of named numbers: one source for the text, the JSON file, the comparison and the page."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.analysis import profile
from f2s_hpc.analysis.depth import SHARES
from f2s_hpc.analysis.flattening import Regression
from f2s_hpc.analysis.table import aligned
from f2s_hpc.report.measure import Measurements, deposit_percentiles
from f2s_hpc.report.traced import APART, CUT, FEW
from f2s_hpc.units import ZERO_CELSIUS

_INDENT = "   "
ROUND_OFF = 1e-9
"""A reference so much smaller than what is compared with it is none."""
PAPER_POROSITY = 0.0053
"""Image porosity of the paper's simulated multi-track deposit, section 5.3 (0.31 % in its micrograph)."""


@dataclass(frozen=True)
class Quantity:
    """One number: ``value`` in SI, shown as value x ``scale`` in ``unit`` with the format ``form``.

    ``key``: its name in the JSON file; ``paper``: the paper's value (SI) where it has one for this case.
    """

    group: str
    key: str
    name: str
    value: float | None
    unit: str = ""
    scale: float = 1.0
    form: str = ".3g"
    paper: float | None = None

    @property
    def topic(self) -> str:
        """What the group is about, the same for every run: its title without what stands in brackets."""
        return self.group.partition(" (")[0]

    def text(self, value: float | None = None) -> str:
        """Return ``value`` (SI; default: its own) in the unit shown, without the unit; "-" where there is none."""
        value = self.value if value is None else value
        if not _known(value):
            return "-"
        text = f"{value * self.scale:{self.form}}"
        return text if float(text) else f"{0.0:{self.form}}"  # (no negative zero)

    def off(self, value: float | None, reference: float | None) -> str:
        """Return how much ``value`` exceeds ``reference`` (SI) as text: in percent, for a share in points, in K.

        A percentage of a porosity near zero would make much of nothing.
        """
        if self.unit != "%":
            return (kelvins if self.unit == "°C" else percent)(value, reference)
        if not _known(value, reference):
            return "-"
        digits = self.form.lstrip("+")
        return f"{round((value - reference) * self.scale, int(digits[1:-1])) + 0.0:+{digits}} points"


def _length(group: str, key: str, name: str, value: float | None, paper: float | None = None,
            form: str = ".2f") -> Quantity:
    return Quantity(group, f"{key}_m", name, value, "µm", 1e6, form, paper)


def _share(group: str, key: str, name: str, value: float | None, paper: float | None = None) -> Quantity:
    return Quantity(group, key, name, value, "%", 100.0, ".3f", paper)


def quantities(found: Measurements) -> list[Quantity]:
    """Return every single number of the measurements, in the order in which they are shown."""
    return [*_heights(found), *_profile(found), *_roughness(found), *_porosity(found), *_flattening(found),
            *_traced(found), *_overall(found)]


def _heights(found: Measurements) -> list[Quantity]:
    group, paper = "Height above the substrate top", found.paper_height
    names = {"dense": "dense-equivalent, by volume fraction", "mean": "mean surface", "median": "median surface",
             "p95": "95th percentile of the surface", "maximum": "maximum of the surface"}
    return [_length(group, f"height_{key}", name, found.heights[key], paper) for key, name in names.items()]


def _profile(found: Measurements) -> list[Quantity]:
    along, mirrored = found.settings.along, found.settings.symmetric
    half = f"; half a track, mirrored at {profile.across(along)} = 0" if mirrored else ""
    group, whole = f"Profile across the track (mean along {along}{half})", ", of the whole track" if mirrored else ""
    size, over = found.size, found.overlap
    rows = [_length(group, "profile_maximum", "maximum height", size.maximum),
            _length(group, "profile_width", f"width at 5 % of the maximum{whole}", size.width),
            Quantity(group, "profile_area_m2", f"area{whole}", size.area, "µm²", 1e12, ".1f")]
    if over is not None:
        top = float(found.experiment.height.max())
        rows += [_length(group, "experiment_maximum", "maximum height of the experiment", top),
                 Quantity(group, "maximum_off_experiment", "maximum height, off the experiment",
                          size.maximum / top - 1.0, "%", 100.0, "+.1f"),
                 Quantity(group, "overlap_over_union", "overlap with the experiment, common area over union",
                          over.over_union, "%", 100.0, ".1f"),
                 Quantity(group, "overlap_over_experiment", "common area over that of the experiment",
                          over.over_second, "%", 100.0, ".1f"),
                 Quantity(group, "overlap_covered", "share of the simulated width that the experiment covers",
                          over.covered, "%", 100.0, ".1f"),
                 Quantity(group, "overlap_experiment_covered", "share of the experiment's width that is simulated",
                          over.second_covered, "%", 100.0, ".1f"),
                 _length(group, "overlap_shift", "shift of the simulated profile", over.shift)]
    return rows


def _roughness(found: Measurements) -> list[Quantity]:
    if found.areal is None:
        return []
    along, across, areal = found.rough_along, found.rough_across, found.areal
    track = found.settings.along
    group = f"Roughness (Gaussian filter, cutoff {1e6 * areal.cutoff:g} µm; ends: {areal.ends})"
    rows = []
    for key, rough, text in (("along", along, f"along {track}"),
                             ("across", across, f"along {profile.across(track)}")):
        length = f"{rough.profiles} profiles {text}, {1e6 * rough.length:.4g} µm long"
        rows += [_length(group, f"Ra_{key}", f"Ra, {length}", rough.Ra),
                 _length(group, f"Ra_{key}_scatter", f"{_INDENT}its standard deviation over them", rough.Ra_scatter),
                 _length(group, f"Rq_{key}", f"Rq, {text}", rough.Rq),
                 _length(group, f"Rq_{key}_scatter", f"{_INDENT}its standard deviation over them", rough.Rq_scatter),
                 _length(group, f"Pa_{key}", f"Pa, {text}, without filter", rough.Pa),
                 _length(group, f"Pq_{key}", f"Pq, {text}, without filter", rough.Pq)]
    return [*rows, _length(group, "Sa", "Sa", areal.Sa), _length(group, "Sq", "Sq", areal.Sq),
            _length(group, "Sa_unfiltered", "Sa without filter", areal.Sa_unfiltered),
            _length(group, "Sq_unfiltered", "Sq without filter", areal.Sq_unfiltered),
            _length(group, "Sz_unfiltered", "Sz without filter", areal.Sz_unfiltered),
            Quantity(group, "Ssk_unfiltered", "skewness Ssk without filter", areal.Ssk_unfiltered, "", 1.0, ".3f"),
            Quantity(group, "Sku_unfiltered", "kurtosis Sku without filter (normal: 3)", areal.Sku_unfiltered, "", 1.0,
                     ".3f")]


def _porosity(found: Measurements) -> list[Quantity]:
    porosity = found.porosity
    if porosity is None:
        return []
    group = "Porosity of the bulk (above the substrate top, below the surface zone)"
    image, pores = porosity.image, porosity.pores
    paper = PAPER_POROSITY if found.paper_height is not None else None
    return [_share(group, "porosity_exact", "exact, from volume fractions", porosity.exact),
            _share(group, "porosity_image", f"image analysis, mean of {image.sections} sections, threshold 0.5, pores "
                                            f"of {image.smallest} pixels or more", image.mean, paper),
            _share(group, "porosity_image_scatter", f"{_INDENT}its standard deviation over them", image.scatter),
            _share(group, "porosity_open", "open to the surface", pores.open),
            _share(group, "porosity_closed", "closed", pores.closed),
            _share(group, "porosity_thin", "in cells more than half full", pores.thin),
            Quantity(group, "porosity_closed_pores", "number of closed pores", float(pores.pores), "", 1.0, ".0f"),
            Quantity(group, "porosity_largest_pore_m3", "largest closed pore", pores.largest, "µm³", 1e18, ".4g"),
            _length(group, "porosity_surface_zone", "surface zone left out", porosity.zone),
            Quantity(group, "porosity_bulk_volume_m3", "volume of the bulk", porosity.volume, "µm³", 1e18, ".4g")]


def _mean(values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else None


def _flattening(found: Measurements) -> list[Quantity]:
    flat = found.flattening
    group = "Flattening of particles in sections, found by ridges of PEEQ"
    rows = [Quantity(group, "flattening_sections", "sections", float(found.section_planes), "", 1.0, ".0f"),
            Quantity(group, "flattening_particles", "particles measured", float(flat.count), "", 1.0, ".0f"),
            Quantity(group, "flattening_equation_5", "mean of W/H, Eq. (5)", _mean(flat.equation_5), "", 1.0, ".3f"),
            Quantity(group, "flattening_equation_6", "mean of W/D, Eq. (6)", _mean(flat.equation_6), "", 1.0, ".3f"),
            _length(group, "flattening_width", "mean width W", _mean(flat.width)),
            _length(group, "flattening_height", "mean height H", _mean(flat.height))]
    for key, name in (("equation_5", "W/H over W, Eq. (5)"), ("equation_6", "W/D over D, Eq. (6)")):
        rows += _line(group, f"flattening_{key}", name, found.fits[key])
    return rows


def _traced(found: Measurements) -> list[Quantity]:
    traced = found.traced
    if traced is None:
        return []
    group, flat = "Tracers: flattening of every particle, from the points that moved with it", traced.flattening

    def count(key: str, name: str, value: int) -> Quantity:
        return Quantity(group, f"tracer_{key}", name, float(value), "", 1.0, ".0f")

    def ratio(key: str, name: str, value: float | None) -> Quantity:
        return Quantity(group, f"tracer_{key}", name, value, "", 1.0, ".3f")

    five, six = _mean(flat.equation_5), _mean(flat.equation_6)
    rows = [count("particles", "particles measured", flat.count), count("cut", "cut by a side", traced.number(CUT)),
            count("apart", "flying, rebounded or gone", traced.number(APART)),
            count("few", "with too few points in the deposit for a shape", traced.number(FEW)),
            count("waiting", "not on the grid yet", traced.waiting), count("points", "points", traced.points),
            count("in_void", f"{_INDENT}of them in void cells", traced.in_void),
            count("outside", f"{_INDENT}of them outside of the box", traced.outside),
            ratio("equation_5", "mean of W/H, Eq. (5)", five), ratio("equation_6", "mean of W/D, Eq. (6)", six),
            ratio("exact_6", "mean of W over the diameter before impact", _mean(flat.exact_6)),
            ratio("bulk", "mean of D over the diameter before impact; 1 for upright spheroids, more for all else",
                  _mean(flat.diameter / flat.true_diameter)),
            _length(group, "tracer_width", "mean width W", _mean(flat.width)),
            _length(group, "tracer_height", "mean height H", _mean(flat.height))]
    for key, name in (("equation_5", "W/H over W, Eq. (5)"), ("equation_6", "W/D over D, Eq. (6)"),
                      ("exact_6", "W over the diameter before impact, over that")):
        rows += _line(group, f"tracer_{key}", name, traced.fits[key])
    for key, name, mine in (("equation_5", "W/H", five), ("equation_6", "W/D", six)):
        other = _mean(getattr(found.flattening, key))
        if mine is not None and other is not None:
            rows.append(Quantity(group, f"sections_{key}_less_tracers", f"mean {name} of the sections, off that",
                                 other / mine - 1.0, "%", 100.0, "+.1f"))
    return rows


def _line(group: str, key: str, name: str, fit: Regression | None) -> list[Quantity]:
    if fit is None:
        return []
    return [Quantity(group, f"{key}_slope_per_m", f"slope of {name}", fit.slope, "1/µm", 1e-6, ".4f"),
            Quantity(group, f"{key}_slope_error_per_m", f"{_INDENT}its standard error", fit.slope_error, "1/µm", 1e-6,
                     ".4f"),
            Quantity(group, f"{key}_intercept", f"intercept of {name}", fit.intercept, "", 1.0, ".3f")]


def _overall(found: Measurements) -> list[Quantity]:
    group = "State of the deposit (by volume, above the substrate top)"
    rows = []
    for name, text, unit, scale, form, shift in (("peeq", "PEEQ", "", 1.0, ".3f", 0.0),
                                                 ("temperature", "temperature", "°C", 1.0, ".1f", ZERO_CELSIUS),
                                                 ("von_mises", "von Mises stress", "MPa", 1e-6, ".1f", 0.0)):
        unit_key = {"": "", "°C": "_degC", "MPa": "_Pa"}[unit]
        for share, value in zip(SHARES, deposit_percentiles(found, name)):
            if share in (0.05, 0.5, 0.95):
                label = "median" if share == 0.5 else f"{100 * share:.0f}th percentile"
                rows.append(Quantity(group, f"{name}_p{100 * share:02.0f}{unit_key}", f"{text}, {label}",
                                     float(value) - shift if math.isfinite(value) else None, unit, scale, form))
    return rows


def _known(*values: float | None) -> bool:
    return all(value is not None and math.isfinite(value) for value in values)


def percent(first: float | None, second: float | None) -> str:
    """Return how much ``first`` exceeds ``second``, in percent of its size, as text; "-" where that has no meaning.

    That is also where the second is round-off beside the first.
    """
    if not _known(first, second) or (abs(second) <= ROUND_OFF * abs(first) and first != second):
        return "-"
    # + 0.0 turns a negative zero into a plain one
    return f"{round(100.0 * (first - second) / (abs(second) or 1.0), 1) + 0.0:+.1f} %"


def kelvins(first: float | None, second: float | None) -> str:
    """Return how much a temperature exceeds another, as text: a percentage would hang on where degC has its zero."""
    return f"{round(first - second, 1) + 0.0:+.1f} K" if _known(first, second) else "-"


@dataclass(frozen=True)
class Table:
    """A table to be written as text or HTML: all cells are text; the first column is left-aligned."""

    title: str
    head: list[str]
    rows: list[list[str]]

    def as_text(self) -> str:
        """Return the table for a terminal."""
        lines = aligned([self.head, *self.rows], left=(0,))
        return "\n".join([self.title, *(f"  {line}".rstrip() for line in lines)])


def tables(runs: Sequence[tuple[str, Measurements]]) -> list[Table]:
    """Return the quantities of one or two runs as tables, one per topic, with the paper's values where it has them.

    What either run has is shown, in order. Titles and names hold numbers of a run (a cutoff, a length): where the runs
    differ both are named. With two runs a column tells by how much the second exceeds the first: in percent, shares in
    points, temperatures in K. The paper is compared with the first run for which it has values.
    """
    labels = [label for label, _ in runs]
    by_topic: list[dict[str, dict[str, Quantity]]] = []
    for _, found in runs:
        by_topic.append({})
        for q in quantities(found):
            by_topic[-1].setdefault(q.topic, {})[q.key] = q
    result = []
    for topic in _union(by_topic):
        members = [topics.get(topic, {}) for topics in by_topic]
        titles = [next(iter(keys.values())).group if keys else None for keys in members]
        judged = next((n for n, keys in enumerate(members) if any(q.paper is not None for q in keys.values())), None)
        head = ["", "unit", *(label or "simulated" for label in labels)]
        head += ["difference"] if len(runs) == 2 else []
        if judged is not None:
            head += ["paper", f"{labels[judged]} off the paper" if judged else "off the paper"]
        rows = [_row([keys.get(key) for keys in members], labels, judged) for key in _union(members)]
        result.append(Table(_both(titles, labels), head, rows))
    return result


def _row(found: Sequence[Quantity | None], labels: Sequence[str], judged: int | None) -> list[str]:
    """Return the row of one quantity of all runs, None where a run lacks it; ``judged``: run to hold to the paper."""
    q = next(o for o in found if o is not None)
    line = [_both([o.name if o else None for o in found], labels), q.unit, *(o.text() if o else "-" for o in found)]
    values = [o.value if o else None for o in found]
    if len(found) == 2:
        # by how many percent a scatter differs says nothing
        line.append("" if q.name.startswith(_INDENT) else q.off(values[1], values[0]))
    if judged is not None:
        mine = found[judged]
        known = mine is not None and mine.paper is not None
        line += [q.text(mine.paper), q.off(mine.value, mine.paper)] if known else ["-", "-"]
    return line


def _union(lists: Sequence[Iterable[str]]) -> list[str]:
    """Return all names, in the order of the first list; what only another has stands behind what it follows there."""
    result: list[str] = []
    for names in lists:
        place = 0
        for name in names:
            if name not in result:
                result.insert(place, name)
            place = result.index(name) + 1
    return result


def _both(texts: Sequence[str | None], labels: Sequence[str]) -> str:
    """Return the text of all runs (None: a run has none), or where they differ each, with its label behind it."""
    there = [(text, label) for text, label in zip(texts, labels) if text is not None]
    if len({text for text, _ in there}) == 1:
        return there[0][0]
    heads = [re.split(r", | \(", text)[0] for text, _ in there]
    # (where one is all that they have in common, both are written whole)
    cut = len(heads[0]) if len(set(heads)) == 1 and all(len(text) > len(heads[0]) for text, _ in there) else 0
    return heads[0][:cut] + "; ".join(f"{text[cut:] if n == 0 else text[cut:].lstrip(', ')} [{label}]"
                                      for n, (text, label) in enumerate(there))


def _thickness(found: Measurements) -> str:
    """Return how thick the layers of the distributions are, and if that is not what was asked for, why."""
    wanted, real = found.settings.layer, found.layer
    asked = "" if abs(real - wanted) < 1e-6 * wanted else f" (whole cells; {1e6 * wanted:g} µm were asked for)"
    return f", in layers of {1e6 * real:g} µm{asked}"


def depth_tables(runs: Sequence[tuple[str, Measurements]]) -> list[Table]:
    """Return PEEQ, temperature and stress by depth as tables, from the top down, in the layers of the first run.

    With one run: median, 5 and 95 %; with two, both medians, the second's read off between its layers, and by how much
    it exceeds the first.
    """
    result = []
    for name, title, shift, scale, form in (("peeq", "PEEQ", 0.0, 1.0, ".3f"),
                                            ("temperature", "Temperature (°C)", ZERO_CELSIUS, 1.0, ".1f"),
                                            ("von_mises", "Von Mises stress (MPa)", 0.0, 1e-6, ".1f")):
        own = runs[0][1].distributions[name]
        columns = [own.median]
        if len(runs) == 2:
            other = runs[1][1].distributions[name]
            known = np.isfinite(other.median)
            columns.append(np.interp(own.middle, other.middle[known], other.median[known], left=np.nan, right=np.nan)
                           if known.any() else np.full(own.low.size, np.nan))
        rows = []
        for n in range(own.low.size):
            values = [(float(column[n]) - shift) * scale for column in columns]
            line = [f"{1e6 * own.low[n]:.0f} to {1e6 * own.high[n]:.0f} µm",
                    *("-" if math.isnan(v) else f"{v:{form}}" for v in values)]
            if len(runs) == 1:
                line += [f"{(v - shift) * scale:{form}}" for v in own.percentiles[n][[0, -1]]]
            else:
                line.append(kelvins(values[1], values[0]) if name == "temperature" else percent(values[1], values[0]))
            rows.append(line)
        head = (["height", "median", "5 %", "95 %"] if len(runs) == 1
                else ["height", *(label for label, _ in runs), "difference"])
        layers = _thickness(runs[0][1])
        result.append(Table(f"{title} by height above the substrate top, median by volume{layers}", head, rows[::-1]))
    return result
