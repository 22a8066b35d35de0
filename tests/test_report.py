"""analyse, compare and report on small runs: what they print, write and refuse, and the hand-over between cycles."""

from __future__ import annotations

import base64
import dataclasses
import html.parser
import json
import math
import pathlib
import re
import shutil
import types

import numpy as np
import pytest

from f2s_hpc.analysis.surface import attached_material, landed_surface
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene
from f2s_hpc.errors import InputError
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.report.commands import as_dictionary
from f2s_hpc.report.deposit import checkpoint_fields, checkpoints_by_cycle, load_deposit
from f2s_hpc.report.draw import draw_all
from f2s_hpc.report.facts import flattening_verdict, handover_text
from f2s_hpc.report.handover import check_handover
from f2s_hpc.report.measure import Settings, is_section4, measure, paper_height
from f2s_hpc.report.page import build_page
from f2s_hpc.report.quantities import Quantity, percent, quantities, tables

SCENE = """
title = "Two batches <on> a small patch"

[domain]
size = ["60 um", "72 um", "150 um"]
cell_size = "6 um"
substrate_height = "30 um"
particle_layer_height = "72 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"
flight = "eulerian"

[batches]
count = 2
particles = 6
seed = 3
diameter_d10 = "20 um"
diameter_d50 = "26 um"
diameter_d90 = "34 um"
diameter_min = "14 um"
diameter_max = "40 um"

[cycles]
count = 2
duration = "0.13 us"
last_duration = "0.2 us"
"""


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory) -> tuple[pathlib.Path, pathlib.Path]:
    """Return the folders of two small runs that differ in the material model."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    made = []
    for name, material in (("ge", "copper-ge"), ("jc", "copper-johnson-cook")):
        made.append(folder / name)
        assert main(["run", str(folder / "scene.toml"), "--out", str(made[-1]), "--set",
                     f'material.name="{material}"']) == 0
    return made[0], made[1]


@pytest.fixture(scope="module")
def ballistic_run(two_runs) -> pathlib.Path:
    """Return the folder of the first run with the default flight."""
    folder = two_runs[0].parent
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "ballistic"), "--set",
                 'particles.flight="ballistic"']) == 0
    return folder / "ballistic"


@pytest.fixture(params=["eulerian", "ballistic"])
def run_of_each_flight(request, two_runs, ballistic_run) -> pathlib.Path:
    return two_runs[0] if request.param == "eulerian" else ballistic_run


@pytest.fixture(scope="module")
def page(two_runs, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("page") / "page.html"
    assert main(["report", str(two_runs[0]), "--with", str(two_runs[1]), "--out", str(path), "--cutoff", "30 um"]) == 0
    return path.read_text(encoding="utf-8")


class Reader(html.parser.HTMLParser):
    """Collects tags, addresses and text of a page; fails on a tag that is not closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open, self.addresses, self.text, self.images = [], [], [], 0

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.addresses += [values[key] for key in ("src", "href") if key in values]
        self.images += tag == "img"
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.mark.parametrize("cycle", [1, 2])
def test_a_checkpoint_is_read_as_the_run_saw_it(two_runs, cycle, monkeypatch):
    """Fails when a derived field is wrong at the joints of the slabs, or a node layer is missed."""
    monkeypatch.setattr("f2s_hpc.report.deposit._LAYERS_AT_ONCE", 4)
    arrays, attributes = checkpoint_fields(checkpoints_by_cycle(two_runs[0])[cycle])
    frame, _ = runs.open_frame(two_runs[0], cycle - 1)
    assert attributes["cycle"] == cycle
    assert set(arrays) == {"volume_fraction", "peeq", "temperature", "von_mises", "speed"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, frame[name], err_msg=name)
    deposit = load_deposit(two_runs[0], cycle)
    assert deposit.source.suffix == ".h5"
    fraction, slow = frame["volume_fraction"], frame["speed"] < 615.0 / 3.0
    assert deposit.landed.tolist() == attached_material(fraction, slow).tolist()
    detached = fraction[slow & ~deposit.landed].sum(dtype=float) * 6e-6**3
    assert deposit.detached == pytest.approx(detached, rel=1e-6, abs=0.0)
    np.testing.assert_array_equal(deposit.surface, landed_surface(fraction, deposit.landed, 6e-6))
    assert deposit.diameters.size == 6 * cycle


def test_a_cycle_without_its_checkpoint_is_read_from_its_frame(two_runs, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(two_runs[0], copy)
    shutil.rmtree(copy / "checkpoints")
    one, two = load_deposit(copy, 2), load_deposit(two_runs[0], 2)
    assert one.source.suffix == ".vtkhdf"
    assert one.time == pytest.approx(two.time, rel=1e-6, abs=0.0)
    np.testing.assert_array_equal(one.fraction, two.fraction)
    assert check_handover(copy) is None
    with pytest.raises(InputError, match="nothing saved of cycle 7; there is 1, 2"):
        load_deposit(copy, 7)


def test_the_handover_changes_nothing_but_the_new_particles(run_of_each_flight):
    """Fails when ``_put_in`` returns ``report.positions`` for both flights: a ballistic batch is only launched."""
    found = check_handover(run_of_each_flight)
    assert (found.cycle, found.particles, found.exact, found.different) == (1, 6, True, 0)
    assert 0 < found.new_cells < found.cells
    assert {"volume_fraction", "peeq", "temperature", "von_mises", "velocity_z", "stress_xz"} <= set(found.differences)
    assert set(found.differences.values()) == {0.0}
    assert "not one bit" in handover_text(found)


def test_a_handover_that_loses_strain_is_seen(run_of_each_flight, tmp_path, monkeypatch, capsys):
    """Fails when changed cells are taken for new ones, only fields of new cells are compared, or the exit code of
    ``report`` or ``analyse`` does not tell.
    """
    from f2s_hpc.cycles import insert

    added = insert.add_material

    def forgetful(state, *arguments):
        quanta = added(state, *arguments)
        state.views["peeq"][:] = np.where(state.views["mass"] > 0.0, 0.5, 0.0)
        return quanta

    monkeypatch.setattr(insert, "add_material", forgetful)
    found = check_handover(run_of_each_flight)
    assert not found.exact
    assert found.differences["peeq"] > 0.1
    assert found.differences["temperature"] == 0.0
    assert main(["analyse", str(run_of_each_flight), "--cutoff", "30 um"]) == 1
    assert "values changed elsewhere, by up to" in capsys.readouterr().out
    page = tmp_path / "page.html"
    assert main(["report", str(run_of_each_flight), "--cutoff", "30 um", "--out", str(page)]) == 1
    assert "hand-over between cycles: cycle 1 to 2" in capsys.readouterr().out
    assert "values changed elsewhere, by up to" in page.read_text(encoding="utf-8")


def test_a_handover_without_a_new_sphere_is_not_checked(ballistic_run, monkeypatch, capsys):
    """Fails when ``exact`` of ``Handover`` leaves out ``self.checked``: the state is compared with its own file."""
    from f2s_hpc.cycles.flight import Flight

    monkeypatch.setattr(Flight, "take_inside", lambda self, time: None)
    found = check_handover(ballistic_run)
    assert (found.particles, found.new_cells, found.different, found.exact) == (0, 0, 0, False)
    assert main(["analyse", str(ballistic_run), "--cutoff", "30 um"]) == 0
    said = capsys.readouterr().out
    assert "Hand-over between cycles: not checked: after cycle 1 no new sphere" in said
    assert "not one bit" not in said


def test_analyse_writes_what_it_prints(two_runs, tmp_path, capsys):
    out, copy = tmp_path / "out", tmp_path / "numbers.json"
    arguments = ["analyse", str(two_runs[0]), "--out", str(out), "--json", str(copy), "--cutoff", "30 um"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    numbers = json.loads(copy.read_text(encoding="utf-8"))
    assert json.loads((out / "analysis.json").read_text(encoding="utf-8")) == numbers
    summary = runs.read_summary(two_runs[0])
    assert numbers["height_mean_m"] == pytest.approx(summary["height_mean_m"], rel=1e-6)
    assert numbers["height_maximum_m"] == pytest.approx(summary["height_max_m"], rel=1e-6)
    assert numbers["height_dense_m"] == pytest.approx(summary["dense_height_m"], rel=0.02)
    assert numbers["cutoff_m"] == pytest.approx(30e-6)
    assert numbers["paper_height_m"] is None
    assert numbers["handover"]["exact"]
    assert f"{1e6 * numbers['height_mean_m']:.2f}" in said
    for text in ("cutoff 30 µm", "not one bit", "PEEQ by height", "W/H, Eq. (5)", "exact, from volume fractions"):
        assert text in said
    assert {p.name for p in out.glob("*.csv")} == {"profile.csv", "flattening.csv", "height-map.csv",
                                                   "peeq-by-height.csv", "temperature-by-height.csv",
                                                   "von_mises-by-height.csv"}
    assert {"profile.png", "height-map.png", "sections.png", "depth.png", "roughness.png"} <= {
        p.name for p in out.glob("*.png")}
    # its own profile is a perfect experiment
    assert main([*arguments, "--experiment", str(out / "profile.csv"), "--no-handover"]) == 0
    numbers = json.loads(copy.read_text(encoding="utf-8"))
    assert numbers["overlap_over_union"] == pytest.approx(1.0, abs=1e-6)
    assert "handover" not in numbers
    assert numbers["overlap_covered"] == pytest.approx(1.0, abs=1e-6)
    assert numbers["profile_mirrored"] is False
    capsys.readouterr()
    assert main([*arguments, "--symmetric", "--no-handover"]) == 0
    assert "half a track, mirrored at x = 0" in capsys.readouterr().out
    assert json.loads(copy.read_text(encoding="utf-8"))["profile_mirrored"]


def test_the_page_holds_everything_and_needs_nothing(page):
    """Fails when a figure is linked instead of embedded, a section is missing, or a title is not escaped."""
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert all(a.startswith(("data:image/png;base64,", "#")) for a in reader.addresses)
    assert not re.search(r"https?:|@import|url\(|<script|<link", page)
    assert reader.images >= 13
    for data in re.findall(r'src="data:image/png;base64,([^"]+)"', page):
        assert base64.b64decode(data, validate=True).startswith(b"\x89PNG")
    anchors = [a for a in reader.addresses if a.startswith("#")]
    assert all(f'id="{anchor[1:]}"' in page for anchor in anchors)
    text = " ".join(reader.text)
    for word in ("Two batches <on> a small patch", "Finding", "Scene", "Particles", "Heights", "Roughness", "Porosity",
                 "Sections", "Flattening", "Energy ledger", "Run time", "Hand-over", "not one bit", "difference",
                 "plastic work", "cutoff 30 µm", "ge", "jc", "johnson cook", "wall time", "dense-equivalent"):
        assert word in text, word
    assert re.search(r"flattens more|cannot be told", text)


def test_a_page_about_one_run_needs_no_labels(two_runs, tmp_path, capsys):
    assert main(["report", str(two_runs[0]), "--cycle", "1", "--no-handover", "--cutoff", "30 um", "--out",
                 str(tmp_path / "one.html")]) == 0
    reader = Reader()
    reader.feed((tmp_path / "one.html").read_text(encoding="utf-8"))
    assert "flattens more" not in " ".join(reader.text)
    assert "opens without network" in capsys.readouterr().out


def test_compare_measures_before_it_counts_bits(two_runs, capsys):
    assert main(["compare", *map(str, two_runs), "--cutoff", "30 um"]) == 0
    said = capsys.readouterr().out
    for text in ("mean surface", "difference", "PEEQ by height", "Temperature (°C) by height", "Mean profiles"):
        assert text in said
    assert said.splitlines()[-1].startswith("not identical")
    assert main(["compare", str(two_runs[0]), str(two_runs[0]), "--exact"]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[-1].startswith("identical in every saved bit")
    assert "mean surface" not in said


def test_the_verdict_names_the_run_that_flattens_more(two_runs, rng):
    """Fails when the two runs are swapped, or a difference inside the scatter is called one."""
    from f2s_hpc.analysis.flattening import flattening_from_sizes

    found = measure(load_deposit(two_runs[0]), Settings(cutoff=30e-6))
    width = rng.normal(30e-6, 1e-6, 40)
    flat = dataclasses.replace(found, flattening=flattening_from_sizes(width, rng.normal(10e-6, 5e-7, 40)))
    round_ = dataclasses.replace(found, flattening=flattening_from_sizes(width, rng.normal(20e-6, 5e-7, 40)))
    assert flattening_verdict(["A", "B"], flat, round_).startswith("A flattens more:")
    assert flattening_verdict(["A", "B"], round_, flat).startswith("B flattens more:")
    assert flattening_verdict(["A", "B"], flat, flat).startswith("Neither A nor B")
    none = dataclasses.replace(found, flattening=flattening_from_sizes(np.empty(0), np.empty(0)))
    assert "cannot be told" in flattening_verdict(["A", "B"], none, flat)


def test_the_papers_height_stands_beside_section_4_only(two_runs):
    found = measure(load_deposit(two_runs[0]), Settings(cutoff=30e-6))
    assert not is_section4(found.deposit)
    assert not any(q.paper for q in quantities(found))
    found = dataclasses.replace(found, paper_height=363e-6)
    (heights,) = [t for t in tables([("", found)]) if t.title.startswith("Height")]
    assert heights.head[-2:] == ["paper", "off the paper"]
    assert heights.rows[0][-2] == "363.00"
    assert heights.rows[0][-1] == percent(found.heights["dense"], 363e-6)
    assert json.dumps(as_dictionary(found), allow_nan=False)


def test_the_papers_height_is_that_of_its_powder_and_material():
    """Fails when any 5000 particles of 615 m/s on that patch are set beside the paper, as Johnson-Cook's are."""
    notes = []
    cases = [([], 334e-6, 363e-6), ([], 290e-6, None), (["material.name=copper-johnson-cook"], 334e-6, None),
             (["particles.temperature=25 degC"], 334e-6, None)]
    for settings, dense, expected in cases:
        like = types.SimpleNamespace(scene=load_scene("section4", settings), diameters=np.full(5000, 20e-6), batches=[])
        assert paper_height(like, dense, notes) == expected, settings
    assert len(notes) == 1
    assert "334 µm of dense height; here it is 290 µm" in notes[0]


def test_what_two_runs_do_not_share_is_shown_for_both(two_runs):
    """Numbers in titles and names are those of each run, and groups and rows of the second alone do not vanish.

    Fails when ``tables`` takes the topics, the keys or the names of the first run for those of both.
    """
    deposit = load_deposit(two_runs[0])
    first, second = (measure(deposit, Settings(cutoff=cutoff)) for cutoff in (30e-6, 36e-6))
    first = dataclasses.replace(first, porosity=None, fits=dict.fromkeys(first.fits))
    longer = dataclasses.replace(second.rough_along, profiles=7)
    second = dataclasses.replace(second, rough_along=longer, paper_height=363e-6)
    second.heights["dense"] = 2.0 * first.heights["dense"]
    found = {table.title.split()[0]: table for table in tables([("A", first), ("B", second)])}
    assert list(found) == ["Height", "Profile", "Roughness", "Porosity", "Flattening", "State"]
    assert re.fullmatch(r"Roughness \(.*cutoff 30 µm.*\) \[A\]; \(.*cutoff 36 µm.*\) \[B\]", found["Roughness"].title)
    (name,) = [row[0] for row in found["Roughness"].rows if row[0].startswith("Ra, ") and "[B]" in row[0]]
    assert re.fullmatch(r"Ra, 10 profiles along y, 72 µm long \[A\]; 7 profiles along y, 72 µm long \[B\]", name)
    assert found["Height"].head[2:] == ["A", "B", "difference", "paper", "B off the paper"]
    assert found["Height"].rows[0][4] == "+100.0 %"
    assert found["Height"].rows[0][-1] == percent(second.heights["dense"], 363e-6)
    assert all(row[2] == "-" and row[3] != "-" and row[4] in ("", "-") for row in found["Porosity"].rows)
    # one alone: its names carry no label, and both ways round hold the same
    assert not any("[" in row[0] for table in tables([("A", first)]) for row in table.rows)
    other = tables([("B", second), ("A", first)])
    assert {(t.title.split()[0], len(t.rows)) for t in other} == {(name, len(t.rows)) for name, t in found.items()}
    # the page shows them too
    page_text = build_page([("A", first), ("B", second)], {})
    assert "exact, from volume fractions" in page_text


def test_shares_differ_in_points_and_all_else_in_percent():
    """A porosity of 0.02 % against one of 0.05 % is no matter of -60 %; fails if a share is divided by another."""
    porosity = Quantity("porosity", "porosity", "porosity", 5e-4, "%", 100.0, ".3f")
    assert porosity.off(2e-4, 5e-4) == "-0.030 points"
    assert porosity.off(5e-4, 0.0) == "+0.050 points"
    assert porosity.off(5e-4, 5e-4 + 1e-9) == "+0.000 points"
    assert porosity.off(None, 5e-4) == porosity.off(math.nan, 5e-4) == "-"
    height = Quantity("heights", "height_m", "height", 3.3e-4, "µm", 1e6, ".2f")
    assert height.off(3.3e-4, 3.0e-4) == "+10.0 %"


@pytest.mark.parametrize(("arguments", "said"), [
    (["--cutoff", "80"], "needs a unit"), (["--cutoff", "80 MPa"], "length"), (["--cutoff", "8 um"], "4 cells"),
    (["--cutoff", "-8 um"], "above zero"), (["--sections", "0"], "at least 1"), (["--prominence", "2"], "below 1"),
    (["--experiment", "none.csv"], "none.csv"), (["--cycle", "9"], "cycle 9"), (["--layer", "0 um"], "above zero")])
def test_bad_input_is_one_line(two_runs, capsys, arguments, said):
    for command in ("analyse", "report"):
        assert main([command, str(two_runs[0]), *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line


def test_what_is_no_run_is_refused(two_runs, tmp_path, capsys):
    for command in ("analyse", "report"):
        for folder in (tmp_path, tmp_path / "none"):
            assert main([command, str(folder)]) == 2
            assert len(capsys.readouterr().err.splitlines()) == 1
    assert main(["report", str(two_runs[0]), "--cutoff", "30 um", "--out", str(tmp_path), "--no-handover"]) == 2
    assert "--out names a file" in capsys.readouterr().err


def test_a_checkpoint_cut_short_is_passed_over(two_runs, tmp_path):
    """It no longer fits its manifest, so its cycle is read from the frame."""
    copy = tmp_path / "copy"
    shutil.copytree(two_runs[0], copy)
    list_checkpoints(copy / layout.CHECKPOINTS)[-1].write_bytes(b"short")
    deposit = load_deposit(copy)
    assert (deposit.cycle, deposit.source.suffix) == (2, ".vtkhdf")


def test_before_anything_has_landed_there_is_nothing_to_measure(two_runs, tmp_path):
    """Fails when the substrate passes for the deposit, or a figure asks for particles that are not there."""
    deposit = load_deposit(two_runs[0])
    bare = deposit.fraction.copy()
    bare[5:] = 0.0
    empty = dataclasses.replace(deposit, fraction=bare, surface=np.full(deposit.surface.shape, deposit.ground))
    found = measure(empty, Settings(cutoff=30e-6))
    values = {q.key: q.value for q in quantities(found)}
    assert values["height_mean_m"] == pytest.approx(0.0, abs=1e-12)
    assert values["peeq_p50"] is None
    assert values["flattening_particles"] == 0.0
    assert found.porosity is None
    assert len(draw_all(tmp_path, [("", found)])) >= 7
    assert flattening_verdict(["A", "B"], found, found).startswith("Which flattens more cannot be told")
    assert json.dumps(as_dictionary(found), allow_nan=False)


def test_a_thin_deposit_has_no_bulk_and_says_so(two_runs, capsys):
    assert main(["analyse", str(two_runs[0]), "--cutoff", "30 um", "--surface-zone", "100 um", "--no-handover"]) == 0
    assert "note: porosity: no bulk is left" in capsys.readouterr().out
