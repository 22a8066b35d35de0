"""Stability: the quick matrix of extreme scenes, a short fuzz; and that the watch sees what is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.config.load import parse_scene
from f2s_hpc.config.schema import SPEED_LIMITS
from f2s_hpc.config.sections import Numerics
from f2s_hpc.cycles.flight import NO_ROOM
from f2s_hpc.cycles.insert import kinetic_quanta
from f2s_hpc.errors import InputError, UnstableStep
from f2s_hpc.fields import VELOCITY
from f2s_hpc.solver.ledger import ENERGY_TERMS
from f2s_hpc.verify import extreme, fuzz, special, watch
from f2s_hpc.verify.box import make_block, make_model, make_setup, never_yields, node_coordinates

QUICK = [e for e in extreme.matrix() if e.quick]
BY_NAME = {e.name: e for e in extreme.matrix()}
PAINTED = ("particles.flight=eulerian",)
"""What the fuzz found before it let particles fly as spheres is looked at as it was found."""

SPHERE = [(5.0, 5.0, 7.2, 2.0)]


def moving_sphere():
    """Return a sphere of four cells above three cells of substrate, and a watch on it."""
    setup = make_setup((10, 10, 12), make_model(3e-6), SPHERE, (0.0, 0.0, -600.0), substrate=3.0)
    setup.clock.limits.heavy_speed = 600.0
    return setup, watch.Watch(setup, 600.0)


# --- the scenes ----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("scene", QUICK, ids=lambda e: e.name)
def test_quick_matrix_is_stable(scene):
    """Fails without the light-node exchange or the limit of the conduction step (LARGEST_NUMBER = 2)."""
    outcome = scene.run(scene.name, scene.text, scene.overrides)
    assert outcome.verdict == watch.STABLE, outcome.reason
    assert outcome.steps > 50
    assert outcome.mass_drift <= watch.MASS_BAR
    assert outcome.energy_rise <= watch.ENERGY_BAR
    assert outcome.speed_ratio < 1.3


def test_a_scene_of_the_matrix_that_is_refused_has_failed(monkeypatch):
    """Each is written so that it can run. Fails when a refusal counts as passed, as it does for random scenes."""
    monkeypatch.setattr(special, "TASKS", (("task", lambda name, text, full, numerics: special.rest(
        name, text, full, ("numerics.courant=3",))),))
    assert all(parse_scene(scene.text, scene.name, scene.overrides) for scene in BY_NAME.values())
    wrong = extreme.Extreme("wrong", extreme.impact(), ("numerics.courant=1.5",), quick=True)
    monkeypatch.setattr(extreme, "matrix", lambda: [wrong])
    outcomes = extreme.run()
    assert [(o.scene, o.verdict, o.passed) for o in outcomes] == [("wrong", watch.FAILED, False),
                                                                  ("task", watch.FAILED, False)]
    assert all(o.reason.startswith("refused: ") and "numerics.courant" in o.reason for o in outcomes)


@pytest.mark.mpi
def test_a_box_that_ranks_can_not_share_is_too_small_not_refused():
    """3 x 3 x 5 cells run on one rank only. Fails when ``process_grid`` raises an InputError as any other."""
    scene = BY_NAME["D/dx 1.5"]
    outcome = scene.run(scene.name, scene.text, scene.overrides)
    assert outcome.verdict == (watch.STABLE if mpi.size() == 1 else watch.SMALL)
    assert outcome.passed


@pytest.mark.parametrize(("arguments", "said"), [
    (["--set", "material.density=1 kg/m3"], "--extreme takes numerics.KEY=value only"),
    (["--set", "numerics.courrant=0.5"], "numerics.courrant"),
    (["--seed", "-1"], "--seed N goes with --extreme, N at least 0")])
def test_extreme_takes_numerics_and_a_seed(arguments, said, monkeypatch, capsys):
    """One line and exit code 2 before any scene is run; fails when they are looked at after the matrix."""
    monkeypatch.setattr(extreme, "matrix", lambda: pytest.fail("a scene was run"))
    assert main(["verify", "--extreme", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said in error


def test_impact_scenes_are_impacts():
    """The scene everything varies deforms its sphere; fails when the sphere misses or is not painted."""
    outcome = watch.run_scene("impact", extreme.impact())
    assert outcome.peeq_max > 0.5
    assert outcome.temperature_max > 750.0
    assert 0.9 < outcome.speed_ratio < 1.2


def test_outflow_sides_bring_no_energy_in():
    """Fails if an outflow side copies the last layer outwards: ``COPY`` for its cells in ``grid/boundary.py``."""
    scene = BY_NAME["all sides open"]
    assert scene.run(scene.name, scene.text, scene.overrides).verdict == watch.STABLE


def test_mass_floor_brings_no_energy_in():
    """Found by the fuzz: spheres of one and two cells, mostly light nodes; fails with a default floor of 0.05."""
    outcome, = fuzz.run(1, first=197, numerics=PAINTED, plain=True)
    assert outcome.verdict == watch.STABLE


def test_mass_floor_withholds_no_braking():
    """Found by the fuzz: a sphere of half a cell meets a mirror; fails when the floor divides a braking force too."""
    outcome, = fuzz.run(1, first=52, numerics=PAINTED, plain=True)
    assert outcome.verdict == watch.STABLE


def test_material_that_touches_a_side_when_it_is_put_in_brings_no_energy():
    """Found by the fuzz: a sphere larger than its box; fails with a whole first step, ``START`` = 0."""
    outcome, = fuzz.run(1, first=104, numerics=PAINTED, plain=True)
    assert outcome.verdict == watch.STABLE


@pytest.mark.parametrize("scene", [194, 284])
def test_kinetic_energy_that_the_remap_rings_up_is_paid_by_heat(scene):
    """Found by the fuzz: at first contact velocities ring, also on light nodes, and total energy rose by 0.2 %.

    Fails when only nodes above ``LEAST_HEATING`` give back what the remap made (``| (lost[n] < 0.0)`` left out).
    """
    outcome, = fuzz.run(1, first=scene, numerics=PAINTED, plain=True)
    assert outcome.verdict == watch.STABLE, outcome.reason


def test_mass_that_leaves_is_counted_to_1e_10():
    """Found by the fuzz: 1700 steps of a slow outflow; fails if ``flux.mass_through_plane`` rounds towards zero."""
    text = fuzz.scene_text(1, 245).replace('y_high = "outflow"', 'y_high = "free"')
    outcome = watch.run_scene("slow outflow", text, PAINTED)
    assert outcome.verdict == watch.STABLE


def test_long_rest_is_rest():
    """Fails when the force of a cell at rest is not exactly zero, or when a step feeds on noise (hourglass = -0.1)."""
    outcomes = list(special.rest("at rest", extreme.impact(), False, ()))
    assert [o.verdict for o in outcomes] == [watch.STABLE] * 2, [o.reason for o in outcomes]
    assert all(o.steps == 3000 for o in outcomes)
    assert outcomes[0].speed_ratio == 0.0


def test_courant_numbers_hold_beyond_their_defaults():
    """The defaults 0.5 and 0.25 have room up to 0.8 and 0.45; fails when the sound speed lacks the shear stiffness."""
    sound, = special.courant("courant", extreme.impact(), False, ())
    crossed, = special.remap_courant("crossed", extreme.impact(), False, ())
    assert sound.verdict == crossed.verdict == watch.STABLE
    assert sound.reason == "courant up to 0.9 holds (default 0.7)"
    assert crossed.reason == "remap_courant up to 0.45 holds (default 0.25)"


def test_a_step_beyond_the_limit_is_found_unstable(monkeypatch):
    """1.3 times the crossing time of sound does not hold, and the report names it; fails when nothing is watched."""
    monkeypatch.setitem(special._COURANT, False, (0.7, 1.3))
    outcome, = special.courant("courant", extreme.impact(), False, ())
    assert outcome.reason.startswith("courant up to 0.7 holds (default 0.7); 1.3 does not: ")


@pytest.mark.parametrize("setting", ["exchange_strength=0.16", "light_mass_floor=0.15"])
def test_settings_that_bring_energy_in_are_refused(setting):
    """Found by the fuzz: six neighbours' exchange beyond 1/6 overshoots; fails when the schema's bounds are wider."""
    with pytest.raises(InputError, match=setting.partition("=")[0]):
        parse_scene(extreme.impact(), "scene", [f"numerics.{setting}"])


# --- what the watch sees -------------------------------------------------------------------------------------------

@pytest.mark.mpi
def test_watch_passes_a_sound_run():
    """The base of the tests below: nothing is wrong with this run."""
    setup, eye = moving_sphere()
    outcome = watch.judge("sound", eye, lambda: eye.run(10e-9, 5))
    assert outcome.verdict == watch.STABLE
    assert outcome.steps == setup.clock.steps > 10
    assert outcome.speed_ratio == pytest.approx(1.0, abs=0.2)


def spoil_mass(state):
    state.views["mass"][...] *= 1.0 - 1e-9


def spoil_energy(state):
    for name in ("velocity_x", "velocity_y", "velocity_z"):
        state.views[name][...] *= 1.01


def spoil_peeq(state):
    state.views["peeq"][...] *= 1.0 - 1e-9


def spoil_sign(state):
    state.views["peeq"][...] -= 1e-9


def spoil_temperature(state):
    state.views["temperature"][...] = np.inf


@pytest.mark.mpi
@pytest.mark.parametrize(("spoil", "reason"), [
    (spoil_mass, "mass: 1.00e-09 of it is missing at step"), (spoil_energy, "energy: it rose by"),
    (spoil_peeq, "PEEQ: its sum fell by 1.00e-09 at step"), (spoil_sign, "peeq below 0"),
    (spoil_temperature, "not finite or not possible at step")])
def test_watch_sees_what_is_wrong(spoil, reason):
    """Each quantity is spoilt by a little in the middle of a run; fails when its bar is widened a hundred times."""
    setup, eye = moving_sphere()

    def task():
        eye.run(20e-9, 5)
        spoil(setup.state)
        eye.look()
        eye.look()

    outcome = watch.judge("spoilt", eye, task)
    assert outcome.verdict == watch.FAILED
    assert reason in outcome.reason
    assert not outcome.passed


@pytest.mark.mpi
def test_energy_that_swings_between_motion_and_stress_does_not_rise():
    """A standing elastic wave, looked at after every remap, over two periods: its energy must only ever fall.

    Fails when velocity is half a step off at a look (leave ``lagrange.second_half`` out of ``advance``).
    """
    model = never_yields(make_model(3e-6))
    setup = make_block((48, 5, 5), model)
    state = setup.state
    x = node_coordinates(state)[0]
    state.views["velocity_x"][...] = np.sin(np.pi * x / 48.0)
    state.boundary.hold([state.views[n] for n in VELOCITY])
    setup.ledger.add("brought_in", kinetic_quanta(state, model))
    eye = watch.Watch(setup, 1.0)
    sound = np.sqrt((model.bulk.bulk_modulus + 4.0 / 3.0 * model.bulk.shear_modulus) / model.bulk.density)
    eye.run(4.0 * 48.0 * model.dx / sound, 1)
    assert setup.clock.steps > 100
    assert eye.energy_rise < watch.ENERGY_BAR


def stopped_by(velocity):
    """Return the outcome of a run in which the nodes inside the sphere are given ``velocity`` on the way."""
    setup, eye = moving_sphere()

    def task():
        eye.run(2e-9, 5)
        state = setup.state
        state.views["velocity_z"][state.views["nodal_mass"] > 0.9] = velocity
        setup.advance_to(20e-9)

    with np.errstate(invalid="ignore", over="ignore"):
        return watch.judge("spoilt", eye, task)


@pytest.mark.mpi
def test_numbers_that_are_not_finite_are_a_failure():
    """A velocity that is infinite ends the run with the cell named; fails when any UnstableStep is a good stop."""
    outcome = stopped_by(np.inf)
    assert outcome.verdict == watch.FAILED
    assert "is not finite at cell (i, j, k) = (" in outcome.reason
    assert not outcome.passed


@pytest.mark.mpi
def test_a_box_that_is_too_low_stops_for_a_clear_reason():
    """Particles that meet the deposit at the top of the box; fails when that counts as failed."""
    _, eye = moving_sphere()

    def task():
        raise UnstableStep(NO_ROOM)

    outcome = watch.judge("low", eye, task)
    assert (outcome.verdict, outcome.passed) == (watch.STOPPED, True)


@pytest.mark.mpi
def test_velocity_that_is_not_a_number_is_not_taken_for_rest():
    """Fails if the flush of tiny velocities asks abs(u) > smallest, which a NaN is not."""
    assert stopped_by(np.nan).verdict == watch.FAILED


@pytest.mark.mpi
def test_mass_is_looked_at_where_nothing_was_put_in():
    """A substrate at rest loses 1e-9 of its mass; fails when the drift is over what was painted, which is nothing."""
    setup = make_block((16, 8, 8), make_model(3e-6))
    eye = watch.Watch(setup, 0.0)
    eye.look()
    spoil_mass(setup.state)
    with pytest.raises(watch.Broken, match=r"mass: 1\.00e-09 of it is missing"):
        eye.look()


@pytest.mark.mpi
def test_energy_that_is_no_number_is_a_failure():
    """Fails when the largest rise is kept by ``max``, which drops a NaN, and again when a later look forgets it."""
    _, eye = moving_sphere()
    terms = dict.fromkeys(ENERGY_TERMS, 0.0) | {"brought_in": 1.0}
    eye._look_at_energy({"energy": terms})
    with pytest.raises(watch.Broken, match="energy: it rose by nan"):
        eye._look_at_energy({"energy": terms | {"elastic": np.nan}})
    with pytest.raises(watch.Broken, match="energy"):
        eye._look_at_energy({"energy": terms})


@pytest.mark.mpi
def test_kinetic_energy_that_no_heat_gave_is_a_rise():
    """Velocities grow by 1 % and the remap's ledger says that ringing made it, but no heat was taken for it.

    Fails when ``held`` is lowered by what the remap made instead of by what the heat gave.
    """
    setup, eye = moving_sphere()

    def task():
        eye.run(20e-9, 5)
        before = kinetic_quanta(setup.state, setup.model)
        spoil_energy(setup.state)
        setup.ledger.add("lost", before - kinetic_quanta(setup.state, setup.model))
        eye.look()

    outcome = watch.judge("ringing", eye, task)
    assert outcome.verdict == watch.FAILED
    assert "energy: it rose by" in outcome.reason


def test_an_exception_of_the_solver_is_a_failure():
    """A run that raises anything but UnstableStep has failed; fails when such errors are taken for a clear stop."""
    _, eye = moving_sphere()

    def task():
        raise OverflowError("too large")

    outcome = watch.judge("broken", eye, task)
    assert (outcome.verdict, outcome.reason) == (watch.FAILED, "OverflowError: too large")


def test_refused_scene_is_told_with_its_line():
    """What the check of a scene refuses is no run; fails when InputError leaves run_scene."""
    outcome = watch.run_scene("wrong", extreme.impact(), ["numerics.courant=1.5"])
    assert outcome.verdict == watch.REFUSED
    assert "numerics.courant" in outcome.reason


def test_table_shows_every_outcome_and_the_counts():
    """Fails when a row or the last line is left out."""
    outcomes = [watch.Outcome("a", watch.STABLE, steps=7), watch.Outcome("b", watch.FAILED, "it broke")]
    head, first, second, last = watch.table(outcomes).splitlines()
    assert head.split()[:3] == ["scene", "verdict", "steps"]
    assert first.split()[:3] == ["a", "stable", "7"]
    assert second.endswith("it broke")
    assert last == "1 stable, 1 failed"


# --- fuzz ----------------------------------------------------------------------------------------------------------

def test_fuzz_has_no_failure():
    """Ten random scenes; fails with light_mass_floor up to 0.9, as scenes allowed before the fuzz (scene 0)."""
    outcomes = fuzz.run(10)
    assert [o.scene for o in outcomes] == [f"fuzz 1-{i}" for i in range(10)]
    assert [o.reason for o in outcomes if not o.passed] == []
    assert sum(o.verdict == watch.STABLE for o in outcomes) >= 7


@pytest.mark.mpi
def test_fuzz_on_ranks_is_the_same():
    """A scene runs alike on every rank; fails when an outcome holds a number of one rank only."""
    outcomes = fuzz.run(1, first=2, numerics=PAINTED, plain=True)
    seen = mpi.all_gather([(o.scene, o.verdict, o.steps, o.peeq_max, o.temperature_max, o.wall_s) for o in outcomes])
    assert all(row == seen[0] for row in seen)
    assert outcomes[0].verdict == watch.STABLE


@pytest.mark.parametrize(("verdict", "code"), [(watch.STABLE, 0), (watch.FAILED, 1)])
def test_one_failure_is_the_exit_code_of_all(verdict, code, monkeypatch, tmp_path, capsys):
    """Fails when ``stability`` returns 0 always, or does not write what it found."""
    monkeypatch.setattr(extreme, "run", lambda *_, report: [watch.Outcome("first", watch.STABLE)])
    monkeypatch.setattr(fuzz, "run", lambda *_, report: [watch.Outcome("second", verdict, "it grew")])
    assert main(["verify", "--extreme", "--json", str(tmp_path / "found.json")]) == code
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert [(row["scene"], row["verdict"]) for row in found] == [("first", watch.STABLE), ("second", verdict)]
    assert "it grew" in capsys.readouterr().out


def test_fuzz_scenes_come_from_their_seed():
    """Same seed and number, same text; others differ; all stay in the ranges; fails with an unseeded generator."""
    texts = [fuzz.scene_text(1, i) for i in range(60)]
    assert texts == [fuzz.scene_text(1, i) for i in range(60)]
    assert len(set(texts)) == 60
    assert fuzz.scene_text(2, 0) != texts[0]
    for name in fuzz._NUMERICS:
        low, high = fuzz._bounds(name)
        assert low < high
        for default in SPEED_LIMITS.get(name, [Numerics.model_fields[name].default]):
            assert low <= default <= high
    rare = [fuzz.options(1, i) for i in range(60)]
    assert rare == [fuzz.options(1, i) for i in range(60)]
    keys = {option.partition("=")[0] for options in rare for option in options}
    assert keys >= {"domain.faces.z_low", "numerics.loss_heating", "numerics.sleeping_depth", "output.origin",
                    "particles.temperature_per_diameter"}
    refusals = []
    for text, options in zip(texts, rare):
        try:
            parse_scene(text, "fuzz", options)
        except InputError as error:
            refusals.append(str(error))
    assert not [line for line in refusals if "temperature" not in line]
