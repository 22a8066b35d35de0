"""What cannot be run, or not as meant, is told in a line; who stops listening or asks to stop loses nothing."""

from __future__ import annotations

import os
import re
import signal
import subprocess

import numpy as np
import pytest
from conftest import F2S, ROOT

from f2s_hpc.config.load import load_scene
from f2s_hpc.cycles.stop import SIGNALS, StopRequest
from f2s_hpc.errors import InputError
from f2s_hpc.io import runs
from f2s_hpc.particles.batch import Batch, check_inside, flight_speed
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.workload.expected import MOST_SAMPLES, moments

SMALL = ["--set", "cycles.count=1", "--set", "output.picture=false"]
TWO_SPEEDS = "x,y,z,r,vx,vy,vz\n0.03,0.03,0.09,0.01,0,0,-55\n0.08,0.08,0.05,0.01,0,0,-600\n"


def refused(*overrides: str) -> str:
    """Return the one line with which the quick start with ``overrides`` is refused."""
    with pytest.raises(InputError) as failure:
        load_scene("quickstart", overrides)
    (line,) = str(failure.value).splitlines()
    return line


def test_a_field_that_the_scene_does_not_have_is_refused_in_its_frames():
    """Fails without "lost_energy" in ``schema.ONLY_WITH``: the run then breaks at its first frame."""
    line = refused("output.fields=['lost_energy']", "numerics.loss_heating=false")
    assert "output.fields" in line
    assert "numerics.loss_heating = true" in line
    load_scene("quickstart", ["output.fields=['lost_energy']"])


@pytest.mark.parametrize(("override", "key"), [
    ("particles.speed='615 km/s'", "particles.speed"),
    ("particles.speed='1e300 m/s'", "particles.speed"),
    ("particles.speed_curvature='1e300 m/s/mm2'", "particles.speed_curvature"),
])
def test_a_speed_that_no_gun_gives_is_refused(override, key):
    """Fails if ``_check_speeds`` looks at the lowest speed only."""
    line = refused(override)
    assert f"{key} makes" in line
    assert "is its unit right?" in line


def test_a_long_cycle_is_looked_at_as_often_as_needed():
    """A cycle a million times too long (a slip in its unit) is planned at once, and all of its time counts.

    Fails without the bound of the looks, or if the share of the time after the last landing is lost.
    """
    scene = load_scene("quickstart", ["cycles.duration='0.166 s'", "cycles.last_duration='0.5 s'"])
    seen = list(moments(scene, make_batches(scene)))
    assert len(seen) <= MOST_SAMPLES * scene.cycles.count
    assert sum(moment.weight for moment in seen) == pytest.approx(1.0, rel=1e-12)


def test_a_sphere_beyond_a_corner_is_refused():
    """Fails if ``check_inside`` looks at each axis alone: such a sphere has no part in the box."""
    def sphere(place: float) -> Batch:
        return Batch(*(np.array([value]) for value in (place, place, 50e-6, 10e-6)))

    check_inside(sphere(-7.0e-6), "list", 1e-4, 1e-4, 1e-4)
    with pytest.raises(InputError, match=r"row 1: .*beyond a corner of the box"):
        check_inside(sphere(-7.1e-6), "list", 1e-4, 1e-4, 1e-4)


def test_particles_that_never_come_down_are_told(tmp_path):
    """Fails if the sign in ``_warn_of_departure`` turns round, or it is called for one kind of batches only."""
    def told(*overrides: str) -> list[str]:
        return [line for line in make_batches(load_scene("quickstart", overrides)).messages if "substrate" in line]

    (tmp_path / "two.csv").write_text(TWO_SPEEDS.replace("-55", "55"), encoding="ascii")
    listed = ["batches.count=0", "batches.particles=0", f"batches.files=['{tmp_path / 'two.csv'}']"]
    assert told() == []
    assert told("particles.direction=[0, 0, 1]")[0].startswith("no particle flies towards the substrate")
    assert told(*listed)[0].startswith("1 of 2 particles do not fly towards the substrate")


def test_a_slow_particle_in_flight_has_not_landed(tmp_path, run_f2s):
    """A sphere at 55 m/s among those of 600 is no deposit while it flies, in the cycle table as in the report.

    Fails if what has landed need not be attached, and is told by a third of the fastest particle's speed, or if the
    line on the cycle has a PEEQ and a temperature of what has not landed.
    """
    (tmp_path / "two.csv").write_text(TWO_SPEEDS, encoding="ascii")
    done = run_f2s(["run", "quickstart", "--out", "slow", *SMALL, "--set", "batches.count=0", "--set",
                    "batches.particles=0", "--set", "batches.files=['two.csv']", "--set",
                    "cycles.last_duration='20 ns'", "--set", "particles.flight='eulerian'"])
    assert done.returncode == 0, done.stderr
    assert "max 0.0 um, loss" in done.stdout
    assert runs.read_summary(tmp_path / "slow")["height_max_m"] == 0.0
    measured = run_f2s(["analyse", "slow", "--no-handover"])
    assert re.search(r"maximum of the surface +µm +0\.00\b", measured.stdout)


def test_the_slowest_particle_sets_what_flies():
    """Fails if a sphere at rest counts as the slowest, or one that is hardly slower than the fastest does."""
    def batch(*speeds: float) -> Batch:
        velocity = np.array([[0.0, 0.0, -s] for s in speeds])
        return Batch(*(np.ones(len(speeds)) for _ in range(4)), velocity)

    assert flight_speed([Batch(*(np.ones(1) for _ in range(4)))], 615.0) == 615.0
    assert flight_speed([batch(615.0, 500.0)], 615.0) == 615.0
    assert flight_speed([batch(615.0), batch(300.0, 0.0)], 615.0) == pytest.approx(420.0)
    # a third of that is what resting surfaces may ring with, however slow one particle is
    assert flight_speed([batch(615.0), batch(5.0)], 615.0) == pytest.approx(369.0)


def test_a_run_that_does_not_fit_into_memory_leaves_nothing(tmp_path):
    """Fails if the run's folder is made before its fields: it would then pass for one that holds a run."""
    command = " ".join(["ulimit -v 6000000; exec", *F2S, "run", "quickstart", "--out", "big", "--set",
                        "'domain.size=[\"5 mm\",\"5 mm\",\"5 mm\"]'", "--set", "'domain.cell_size=\"4 um\"'"])
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
                          capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == InputError.exit_code, done.stderr
    (line,) = done.stderr.splitlines()
    assert "not enough memory for 1250 x 1250 x 1250 points" in line
    assert not (tmp_path / "big").exists()


def test_a_run_goes_on_when_nobody_reads_what_it_prints(tmp_path):
    """Fails if a closed pipe ends the run, as it does where ``Progress`` lets it through."""
    command = " ".join([*F2S, "run", "quickstart", "--out", "piped", *SMALL, "--set",
                        "'output.progress_seconds=\"1 ms\"'"])
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {command} | head -1"], cwd=tmp_path,
                          env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300,
                          check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert runs.read_summary(tmp_path / "piped")["status"] == "complete"


def test_ctrl_c_asks_for_a_stop_once():
    """Fails if SIGINT is not caught, which would lose the cycle, or is caught twice, which would not end a hung run."""
    numbers = SIGNALS
    before = [signal.getsignal(number) for number in numbers]
    try:
        stop = StopRequest(None)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.asked()
        assert stop.reason() == "signal SIGINT"
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    finally:
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)


@pytest.mark.parametrize("arguments", [["run", "splat"], ["resume", "out"]])
def test_single_ranks_of_a_foreign_launcher_do_not_race_for_a_folder(tmp_path, run_f2s, arguments):
    """Two processes that each believe to be alone: none of them runs. Fails if ``ranks_together`` is not called."""
    done = run_f2s(arguments, environment={"PMI_SIZE": "2", "PMI_RANK": "1"})
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"f2s {arguments[0]}: 2 processes were started together, but MPI tells each")
    assert not os.listdir(tmp_path)
