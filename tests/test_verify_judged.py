"""What verification cases of bodies judge, and what they do not: other problems, energy, deposits of nothing."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from verify_setup import CASES, made_splat, rows

from f2s_hpc.solver.ledger import ENERGY_TERMS
from f2s_hpc.verify import deposit, impact, splat, taylor
from f2s_hpc.verify.box import make_model, make_setup
from f2s_hpc.verify.case import Measured, judged


def test_another_problem_has_no_published_reference(monkeypatch):
    """Fails when ``as_published`` looks at some settings only, or not at constants of the material."""
    monkeypatch.setattr(splat, "splat", made_splat)
    for override in ("temperature=400 K", "diameter=30 um", "material=copper-ge", "material.conductivity=1 W/m/K"):
        found = rows("impact-jc", "resolutions=24", override)
        assert all(row.measured.reference is None for (name, _), row in found.items() if "remainder" not in name)
        assert all(row.passed is None for (name, _), row in found.items() if "remainder" not in name)
    found = rows("impact-jc", "resolutions=24", "speeds=300", "places=2", "numerics.hourglass=0.02")
    assert found["PEEQ p95, 300 m/s", 24.0].measured.bar == 0.06


def made_bar(monkeypatch, *shapes):
    """Let a Taylor bar have these shapes (foot radius, the same on an axis, length) at its times, the last for long."""
    left = list(shapes)
    setup = SimpleNamespace(advance_to=lambda end: None, clock=SimpleNamespace(steps=1, active_cell_steps=1),
                            model=SimpleNamespace(dx=1e-3))
    monkeypatch.setattr(taylor, "make_bar", lambda *_: setup)
    monkeypatch.setattr(taylor, "shape", lambda _: left.pop(0) if len(left) > 1 else left[0])
    monkeypatch.setattr(taylor.energy, "row_of", lambda _, level, cost: Measured("remainder", level, 1e-3, 0, 0, 0,
                                                                                  **cost))


@pytest.mark.parametrize("override", ["material=copper-ge", "speed=200 m/s", "material.poisson_ratio=0.3"])
def test_another_bar_has_no_reference(override, monkeypatch):
    """Neither reference, error, bar nor history; fails when errors are those against the hidden reference."""
    made_bar(monkeypatch, (7e-3, 7e-3, 21e-3))
    found = rows("taylor-bar", "resolutions=4", override)
    assert [quantity for quantity, _ in found] == ["final length", "foot radius", "foot radius along an axis",
                                                   "remainder"]
    assert all(row.measured.error == 0.0 and row.passed is None for row in found.values())
    assert found["final length", 4.0].measured.reference is None


def test_a_history_that_is_no_number_is_missed(monkeypatch):
    """NaN once on the way; fails when the worst is kept by ``max``, which drops it."""
    made_bar(monkeypatch, (math.nan, 4e-3, math.nan), (taylor.FINAL_RADIUS, 7e-3, taylor.FINAL_LENGTH))
    case = CASES["taylor-bar"]
    found = judged(case.name, list(case.run(case.options(False, ["resolutions=24"]))))
    passed = {row.measured.quantity: row.passed for row in found}
    assert passed["final length"]
    assert passed["history of the length"] is passed["history of the radius"] is False


@pytest.mark.parametrize(("whole", "half", "ratio", "passed"), [
    (4e-3, 2e-3, 0.5, True), (5e-4, 2e-3, 4.0, False), (1e-4, 9e-4, 9.0, None), (2e-3, 1e-4, 0.05, True)])
def test_half_the_step_is_judged_by_the_true_ratio(whole, half, ratio, passed, monkeypatch):
    """At both meshes from 8 cells on. Fails when the ratio is over 0.001 at least, or is judged where both cancel."""
    def made(impact_, level, overrides, place=0.0):
        found = made_splat(impact_, level, (), place)
        found.balance["energy"]["time_step"] = half if any("courant" in o for o in overrides) else whole
        return found

    monkeypatch.setattr(impact, "splat", made)
    found = rows("energy-jc", "resolutions=6,8,12,16")
    name = "time step and remainder, half the step over whole"
    assert [level for quantity, level in found if quantity == name] == [8.0, 12.0]
    for level in (8.0, 12.0):
        assert found[name, level].measured.value == pytest.approx(ratio)
        assert found[name, level].passed is passed


def test_numerical_parts_must_fall_with_the_cells(monkeypatch):
    """From 8 cells on, unless under 0.3 %. Fails when a part may grow as it likes (``bar=None`` in ``_shares``)."""
    def made(impact_, level, _, place=0.0):
        found = made_splat(impact_, level, (), place)
        found.balance["energy"] |= {"hourglass": 1e-3 * level, "light_nodes": 1e-4 * level,
                                    "remap_kinetic": 0.1 / level}
        return found

    monkeypatch.setattr(impact, "splat", made)
    found = rows("energy-jc")
    for part, passed in (("hourglass", False), ("light_nodes", True), ("remap_kinetic", True)):
        assert [found[part, level].passed for level in (6.0, 8.0, 12.0)] == [None, None, passed]


def test_a_film_within_a_layer_of_cells_has_no_height():
    """A fast sphere at a mirror (depth 0); fails when ``_axes`` takes the root of a moment less than that of a cell."""
    found = rows("energy-jc", "depth=0", "resolutions=4")
    assert found["time step and remainder", 4.0].measured.value < 0.05


def deposited(monkeypatch, *temperatures):
    """Let the meshes of deposit-temperature end with these temperatures (degC)."""
    left = list(temperatures)
    setup = SimpleNamespace(state=None, model=None, ledger=None, clock=SimpleNamespace(steps=1, active_cell_steps=1))
    balance = {"energy": dict.fromkeys(ENERGY_TERMS, 0.0) | {"brought_in": 1.0}, "numerical_loss_fraction": 0.1}
    monkeypatch.setattr(deposit, "_deposited", lambda scene: (setup, 0))
    monkeypatch.setattr(deposit, "deposit_temperature", lambda *_: left.pop(0))
    monkeypatch.setattr(deposit.measure, "measure_balance", lambda *_: balance)
    case = CASES["deposit-temperature"]
    levels = ",".join(f"{level:g}" for level in (4.0, 5.0, 7.5)[3 - len(temperatures):])
    found = judged(case.name, list(case.run(case.options(False, [f"resolutions={levels}"]))))
    return {(row.measured.quantity, row.measured.resolution): row for row in found}


def test_one_mesh_has_no_spread(monkeypatch):
    """Nor has a mesh of less than 5 cells per 30 um a part in it. Fails when one mesh is met with a spread of 0."""
    spread = "spread of the mean temperature", 7.5
    assert spread not in deposited(monkeypatch, 600.0)
    found = deposited(monkeypatch, 500.0, 600.0, 612.0)
    assert found[spread].measured.value == pytest.approx(12.0 / 606.0)
    assert found[spread].passed
    assert not deposited(monkeypatch, 600.0, 640.0)[spread].passed


def test_a_deposit_of_nothing_is_a_failure(monkeypatch):
    """Fails when a mean over no mass is a division by zero, or its NaN has no bar."""
    setup = make_setup((4, 4, 8), make_model(6e-6))
    scene = SimpleNamespace(top_speed=600.0, domain=SimpleNamespace(substrate_height=6e-6))
    assert math.isnan(deposit.deposit_temperature(setup, scene))
    found = deposited(monkeypatch, math.nan, 600.0)
    assert found["mean deposit temperature, degC", 5.0].passed is False
    assert found["spread of the mean temperature", 7.5].passed is False
