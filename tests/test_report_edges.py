"""Analyses at their edges: nothing landed, round-off, moved profiles, coarse cells, PEEQ of zero; their CSV files."""

from __future__ import annotations

import csv
import dataclasses
import pathlib
import re

import numpy as np
import pytest
from test_report_numbers import CELLS, DX, GROUND, SCENE, SETTINGS, made

from f2s_hpc.analysis.boundaries import basins
from f2s_hpc.analysis.profile import Profile
from f2s_hpc.config import parse_scene
from f2s_hpc.errors import InputError
from f2s_hpc.report import facts
from f2s_hpc.report.commands import analyse, compare_measurements
from f2s_hpc.report.draw import draw_all
from f2s_hpc.report.measure import Settings, measure
from f2s_hpc.report.quantities import Quantity, percent


def test_an_empty_deposit_is_compared_and_drawn_without_nonsense(monkeypatch, tmp_path):
    """Nothing lies on the substrate of one run, which has none itself: no number of it, and no percentage of nothing.

    Fails when ``depth_tables`` interpolates in no layer, ``percent`` divides by what is round-off, or ``draw_all``
    draws the flattening of no particle.
    """
    first = made()
    nothing = np.zeros_like(first.fraction)
    bare = dataclasses.replace(first, fraction=nothing, landed=nothing > 0.0,
                               surface=np.full_like(first.surface, GROUND * DX - 7e-21))
    both = {"a": first, "b": bare}
    monkeypatch.setattr("f2s_hpc.report.commands.load_deposit", lambda folder, cycle: both[folder])
    for one, two in (("a", "b"), ("b", "a")):
        said = compare_measurements(one, two, SETTINGS)
        assert "nan" not in said
        assert "-0.00" not in said
        assert max(map(float, re.findall(r"([\d.]+) (?:%|µm)", said)), default=0.0) < 1e6
    runs = [(name, measure(deposit, SETTINGS)) for name, deposit in both.items()]
    assert "PEEQ of the deposit: 2.000 (a) and - (b, -)" in " ".join(facts.findings(runs))
    assert draw_all(tmp_path, runs)["profile"][0].exists()
    assert "flattening" not in draw_all(tmp_path, runs[1:])  # (no axes around no particles)
    scan = Profile(np.array([0.0, 60e-6]), np.array([10e-6, 10e-6]))
    assert "overlap: nothing has landed" in " ".join(measure(bare, SETTINGS, scan).notes)


def test_percentages_are_of_the_size_of_what_they_refer_to():
    """-1 is more than -2: by half of its size. Fails when the sign of the reference turns that of the difference."""
    assert percent(-1e-6, -2e-6) == "+50.0 %"
    assert percent(-3.0, 2.0) == "-250.0 %"
    assert percent(1.0, 1e-12) == percent(1.0, 0.0) == percent(None, 1.0) == "-"
    assert percent(0.0, 0.0) == "+0.0 %"
    degrees = Quantity("state", "temperature_p50_degC", "temperature, median", 40.0, "°C", 1.0, ".1f")
    assert degrees.off(40.0, 20.0) == "+20.0 K"


def test_a_comparison_tells_of_different_times_and_passes_notes_on(monkeypatch):
    """Fails when ``compare_measurements`` leaves out what the measurements note."""
    first = made()
    later = dataclasses.replace(first, cycle=2, time=4e-9, detached=1e-15)
    both = {"a": first, "b": later}
    monkeypatch.setattr("f2s_hpc.report.commands.load_deposit", lambda folder, cycle: both[folder])
    said = compare_measurements("a", "b", SETTINGS)
    assert "a: 10 particles, cycle 1 of 3, 0.002 µs" in said.splitlines()[0]
    assert "the ends of cycle 1 and 2" in said
    assert "note (b): heights: 1e+03 µm³ of slow fragments hang in the air" in said
    assert "different times" not in compare_measurements("a", "a", SETTINGS)


def test_the_profile_is_drawn_where_it_was_compared(monkeypatch, tmp_path):
    """Fails when ``draw_all`` gives ``profiles`` the profile before it was moved."""
    deposit = made()
    own = measure(deposit, SETTINGS).profile
    found = measure(deposit, dataclasses.replace(SETTINGS, align=True), dataclasses.replace(own, x=own.x + 3e-4))
    drawn = []
    monkeypatch.setattr("f2s_hpc.analysis.figures.profiles", lambda path, runs, *more: drawn.extend(runs))
    draw_all(tmp_path, [("", found)])
    (name, profile), = drawn
    assert name == "mean profile, moved by 300.0 µm"
    assert np.allclose(profile.x, own.x + 3e-4)


def test_cells_too_coarse_for_the_usual_cutoff_leave_roughness_out():
    """One that was asked for is refused. Fails when ``_roughness`` lets the filter judge both."""
    coarse = made(pathlib.Path("nowhere"), 'domain.cell_size="2 um"')
    coarse = dataclasses.replace(coarse, scene=parse_scene(SCENE.replace('"2 um"', '"24 um"'), "test"))
    assert any("--cutoff" in note for note in measure(coarse, Settings()).notes)
    with pytest.raises(InputError, match="cutoff 81 um"):
        measure(coarse, Settings(cutoff=81e-6))


def test_basins_of_no_peeq_are_one_particle_each():
    """Fails when ``_merge`` asks for a ridge lower than its share of nothing."""
    y, x = np.mgrid[:40, :40] - 19.5
    distance = np.hypot(x, y)
    peeq = np.where((distance > 10.0) & (distance < 13.0), 2.0, 0.0)
    assert basins(peeq, np.full(peeq.shape, True), smoothing=0.0).max() == 2


def test_csv_files_hold_what_their_heads_say(tmp_path, monkeypatch):
    """Fails when x and y of the height map change places, its heights count from the bottom of the box, a column has
    another unit, or one is that of its neighbour.
    """
    deposit = dataclasses.replace(made(), peeq=1.0 + np.random.Generator(np.random.PCG64(2)).random(CELLS[::-1]))
    monkeypatch.setattr("f2s_hpc.report.commands.load_deposit", lambda folder, cycle: deposit)
    monkeypatch.setattr("f2s_hpc.report.commands.draw_all", lambda folder, runs: {})
    settings = dataclasses.replace(SETTINGS, prominence=0.05)
    assert analyse("nowhere", settings, out=str(tmp_path), handover=False) == 0
    found = measure(deposit, settings)

    def columns(name: str) -> dict[str, np.ndarray]:
        with (tmp_path / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        return dict(zip(head, np.array(rows, dtype=float).T, strict=True))

    j, i = np.indices(deposit.surface.shape)
    flat, layers = found.flattening, found.distributions["temperature"]
    assert flat.count > 0
    wanted = {
        "profile": {"x_um": 1e6 * found.profile.x, "height_um": 1e6 * found.profile.height},
        "height-map": {"x_um": 2.0 * i.ravel() + 1.0, "y_um": 2.0 * j.ravel() + 1.0,
                       "height_um": 1e6 * deposit.surface.ravel() - 20.0},
        "flattening": {"width_um": 1e6 * flat.width, "height_um": 1e6 * flat.height, "equation_5": flat.equation_5,
                       "diameter_um": 1e6 * flat.diameter, "equation_6": flat.equation_6},
        "temperature-by-height": {
            "low_um": 1e6 * layers.low, "high_um": 1e6 * layers.high, "volume_um3": 1e18 * layers.volume,
            "mean_K": layers.mean, **{f"p{n}_K": p for n, p in zip(("05", "25", "50", "75", "95"),
                                                                    layers.percentiles.T)}}}
    for name, expected in wanted.items():
        found_columns = columns(name)
        assert list(found_columns) == list(expected)
        for column, numbers in expected.items():
            assert found_columns[column] == pytest.approx(numbers, rel=1e-6, abs=1e-6), (name, column)


def test_a_pore_that_reaches_into_the_surface_zone_stays_closed():
    """Fails when the way out of a pore is told by the top of the bulk and not by the surface."""
    deposit = made()
    deposit.fraction[31:37, 10:12, 10:12] = 0.0  # the surface is at 40, the zone is 5 cells thick
    pores = measure(deposit, dataclasses.replace(SETTINGS, surface_zone=10e-6)).porosity.pores
    assert pores.open == 0.0
    assert pores.pores == 1
    assert 4 * 2 * DX**3 < pores.largest < 4 * 5 * DX**3
