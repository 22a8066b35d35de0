"""``f2s verify``: every analytic case at quick size with the errors it must reach, and the command itself."""

from __future__ import annotations

import csv
import json
import math

import pytest

from f2s_hpc import mpi
from f2s_hpc.analysis.verification import case_table, overview_table
from f2s_hpc.analysis.work_precision import _draw_bars, _over_resolution, curves, draw_case
from f2s_hpc.cli.main import main
from f2s_hpc.errors import InputError, UnstableStep
from f2s_hpc.materials.flow_stress import flow_stress
from f2s_hpc.verify import material, sample, suite
from f2s_hpc.verify.box import make_model
from f2s_hpc.verify.case import Case, Measured, judged
from f2s_hpc.verify.piston import two_waves
from f2s_hpc.verify.registry import CASES, find

KEYS = {"case", "quantity", "resolution", "dx_m", "value", "reference", "error", "order", "bar", "least_order",
        "passed", "steps", "cell_steps", "wall_s"}


def measure(name: str, *overrides: str) -> list[dict]:
    """Return the rows of a case at quick size."""
    (case,) = find([name])
    return [suite.as_dict(row) for row in suite.run_case(case, case.options(False, list(overrides)))]


def finest(rows: list[dict]) -> dict[str, float]:
    """Return the error of each quantity at its finest resolution."""
    return {row["quantity"]: row["error"] for row in rows}


def check(rows: list[dict], limits: dict[str, float]) -> None:
    """Check that all bars are met, and the finest errors ``limits``."""
    assert {row["quantity"] for row in rows} == set(limits)
    missed = [(row["quantity"], row["resolution"], row["error"], row["bar"], row["order"]) for row in rows
              if row["passed"] is False]
    assert not missed
    for quantity, error in finest(rows).items():
        assert error <= limits[quantity], quantity
    assert all(row["steps"] > 0 for row in rows)


def row(**changed) -> dict:
    """Return a row of a table."""
    return {"case": "c", "quantity": "q", "resolution": 8.0, "dx_m": 0.1, "value": 1.0, "reference": None, "error": 0.1,
            "order": None, "bar": None, "least_order": None, "passed": None, "steps": 5, "cell_steps": 50,
            "wall_s": 0.5, "compares": True} | changed


# --- cases -------------------------------------------------------------------------------------------


def test_elastic_wave_is_of_second_order():
    """Fails when one ``0.25 / dx`` of ``lagrangian_step`` becomes ``0.26 / dx``."""
    check(measure("elastic-wave"), {"stress, L2": 8e-4, "velocity, L2": 8e-4})


def test_elastic_wave_along_the_diagonal_is_of_second_order():
    """Fails when ``(x - y + z)`` of ``_corner_forces`` becomes ``(x + z)``."""
    check(measure("elastic-wave-diagonal"), {"stress, L2": 3.5e-3, "velocity, L2": 3.5e-3})


@pytest.mark.parametrize(("name", "plateau", "late", "overshoot"), [
    ("piston", 2e-4, 1e-3, 0.048), ("piston-100", 1e-3, 0.015, 0.039), ("piston-300", 3e-3, 0.05, 0.021)])
def test_piston_meets_the_two_wave_solution(name, plateau, late, overshoot):
    """Fails when ``+ eos.gamma * eos.density * energy`` of ``_grueneisen_pressure`` is left out.

    And when ``_largest_stress_until`` looks at the end only: the overshoot is that of the first moments at the wall.
    """
    rows = measure(name)
    check(rows, {
        "plateau stress (Pa)": plateau, "plateau velocity (m/s)": plateau, "plastic wave speed (m/s)": 4e-3,
        "precursor stress (Pa)": 4.5e-3, "precursor velocity (m/s)": 3.5e-3, "precursor wave speed (m/s)": 1.5e-3,
        "overshoot of stress (Pa)": overshoot, "overshoot at half time and end (Pa)": late})
    assert finest(rows)["overshoot of stress (Pa)"] > 0.015


def test_two_waves_are_the_published_ones():
    """Udaykumar et al. 2003: all printed digits; fails when ``0.5 * yielding / shear`` becomes ``yielding / shear``."""
    precursor, plastic = two_waves(make_model(1e-6, "copper-piston"), 20.0)
    values = (precursor.speed, precursor.velocity, precursor.density, precursor.energy, precursor.stress)
    assert values == pytest.approx((4722.18, 4.7198, 8938.93, 11.138, 199.03e6), rel=4e-5)
    values = (plastic.speed, plastic.density, plastic.energy, plastic.stress)
    assert values == pytest.approx((3976.96, 8973.45, 213.53, 741.59e6), rel=5e-6)
    with pytest.raises(InputError, match=r"faster than 4\.72"):
        two_waves(make_model(1e-6, "copper-piston"), 4.0)


def test_leveque_field_brings_the_sphere_back():
    """E1 at 32 below plicRDF's 7.743e-3; fails when ``distance - a * start`` of ``slab_volume`` is ``distance``."""
    check(measure("vof-leveque"), {"E1": 7.743e-3, "volume": 1e-12, "mass": 1e-12})


@pytest.mark.slow
def test_reversed_vortex_brings_the_disc_back():
    """E1 at 64 below 1.2 times the reference; fails when ``distance - a * start`` of ``slab_volume`` is ``distance``.

    """
    check(measure("vof-vortex"), {"E1": 1.2 * 0.0108781, "volume": 1e-12, "mass": 1e-12})


@pytest.mark.slow
def test_free_flight_changes_nothing():
    """Fails when ``(q_low - q)`` of the remap's updates is taken at the other face."""
    check(measure("free-flight"), {"velocity": 1e-9, "stress": 1e-9, "temperature": 1e-9, "PEEQ": 0.0, "mass": 1e-12,
                                   "centroid (cells)": 0.04})


@pytest.mark.slow
def test_free_flight_ends_where_it_leads():
    """Along the diagonal, the worst direction: 2 % of the way off at 5 cells per diameter, falling with order 2.

    Fails when ``distance - a * start`` of ``slab_volume`` is ``distance``.
    """
    rows = measure("free-flight", "direction=1,1,-1", "distance=40", "resolutions=5,8")
    errors = [row for row in rows if row["quantity"] == "centroid (cells)"]
    assert [row["error"] < limit for row, limit in zip(errors, (0.42, 0.16))] == [True, True]
    assert errors[1]["order"] > 1.8
    assert errors[1]["passed"]


def test_rotation_keeps_the_invariants():
    """Fails when ``second`` of ``_sweep_fields`` becomes 0.0 (a remap of first order).

    The components, when stress is carried along but not turned: ``ax, ay, az`` of ``_trial_stress`` zero. They are then
    off by 94 % at any size, while all invariants are right.
    """
    check(measure("rotating-block"), {"von Mises stress, L1": 0.025, "third invariant, L1": 0.023, "shape, L1": 0.022,
                                      "components after an eighth of a turn, L1": 0.003, "mass": 1e-12})


def test_what_turns_keeps_its_spin():
    """But for what the remap takes. Fails (15 and 7 %) when light nodes share what is across the line between them."""
    rows = measure("spinning-sphere", "resolutions=8,12")
    check(rows, {"angular momentum lost": 0.009})
    assert rows[0]["error"] < 0.02


def test_a_collision_is_the_same_in_a_moving_frame():
    """In shape and mean PEEQ. Fails when cell fields are remapped at first order (``second`` of ``_sweep_fields`` 0.0).
    """
    rows = measure("moving-frame", "resolutions=12")
    check(rows, {"extent along": 0.003, "extent across": 0.004, "PEEQ mean": 0.015, "PEEQ p95": 0.3})
    assert rows[2]["reference"] > 0.5


def test_simple_shear_follows_the_closed_form():
    """Fails when ``+ shear_modulus * dxy`` is left out of ``qxy`` in ``_trial_stress``."""
    rows = measure("simple-shear")
    check(rows, dict.fromkeys(("stress xx", "stress yy", "stress xy"), 2e-7))
    assert all(row["order"] > 1.95 for row in rows if row["resolution"] > 100)


def test_heat_slab_decays_at_second_order():
    """On any meshes. Fails when ``number * total`` of ``heat_gained`` becomes ``0.99 * number * total``; the orders,
    when each mesh takes the step that sound allows (``coarsest`` left out of ``_slab``): -5 at 32 cells then.
    """
    rows = measure("heat-slab", "resolutions=8,12,16,24,32")
    check(rows, {"temperature, L2": 8e-5})
    assert [row["order"] for row in rows[1:]] == pytest.approx([2.0] * 4, abs=0.02)


def test_plastic_work_heats_to_round_off():
    """Fails when ``s[PLASTIC * W + i]`` of the power in ``_heat_chunk`` becomes ``s[STRAIN * W + i]``."""
    check(measure("plastic-heating"), {"temperature rise, sum of stress times strain (K)": 5e-12,
                                       "temperature rise, closed form (K)": 4e-4, "heat in the ledger (J)": 1e-8})


def test_radial_return_solves_random_states():
    """Fails when ``_NEAR`` becomes 5e-2, or ``theta * (hardened * bend`` of ``return_step`` loses ``theta``."""
    names = ("Ge", "Johnson-Cook", "linear hardening")
    limits = {f"{name}: {what}": limit for name in names for what, limit in (
        ("flow stress", 1e-11), ("3 G increment over trial stress", 1e-12), ("iterations", 8))}
    check(measure("radial-return", "resolutions=3000,10000"), limits)


def test_flow_stress_has_the_tabulated_values():
    """Fails when ``alpha`` of copper-ge in the library becomes 7.51 MPa, or ``slope_rate`` loses a term."""
    limits = {f"{name}, {what}": limit for name in ("Ge", "Johnson-Cook") for what, limit in (
        ("flow stress", 1e-8), ("slope in PEEQ", 1e-8), ("slope in rate", 1e-8))}
    check(measure("flow-stress"), limits)


@pytest.mark.mpi
def test_rows_are_the_same_on_every_rank(shared_path):
    """Waves and a turning block on any number of ranks; fails when ``sample.sums`` returns this rank's own sums."""
    assert suite.verify(["elastic-wave", "rotating-block", "simple-shear"], ["resolutions=16,20", "shear=1"], False,
                        shared_path, shared_path / "rows.json") == 1  # at 20 the shear's steps are not small
    rows = json.loads((shared_path / "rows.json").read_text(encoding="utf-8"))
    errors = {(row["case"], row["quantity"], row["resolution"]): row["error"] for row in rows}
    assert errors["elastic-wave", "stress, L2", 16] == pytest.approx(2.57594e-3, rel=1e-5)
    assert errors["rotating-block", "von Mises stress, L1", 16] < 0.1
    mine = [row["error"] for row in measure("rotating-block", "resolutions=16")]
    assert all(other == mine for other in mpi.all_gather(mine))


# --- the command -------------------------------------------------------------------------------------


def test_command_writes_tables_and_plots(run_f2s, tmp_path):
    """Exit code 0, table, overview, CSV, JSON and PNG; fails when ``_write_case`` leaves out one of the three files."""
    result = run_f2s(["verify", "simple-shear", "heat-slab", "--set", "resolutions=100,200,600", "--set", "shear=1",
                      "--set", "decay=1e-5", "--json", "rows.json", "--out", "figures"])
    assert result.returncode == 0, result.stdout + result.stderr
    assert "simple-shear: Elastic simple shear" in result.stdout
    assert "6 of 6 bars met" in result.stdout
    rows = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))
    assert len(rows) == 12
    assert set(rows[0]) == KEYS
    assert {row["case"] for row in rows} == {"simple-shear", "heat-slab"}
    folder = tmp_path / "figures"
    with (folder / "simple-shear.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert [float(line["error"]) for line in table] == [row["error"] for row in rows[:9]]
    assert json.loads((folder / "simple-shear.json").read_text(encoding="utf-8")) == rows[:9]
    for name in ("simple-shear", "heat-slab", "overview"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_missed_bar_gives_exit_code_1(tmp_path, capsys):
    """A wave that is not weak, dust that takes volume away; fails when the last line of ``verify`` returns 0."""
    assert main(["verify", "elastic-wave", "--set", "strain=0.05", "--set", "resolutions=8,16",
                 "--out", str(tmp_path)]) == 1
    assert "MISSED" in capsys.readouterr().out
    assert main(["verify", "vof-leveque", "--set", "resolutions=8", "--set", "numerics.dust=1e-4",
                 "--out", str(tmp_path)]) == 1
    assert "0 of 2 bars met" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "said"), [
    (["elastic-wav"], 'no verification case "elastic-wav"; did you mean "elastic-wave"?'),
    (["elastic-wave", "--set", "strin=1"], 'case "elastic-wave" has no setting "strin"; did you mean "strain"?'),
    (["heat-slab", "elastic-wave", "--set", "sheer=1"], 'the chosen cases have no setting "sheer"'),
    (["elastic-wave", "--set", "length=3 K"], "--set length: "),
    (["elastic-wave", "--set", "resolutions=8,4"], "write rising numbers with commas"),
    (["elastic-wave", "--set", "strain"], "write it as NAME=VALUE"),
    (["elastic-wave", "--set", "numerics.courrant=0.4"], "numerics.courrant"),
    (["piston", "--set", "speed=1 m/s", "--set", "resolutions=20"], "the piston must be faster than 4.72 m/s"),
])
def test_wrong_names_are_one_line(arguments, said, tmp_path, capsys):
    """Exit code 2 and one line on standard error; fails when ``did_you_mean`` is left out of ``find``."""
    assert main(["verify", *arguments, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said in error


def test_a_setting_needs_only_one_of_the_cases(tmp_path):
    """``shear`` is no setting of heat-slab; fails when ``any`` of ``_check_overrides`` becomes ``all``."""
    assert main(["verify", "simple-shear", "heat-slab", "--set", "shear=0.1", "--set", "resolutions=100,1000",
                 "--set", "decay=1e-6", "--out", str(tmp_path)]) == 0


def test_list_names_every_case(capsys):
    """Fails when ``list_cases`` leaves out the settings or a case."""
    assert main(["verify", "--list"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{case.name} " in printed for case in CASES)
    assert "strain=1e-6" in printed
    assert len({case.name for case in CASES}) == len(CASES)


def test_a_run_that_the_solver_stops_is_a_missed_bar():
    """Rows before the stop stay, the stop is one more; fails when ``bar=0.0`` of ``run_case`` becomes ``bar=None``."""
    def run(options):
        yield Measured("height", 4, 1.0, 2.0, 2.1, 0.05, 0.1)
        raise UnstableStep("the time step collapsed")

    case = Case("c", "title", run, (4.0,), (4.0,))
    rows = [suite.as_dict(row) for row in suite.run_case(case, case.options(False, []))]
    assert [row["passed"] for row in rows] == [True, False]
    assert rows[1]["quantity"] == "stopped: the time step collapsed"
    assert "1 of 2 bars met" in overview_table(rows)


def test_a_bar_and_an_order_are_met_or_missed():
    """Errors 0.4, 0.1, 0.1 at spacings 2, 1, 1/2. Fails when a bar that is just met is missed, one of two met bars is
    enough, an order that is not known passes, or quantities that do not compare have one.
    """
    def rows(bar: float | None, least_order: float | None, compares: bool = True) -> list:
        return judged("c", [Measured("q", n, dx, 1.0, None, error, bar, least_order, compares)
                            for n, (dx, error) in enumerate(((2.0, 0.4), (1.0, 0.1), (0.5, 0.1)))])

    assert [row.order for row in rows(None, None)] == [None, 2.0, 0.0]
    assert [row.passed for row in rows(None, None)] == [None] * 3
    assert [row.passed for row in rows(0.1, None)] == [False, True, True]
    assert [row.passed for row in rows(None, 2.0)] == [False, True, False]
    assert [row.passed for row in rows(0.1, 2.0)] == [False, True, False]
    assert [row.order for row in rows(0.1, None, False)] == [None] * 3


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_is_no_number_has_missed_its_bar(wrong):
    """Fails when a verdict asks ``m.error <= m.bar`` alone (a value), or an order from infinity counts."""
    rows = [Measured("a", 8, 2.0, 1.0, None, wrong, 0.5), Measured("a", 16, 1.0, 1.0, None, 0.1, None, 1.0),
            Measured("b", 8, 2.0, wrong, None, 0.1, 0.5), Measured("c", 8, 2.0, wrong, None, wrong)]
    assert [row.passed for row in judged("c", rows)] == [False, False, False, None]


@pytest.mark.mpi
def test_the_largest_over_ranks_may_be_no_number():
    """One rank has a NaN, and all must see it; fails when ``sample.largest`` is a maximum of MPI."""
    alone = mpi.rank() == mpi.size() - 1
    found = sample.largest([math.nan if alone else 1.0, float(mpi.rank())])
    assert math.isnan(found[0])
    assert found[1] == mpi.size() - 1


@pytest.mark.parametrize("which", [0, 1, 2])
def test_flow_stress_that_is_no_number_is_seen(which, monkeypatch):
    """Value or a slope is NaN at one point; fails when ``_difference_errors`` keeps the larger one by ``max``."""
    def broken(flow, peeq, rate, temperature):
        found = list(flow_stress(flow, peeq, rate, temperature))
        if (rate, temperature) in ((30.0, 500.0), (1e7, 600.0)):
            found[which] = math.nan
        return tuple(found)

    monkeypatch.setattr(material, "flow_stress", broken)
    assert any(row["passed"] is False for row in measure("flow-stress"))


def test_a_constant_goes_to_the_model_that_has_it():
    """The other model keeps its table. Fails when ``reaching`` returns all overrides: an unknown key of the other."""
    asked = {row["quantity"] for row in measure("flow-stress", "material.flow_stress.C=0.02")}
    assert "Ge, flow stress" in asked
    assert "Johnson-Cook, slope in rate" in asked
    assert "Johnson-Cook, flow stress" not in asked


def test_tables_say_what_is_missed():
    """Fails when ``missed or rows`` of ``_tightest`` becomes ``rows``."""
    rows = [row(bar=0.11, passed=True), row(quantity="other", error=0.2, bar=1.9, passed=False, least_order=1.0)]
    assert "MISSED: other, 8 cells: error 2.00e-01, bar 1.9, order 1" in overview_table(rows)
    assert "1 of 2 bars met" in overview_table(rows)
    lines = case_table("c", "title\nand more", rows).splitlines()
    assert lines[0] == "c: title"
    assert len({line.index(end) + len(end) for line, end in zip(lines[4:], ("met", "MISSED"))}) == 1


def test_nothing_judged_is_not_met():
    """Fails when a case without bars says ``0 of 0``."""
    text = overview_table([row()])
    assert text.splitlines()[-1] == "nothing judged"
    assert "0 of 0" not in text


@pytest.mark.parametrize(("rows", "shown"), [
    ([row(compares=False, resolution=n, error=0.1 / n) for n in (4.0, 8.0)], ({"q": 2}, "error")),
    ([row(compares=False, resolution=n, error=0.0, value=-n) for n in (4.0, 8.0)], ({"q": 2}, "value")),
    ([row(error=0.0, reference=1.0)], ({"q": 1}, "value")), ([row(value=math.nan, error=math.nan)], ({}, "value"))])
def test_every_case_has_a_plot(rows, shown, tmp_path):
    """Over the resolution where nothing makes a curve: errors, else values; fails when ``draw_case`` draws curves only.

    Nothing is written where no number is finite.
    """
    pytest.importorskip("matplotlib")
    lines, up = _over_resolution(rows)
    assert ({quantity: len(points) for quantity, points in lines.items()}, up) == shown
    path = tmp_path / "plot.png"
    assert draw_case(rows, path, "c", "title") is bool(lines)
    assert path.exists() is bool(lines)


def test_curves_need_work_and_errors():
    """Points without an error or time, and quantities that took no longer when finer, make no curve; fails when
    ``1.2 * points[0]`` becomes ``0.0 * points[0]``.
    """
    fine = row(resolution=16.0, wall_s=2.0, error=0.01)
    assert curves([row(), fine]) == {"q": [row(), fine]}
    assert curves([row(), row(resolution=16.0)]) == {}
    assert curves([row(compares=False), row(compares=False, wall_s=3.0)]) == {}
    assert curves([row(error=math.inf), fine]) == {}
    assert curves([row(error=1e-16), fine]) == {}


def test_a_bar_is_a_line_only_where_it_holds_for_all():
    """Fails when the bars that are not asked for are left out of ``set(bars)``."""
    figure = pytest.importorskip("matplotlib.figure").Figure()

    def drawn(*bars: float | None) -> list[tuple[int, str]]:
        axes = figure.add_subplot()
        points = [row(wall_s=1.0 + number, bar=bar) for number, bar in enumerate(bars)]
        _draw_bars(axes, {"q": points[:2], "other": points[2:]})
        return [(len(line.get_xdata()), line.get_marker()) for line in axes.lines]

    assert drawn(0.1, 0.1, 0.1, 0.1) == [(2, "None")]
    assert drawn(0.1, 0.1, None, None) == [(2, "_")]
    assert drawn(None, 0.1, 0.1, 0.2) == [(3, "_")]
    assert drawn(None, None, None, None) == []
