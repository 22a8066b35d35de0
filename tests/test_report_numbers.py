"""What analyse and report say of a deposit made by hand, whose numbers are known, and of a short run's files."""

from __future__ import annotations

import csv
import dataclasses
import json
import pathlib
from types import SimpleNamespace

import numpy as np
import pytest

from f2s_hpc.analysis.flattening import flattening_from_sizes
from f2s_hpc.analysis.profile import Profile
from f2s_hpc.analysis.roughness import MIRROR, RENORMALISED
from f2s_hpc.cli.main import main
from f2s_hpc.config import dump_scene, load_scene, parse_scene
from f2s_hpc.io import checkpoint, vtkhdf
from f2s_hpc.io.layout import Block
from f2s_hpc.particles.batch import Batch
from f2s_hpc.report import facts
from f2s_hpc.report.commands import compare_measurements
from f2s_hpc.report.deposit import FRAME_FIELDS, Deposit, checkpoints_by_cycle, load_deposit
from f2s_hpc.report.handover import check_handover
from f2s_hpc.report.measure import (
    Settings,
    deposit_percentiles,
    filter_ends,
    half_track,
    measure,
    median_diameter,
    particles_of_plane,
    section_planes,
)
from f2s_hpc.report.page import build_page
from f2s_hpc.report.quantities import depth_tables, quantities

DX = 2e-6
CELLS = (30, 24, 75)  # x, y, z
GROUND, TOP, AIR = 10, 45, 55  # planes: of the substrate top, of the deposit's, of what flies above it
SCENE = """
title = "Made by hand"
domain = { size = ["60 um", "48 um", "150 um"], cell_size = "2 um", substrate_height = "20 um", \
particle_layer_height = "80 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC", flight = "eulerian" }
batches = { spheres = [["20 um", "20 um", "20 um", "10 um"]] }
cycles = { count = 3, duration = "2 ns" }
output = { picture = false, keep_checkpoints = 3 }
"""
SETTINGS = Settings(cutoff=30e-6)


def made(folder: pathlib.Path = pathlib.Path("nowhere"), *overrides: str) -> Deposit:
    """Return a deposit that falls off along x, on a softer substrate, below a block in flight.

    PEEQ is 0.5 in the substrate, 2 in the deposit, and 9 and odd in flight; ten spheres, nine small and one large.
    """
    scene = parse_scene(SCENE, "test", overrides)
    shape = CELLS[::-1]
    height = np.broadcast_to(TOP - 0.5 * np.arange(CELLS[0]), shape[1:])
    fraction = np.clip(height - np.arange(shape[0])[:, None, None], 0.0, 1.0)
    fraction[AIR:AIR + 8] = 1.0
    landed = (fraction > 0.0) & (np.arange(shape[0]) < AIR)[:, None, None]
    peeq = np.where(np.arange(shape[0]) < GROUND, 0.5, 2.0)[:, None, None] * np.ones(shape)
    peeq[AIR:] = 9.0 + 8.0 * np.random.Generator(np.random.PCG64(1)).random((shape[0] - AIR, *shape[1:]))
    radii = np.array([5e-6] * 9 + [20e-6])
    batch = Batch(*(np.full(10, 3e-5) for _ in range(3)), radii)
    fields = (fraction, peeq, 273.15 + 100.0 * peeq, 1e8 * peeq)
    return Deposit(folder, scene, 1, 2e-9, folder / "made.h5", *(f.astype(np.float32) for f in fields), landed, 0.0,
                   height * DX, [batch])


def values(found) -> dict:
    return {q.key: q for q in quantities(found)}


# --- what is measured ---------------------------------------------------------------------------------------


def test_the_median_particle_is_that_of_the_volume_and_half_of_it_is_the_surface_zone():
    """Fails when particles count alike in ``median_diameter``, or the zone is a whole diameter."""
    deposit = made()
    # nine of 10 um and one of 40 um, volumes 1 and 64: halfway between the middles of the last two steps
    assert median_diameter(deposit) == pytest.approx(10e-6 + 30e-6 * (36.5 - 8.5) / (41.0 - 8.5), rel=1e-9)
    assert measure(deposit, SETTINGS).porosity.zone == pytest.approx(0.5 * median_diameter(deposit), rel=1e-12)
    assert measure(deposit, dataclasses.replace(SETTINGS, surface_zone=11e-6)).porosity.zone == 11e-6


def test_sections_are_a_median_diameter_apart():
    """A box of 30 x 24 cells, particles of 5.95 cells.

    Fails when planes lie closer, so that a particle counts twice, or the first at a side of the box.
    """
    even = Batch(*(np.full(4, 3e-5) for _ in range(3)), np.full(4, 5.95e-6))
    planes = section_planes(dataclasses.replace(made(), batches=[even]))
    assert planes == [(1, 3), (1, 9), (1, 15), (1, 21), (2, 3), (2, 9), (2, 15), (2, 21), (2, 27)]


def test_what_flies_is_no_part_of_the_deposit():
    """Fails when distributions or sections take all material, cells count as full, or the substrate is deposit."""
    deposit = made()
    found = measure(deposit, SETTINGS)
    for name, value in (("peeq", 2.0), ("temperature", 473.15), ("von_mises", 2e8)):
        assert deposit_percentiles(found, name) == pytest.approx(np.full(5, value), rel=1e-5)
        assert found.distributions[name].high[-1] <= (TOP - GROUND) * DX + 5e-6
        landed = deposit.fraction[deposit.landed].sum(dtype=float) * DX**3
        assert found.distributions[name].volume.sum() == pytest.approx(landed, rel=1e-6, abs=0.0)
    section = particles_of_plane(deposit, 1, 5, 0.15)
    assert not section.boundaries[AIR:].any()
    everywhere = dataclasses.replace(deposit, landed=deposit.fraction > 0.0)
    assert particles_of_plane(everywhere, 1, 5, 0.15).boundaries[AIR:].any()
    strained = 1.0 + np.random.Generator(np.random.PCG64(2)).random(deposit.peeq.shape)
    for height, first in (("20 um", GROUND), ("20.2 um", GROUND + 1)):  # a cell that its top crosses is substrate
        half = dataclasses.replace(made(pathlib.Path("nowhere"), f"domain.substrate_height={height}"), peeq=strained)
        ridges = particles_of_plane(half, 1, 5, 0.05).boundaries
        assert not ridges[:first].any()
        assert ridges[first].any()


def test_settings_reach_what_they_set():
    """Fails when ``measure`` drops ``symmetric``, ``layer``, ``sections``, ``smallest_pore`` or ``prominence``."""
    deposit = made()
    settings = dataclasses.replace(SETTINGS, symmetric=True, layer=20e-6, sections=3, smallest_pore=1)
    found, plain = measure(deposit, settings), measure(deposit, SETTINGS)
    assert found.profile.x[0] == -found.profile.x[-1] == pytest.approx(-59e-6)
    assert found.size.area == pytest.approx(2.0 * plain.size.area, rel=1e-9)
    assert np.diff(found.distributions["peeq"].low)[-2] == pytest.approx(20e-6)
    assert (found.porosity.image.sections, found.porosity.image.smallest) == (6, 1)
    odd = dataclasses.replace(deposit, landed=deposit.fraction > 0.0)
    ridges = measure(odd, dataclasses.replace(SETTINGS, prominence=0.05))
    assert ridges.flattening.count > measure(odd, SETTINGS).flattening.count
    # each equation has its line over what Fig. 17 has it over
    for equation, over in (("equation_5", ridges.flattening.width), ("equation_6", ridges.flattening.diameter)):
        assert ridges.fits[equation].centre == pytest.approx(over.mean(), rel=1e-9)


def test_layers_are_as_thick_as_whole_cells_and_say_so():
    """Fails when the title gives what was asked for (``real = wanted``); the table has layers of 8 um."""
    found = measure(made(), dataclasses.replace(SETTINGS, layer=7.3e-6))
    table = depth_tables([("", found)])[0]
    assert table.title.endswith("in layers of 8 µm (whole cells; 7.3 µm were asked for)")
    assert table.rows[-1][0] == "-20 to -16 µm"
    assert table.rows[-2][0] == "-16 to -8 µm"
    plain = depth_tables([("", measure(made(), SETTINGS))])[0]
    assert plain.title.endswith("in layers of 10 µm")


def test_the_help_gives_the_defaults_that_hold(capsys):
    """Fails when ``--help`` leaves out the two cells of the surface zone, or the whole cells of the layers."""
    with pytest.raises(SystemExit):
        main(["analyse", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "half the median particle diameter, but at least two cells" in said
    assert "rounded to whole cells, at least one" in said
    assert "it runs over y and is mirrored at y = 0" in said
    assert "--no-symmetric" in said
    small = Batch(*(np.full(1, 3e-5) for _ in range(3)), np.full(1, 3e-6))
    coarse = measure(dataclasses.replace(made(), batches=[small]), SETTINGS)
    assert coarse.porosity.zone == 2.0 * DX


def test_the_profile_is_moved_onto_the_experiment_if_asked_to():
    """A scan with another zero; fails when ``align`` does not reach ``overlap``, or the two change places.

    Or when the maximum is set off by that of the experiment over it (``top / size.maximum``).
    """
    deposit = made()
    settings = dataclasses.replace(SETTINGS, symmetric=True)
    profile = measure(deposit, settings).profile
    scan = Profile(profile.x + 40e-6, 0.9 * profile.height)
    apart = measure(deposit, settings, scan).overlap
    measured = measure(deposit, dataclasses.replace(settings, align=True), scan)
    found, shown = measured.overlap, values(measured)
    assert shown["maximum_off_experiment"].value == pytest.approx(1.0 / 0.9 - 1.0, rel=1e-9)
    assert shown["experiment_maximum_m"].value == pytest.approx(0.9 * profile.height.max(), rel=1e-9)
    assert (shown["overlap_over_union"].value, shown["overlap_over_experiment"].value) == pytest.approx((0.9, 1.0))
    assert found.shift == pytest.approx(40e-6, rel=1e-9)
    assert (found.over_union, found.over_second) == pytest.approx((0.9, 1.0), rel=1e-6)
    assert apart.shift == 0.0
    assert apart.over_second < 0.99


@pytest.mark.parametrize(("name", "overrides", "along", "half"), [
    ("track-160", [], "y", True), ("track-80", [], "y", True), ("track-160", [], "x", False),
    ("track-160", ["batches.jet_centre=1.774 mm"], "y", False), ("track-160", ["domain.faces.x_low=free"], "y", False),
    ("quickstart", [], "y", False), ("splat-quarter", [], "y", True), ("splat-quarter", [], "x", True),
    ("splat", [], "y", False)])
def test_the_scene_tells_whether_half_a_track_was_sprayed(name, overrides, along, half):
    """Fails when ``half_track`` looks at the side alone (``return True`` after it), or at the spray alone."""
    assert half_track(load_scene(name, overrides), along) is half


def test_half_a_track_is_mirrored_unless_told_not_to():
    """A scan of the whole track, with another zero, over a run of its half: with ``--align`` all of it agrees.

    Fails when ``measure`` takes ``settings.symmetric`` of None for no.
    """
    at_mirror = 'batches.spheres=[["0 um", "20 um", "20 um", "10 um"]]'
    deposit = made(pathlib.Path("nowhere"), at_mirror)
    aligned = dataclasses.replace(SETTINGS, align=True)
    whole = measure(deposit, dataclasses.replace(SETTINGS, symmetric=True))
    scan = Profile(whole.profile.x + 40e-6, whole.profile.height)
    found = measure(deposit, aligned, scan)
    assert (found.overlap.over_union, found.overlap.shift) == pytest.approx((1.0, 40e-6), rel=1e-6)
    assert any("mirrored at x = 0" in note for note in found.notes)
    shown = values(found)
    assert "mirrored at x = 0" in shown["profile_width_m"].group
    assert shown["profile_width_m"].name.endswith("of the whole track")
    assert shown["profile_area_m2"].name.endswith("of the whole track")
    half = measure(deposit, dataclasses.replace(aligned, symmetric=False), scan)
    assert half.size.area == pytest.approx(0.5 * found.size.area, rel=1e-9)
    assert half.overlap.over_union < 0.85
    assert not any("mirrored" in note for note in half.notes)
    assert measure(deposit, dataclasses.replace(SETTINGS, along="x")).settings.symmetric is False
    assert values(half)["profile_area_m2"].name == "area"


def test_a_mirror_where_there_is_none_is_told():
    """Fails when ``_mirror_notes`` does not look at the side."""
    settings = dataclasses.replace(SETTINGS, symmetric=True, along="x")
    (note,) = [n for n in measure(made(pathlib.Path("nowhere"), "domain.faces.y_low=free"), settings).notes
               if n.startswith("profile")]
    assert 'mirrored at y = 0 as asked (--symmetric), though domain.faces.y_low is "free"' in note


def test_a_scan_of_a_part_of_the_deposit_is_told():
    """Fails when ``_cover_notes`` is not called: such an overlap was 100 % without a word."""
    deposit = made()
    profile = measure(deposit, SETTINGS).profile
    part = slice(10, 16)
    found = measure(deposit, SETTINGS, Profile(profile.x[part], profile.height[part]))
    assert found.overlap.over_union == pytest.approx(1.0, abs=1e-9)
    assert found.overlap.covered == pytest.approx(6.0 / CELLS[0], rel=1e-9)
    assert found.overlap.second_covered == 1.0
    assert any("covers 20 % of the width of the simulated profile" in note for note in found.notes)
    assert values(found)["overlap_covered"].text() == "20.0"
    assert not any("overlap" in note for note in measure(deposit, SETTINGS, profile).notes)
    wide = Profile(np.linspace(-60e-6, 120e-6, 91), np.full(91, 40e-6))
    assert any("covers 33 % of the width of the experiment" in note
               for note in measure(deposit, SETTINGS, wide).notes)


def test_profiles_end_as_mirrors_between_symmetry_sides_only():
    """Fails when ``filter_ends`` looks at one side of an axis, or takes one axis for both."""
    assert filter_ends(made()) == (MIRROR, MIRROR)
    for side, ends in (("x_high", (RENORMALISED, MIRROR)), ("x_low", (RENORMALISED, MIRROR)),
                       ("y_low", (MIRROR, RENORMALISED)), ("y_high", (MIRROR, RENORMALISED))):
        assert filter_ends(made(pathlib.Path("nowhere"), f'domain.faces.{side}="free"')) == ends


@pytest.mark.parametrize("along", ["y", "x"])
def test_roughness_along_the_track_and_across_it_are_not_mixed_up(along):
    """Waves over x, a free side of x: only profiles along x are rough, and only their ends are renormalised.

    Fails when ``_roughness`` takes profiles of the other axis, or the ends of the other, for one or for both.
    """
    wave = 2e-6 * np.sin(2.0 * np.pi * (np.arange(CELLS[0]) + 0.5) / 6.0)
    deposit = made(pathlib.Path("nowhere"), 'domain.faces.x_high="free"')
    deposit = dataclasses.replace(deposit, surface=np.tile(80e-6 + wave, (CELLS[1], 1)))
    found = measure(deposit, dataclasses.replace(SETTINGS, along=along))
    over_y, over_x = (found.rough_along, found.rough_across)[::1 if along == "y" else -1]
    assert (over_x.profiles, over_x.length, over_x.ends) == (24, pytest.approx(60e-6), RENORMALISED)
    assert (over_y.profiles, over_y.length, over_y.ends) == (30, pytest.approx(48e-6), MIRROR)
    assert over_x.Pq == pytest.approx(2e-6 / np.sqrt(2.0), rel=1e-9)
    assert 0.9 * over_x.Pq < over_x.Rq == pytest.approx(found.areal.Sq, rel=1e-9)
    assert over_y.Pq < 1e-15
    assert found.areal.ends == "renormalised along x, mirror along y"
    shown, name = values(found), "across" if along == "y" else "along"
    assert shown[f"Ra_{name}_m"].name.startswith("Ra, 24 profiles along x, 60 µm long")
    told = [shown[f"{key}_m"].value for key in (f"Ra_{name}", f"Rq_{name}", f"Pa_{name}", f"Pq_{name}", "Sa", "Sq")]
    assert told == [over_x.Ra, over_x.Rq, over_x.Pa, over_x.Pq, found.areal.Sa, found.areal.Sq]


# --- how it is shown ----------------------------------------------------------------------------------------


def test_numbers_are_shown_in_the_unit_beside_them():
    """Fails when a scale is wrong, degC stay K, open and closed pores or the two equations change places."""
    deposit = made()
    deposit.fraction[GROUND + 4:GROUND + 7, 10:12, 10:12] = 0.0  # one closed pore of 12 cells
    found = measure(deposit, dataclasses.replace(SETTINGS, surface_zone=10e-6))
    shown = values(found)
    bulk = found.porosity.volume / DX**3
    assert shown["porosity_exact"].text() == f"{100 * 12 / bulk:.3f}"
    assert (shown["porosity_open"].text(), shown["porosity_closed"].text()) == ("0.000", f"{100 * 12 / bulk:.3f}")
    assert shown["porosity_largest_pore_m3"].text() == "96"  # um3
    assert shown["porosity_image"].paper is None
    assert shown["peeq_p50"].text() == "2.000"
    assert shown["temperature_p50_degC"].text() == "200.0"
    assert shown["von_mises_p50_Pa"].text() == "200.0"
    mean = (TOP - 0.5 * np.arange(CELLS[0]) - GROUND).mean() * DX
    assert shown["height_mean_m"].text() == f"{1e6 * mean:.2f}"
    assert shown["profile_area_m2"].text() == f"{1e12 * mean * 60e-6:.1f}"
    flat = flattening_from_sizes(np.array([16e-6, 32e-6, 8e-6]), np.array([2e-6, 4e-6, 8e-6]))
    shown = values(dataclasses.replace(found, flattening=flat))
    told = [shown[f"flattening_{key}"].value for key in ("equation_5", "equation_6", "width_m", "height_m")]
    assert told == pytest.approx([17.0 / 3.0, 5.0 / 3.0, 56e-6 / 3.0, 14e-6 / 3.0])
    line = SimpleNamespace(slope=2e4, slope_error=3e3, intercept=1.5)
    shown = values(dataclasses.replace(found, fits=dict.fromkeys(found.fits, line)))
    assert shown["flattening_equation_5_slope_per_m"].text() == "0.0200"
    assert shown["flattening_equation_5_slope_error_per_m"].text() == "0.0030"
    peeq, temperature, stress = depth_tables([("", found)])
    assert peeq.rows[0][0].startswith("6")  # from the top down
    assert peeq.rows[0][1:] == ["2.000"] * 3
    assert temperature.rows[0][1:] == ["200.0"] * 3
    assert stress.rows[0][1:] == ["200.0"] * 3


def test_ledger_and_cost_are_those_of_the_cycle_shown(tmp_path):
    """The run has gone on since; fails when ``_cycle_row`` takes another row, or the summary for the row."""
    columns = ["cycle", "wall_s", "steps", "energy_brought_in_J", "energy_plastic_work_J"]
    with (tmp_path / "summary.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, [2, 90.0, 700, 4e-6, 3e-6], [1, 30.0, 300, 2e-6, 1e-6]])
    (tmp_path / "summary.json").write_text(json.dumps({"ranks": 3, "wall_s": 600.0, "steps": 5000}), encoding="utf-8")
    runs = [("", measure(made(tmp_path), SETTINGS))]
    assert facts.energy_table(runs).rows == [["brought in by the particles", "2", "100.00"],
                                             ["plastic work", "1", "50.00"]]
    cost = dict(facts.cost_table(runs).rows)
    assert (cost["wall time"], cost["ranks"], cost["steps"]) == ("30.0 s", "3", "300")
    assert '<span style="width:50.0%">' in build_page(runs, {})


# --- from which file ----------------------------------------------------------------------------------------


def blocks(names: tuple[str, ...]) -> list[Block]:
    return [Block(name, np.full((75, 24, 30), float(number)), (0, 0, 0), (75, 24, 30))
            for number, name in enumerate(names)]


def test_a_checkpoint_in_the_middle_of_a_cycle_is_no_end_of_one(tmp_path):
    """A stop leaves one under the number of the cycles done; fails when ``batch_is_in`` is not looked at."""
    folder = tmp_path / "checkpoints"
    end = checkpoint.write_checkpoint(folder, 1, blocks(("mass",)), {"step": 100, "batch_is_in": False})
    checkpoint.write_checkpoint(folder, 1, blocks(("mass",)), {"step": 150, "batch_is_in": True})
    checkpoint.write_checkpoint(folder, 0, blocks(("mass",)), {"step": 50, "batch_is_in": True})
    assert checkpoints_by_cycle(tmp_path) == {1: end}


def test_a_frame_in_the_middle_of_a_cycle_is_no_end_of_one(tmp_path):
    """Those of ``output.frame_interval`` say so; fails when ``ends_cycle`` is not looked at."""
    text = dump_scene(parse_scene(SCENE, "test"))
    for number, ends in ((0, True), (1, False)):
        vtkhdf.write_frame(tmp_path / "frames", number, 1e-9 * (number + 1), blocks(FRAME_FIELDS), (0, 0, 0), (DX,) * 3,
                           {"cycle": 1, "ends_cycle": ends, "scene": text})
    assert load_deposit(tmp_path).source.name == "frame_000000.vtkhdf"


def test_what_has_landed_is_slower_than_a_tenth_of_the_fastest_particles(tmp_path):
    """As in the cycle table, also where the axis of the jet is not the fastest place of the box.

    Fails when ``_deposit`` takes ``particles.speed``, which is that on the axis.
    """
    scene = parse_scene(SCENE, "test", ["particles.speed=400 m/s", "particles.speed_curvature=100000 m/s/mm2"])
    assert scene.top_speed == pytest.approx(760.0)  # at x = 60 um
    fields = {block.name: block for block in blocks(FRAME_FIELDS)}
    for name, value in (("volume_fraction", 1.0), ("speed", 60.0)):
        fields[name].data[...] = value
    vtkhdf.write_frame(tmp_path / "frames", 0, 1e-9, list(fields.values()), (0, 0, 0), (DX,) * 3,
                       {"cycle": 1, "ends_cycle": True, "scene": dump_scene(scene)})
    assert load_deposit(tmp_path).landed.all()


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> pathlib.Path:
    """Return the folder of a run of three cycles, all of whose checkpoints are kept."""
    folder = tmp_path_factory.mktemp("short")
    text = SCENE.replace("2 um\", substrate", "6 um\", substrate").replace('"20 um", "20 um", "20 um", "10 um"',
                                                                            '"20 um", "20 um", "61 um", "10 um"')
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


def test_the_handover_that_was_asked_for_is_checked(short):
    """The newest by default, and where no cycle follows the one before; fails when ``cycle`` does not choose."""
    assert [check_handover(short, cycle).cycle for cycle in (None, 1, 2, 3)] == [2, 1, 2, 2]


def test_a_handover_that_loses_stress_is_seen(short, monkeypatch):
    """Fails when ``_compare`` takes the von Mises stress as unchanged."""
    from f2s_hpc.cycles import insert

    added = insert.add_material

    def forgetful(state, *arguments):
        quanta = added(state, *arguments)
        state.views["stress_xy"][5, 6, 6] += 1e6
        return quanta

    monkeypatch.setattr(insert, "add_material", forgetful)
    found = check_handover(short)
    assert found.different == 1
    assert found.differences["stress_xy"] == pytest.approx(1e6)
    assert found.differences["von_mises"] > 1e5


def test_the_tables_of_analyse_hold_the_measurements(tmp_path, monkeypatch):
    """Fails when columns change places, percentiles are turned round, or heights count from the bottom of the box."""
    deposit = made(tmp_path)
    deposit.peeq[GROUND:AIR] += np.arange(CELLS[0], dtype=np.float32)
    deposit.surface[7, 3] += 1e-6
    monkeypatch.setattr("f2s_hpc.report.commands.load_deposit", lambda folder, cycle: deposit)
    assert main(["analyse", str(tmp_path), "--out", str(tmp_path / "out"), "--cutoff", "30 um", "--no-handover",
                 "--json", str(tmp_path / "copy.json")]) == 0
    assert (tmp_path / "copy.json").read_text() == (tmp_path / "out" / "analysis.json").read_text()
    tables = {}
    for path in (tmp_path / "out").glob("*.csv"):
        with path.open(encoding="utf-8") as file:
            tables[path.stem] = list(csv.DictReader(file))
    cells = {(round(float(row["x_um"]) / 2 - 0.5), round(float(row["y_um"]) / 2 - 0.5)): float(row["height_um"])
             for row in tables["height-map"]}
    assert len(cells) == CELLS[0] * CELLS[1]
    for (i, j), height in cells.items():
        assert height == pytest.approx(1e6 * (deposit.surface[j, i] - deposit.ground), abs=1e-4)
    layer = tables["peeq-by-height"][-5]
    assert [float(layer[f"p{share:02d}"]) for share in (5, 25, 50, 75, 95)] == pytest.approx(
        [2.0 + share for share in (1.0, 7.0, 14.5, 22.0, 28.0)], abs=0.6)
    assert float(layer["low_um"]) == pytest.approx(float(tables["peeq-by-height"][-6]["high_um"]))
    profile = {float(row["x_um"]): float(row["height_um"]) for row in tables["profile"]}
    assert profile[5.0] == pytest.approx((TOP - GROUND - 1.0) * 2.0, abs=1e-3)


def test_mean_profiles_are_compared_with_the_first(monkeypatch):
    """The second stands 3 um higher, the first 70 um high. Fails when one is not taken off the other."""
    first = made()
    both = {"a": first, "b": dataclasses.replace(first, surface=first.surface + 3e-6)}
    monkeypatch.setattr("f2s_hpc.report.commands.load_deposit", lambda folder, cycle: both[folder])
    said = compare_measurements("a", "b", SETTINGS)
    assert ("Mean profiles: 3.00 µm apart (root mean square), at most 3.00 µm; 4.3 and 4.3 % of the maximum of the "
            "first") in said
