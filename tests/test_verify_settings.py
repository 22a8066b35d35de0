"""``f2s verify --set``: what is refused, before anything runs, and what a case does that breaks on the way."""

from __future__ import annotations

import math

import pytest

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.errors import InputError
from f2s_hpc.grid.box import GHOST
from f2s_hpc.verify import suite
from f2s_hpc.verify.case import Case, Measured
from f2s_hpc.verify.registry import CASES, find
from f2s_hpc.verify.setting import NUMBER, WHOLE, Setting


@pytest.mark.parametrize(("case", "override", "said"), [
    ("elastic-wave", "strain=abc", "--set strain=abc: write a number above 0"),
    ("elastic-wave", "periods=0", "--set periods=0: write a number above 0"),
    ("elastic-wave", "strain=nan", "--set strain=nan: write a number above 0"),
    ("elastic-wave", "resolutions=0.3", "elastic-wave needs 4 or more, not 0.3"),
    ("elastic-wave", "resolutions=8.5,16", "elastic-wave needs whole numbers, not 8.5"),
    ("elastic-wave", "material=coper-ge", 'no such material; did you mean "copper-ge"?'),
    ("elastic-wave", "length=-1 um", "write a length above 0 m"),
    ("heat-slab", "material.conductivity=0 W/m/K", "without conduction there is nothing to compare"),
    ("heat-slab", "numerics.conduction=false", "without conduction there is nothing to compare"),
    ("heat-slab", "decay=0", "write a number above 0"),
    ("plastic-heating", "material.taylor_quinney=0", "no plastic work becomes heat"),
    ("plastic-heating", 'material.flow_stress={model="elastic"}', "no plastic work becomes heat"),
    ("radial-return", "trial=0.5", "--set trial=0.5: write a number above 1"),
    ("radial-return", "material.flow_stress.model=elastic", "their constants may be replaced, not they"),
    ("flow-stress", "material.flow_stress.rat_s=1 1/s", 'did you mean "material.flow_stress.rate_s"?'),
    ("flow-stress", "material.flow_stress.C=much", "material.flow_stress.C"),
    ("deposit-temperature", "cycles=abc", "write a whole number from 1 on"),
    ("deposit-temperature", "seed=-1", "write a whole number from 0 on"),
    ("deposit-temperature", "footprint=1 um", 'write a length from 24 um on, or "default"'),
    ("section4", "cycles=abc", 'write a whole number from 1 on, or "default"'),
    ("impact-jc", "half_width=abc", "--set half_width=abc: write a number above 0.5"),
    ("impact-jc", "places=33", "write a whole number from 1 to 32"),
    ("impact-jc", "speeds=500", "write published speeds in m/s with commas"),
    ("impact-ge", "resolutions=8,12", "impact-ge needs 3 resolutions or more"),
    ("impact-lagrangian", "material=copper-piston", "knows linear pressure only"),
    ("simple-shear", "shear=0", "write a number above 0"),
    ("simple-shear", "shear=-1", "write a number above 0"),
    ("free-flight", "distance=0", "write a number above 0"),
    ("spinning-sphere", "turns=0", "write a number above 0"),
    ("free-flight", "distance=-100", "write a number above 0"),
    ("free-flight", "direction=1,inf,0", 'write "all", or three numbers'),
    ("vof-vortex", "period=0", "write a number above 0"),
    ("vof-vortex", "courant=2", "write a number above 0 and at most 1"),
])
def test_a_wrong_setting_is_one_line(case, override, said, tmp_path, capsys):
    """Exit code 2, and nothing written. Fails when ``Setting.read`` takes any number, or ``_check`` is left out."""
    out = tmp_path / "out"
    assert main(["verify", case, "--set", override, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said in error
    assert not out.exists()


def test_settings_are_refused_before_any_case_runs(tmp_path, capsys):
    """``heat-slab`` could run with two resolutions, ``impact-ge`` can not; fails when each is checked as it is run."""
    assert main(["verify", "heat-slab", "impact-ge", "--set", "resolutions=8,12", "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert "heat-slab" not in printed.out
    assert "impact-ge needs 3 resolutions" in printed.err


@pytest.mark.parametrize(("setting", "text", "value"), [
    (Setting("1"), "2.5", 2.5), (Setting("1", kind=WHOLE), "3", 3), (Setting("1 m", "length"), "2 mm", 2e-3),
    (Setting("3", least=0.0), "0", 0.0), (Setting("a", words=("a",)), "a", "a"), (Setting("1", most=2.0), "2", 2.0)])
def test_a_right_setting_is_read(setting, text, value):
    """Fails when a bound that may be reached is refused, or a word is read as a number."""
    assert setting.read("name", text) == value


@pytest.mark.parametrize(("kind", "text"), [
    (WHOLE, "2.5"), (NUMBER, "inf"), (NUMBER, "0"), (NUMBER, "5"), (NUMBER, "")])
def test_a_wrong_value_says_what_is_right(kind, text):
    """Fails when one of the bounds, or that the number is whole, is not looked at."""
    with pytest.raises(InputError, match=r"--set name=.*: write a (whole )?number above 0 and at most 4"):
        Setting("1", kind=kind, most=4).read("name", text)


def test_every_default_is_a_right_one():
    """Of all cases, quick and full; fails when a default is outside its own range, or a case refuses its own."""
    for case in CASES:
        for full in (False, True):
            case.check(case.options(full, []))
            levels = case.full if full else case.quick
            assert levels[0] >= case.least
            assert len(levels) >= (2 if case.name == "impact-paper-cells" else 3)


def test_an_elastic_material_has_nothing_that_yields(tmp_path):
    """Fails when ``never_yields`` looks for the yield stress of a model that has none."""
    assert main(["verify", "elastic-wave", "--set", 'material.flow_stress={model="elastic"}', "--set",
                 "resolutions=8,16", "--out", str(tmp_path)]) == 0


def test_another_period_has_no_reference():
    """Fails when the published error of T = 15 is held against another time."""
    (case,) = find(["vof-vortex"])
    rows = suite.run_case(case, case.options(False, ["period=0.3", "resolutions=32"]))
    (found,) = [row for row in rows if row.measured.quantity == "E1"]
    assert (found.measured.reference, found.measured.bar, found.passed) == (None, None, None)
    assert 0.0 < found.measured.error < 1e-3


@pytest.mark.parametrize(("error", "said"), [
    (ZeroDivisionError("division by zero"), "failed: ZeroDivisionError: division by zero"),
    (ValueError("math domain error"), "failed: ValueError: math domain error"),
    (TypeError("no number"), "failed: TypeError: no number"),
    (InputError("too small"), "refused: too small")])
def test_what_breaks_on_the_way_is_a_failed_row(error, said):
    """Rows before it stay. Fails when it leaves ``run_case``: the cases after it are lost."""
    def run(options):
        yield Measured("height", 4, 1.0, 2.0, 2.1, 0.05, 0.1)
        raise error

    case = Case("c", "title", run, (4.0,), (4.0,))
    rows = [suite.as_dict(row) for row in suite.run_case(case, case.options(False, []))]
    assert [(row["quantity"], row["passed"]) for row in rows] == [("height", True), (said, False)]


@pytest.mark.mpi
def test_a_box_that_ranks_can_not_share_is_skipped():
    """The resolutions that fit are run. Fails when the refusal of ``process_grid`` ends the case, or counts as met."""
    (case,) = find(["heat-slab"])
    rows = suite.run_case(case, case.options(False, ["resolutions=8,16", "decay=0.001"]))
    skipped = [row for row in rows if row.measured.quantity.startswith("skipped: a box of 8 x 3 x 3 cells")]
    assert len(skipped) == (GHOST * mpi.size() > 8)
    assert all(row.passed is None and math.isnan(row.measured.value) for row in skipped)
    assert [row.measured.resolution for row in rows if row.passed] == [8.0, 16.0][len(skipped):]
