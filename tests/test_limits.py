"""Numbers far beyond all sense, mostly wrong units: one line that names them, no traceback, no warning, no hanging."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.bench.rates import read_rates, write_rates
from f2s_hpc.cli.main import main
from f2s_hpc.errors import InputError
from f2s_hpc.particles.batch import Batch, check_inside
from f2s_hpc.particles.stream import fit_number
from f2s_hpc.workload.predict import FLYING, SOLID, Rates

RATES = Rates(1e-3, {SOLID: 6e-7, FLYING: 5e-7}, 0.5, 1.0, 2e9, ((0.0, 3.0), (10.0, 4.0)), 1, 8, "a test",
              ((100, 0.9), (1000, 1.1)))


def one_line(capsys) -> str:
    """Return the only line that was printed: on standard error, by rank 0."""
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == int(mpi.is_root()), err
    return mpi.broadcast(err)


@pytest.mark.mpi
@pytest.mark.parametrize(("override", "said"), [
    ('domain.cell_size="1e-300 m"', "nodes, 2.147e+09 are possible"),
    ('domain.cell_size="1e-320 m"', "nodes, 2.147e+09 are possible"),
    # (fewer cells than that, but more nodes)
    (('domain={size=["1.29 mm", "1.29 mm", "1.29 mm"], cell_size="1 um", substrate_height="60 um", '
      'particle_layer_height="100 um"}'), "gives 2.152e+09 nodes, 2.147e+09 are possible"),
    ("material.poisson_ratio=0.4999999999999999", "3e+08 are possible"),
    ('material.density="8960 g/cm3"', "must be at most 30000 kg/m3; is its unit right?"),
    ('material.density="1e-300 kg/m3"', "must be at least 100 kg/m3"),
    ('material.young_modulus="1e300 Pa"', "must be at most 10000 GPa"),
    ('material.young_modulus="128 kPa"', "must be at least 1 MPa"),
    ('material.specific_heat="384.6 kJ/kg/K"', "must be at most 20000 J/kg/K"),
    ('material.conductivity="385 MW/m/K"', "must be at most 100000 W/m/K"),
    ('substrate.temperature="1100 degC"', "must be below the melting temperature (1083 degC)"),
    ('particles.temperature="1083 degC"', "must be below the melting temperature (1083 degC)"),
    ('cycles.duration="1e300 s"', "1e+12 are possible"), ('particles.speed="1e300 m/s"', "particles.speed makes"),
    ('particles.speed_curvature="1e300 m/s/mm2"', "particles.speed_curvature makes"),
    ('batches.diameter_min="1e-300 m"', "diameter_min must be at least"),
    ("batches.gap_factor=1e160", "at most 1000"), ("batches.particles=100000000000000", "at most 1e+06"),
    ("batches.count=100000", "at most 10000"), ("cycles.count=10000000", "at most 100000"),
    ('batches.spheres=[["1 um","1 um","50 um","1e-300 m"]]', "row 1: a radius of 1e-297 mm")])
def test_a_scene_beyond_all_sense_is_refused(capsys, override, said):
    """Fails with a traceback, a warning of numpy or no end if the bound of the key is taken away."""
    assert main(["check", "quickstart", "--set", override]) == 2
    assert said in one_line(capsys)


@pytest.mark.parametrize("arguments", [
    ["--scan-speed", "1e-320 m/s"], ["--path", "1e308 m"], ["--largest", "1e200 m"], ["--smallest", "1e-300 m"],
    ["--density", "1e-320 kg/m3"], ["--per-batch", str(10**400)]])
def test_a_feed_beyond_all_sense_is_refused(capsys, arguments):
    """Fails with an OverflowError if particles are rounded up, or diameters put to a power, without a bound."""
    assert main(["feed", *arguments]) == 2
    assert "possible" in (line := one_line(capsys)) or "diameter_m" in line or "per batch" in line


@pytest.mark.mpi
@pytest.mark.parametrize("width", [float("nan"), 10**400, float("inf"), None])
def test_a_stream_without_numbers_is_refused(capsys, shared_path, width):
    """Fails with decimal.InvalidOperation or OverflowError if ``scene_keys`` does not look at the numbers."""
    fits = {"format": "f2s stream 1", "number_over_lateral_position": {"width_m": {"value": width}},
            "velocity_over_lateral_position": {"axis_m_s": {"value": 600.0}, "curvature_1_m_s": {"value": 0.0}}}
    path = shared_path / "stream.json"
    if mpi.is_root():
        path.write_text("[" * 100_000 if width is None else json.dumps(fits), encoding="utf-8")
    mpi.barrier()
    assert main(["check", "quickstart", "--set", f"particles.stream={path}"]) == 2
    assert "stream.json" in one_line(capsys)


@pytest.mark.parametrize("changes", [
    {"steps": 0}, {"steps": "a"}, {"steps": 1.5}, {"reductions": "x"}, {"sizes": [[0, 0]]}, {"sizes": [[100, 0]]},
    {"cores": 0}, {"exchanges": [[1, float("nan")]]}, {"per_step": 10**400}, {"packing": 0},
    {"per_cell": {SOLID: 1, FLYING: 1, "x": 1}}])
def test_rates_that_are_none_are_refused(tmp_path, capsys, changes):
    """Fails with a ZeroDivisionError or TypeError if ``read_rates`` checks some of the numbers only."""
    path = tmp_path / "rates.json"
    write_rates(path, RATES)
    assert read_rates(path) == RATES
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")
    assert main(["plan", "quickstart", "--rates", str(path)]) == 2
    assert "no file of rates" in one_line(capsys)
    with pytest.raises(InputError, match=r"rates\.json"):
        read_rates(path)


@pytest.mark.parametrize("levels", ["nan", "8,nan", "inf", "8,inf"])
def test_resolutions_are_numbers(capsys, levels):
    """Fails with a ValueError if NaN passes for a number above zero."""
    assert main(["verify", "simple-shear", "--set", f"resolutions={levels}"]) == 2
    assert "rising numbers" in one_line(capsys)


@pytest.mark.parametrize("scale", [1e-300, 1e299])
def test_lateral_positions_beyond_all_sense_are_refused(rng, scale):
    """Fails with "Initial guess is outside of provided bounds" if the range of the positions is not looked at."""
    with pytest.raises(InputError, match="is their unit right"):
        fit_number(scale * rng.standard_normal(500), "far.csv")


def test_one_particle_far_away_is_no_wrong_guess(rng):
    """Fails with a ValueError if the first guess may lie outside the bounds: the spread is then 1e-3 of the range."""
    position = 1e-3 * rng.standard_normal(2_000_000)
    position[0] = 10.0
    with pytest.raises(InputError, match="are these right"):
        fit_number(position, "outlier.csv")


def test_a_sphere_smaller_than_an_atom_is_refused():
    """Fails if a radius of 1e-300 m passes: its volume is zero, and no median of the volume can be told."""
    batch = Batch(*(np.array([value]) for value in (1e-6, 1e-6, 50e-6, 1e-300)))
    with pytest.raises(InputError, match=r"batch\.csv: row 1: a radius of 1e-297 mm"):
        check_inside(batch, "batch.csv", 1e-4, 1e-4, 1e-4)
    check_inside(dataclasses.replace(batch, r=np.array([1e-9])), "batch.csv", 1e-4, 1e-4, 1e-4)
