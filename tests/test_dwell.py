"""The dwell between two cycles: heat flows in long steps, and nothing else happens."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest
from conftest import f2s
from solver_setup import ALL_SYMMETRY, cell_coordinates, make_block, make_model, make_setup
from test_damaged import SCENE

from f2s_hpc import mpi, phases
from f2s_hpc.cli.main import main
from f2s_hpc.cycles import pause, simulation
from f2s_hpc.cycles.simulation import Simulation
from f2s_hpc.errors import F2SError
from f2s_hpc.fields import VELOCITY
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.io.compare import compare_runs
from f2s_hpc.materials.pressure import unloaded
from f2s_hpc.report.deposit import checkpoints_by_cycle
from f2s_hpc.solver import dwell as solver_dwell
from f2s_hpc.solver.dwell import LARGEST_NUMBER, Course, dwell, most_stages, stage_count, stage_weights
from f2s_hpc.solver.heat import conduct, diffusivity
from f2s_hpc.solver.timestep import SAVE, STOP

DX = 3e-6
MODEL = make_model(DX)
RATE = diffusivity(MODEL) / DX**2  # explicit steps of number 1 per second

LONG = SCENE + 'substrate = { backing = "100 um" }\noutput = { picture = false, keep_checkpoints = 9 }\n'
for old, new in (('"72 um"', '"112 um"'), ('"56 um"', '"96 um"'), ("count = 2", 'count = 3, dwell = "20 us"')):
    LONG = LONG.replace(old, new)


def heat(state) -> float:
    """Return mass times temperature of all owned cells (full cells times K)."""
    return float((state.owned("mass") * state.owned("temperature")).sum())


@pytest.mark.parametrize("stages", [3, 5, 25, 301])
def test_stages_are_consistent_and_damp_whatever_is_there(stages):
    """A constant stays, exp(-z) is met to second order, and no z up to the limit grows.

    Fails with any other mu, nu, mu~ or gamma~, or when ``stage_count`` promises more than (s^2 + s - 2) / 4.
    """
    def amplified(z: float) -> float:
        before = now = 1.0
        for mu, nu, mu_gained, first in stage_weights(stages):
            before, now = now, mu * now + nu * before + (1.0 - mu - nu) - z * (mu_gained * now + first)
        return now

    assert amplified(0.0) == pytest.approx(1.0, abs=1e-12)
    errors = [abs(amplified(z) - math.exp(-z)) for z in (0.02, 0.01)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(3.0, abs=0.1)
    # an explicit step at its limit has z = 2
    limit = 2.0 * (stages**2 + stages - 2) / 4.0
    assert max(abs(amplified(z)) for z in np.linspace(0.1, limit, 2000)) <= 1.0
    assert stage_count(LARGEST_NUMBER * limit / 2.0) == stages
    assert stage_count(LARGEST_NUMBER * limit / 2.0 * 1.01) == stages + 2


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_cosine_decays_at_its_rate(axis):
    """40 cells, to a third: 1200 explicit steps in a tenth of as many stages, 0.3 % off.

    Fails if ghosts are not exchanged between the stages, or a super step takes the weights of another.
    """
    cells, size = 40, [3, 3, 3]
    size[axis] = cells
    setup = make_block(size, MODEL)
    profile = 100.0 * np.cos(math.pi * cell_coordinates(setup.state)[axis] / cells)
    setup.state.views["temperature"][...] = 500.0 + profile
    duration = 1.0 / ((math.pi / cells) ** 2 * RATE)
    course = Course(duration)
    assert dwell(setup.state, MODEL, course, None, 300.0) == 0
    assert course.stages < 0.25 * duration * RATE / LARGEST_NUMBER
    assert course.stages == most_stages(duration, RATE)
    expected = 500.0 + profile * math.exp(-2.0 * (1.0 - math.cos(math.pi / cells)) * duration * RATE)
    found = setup.state.views["temperature"]
    np.testing.assert_allclose((found - expected)[setup.state.part.owned_cells], 0.0, atol=0.1)


def test_it_ends_where_many_explicit_steps_do(rng):
    """Touching spheres at random temperatures, with slivers and void; heat is kept to round-off.

    Fails if ``super_stage`` reads one cell further, or ``remember`` leaves rows out.
    """
    fields = []
    for long in (False, True):
        setup = make_setup((20, 14, 13), MODEL, [(6.1, 7.2, 6.4, 4.6), (14.6, 7.0, 6.2, 3.9)], sides=ALL_SYMMETRY)
        state, generator = setup.state, np.random.default_rng(3)
        random = generator.uniform(300.0, 1200.0, state.views["temperature"].shape)
        state.views["temperature"][...] = np.where(state.views["mass"] > 0.0, random, 0.0)
        state.exchange(("temperature",))
        before = heat(state)
        if long:
            dwell(state, MODEL, Course(30.0 / RATE), None, 300.0)
        else:
            for _ in range(300):
                conduct(state, MODEL, 0.1 / RATE)
                state.exchange(("temperature",))
        assert heat(state) == pytest.approx(before, rel=1e-12)
        fields.append(state.owned("temperature").copy())
    assert np.ptp(fields[0][fields[0] > 0.0]) > 5.0
    np.testing.assert_allclose(fields[1], fields[0], atol=0.5)


def test_it_ends_early_where_nothing_changes_any_more():
    """A second of conduction in a block of 36 um. Fails if the end is only looked for at a fixed number of steps."""
    setup = make_block((12, 4, 4), MODEL)
    x, _, _ = cell_coordinates(setup.state)
    setup.state.views["temperature"][...] = 500.0 + 100.0 * np.cos(math.pi * x / 12)
    course = Course(1.0)
    assert dwell(setup.state, MODEL, course, None, 300.0) == 0
    assert course.stages < 1e-3 * RATE
    assert np.ptp(setup.state.owned("temperature")) < 1e-3
    assert setup.state.owned("temperature").mean() == pytest.approx(500.0, abs=1e-9)


def test_round_off_does_not_keep_it_from_its_end(monkeypatch):
    """Hours on fine cells. Fails without ``ROUND_OFF``: 999 stages never leave every cell within 3e-11 K."""
    calls = 0

    def super_step(_work, number: float) -> tuple[int, float]:
        nonlocal calls
        calls += 1
        assert calls < 100
        return stage_count(number), 5e-9

    monkeypatch.setattr(solver_dwell._Work, "super_step", super_step)
    course = Course(1e4)
    assert dwell(make_block((4, 4, 4), MODEL).state, MODEL, course, None, 300.0) == 0
    # (only when steps do not grow any more: a short one that changes little tells nothing)
    assert course.stages > solver_dwell.MOST_STAGES * 5


def test_the_most_stages_are_told_at_once_also_of_hours():
    """Fails if each super step of 1e4 s is counted by itself: there are 1e9 of them."""
    year = most_stages(1e4, 1e12)
    assert year == pytest.approx(1e16 / solver_dwell.LONGEST_NUMBER * solver_dwell.MOST_STAGES, rel=1e-4)


@pytest.mark.parametrize("backing", [0.0, 30e-6])
def test_heat_leaves_through_the_bottom_as_through_a_wall(backing):
    """A column of 20 cells on what is held at 300 K: the slowest mode of a wall that gives its heat away, q tan q = Bi.

    Fails if ``heat_through_bottom`` takes the whole cell for half of it, or sees every plane as the lowest.
    """
    cells = 20
    setup = make_block((3, 3, cells), MODEL)
    state = setup.state
    state.views["temperature"][...] = 800.0
    length = cells * DX

    def eigenvalue() -> float:
        if backing == 0.0:
            return 0.5 * math.pi
        low, high = 1e-9, 0.5 * math.pi - 1e-9
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if middle * math.tan(middle) < length / backing else (low, middle)
        return low

    q = eigenvalue()
    duration = 0.8 * length**2 / (q * q * diffusivity(MODEL))
    before = heat(state)
    dwell(state, MODEL, Course(duration), backing, 300.0)
    # series of a wall, of which the first term is left (Carslaw and Jaeger 1959, section 3.11)
    first = 4.0 * math.sin(q) / (2.0 * q + math.sin(2.0 * q))
    z = cell_coordinates(state)[2] * DX / length
    expected = 300.0 + 500.0 * first * np.cos(q * (1.0 - z)) * math.exp(-0.8)
    np.testing.assert_allclose((state.views["temperature"] - expected)[state.part.owned_cells], 0.0, atol=2.0)
    assert heat(state) < 0.8 * before


def test_void_above_the_bottom_stays_void():
    """A sphere on the bottom, which is held hot. Fails if the temperature of empty cells there is set: they hold zero.
    """
    setup = make_setup((14, 14, 8), MODEL, [(7.0, 7.0, 3.0, 3.0)], sides=ALL_SYMMETRY)
    state = setup.state
    dwell(state, MODEL, Course(30.0 / RATE), 0.0, 900.0)
    void = state.owned("mass") == 0.0
    assert void[0].any()
    assert not void[0].all()
    assert (state.owned("temperature")[void] == 0.0).all()
    assert state.owned("temperature")[0].max() > 600.0


def test_a_deposit_that_cools_does_not_tear():
    """Mie-Grueneisen: hot material under no pressure stays whole and at rest when it has cooled by 700 K.

    What sleeps takes part. Fails if the internal energy follows the heat: 5 GPa of tension tear every cell at once.
    """
    model = make_model(DX, "copper-piston", overrides=["material.conductivity=385 W/m/K"])
    setup = make_setup((4, 4, 16), model, substrate=12.0)
    state, energy = setup.state, 700.0 * model.bulk.specific_heat
    there = state.views["mass"] > 0.0
    state.views["temperature"][there], state.views["internal_energy"][there] = 1000.0, energy
    state.views["mass"][there] = unloaded(model.eos, energy)
    state.settle()
    state.set_floor(3)
    dwell(state, model, Course(1e-3), 10e-6, 300.0)
    assert state.owned("temperature")[:12].max() < 310.0
    state.set_floor(0)
    setup.advance(3)
    assert state.owned("volume_fraction")[:11].min() == 1.0
    assert max(np.abs(state.owned(name)).max() for name in VELOCITY) < 1.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder of a run of three cycles with dwells, made once by all ranks together."""
    folder = mpi.broadcast(tmp_path_factory.mktemp("dwell"))
    if mpi.is_root():
        (folder / "scene.toml").write_text(LONG, encoding="utf-8")
    mpi.barrier()
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


@pytest.mark.mpi
def test_a_run_dwells_between_its_cycles_and_a_resumed_one_as_well(whole, shared_path, monkeypatch, capsys):
    """Twice in three cycles; stopped at the end of a cycle and within the next, it ends in the same bits.

    Fails if a resumed run dwells anew in the middle of a cycle, not at all, or the first batch is waited for; and if
    nobody says why a run stopped that did so at the end of a cycle.
    """
    folder, advance = shared_path / "run", simulation.advance
    scene = whole.parent / "scene.toml"
    stops = iter([15e-9, 20e-9])
    at = next(stops)

    def stopped(state, model, clock, *more):
        advance(state, model, clock, *more)
        clock.stop = clock.time >= at * (1.0 - 1e-9)

    monkeypatch.setattr(simulation, "advance", stopped)
    assert main(["run", str(scene), "--out", str(folder)]) == 75
    assert ("stopped: the wall-time budget is spent" in capsys.readouterr().out) == mpi.is_root()
    at = next(stops)
    assert main(["resume", str(folder)]) == 75
    monkeypatch.setattr(simulation, "advance", advance)
    capsys.readouterr()
    assert main(["resume", str(folder)]) == 0
    said = capsys.readouterr().out
    ends = [list_checkpoints(place / layout.CHECKPOINTS)[-1] for place in (whole, folder)]
    (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
    assert all(np.array_equal(values, others[name]) for name, values in fields.items())
    if not mpi.is_root():
        return
    assert said.count("dwell of 20 us: the deposit's median temperature goes from") == 1
    rows = [runs.read_cycle_table(place) for place in (whole, folder)]
    assert [float(row["dwell_s"]) for row in rows[0]] == pytest.approx([0.0, 20e-6, 40e-6])
    for one, other in zip(*rows):
        assert one["dwell_heat_left_J"] == other["dwell_heat_left_J"]
    left = [float(row["dwell_heat_left_J"]) for row in rows[0]]
    assert 0.0 == left[0] < left[1] < left[2]
    assert float(rows[0][1]["temperature_p50_after_dwell_degC"]) < float(rows[0][0]["temperature_p50_degC"]) - 20.0


@pytest.mark.mpi
def test_a_run_stops_within_a_dwell_and_goes_on_with_it(whole, shared_path, monkeypatch, capsys):
    """Saved once on the way, then stopped, by another rank than the first if there is one: it ends in the same bits.

    Fails if nobody is asked during a dwell, if a resumed one begins anew, or if a checkpoint within it passes for the
    end of the cycle, in analyses or in ``f2s compare``.
    """
    folder, request, calls = shared_path / "run", Simulation._request, 0

    def asked(self) -> int:
        nonlocal calls
        if self.pause.course is None or mpi.rank() < mpi.size() - 1:
            return request(self)
        calls += 1
        return {2: SAVE, 5: STOP}.get(calls, 0)

    monkeypatch.setattr(Simulation, "_request", asked)
    assert main(["run", str(whole.parent / "scene.toml"), "--out", str(folder)]) == 75
    said = capsys.readouterr().out
    monkeypatch.setattr(Simulation, "_request", request)
    places = list_checkpoints(folder / layout.CHECKPOINTS)
    pauses = [runs.open_checkpoint_serial(path, [])[1]["pause"] for path in places]
    assert [(pause["count"], pause["course"] is None) for pause in pauses] == [(0, True), (0, False), (0, False)]
    assert 20e-6 > pauses[1]["course"]["left"] > pauses[2]["course"]["left"] > 0.0
    assert checkpoints_by_cycle(folder) == {1: places[0]}
    assert main(["resume", str(folder)]) == 0
    ends = [list_checkpoints(place / layout.CHECKPOINTS)[-1] for place in (whole, folder)]
    (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
    assert all(np.array_equal(values, others[name]) for name, values in fields.items())
    if mpi.is_root():
        assert said.count(f"checkpoint {folder}") == 2
        assert f"stopped: the wall-time budget is spent; checkpoint {places[2]}" in said
        rows = [runs.read_cycle_table(place) for place in (whole, folder)]
        assert [row["dwell_heat_left_J"] for row in rows[0]] == [row["dwell_heat_left_J"] for row in rows[1]]
        assert compare_runs(whole, folder).identical


def test_a_dwell_is_no_startup(whole, tmp_path, monkeypatch):
    """Fails if a resumed run that begins with a dwell counts it as startup."""
    shutil.copytree(whole, tmp_path / "run")
    for path in list_checkpoints(tmp_path / "run" / layout.CHECKPOINTS)[1:]:
        path.unlink()
    told = []
    monkeypatch.setattr(phases, "started", lambda follow: told.append("started"))
    monkeypatch.setattr(pause, "dwell", lambda *_: told.append("dwell") or 1)
    monkeypatch.setattr(Simulation, "_request", lambda self: 0)
    monkeypatch.setattr(Simulation, "_save", lambda self, stops: (_ for _ in ()).throw(F2SError("far enough")))
    assert main(["resume", str(tmp_path / "run")]) != 0
    assert told == ["started", "dwell"]


@pytest.mark.mpi
def test_the_bits_of_a_run_with_dwells_do_not_hang_on_its_ranks(whole, tmp_path_factory):
    """The same scene on one rank. Fails if a sum over ranks decides when a dwell ends, or ghosts are late."""
    alone = mpi.broadcast(tmp_path_factory.mktemp("alone"))
    if mpi.is_root():
        (alone / "scene.toml").write_text(LONG, encoding="utf-8")
        f2s("run", "scene.toml", "--out", "run", cwd=alone)
        ends = [list_checkpoints(place / layout.CHECKPOINTS)[-1] for place in (whole, alone / "run")]
        (fields, _), (others, _) = (runs.open_checkpoint_serial(path) for path in ends)
        assert all(np.array_equal(values, others[name]) for name, values in fields.items())
    mpi.barrier()


@pytest.mark.parametrize(("settings", "says"), [
    (["cycles.dwell=20 us", "numerics.conduction=false"], "has no effect with numerics.conduction = false"),
    (["cycles.dwell=20 us", "material.conductivity=0 W/m/K"], "has no effect with material.conductivity = 0"),
    (["substrate.backing=3 mm"], "has no effect without cycles.dwell"),
    (["cycles.dwell=20 us", "substrate.backing=3 mm", "domain.faces.z_low=symmetry"], 'a side that is "symmetry"'),
    (["cycles.dwell=20 h"], "is its unit right?"),
])
def test_what_has_no_effect_is_refused(settings, says, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    done = f2s("check", "scene.toml", *(part for text in settings for part in ("--set", text)), cwd=tmp_path, code=2)
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
