"""What ``f2s analyse``, ``f2s compare`` and ``f2s report`` do. Alone, on one process, from the files of a run."""

from __future__ import annotations

import json
import math
import os
import pathlib
import tempfile
from collections.abc import Sequence

import numpy as np

from f2s_hpc import mpi, places
from f2s_hpc.analysis.depth import SHARES
from f2s_hpc.analysis.profile import Profile
from f2s_hpc.errors import InputError
from f2s_hpc.grid import petsc
from f2s_hpc.report import facts, traced
from f2s_hpc.report.deposit import load_deposit
from f2s_hpc.report.draw import draw_all
from f2s_hpc.report.experiment import read_profile, write_columns
from f2s_hpc.report.handover import check_handover, memory_needed
from f2s_hpc.report.measure import Measurements, Settings, measure
from f2s_hpc.report.page import build_page
from f2s_hpc.report.quantities import ROUND_OFF, depth_tables, quantities, tables
from f2s_hpc.units import pretty_bytes

ANALYSIS, REPORT = "analysis", "report.html"
MEMORY_SHARE = 0.7
"""The hand-over is not checked when the state of the run takes more than this share of the machine's memory."""

LATER = 1e-6
"""Share of the time by which two states may be apart and count as of the same time."""

_MICRO = 1e6


def alone(command: str) -> None:
    """Raise ``InputError`` under several ranks: they would all write the same files."""
    if mpi.size() > 1:
        raise InputError(f"f2s {command}: works alone; start it without mpirun")


def measured(folder: str, settings: Settings, cycle: int | None = None, experiment: Profile | None = None,
             handover: bool = True) -> Measurements:
    """Return the measurements of the run in ``folder``; ``handover``: check the newest hand-over too,
    where what the solver stands on is installed and the memory suffices; else a note tells why not.

    Raises ``InputError`` for what is no run or cannot be measured, ``CheckpointError`` for damaged files.
    """
    found = measure(load_deposit(folder, cycle), settings, experiment)
    if not handover:
        return found
    need = memory_needed(found.deposit.scene)
    if lacking := petsc.lacking():
        found.notes.append(f"hand-over between cycles: not checked; it takes the solver, and {lacking}")
    elif need > MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"):
        found.notes.append(f"hand-over between cycles: not checked; it takes {pretty_bytes(need)}, too much for this "
                           "machine")
    else:
        found.handover = check_handover(folder, cycle)
    return found


def analyse(folder: str, settings: Settings, cycle: int | None = None, experiment: str | None = None,
            out: str | None = None, json_file: str | None = None, handover: bool = True) -> int:
    """Measure a run, print the tables, and write JSON, CSV and PNG files into ``out``; return the exit code.

    ``out``: default ``analysis`` in the run's folder; ``json_file``: one more copy of the numbers. The exit code is 1
    when the hand-over between cycles changed anything.
    """
    alone("analyse")
    profile = read_profile(experiment) if experiment else None
    place = pathlib.Path(out) if out else places.run_folder(folder) / ANALYSIS
    places.check_folder(place, "--out")
    if json_file:
        places.check_file(json_file, "--json")
    found = measured(folder, settings, cycle, profile, handover)
    places.make_folder(place, "--out")
    print(f"{found.deposit.scene.title}: {facts.subtitle([('', found)])}, from {found.deposit.source}")
    print("\n\n".join(table.as_text() for table in [*tables([("", found)]), *depth_tables([("", found)])]))
    if handover:
        print(f"\nHand-over between cycles: {facts.handover_text(found.handover)}")
    for note in found.notes:
        print(f"note: {note}")
    numbers = json.dumps(as_dictionary(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    for path in [place / "analysis.json", *([json_file] if json_file else [])]:
        places.write_text(path, numbers)
    _write_tables(place, found)
    drawn = draw_all(place, [("", found)])
    print(f"written to {place}: analysis.json, {', '.join(sorted(p.name for p in place.glob('*.csv')))}, "
          f"{sum(map(len, drawn.values()))} figures")
    return int(_handover_is_wrong(found))


def _handover_is_wrong(found: Measurements) -> bool:
    """Did the hand-over, where it was checked, change anything?"""
    return bool(found.handover and found.handover.different)


def report(folder: str, settings: Settings, second: str | None = None, cycle: int | None = None,
           experiment: str | None = None, out: str | None = None, handover: bool = True) -> int:
    """Write the page about the run in ``folder``, beside a ``second`` one if given; return the exit code.

    ``out``: the HTML file, default ``report.html`` in the run's folder. The exit code is that of :func:`analyse`, for
    either run.
    """
    alone("report")
    profile = read_profile(experiment) if experiment else None
    path = pathlib.Path(out) if out else places.run_folder(folder) / REPORT
    places.check_file(path, "--out")
    folders = [folder] if second is None else [folder, second]
    labels = run_labels(folders) if second is not None else [""]
    runs = [(label, measured(name, settings, cycle, profile, handover)) for label, name in zip(labels, folders)]
    with tempfile.TemporaryDirectory() as pictures:
        page = build_page(runs, draw_all(pathlib.Path(pictures), runs))
    places.write_text(path, page)
    for text in facts.findings(runs):
        print(text)
    wrong = [(label, found) for label, found in runs if _handover_is_wrong(found)]
    for label, found in wrong:
        print(f"{label + ': ' if label else ''}hand-over between cycles: {facts.handover_text(found.handover)}")
    print(f"report {path} ({len(page) / 1e6:.1f} MB, one file, opens without network)")
    return int(bool(wrong))


def compare_measurements(first: str, second: str, settings: Settings) -> str:
    """Return the measurements of two runs and their differences in percent, as text."""
    runs = [(label, measured(folder, settings, handover=False))
            for label, folder in zip(run_labels([first, second]), (first, second))]
    parts = [table.as_text() for table in [*tables(runs), *depth_tables(runs)]]
    parts += [_profile_difference(runs), facts.flattening_verdict([n for n, _ in runs], runs[0][1], runs[1][1])]
    notes = _comparison_notes(runs)
    if notes:
        parts.append("\n".join(notes))
    return "\n\n".join([f"Compared: {facts.subtitle(runs)}", *parts])


def _comparison_notes(runs: facts.Runs) -> list[str]:
    """Return the notes of both runs, and whether the states compared are of different times."""
    notes = [f"note ({label}): {text}" for label, m in runs for text in m.notes]
    (cycle, time), (other, second) = ((m.deposit.cycle, m.deposit.time) for _, m in runs)
    if cycle != other or abs(second - time) > LATER * max(time, second):
        notes.append(f"note: the states are of different times, the ends of cycle {cycle} and {other}, "
                     f"{_MICRO * time:.3f} and {_MICRO * second:.3f} µs")
    return notes


def run_labels(folders: Sequence[str]) -> list[str]:
    """Return short names of runs: the folders' own where they differ, else as they were given."""
    names = [pathlib.Path(folder).resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [os.fspath(folder) for folder in folders]


def _profile_difference(runs: facts.Runs) -> str:
    """Return how far the mean profiles are apart, where both are known."""
    one, two = (m.profile for _, m in runs)
    inside = (one.x >= two.x[0]) & (one.x <= two.x[-1])
    if not inside.any():
        return "Mean profiles: no place in common"
    gap = np.interp(one.x[inside], two.x, two.height) - one.height[inside]
    rms = float(np.sqrt((gap**2).mean()))
    scale = float(one.height.max())
    worst = float(np.abs(gap).max())
    text = f"Mean profiles: {_MICRO * rms:.2f} µm apart (root mean square), at most {_MICRO * worst:.2f} µm"
    if scale <= ROUND_OFF * runs[0][1].deposit.dx:
        return text
    return f"{text}; {100 * rms / scale:.1f} and {100 * worst / scale:.1f} % of the maximum of the first"


def as_dictionary(found: Measurements) -> dict:
    """Return all numbers for a JSON file, SI, temperatures in degC where the key says so; what is missing is None."""
    deposit = found.deposit
    result = {
        "run": str(deposit.folder), "scene": deposit.scene.title, "source": deposit.source.name,
        "cycle": deposit.cycle, "time_s": deposit.time, "cell_size_m": deposit.dx,
        "cutoff_m": found.settings.cutoff, "track_along": found.settings.along,
        "profile_mirrored": found.settings.symmetric, "layer_m": found.layer,
        "surface_zone_m": found.porosity.zone if found.porosity else None, "paper_height_m": found.paper_height,
        **{q.key: q.value if q.value is not None and math.isfinite(q.value) else None for q in quantities(found)},
        "notes": found.notes}
    if found.areal is not None:
        result |= {"filter_ends": found.areal.ends, "profile_length_along_m": found.rough_along.length,
                   "profile_length_across_m": found.rough_across.length,
                   "length_is_standard": found.rough_along.standard and found.rough_across.standard}
    if found.handover is not None:
        hand = found.handover
        result["handover"] = {"cycle": hand.cycle, "checked": hand.checked, "exact": hand.exact,
                              "particles": hand.particles, "values_different": hand.different,
                              "cells": hand.cells, "cells_touched": hand.new_cells, "differences": hand.differences}
    for name, d in found.distributions.items():
        result[f"{name}_by_height"] = {
            "low_m": d.low.tolist(), "high_m": d.high.tolist(), "volume_m3": d.volume.tolist(),
            "mean": _plain(d.mean), "shares": list(SHARES), "percentiles": [_plain(row) for row in d.percentiles]}
    return result


def _plain(values: np.ndarray) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in values]


def _write_tables(place: pathlib.Path, found: Measurements) -> None:
    """Write the CSV files: profile, particles, distributions, height map."""
    profile, flat, deposit = found.profile, found.flattening, found.deposit
    write_columns(place / "profile.csv", {"x_um": _micro(profile.x), "height_um": _micro(profile.height)})
    write_columns(place / "flattening.csv", {
        "width_um": _micro(flat.width), "height_um": _micro(flat.height), "equation_5": flat.equation_5.tolist(),
        "diameter_um": _micro(flat.diameter), "equation_6": flat.equation_6.tolist()})
    if found.traced is not None:
        write_columns(place / "flattening-tracers.csv", traced.columns(found.traced))
    for name, d in found.distributions.items():
        unit = {"peeq": "", "temperature": "_K", "von_mises": "_Pa"}[name]
        columns = {"low_um": _micro(d.low), "high_um": _micro(d.high), "volume_um3": (1e18 * d.volume).tolist(),
                   f"mean{unit}": d.mean.tolist()}
        columns |= {f"p{100 * share:02.0f}{unit}": d.percentiles[:, n].tolist() for n, share in enumerate(SHARES)}
        write_columns(place / f"{name}-by-height.csv", columns)
    j, i = np.indices(deposit.surface.shape)
    write_columns(place / "height-map.csv", {
        "x_um": _micro((i.ravel() + 0.5) * deposit.dx), "y_um": _micro((j.ravel() + 0.5) * deposit.dx),
        "height_um": _micro(deposit.surface.ravel() - deposit.ground)})


def _micro(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in _MICRO * np.asarray(values)]
