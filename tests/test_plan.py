"""``f2s plan``: the model of a step, the expected load, and the prediction against real runs."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from f2s_hpc.bench import crowd
from f2s_hpc.bench import rates as measured
from f2s_hpc.cli import plan
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene
from f2s_hpc.errors import InputError
from f2s_hpc.grid.box import GHOST, Box
from f2s_hpc.grid.decomposition import ownership_ranges
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.plan import BatchPlan, make_batches
from f2s_hpc.solver.dwell import most_stages
from f2s_hpc.workload import marks
from f2s_hpc.workload.expected import ON_GRID, moments, part_cells
from f2s_hpc.workload.predict import FLYING, SOLID, Network, Rates, busy_seconds, message_seconds, predict, table

RATES = Rates(1e-3, {SOLID: 6e-7, FLYING: 5e-7}, 0.5, 1.0, 2e9, ((0, 3), (10, 4)), 1, 1, "a test")
COARSE = ["domain.cell_size=12 um", "particles.flight=eulerian"]


def test_parts_add_up_to_the_box():
    scene = load_scene("section4", COARSE)
    moment = list(moments(scene, make_batches(scene)))[20]
    nx = scene.domain.cells[0]
    box = Box(scene.domain.cells, 1e-6)
    whole = part_cells(moment.blocks, nx, ownership_ranges(box, (1, 1, 1)), (0, 0, 0))
    parts = part_cells(moment.blocks, nx, ownership_ranges(box, (3, 2, 2)), (0, 0, 0))
    assert parts.shape == (2, 2, 3)
    assert parts.sum() == whole[0, 0, 0] > 0
    wide = part_cells(moment.blocks, nx, ownership_ranges(box, (3, 2, 2)), (GHOST, GHOST, GHOST))
    assert (wide > parts).all()


def test_the_load_follows_the_particles():
    """All particles fly at first; at the end of the run all are deposit, and its volume is theirs."""
    scene = load_scene("section4", COARSE)
    history = list(moments(scene, make_batches(scene)))
    assert sum(m.weight for m in history) == pytest.approx(1.0)
    first, last = history[0], history[-1]
    assert (first.blocks & ~first.solid & 1).sum() > first.solid.sum()
    assert (last.blocks & ~last.solid & 1).sum() < 0.05 * last.solid.sum()
    substrate = history[0].solid.sum()
    assert last.solid.sum() > 3 * substrate
    assert all((m.blocks >= m.solid).all() for m in history)


def test_ballistic_flight_makes_only_what_is_close_to_the_surface_active():
    """Fails when ``moments`` marks flying spheres whatever the flight is, or none of them."""
    scene = load_scene("section4", COARSE[:1])
    plan = make_batches(scene)
    history = list(moments(scene, plan, 1))
    assert (history[0].blocks == history[0].solid).all()  # the first batch is far above
    assert history[0].pace == 1.0
    reach = 2.0 * max(batch.r.max() for batch in plan.batches) / scene.domain.cell_size + ON_GRID + GHOST
    above = []
    for moment in history:
        top, highest = (np.flatnonzero(blocks.any(axis=(1, 2))).max() for blocks in (moment.blocks, moment.solid))
        above.append(top - highest)
    assert 0 < max(above) <= reach
    assert history[-1].pace == 1.0  # all are down
    assert max(moment.pace for moment in history) > 1.0


def test_a_landed_sphere_fills_the_hollow_below_it(rng):
    """Its volume is kept, and hills keep their height; fails when a sphere is spread evenly over its disc."""
    height = np.where(np.arange(40) < 20, 5.0, 8.0) * np.ones((40, 1))
    before, r = height.copy(), 6.0
    x, y = np.array([20.0]), np.array([20.0])
    assert marks.land(height, x, y, np.array([8.1]), np.array([r]), np.ones(1, dtype=np.bool_), 1.5) == 0
    assert marks.land(height, x, y, np.array([7.9]), np.array([r]), np.ones(1, dtype=np.bool_), 1.5) == 1
    assert (height - before).sum() == pytest.approx(4.0 / 3.0 * np.pi * r**3, rel=0.01)
    level = height[20, 20]
    assert level > 8.0
    assert height[20, 19] == pytest.approx(level, abs=1e-2)
    assert height[0, 0] == 5.0


def test_spheres_that_will_touch_in_flight_are_on_the_grid_early():
    """Fails when ``moments`` gives all spheres the scene's velocity, or asks for the surface alone."""
    scene = load_scene("section4", [*COARSE[:1], "cycles.count=1", "cycles.last_duration=0.1 us"])
    places = [np.array(a) for a in ([100e-6, 100e-6], [100e-6, 100e-6], [60e-6, 160e-6], [15e-6, 15e-6])]
    seen = []
    for upper in (-600.0, -1200.0):
        batch = Batch(*places, np.array([[0.0, 0.0, -600.0], [0.0, 0.0, upper]]))
        first = next(moments(scene, BatchPlan([batch], [0])))
        seen.append(int((first.blocks & ~first.solid & 1).sum()))
    assert seen[0] == 0
    assert seen[1] > 0


def test_steps_and_active_cells_of_a_whole_run_are_foretold(run_f2s, tmp_path):
    """Three cycles of section4, the first in the air; fails without ``_pace``, or when only CALM is taken."""
    settings = ["domain.cell_size=10 um", "cycles.count=3", "cycles.last_duration=0.325 us", "output.picture=false",
                "output.frames=none", "output.checkpoints=false"]
    done = run_f2s(["run", "section4", "--out", "run", *(a for s in settings for a in ("--set", s))])
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    scene = load_scene("section4", settings)
    plan = make_batches(scene)
    assert predict(scene, plan, [1], RATES, Network())[0].steps == pytest.approx(summary["steps"], rel=0.08)
    nx = scene.domain.cells[0]
    whole = ownership_ranges(Box(scene.domain.cells, 1e-6), (1, 1, 1))
    history = list(moments(scene, plan))
    steps = np.array([m.weight * m.pace for m in history])
    active = np.array([part_cells(m.blocks, nx, whole, (0, 0, 0))[0, 0, 0] for m in history])
    found = summary["active_cell_steps"] / summary["steps"]
    assert (steps * active).sum() / steps.sum() == pytest.approx(found, rel=0.15)


def test_messages_of_a_cut_box():
    """Two ranks of 10 x 8 x 6 cells each swap four layers; a corner of a 2 x 2 grid has three neighbours."""
    scene = load_scene("splat")
    network = Network(1e-6, 1e9)
    seconds, sent = message_seconds(scene, ([10, 10], [8], [6]), RATES, network)
    assert sent.shape == (1, 1, 2)
    assert (sent == 8 * 17 * 4 * 8 * 6).all()
    assert seconds[0, 0, 0] == pytest.approx(2 * 1e-6 + 2e-6 + sent[0, 0, 0] * 1.5e-9)
    seconds, _ = message_seconds(scene, ([10, 10], [8, 8], [6]), RATES, Network(1.0, 1e30))
    assert seconds[0, 0, 0] == pytest.approx(2 * 3 + 2 * 2, rel=1e-3)


@pytest.mark.parametrize("name", ["section4", "section4-standard", "quickstart", "wide-100k"])
def test_predictions_of_the_scenes(name):
    """More ranks take less time and less memory, at no more than full efficiency, up to 4,096 where the box allows."""
    scene = load_scene(name, COARSE if name.startswith("section4") else [])
    ranks = {"wide-100k": [1, 16, 256, 1024, 4096], "quickstart": [1, 2, 4, 8]}.get(name, [1, 2, 8, 32])
    found = predict(scene, make_batches(scene), ranks, RATES, Network())
    assert [p.ranks for p in found] == ranks
    times, memory = [p.total_s for p in found], [p.memory for p in found]
    assert times == sorted(times, reverse=True)
    # (of so small a box, ghosts and their maps are more than what is shared out)
    assert name == "quickstart" or memory[-1] < memory[0]
    assert found[0].efficiency == pytest.approx(1.0)
    assert all(0.0 < p.efficiency <= 1.0 + 1e-9 for p in found)
    assert all(p.imbalance >= 1.0 - 1e-12 for p in found)
    assert len(table(found).splitlines()) == len(ranks) + 1


def test_ranks_of_one_machine_slow_each_other():
    """Fails when ``predict`` leaves out ``Rates.crowd``, or when it goes on growing beyond the cores of a machine."""
    scene = load_scene("quickstart")
    crowded = replace(RATES, crowding=1.5, cores=4)
    assert [crowded.crowd(ranks) for ranks in (1, 4, 64)] == [1.0, 1.5, 1.5]
    assert 1.0 < crowded.crowd(2) < crowded.crowd(3) < 1.5
    plan = make_batches(scene)
    alone, together = (predict(scene, plan, [1, 4], rates, Network()) for rates in (RATES, crowded))
    assert together[0] == alone[0]
    busy = [found[1].step_s - found[1].messages_s for found in (alone, together)]
    assert busy[1] == pytest.approx(1.5 * busy[0])


def test_a_step_costs_its_solid_and_its_flying_cells_and_what_caches_add():
    """By hand on one rank. Fails when flying cells are counted among the solid ones too, or ``slower`` is left out."""
    scene = load_scene("section4", COARSE)
    moment = list(moments(scene, make_batches(scene)))[20]
    cells, box = scene.domain.cells[0], Box(scene.domain.cells, 1e-6)
    whole = ownership_ranges(box, (1, 1, 1))
    wanted, visited = RATES.per_step, 0
    for kind, blocks in ((SOLID, moment.solid), (FLYING, moment.blocks - moment.solid)):
        owned, rows, local = (int(part_cells(blocks, cells, whole, widths)[0, 0, 0])
                              for widths in ((0, 0, 0), (GHOST, 0, 0), (GHOST,) * 3))
        assert owned > 1000
        wanted += RATES.per_cell[kind] * (owned + 1.0 * (rows - owned) + 0.5 * (local - rows))
        visited += local
    assert busy_seconds(moment, cells, whole, RATES)[0, 0, 0] == pytest.approx(wanted, rel=1e-12)
    large = replace(RATES, sizes=((100, 1.0), (visited, 1.25), (10 * visited, 1.25)))
    assert busy_seconds(moment, cells, whole, large)[0, 0, 0] == pytest.approx(1.25 * wanted, rel=1e-12)


def test_the_slowest_rank_ends_the_step():
    """All load on one side, no messages and no ghosts: no more ranks than the load keeps busy are of use.

    Fails when ``predict`` takes the mean of the ranks, or ``efficiency`` is not that of one rank over as many.
    """
    scene = load_scene("section4", [*COARSE, "cycles.count=1", "batches.count=1"])
    batch = make_batches(scene).batches[0]
    side = BatchPlan([batch.chosen(batch.x < 60e-6)], [0])
    free = replace(RATES, per_step=0.0, per_cell={SOLID: 0.0, FLYING: 5e-7}, ghost_share=0.0, end_share=0.0,
                   packing=1e30, reductions=0)
    one, four = predict(scene, side, [1, 4], free, Network(0.0, 1e30))
    assert four.messages_s < 1e-12 * four.step_s
    assert four.imbalance > 1.2
    assert four.efficiency <= 1.0 / four.imbalance + 1e-9
    assert four.efficiency == pytest.approx(one.step_s / (4.0 * four.step_s), rel=1e-9)
    assert (one.steps, one.total_s) == (four.steps, pytest.approx(one.steps * one.step_s))


def test_messages_are_those_of_a_step_not_of_a_remap():
    """Rates of a round of three steps: a third of its exchanges each; fails when ``/ rates.steps`` is left out."""
    scene = load_scene("splat")
    network, ranges = Network(1e-3, 1e9), ([10, 10], [8], [6])
    seconds, sent = message_seconds(scene, ranges, replace(RATES, reductions=0), network)
    third, less = message_seconds(scene, ranges, replace(RATES, reductions=0, steps=3), network)
    assert (3.0 * third == pytest.approx(seconds), 3.0 * less == pytest.approx(sent)) == (True, True)


def test_too_many_ranks_for_the_box_are_refused():
    scene = load_scene("splat")
    with pytest.raises(InputError, match="can not be cut into 4096 blocks"):
        predict(scene, make_batches(scene), [4096], RATES, Network())


def test_fit_finds_the_rates_it_was_made_from():
    rows = [(6000, 4000, 5000), (25_000, 7000, 11_000), (100_000, 15_000, 30_000), (400_000, 30_000, 60_000),
            (100_000, 60_000, 20_000), (100_000, 5000, 90_000), (512, 500, 3000)]

    def seconds(cost, row):
        return 2e-3 + cost * (row[0] + 0.9 * row[1] + 0.4 * row[2])

    found = measured._fitted(rows, [seconds(7e-7, row) for row in rows])
    assert found.per_step == pytest.approx(2e-3, rel=1e-6)
    assert found.per_cell == pytest.approx({SOLID: 7e-7}, rel=1e-6, abs=0.0)
    assert (found.ghost_share, found.end_share) == pytest.approx((0.4, 0.9))
    assert [factor for _, factor in found.sizes] == pytest.approx([1.0] * 4)
    assert measured._cost(found, rows[1], seconds(5e-7, rows[1])) == pytest.approx(5e-7, rel=1e-6)


def test_rates_are_kept_and_wrong_files_refused(tmp_path):
    measured.write_rates(tmp_path / "r.json", RATES)
    assert measured.read_rates(tmp_path / "r.json") == RATES
    for text in ("{}", "nonsense", '{"per_step": 1}', json.dumps({"per_step": float("nan"), "per_cell": {}})):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(InputError, match="is no file of rates"):
            measured.read_rates(tmp_path / "bad.json")


def test_rates_that_another_version_kept_are_measured_anew(tmp_path, monkeypatch):
    scene = load_scene("quickstart")
    monkeypatch.setattr(measured, "cache_file", lambda scene: tmp_path / "kept.json")
    monkeypatch.setattr(measured, "calibrate", lambda *arguments: RATES)
    (tmp_path / "kept.json").write_text('{"per_step": 1.0}')
    assert measured.rates_for(scene, make_batches(scene), None) == RATES
    assert measured.read_rates(tmp_path / "kept.json") == RATES


def test_plan_command(run_f2s, tmp_path):
    """Prediction and check of a small scene: how many cells are active is a prediction that no clock disturbs."""
    done = run_f2s(["plan", "quickstart", "--ranks", "1,2", "--rates", "rates.json", "--check", "--json", "p.json"])
    assert done.returncode == 0, done.stderr
    assert "measuring the rates" in done.stdout
    record, rates = (json.loads((tmp_path / name).read_text()) for name in ("p.json", "rates.json"))
    assert rates["cores"] == crowd.cores()
    assert rates["crowding"] >= 1.0
    assert [p["ranks"] for p in record["predictions"]] == [1, 2]
    for row in record["check"]:
        assert row["predicted_active"] == pytest.approx(row["active_cells"], rel=0.05)
        assert row["ratio"] == pytest.approx(row["predicted_step_s"] / row["step_s"])
    assert [row["ranks"] for row in record["check"]] == [1, 2]
    again = run_f2s(["plan", "quickstart", "--ranks", "2", "--rates", "rates.json"])
    assert "measuring" not in again.stdout
    printed = float(again.stdout.splitlines()[-1].split()[3])
    assert np.isclose(record["predictions"][1]["step_s"] * 1e3, printed, atol=0.01)


def test_what_does_not_fit_is_known_before_the_rates_are_measured(run_f2s, tmp_path):
    """Fails if one number of ranks of the default takes the others away, or one that was asked for is left out."""
    measured.write_rates(tmp_path / "r.json", RATES)
    small = ["plan", "splat", "--set", "domain.cell_size=4 um", "--set", 'domain.size=["48 um", "48 um", "84 um"]',
             "--set", 'batches.spheres=[["24 um", "24 um", "20 um", "15 um"]]', "--rates", "r.json"]
    done = run_f2s(small)
    assert done.returncode == 0, done.stderr
    assert "note: the box is too small for 64 ranks; left out" in done.stdout
    assert [line.split()[0] for line in done.stdout.splitlines()[-4:]] == ["1", "2", "4", "16"]
    done = run_f2s([*small[:-1], "new.json", "--ranks", "1,64"])
    assert (done.returncode, done.stdout) == (2, "")
    assert "can not be cut into 64 blocks" in done.stderr


def test_a_cache_that_cannot_be_written_is_a_note(tmp_path, monkeypatch):
    """Fails if three quarters of a minute of measuring end in an error."""
    scene, said = load_scene("splat"), []
    (tmp_path / "file").touch()
    monkeypatch.setattr(measured, "cache_file", lambda scene: tmp_path / "file" / "rates.json")
    monkeypatch.setattr(measured, "calibrate", lambda *arguments: RATES)
    assert measured.rates_for(scene, make_batches(scene), None, said.append) == RATES
    assert len(said) == 1
    assert "the rates are not kept" in said[0]
    with pytest.raises(InputError):
        measured.rates_for(scene, make_batches(scene), str(tmp_path / "file" / "rates.json"))


@pytest.mark.parametrize(("arguments", "said"), [
    (["--check-time", "1 ns"], "give --check too"), (["--check", "--check-time", "0 ns"], "it must be above 0"),
    (["--check", "--check-time=-1 ns"], "it must be above 0"),
    (["--ranks", "0"], "whole numbers from 1 to 4,096"), (["--ranks", "two"], "whole numbers from 1 to 4,096"),
    (["--ranks", "5000"], "whole numbers from 1 to 4,096"), (["--bandwidth", "0"], "--bandwidth must be above 0"),
    (["--latency", "3 um"], "--latency 3 um: this is a length"), (["--rates", "bad.json"], "is no file of rates")])
def test_wrong_arguments_are_one_line_and_code_2(capsys, monkeypatch, tmp_path, arguments, said):
    """Fails when the bound of one of these options is taken away."""
    (tmp_path / "bad.json").write_text("[]")
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "splat", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_what_dwells_take_is_told_beside_the_times():
    """Fails if the last cycle counts too, no cycle has one after it, or a scene without dwells gets the line."""
    scene = load_scene("section4", [*COARSE, "cycles.dwell=10 ms"])
    found = [SimpleNamespace(ranks=1, step_s=1.0), SimpleNamespace(ranks=4, step_s=0.04)]
    (line,) = plan._dwells(scene, found)
    stages = most_stages(10e-3, 385 / (8960 * 384.6) / 12e-6**2)
    assert f"9 dwells of 10 ms come on top of these times, each of at most {stages:,} stages" in line
    assert f"{9 * stages * 0.02 / 60:.1f} min on 1 rank, {9 * stages * 0.02 * 0.04:.1f} s on 4 ranks" in line
    assert plan._dwells(load_scene("section4", COARSE), found) == []
    assert plan._dwells(load_scene("section4", [*COARSE, "cycles.dwell=10 ms", "cycles.count=1"]), found) == []
