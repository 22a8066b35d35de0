"""Particles with temperatures of their own: in files, by size, on the grid, in flight and over a stop."""

from __future__ import annotations

import math
import pathlib
import re

import numpy as np
import pytest
from conftest import f2s

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.cli.main import main
from f2s_hpc.config import describe, dump_scene, parse_scene
from f2s_hpc.cycles.flight import Flight
from f2s_hpc.cycles.insert import InsertReport, paint_batch, paint_substrate
from f2s_hpc.errors import InputError
from f2s_hpc.io import runs
from f2s_hpc.io.compare import compare_runs
from f2s_hpc.particles.batch import Batch, clipped_volume, from_lists, join, read_csv, to_lists, write_csv
from f2s_hpc.particles.plan import make_batches, plan_digest

UM = 1e-6
ZERO_K = 273.15

BOX = """
title = "A small box"
domain = { size = ["120 um", "60 um", "150 um"], cell_size = "6 um", substrate_height = "18 um", \
particle_layer_height = "102 um" }
material = { name = "copper-ge" }
particles = { speed = "600 m/s", temperature = "450 degC" }
batches = { count = 2, particles = 6 }
cycles = { count = 2, duration = "0.1 us" }
output = { picture = false, frames = "none" }
"""
LAW = ["particles.temperature_per_diameter=-2 K/um", "particles.temperature_diameter=30 um"]
HOT = "x,y,z,r,temperature\n0.03,0.03,0.03,0.012,500\n0.08,0.03,0.06,0.015,-20.5\n"


def batch_of(*spheres: tuple[float, ...]) -> Batch:
    """Return a batch of (x, y, z, r in um, temperature in K)."""
    table = np.array(spheres, dtype=float)
    return Batch(*(np.ascontiguousarray(column) * UM for column in table[:, :4].T), temperature=table[:, 4].copy())


class Box:
    """An empty box of BOX in memory, and what the tests ask of it (collective)."""

    def __init__(self) -> None:
        self.scene = parse_scene(BOX, "test")
        self.model, self.state = build_model(self.scene), build_state(self.scene)
        self.ledger = build_ledger(self.model)

    def put(self, batch: Batch) -> InsertReport:
        return paint_batch(self.state, self.model, batch, 0.0, (0.0, 0.0, -600.0), 723.15, self.ledger, 7)

    def whole(self, name: str) -> np.ndarray:
        """Return the global array [k, j, i] of a field of cells, on every rank."""
        part, out = self.state.part, np.empty(self.state.part.box.shape)
        for start, block in mpi.all_gather((part.start, self.state.owned(name).copy())):
            out[tuple(slice(s, s + n) for s, n in zip(start[::-1], block.shape))] = block
        return out


# --- files and laws --------------------------------------------------------------------------------------------------


def test_temperatures_go_through_a_file_bit_for_bit(tmp_path):
    """In degC there, in K here, with velocities or without, in any order of columns. Fails when either side rounds."""
    kelvin = np.array([0.0, 723.15, 298.15, 1000.0 / 3.0, math.nextafter(723.15, 1e9)])
    places = [np.linspace(1, 2, 5) * UM for _ in range(4)]
    for velocity in (None, np.arange(15.0).reshape(5, 3)):
        batch = Batch(*places, velocity, kelvin)
        write_csv(tmp_path / "b.csv", batch)
        for again in (read_csv(tmp_path / "b.csv"), from_lists(to_lists(batch))):
            assert list(again.columns) == list(batch.columns)
            assert all(np.array_equal(again.columns[name], batch.columns[name]) for name in batch.columns)
    assert ",3.0,4.0,5.0,450\n" in (tmp_path / "b.csv").read_text(encoding="ascii")
    (tmp_path / "c.csv").write_text("temperature,vz,x,vx,y,r,z,vy\n450,-600,0.03,5,0.04,0.01,0.05,-7\n",
                                    encoding="ascii")
    one = read_csv(tmp_path / "c.csv")
    assert (one.velocity.tolist(), one.temperature.tolist()) == ([[5.0, -7.0, -600.0]], [723.15])
    assert from_lists([[1.0], [2.0], [3.0], [4.0]]).columns.keys() == {"x", "y", "z", "r"}  # (older checkpoints)
    assert from_lists([[1.0], [2.0], [3.0], [4.0], [[0.0, 0.0, -1.0]]]).velocity.shape == (1, 3)


@pytest.mark.parametrize(("text", "words"), [
    (HOT.replace("500", "hot"), "row 1: temperature is 'hot', but must be a number in degC, like 450"),
    (HOT.replace("-20.5", "-274"), "row 2: temperature is '-274', but must be a number in degC"),
    (HOT.replace("500", "nan"), "row 1: temperature is 'nan'"),
    (HOT.replace("-20.5", "1083"), "row 2: temperature 1083 degC must be below the melting temperature (1083 degC)"),
    (HOT.replace("temperature", "T"), "unexpected column 'T'; the first line must be x,y,z,r (millimetres), after")])
def test_wrong_temperatures_in_files_are_one_line(tmp_path, capsys, text, words):
    (tmp_path / "b.csv").write_text(text, encoding="ascii")
    (tmp_path / "s.toml").write_text(BOX, encoding="ascii")
    assert main(["check", str(tmp_path / "s.toml"), "--set", f"batches.files={tmp_path / 'b.csv'}"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"b.csv: {words}" in said


def test_each_sphere_has_the_temperature_of_its_size():
    """Fails when the diameter is the radius, or mirror images lose it."""
    scene = parse_scene(BOX, "test", [*LAW, 'batches.mirror_repeats=["x"]', "cycles.count=4"])
    plan = make_batches(scene)
    assert len(plan.batches) == 4
    for batch in plan.batches:
        assert batch.temperature == pytest.approx(723.15 - 2e6 * (2.0 * batch.r - 30 * UM), rel=1e-14)
        assert batch.velocity is None
    assert parse_scene(dump_scene(scene), "again") == scene
    assert re.search("# temperature +340 degC to 490 degC over diameter\n", describe(scene, 1, [(20, 10, 25)]))
    assert any(re.fullmatch(r"particles are at \d+\.\d to \d+\.\d degC, \d+\.\d in the mean", message)
               for message in plan.messages)
    plain, zero = (make_batches(parse_scene(BOX, "test", more)) for more in (
        [], ["particles.temperature_per_diameter=0 K/um", "particles.temperature_diameter=20 um"]))
    assert plan_digest(plain, 2) == plan_digest(zero, 2) != plan_digest(plan, 2)
    assert all(batch.temperature is None for batch in zero.batches)


@pytest.mark.parametrize(("overrides", "words"), [
    ([LAW[0]], "particles.temperature_diameter is missing: temperature_per_diameter counts from the diameter that"),
    ([LAW[1]], "particles.temperature_diameter has no effect without temperature_per_diameter"),
    (["particles.temperature_per_diameter=-2 m/s/um", LAW[1]], 'write for example "-2 K/um"'),
    (["particles.temperature_per_diameter=40 K/um", LAW[1]],
     "particles.temperature_per_diameter makes -350 degC for a diameter of 10 um, which must be above absolute zero"),
    (["particles.temperature_per_diameter=-40 K/um", LAW[1]],
     "makes 1250 degC for a diameter of 10 um, which must be below the melting temperature (1083 degC)"),
    (["particles.temperature=1090 degC"], "particles.temperature must be below the melting temperature")])
def test_wrong_laws_of_temperature_are_one_line(overrides, words):
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        parse_scene(BOX, "test", overrides)
    assert "\n" not in str(caught.value)


def test_temperatures_of_files_come_before_the_law(tmp_path, monkeypatch):
    """Fails if a file's temperatures are replaced, or a size beyond what the law was checked for passes."""
    monkeypatch.chdir(tmp_path)
    pathlib.Path("a.csv").write_text(HOT, encoding="ascii")
    pathlib.Path("b.csv").write_text("x,y,z,r\n0.03,0.03,0.03,0.01\n", encoding="ascii")
    both, one = (BOX.replace("count = 2, particles = 6", f"files = {names}") for names in (
        '["a.csv", "b.csv"]', '["a.csv"]'))
    first, second = make_batches(parse_scene(both, "test")).batches
    assert (first.temperature.tolist(), second.temperature.tolist()) == ([500 + ZERO_K, 252.65], [723.15])
    second = make_batches(parse_scene(both, "test", LAW)).batches[1]
    assert second.temperature == pytest.approx([743.15], rel=1e-14)
    with pytest.raises(InputError, match=r"temperature_per_diameter has no effect where all batches\.files give"):
        make_batches(parse_scene(one, "test", LAW))
    with pytest.raises(InputError, match=r"b\.csv: row 1: a diameter of 0\.02 mm, for which "
                                         r"particles\.temperature_per_diameter was not checked"):
        make_batches(parse_scene(both, "test", [*LAW, "batches.diameter_min=21 um", "batches.diameter_d10=22 um"]))


# --- on the grid and in flight ---------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_each_sphere_brings_its_own_heat():
    """Alone, cut by a mirror, and two in contact, whose shared cells are as hot as their mass.

    Fails when a shared cell takes the last sphere's temperature: drop ``old *`` in ``add_different_spheres``.
    """
    box = Box()
    batch = batch_of((28, 30, 60, 12, 400), (50.9, 33, 60, 11, 900), (95, 30, 90, 14, 1234.5), (2, 5, 120, 11, 700))
    assert box.put(batch).moved == 0
    mass, temperature = box.whole("mass"), box.whole("temperature")
    volume = np.array([clipped_volume(batch.chosen(slice(n, n + 1)), *box.scene.domain.extents)
                       for n in range(4)]) / (6 * UM) ** 3
    assert (mass * temperature).sum() == pytest.approx(volume @ batch.temperature, rel=1e-11)
    shared = (mass > 0) & ~np.isin(temperature, batch.temperature)
    assert 0 < shared.sum() < 30
    assert ((temperature[shared] > 400) & (temperature[shared] < 900)).all()
    assert (temperature[mass == 0] == 0).all()


@pytest.mark.mpi
def test_one_temperature_for_all_paints_the_very_bits_of_the_scenes():
    """Also in contact with each other and with the substrate. Fails when a cell is sum(m T) / sum(m), which rounds."""
    own, common = Box(), Box()
    batch = batch_of(*[(*sphere, 723.15) for sphere in ((2, 30, 60, 11), (63, 33, 40, 14), (63, 33, 69, 15),
                                                        (90, 20, 29.5, 12.5))])
    for box, spheres in ((own, batch), (common, Batch(batch.x, batch.y, batch.z, batch.r))):
        paint_substrate(box.state, 18 * UM, 298.15)
        box.put(spheres)
    for name in ("mass", "temperature"):
        assert np.array_equal(own.whole(name), common.whole(name)), name
    assert own.ledger.totals() == common.ledger.totals()


@pytest.mark.mpi
def test_spheres_keep_their_temperatures_in_flight_and_when_they_wait():
    """Fails when the flight, what it hands over or what a checkpoint holds of it is made of places and radii only."""
    box = Box()
    flight = Flight(6 * UM, box.scene.domain.extents)
    for batch in (batch_of((30, 30, 60, 12, 400), (90, 30, 60, 12, 900)), batch_of((60, 30, 120, 12, 600))):
        flight.launch(box.state, batch, (0.0, 0.0, -600.0), 0.0)
    again = Flight(6 * UM, box.scene.domain.extents)
    again.restore(flight.attributes())
    for each in (flight, again):
        taken, velocity = each.take_inside(1e-8)
        assert (taken.temperature.tolist(), velocity) == ([400.0, 900.0, 600.0], (0.0, 0.0, -600.0))
    paint_substrate(box.state, 150 * UM, 298.15)
    report = box.put(batch_of((30, 30, 60, 12, 400)))
    assert (report.spheres, report.deferred.temperature.tolist()) == (0, [400.0])
    assert join([report.deferred, taken]).temperature.tolist() == [400.0, 400.0, 900.0, 600.0]


def test_a_run_that_was_lengthened_has_the_bits_of_one_that_was_not(tmp_path):
    """On 1 and 2 ranks, with files and a law. Fails if a rank gives spheres other temperatures, or the law's no-effect
    check refuses the copies of the files that a run keeps."""
    (tmp_path / "s.toml").write_text(BOX, encoding="ascii")
    (tmp_path / "a.csv").write_text(HOT, encoding="ascii")
    (tmp_path / "b.csv").write_text("x,y,z,r\n0.05,0.03,0.03,0.014\n", encoding="ascii")
    options = [part for text in [*LAW, 'batches.files=["a.csv", "b.csv"]'] for part in ("--set", text)]
    f2s("run", "s.toml", "--out", "whole", *options, ranks=2, cwd=tmp_path)
    f2s("run", "s.toml", "--out", "parts", *options, "--set", "cycles.count=1", cwd=tmp_path)
    f2s("resume", "parts", "--set", "cycles.count=2", cwd=tmp_path)
    assert compare_runs(tmp_path / "whole", tmp_path / "parts").identical
    summary = runs.read_summary(tmp_path / "whole")
    assert summary["status"] == "complete"
    assert summary["mass_drift_relative"] < 1e-12
