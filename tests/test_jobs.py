"""The job templates: their commands, the chain of jobs that resume each other, signals, scaling tables."""

from __future__ import annotations

import csv
import json
import pathlib
import re
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from conftest import ROOT, launch
from script_setup import FAKE_MPIRUN, bash, plain_environment, write_command

JOBS = ["section4", "wide-100k", "multitrack", "chain", "strong-scaling", "weak-scaling"]


@pytest.mark.parametrize("job", JOBS)
def test_job_dry_run_prints_its_commands(project, job):
    done = bash([f"jobs/{job}.sh"], project, DRY_RUN="1", SLURM_NTASKS="4", OUT="runs/here")
    assert done.returncode == 0, done.stderr
    commands = done.stdout.splitlines()
    scene = job if job in ("wide-100k", "multitrack") else "section4"
    program = "python -m f2s_hpc.cli.timed_run" if "scaling" in job else "f2s"
    assert all(re.match(rf"mpirun -n \d+ {program} run {scene} --out runs/here", line) for line in commands)
    ranks = [int(line.split()[2]) for line in commands]
    assert ranks == ([4, 1, 2, 4] if "scaling" in job else [4])  # (first all nodes compile)
    assert not (project / "runs").exists()


@pytest.mark.parametrize("job", JOBS)
def test_a_job_explains_itself_and_starts_nothing(project, job):
    """Fails if ``--help`` goes on to the commands, as any other word does, or tells of the job behind it."""
    done = bash([f"jobs/{job}.sh", "--help"], project)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == (ROOT / f"jobs/{job}.sh").read_text(encoding="utf-8").splitlines()[1].removeprefix("# ")
    assert any(f"jobs/{job}.sh" in line for line in lines)
    assert not any("SBATCH" in line or "set -" in line for line in lines)
    assert not (project / "runs").exists()


@pytest.mark.parametrize("job", JOBS)
def test_jobs_start_from_any_folder(project, job):
    """Fails if a job looks for the repository where it is called, or a slash at the end of OUT puts files into it."""
    (project / "elsewhere").mkdir()
    write_command(project / ".venv/bin/mpirun", "exit 0")
    write_command(project / ".venv/bin/f2s", "")
    write_command(project / ".venv/bin/python", "")
    done = bash([f"../jobs/{job}.sh"], project / "elsewhere", OUT="runs/o//")
    assert done.returncode == 0, done.stdout + done.stderr
    assert [path.name for path in (project / "runs").iterdir()] == ["o.jobs.txt"]
    assert "--out runs/o/" not in done.stdout.replace("runs/o/ranks", "").replace("runs/o/compile", "")


@pytest.mark.parametrize("job", JOBS)
def test_only_chains_may_be_started_again_and_no_log_is_lost(job):
    """Sites may requeue after a node has failed: the same number, so the same folder, which ``f2s run`` refuses.

    Fails without ``--no-requeue`` in a job that cannot resume, or without ``--open-mode=append`` in any.
    """
    lines = (ROOT / f"jobs/{job}.sh").read_text(encoding="utf-8").splitlines()
    asked = {line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH ")}
    resumes = job in ("chain", "wide-100k", "multitrack")
    assert {"--requeue", "--no-requeue"} & asked == {"--requeue" if resumes else "--no-requeue"}
    assert "--open-mode=append" in asked


@pytest.mark.parametrize("kind", ["strong", "weak"])
def test_scaling_jobs_refuse_arguments_that_they_would_not_heed(project, kind):
    done = bash([f"jobs/{kind}-scaling.sh", "--set", "domain.cell_size=6 um"], project, DRY_RUN="1")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"jobs/{kind}-scaling.sh: takes variables, no arguments; --help names them\n"


def test_weak_scaling_keeps_the_work_of_a_rank(project):
    done = bash(["jobs/weak-scaling.sh"], project, DRY_RUN="1", RANKS="1 6", PATCH_MM="0.1", PARTICLES="40")
    first, last = (line.replace("\\", "") for line in done.stdout.splitlines()[1:])
    assert 'domain.size=["0.1 mm", "0.1 mm", "0.6 mm"]' in first
    assert "batches.particles=40 " in first
    assert 'domain.size=["0.3 mm", "0.2 mm", "0.6 mm"]' in last
    assert "batches.particles=240 " in last


def test_chain_resumes_until_complete(project):
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", """
        echo "$*" >>calls
        mkdir -p runs/c/checkpoints
        links=$(wc -l <calls)
        touch "runs/c/checkpoints/checkpoint_$links.json"
        [ $links -eq 3 ] || exit 75
        """)
    done = bash(["jobs/chain.sh", "--set", "a=b c"], project, OUT="runs/c", SCENE="splat")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "calls").read_text().splitlines() == [
        "run splat --out runs/c --set a=b c", "resume runs/c", "resume runs/c"]


def test_chain_takes_more_cycles_and_a_scene_of_ones_own(project):
    """Fails if ``link`` hands CYCLES to ``f2s run`` or ``f2s resume`` alone, or OUT is made of the path of SCENE."""
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", 'echo "$*" >>calls; mkdir -p runs/mine-chain/checkpoints; '
                                             'touch runs/mine-chain/checkpoints/a.json')
    scene = project / "scenes/mine.toml"
    for cycles in ("4", "7"):
        done = bash(["jobs/chain.sh"], project, SCENE=str(scene), CYCLES=cycles)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "calls").read_text().splitlines() == [
        f"run {scene} --out runs/mine-chain --set cycles.count=4", "resume runs/mine-chain --set cycles.count=7"]


def lost_run(project: pathlib.Path) -> None:
    """Leave what a node leaves that fails before the first checkpoint; stand-ins note the commands."""
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", 'echo "$*" >>calls')
    (project / "runs/c/checkpoints").mkdir(parents=True)
    (project / "runs/c/checkpoints/.checkpoint_cycle_0001_step_00000020.h5.partial").touch()


def test_chain_starts_anew_after_a_node_is_lost_before_the_first_checkpoint(project):
    """Fails if the chain calls ``f2s resume``, which has nothing to go on from, or loses what was there."""
    lost_run(project)
    (project / "runs/c-lost-1").mkdir()
    done = bash(["jobs/chain.sh", "--set", "a=b"], project, OUT="runs/c", SCENE="splat")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "calls").read_text().splitlines() == ["run splat --out runs/c --set a=b"]
    assert (project / "runs/c-lost-2/checkpoints").is_dir()
    assert "becomes runs/c-lost-2" in done.stdout


def test_chain_moves_nothing_in_a_dry_run_and_no_run_that_is_complete(project):
    """Fails if ``DRY_RUN=1`` moves the folder, or if a complete run without checkpoints passes for a lost one."""
    lost_run(project)
    done = bash(["jobs/chain.sh"], project, OUT="runs/c", SCENE="splat", DRY_RUN="1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].split() == ["mpirun", "-n", "2", "f2s", "run", "splat", "--out", "runs/c"]
    assert [path.name for path in (project / "runs").iterdir()] == ["c"]
    (project / "runs/c/summary.json").write_text('{\n  "status": "complete"\n}\n')
    assert bash(["jobs/chain.sh"], project, OUT="runs/c", SCENE="splat").returncode == 0
    assert (project / "calls").read_text().splitlines() == ["resume runs/c"]


def test_chain_ends_where_a_file_tells_it_to(project):
    """Fails if the chain starts another link after ``touch OUT/STOP``."""
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", """
        echo "$*" >>calls
        mkdir -p runs/c/checkpoints
        touch runs/c/checkpoints/a.json runs/c/STOP
        exit 75
        """)
    done = bash(["jobs/chain.sh"], project, OUT="runs/c", SCENE="splat")
    assert done.returncode == 75, done.stdout + done.stderr
    assert (project / "calls").read_text() == "run splat --out runs/c\n"
    assert "runs/c/STOP told it to" in done.stdout


def test_chain_in_slurm_goes_back_to_the_queue(project):
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", "mkdir -p runs/c/checkpoints; touch runs/c/checkpoints/a.json; exit 75")
    write_command(project / ".venv/bin/scontrol", 'echo "scontrol $*" >>calls')
    done = bash(["jobs/chain.sh"], project, OUT="runs/c", SLURM_JOB_ID="17", SLURM_SUBMIT_DIR=str(project))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "calls").read_text() == "scontrol requeue 17\n"


FAKE_SBATCH = """
    # as SLURM does it: directives are read, the script is started elsewhere with the job's variables
    echo "sbatch $*" >>calls
    grep -c '^#SBATCH' "${@: -1}" >>directives
    """


def test_chain_resubmits_itself_where_requeueing_is_off(project):
    """Fails if the new job loses what the first was asked for with, on nodes, time, partition or account."""
    write_command(project / ".venv/bin/srun", 'echo "srun $*" >>calls\nshift 3\nexec "$@"')
    write_command(project / ".venv/bin/f2s", "mkdir -p runs/c/checkpoints; touch runs/c/checkpoints/a.json; exit 75")
    write_command(project / ".venv/bin/scontrol", "exit 1")
    write_command(project / ".venv/bin/sbatch", FAKE_SBATCH)
    done = bash(["jobs/wide-100k.sh"], project, OUT="runs/c", SLURM_JOB_ID="17", SLURM_SUBMIT_DIR=str(project),
                SLURM_NTASKS="8", LAUNCH="srun --mpi=pmix -n", SLURM_JOB_NUM_NODES="2", SLURM_NTASKS_PER_NODE="4",
                SLURM_JOB_PARTITION="long", SLURM_JOB_ACCOUNT="metal", SLURM_JOB_QOS="night",
                SLURM_JOB_START_TIME="1700000000", SLURM_JOB_END_TIME="1700021600")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "calls").read_text().splitlines() == [
        "srun --mpi=pmix -n 8 f2s run wide-100k --out runs/c",
        ("sbatch --ntasks=8 --nodes=2 --ntasks-per-node=4 --partition=long --account=metal --qos=night --time=360 "
         f"{project}/jobs/wide-100k.sh")]
    assert int((project / "directives").read_text()) >= 8


@pytest.mark.parametrize("job", JOBS)
def test_jobs_run_under_slurm_and_tell_where(project, job):
    """Every job through fake commands of SLURM: launched by srun, kernels on the node's disk, provenance written."""
    write_command(project / ".venv/bin/srun",
                  'echo "$*" >>calls\nwhile [[ $1 != @(f2s|python) ]]; do shift; done\nexec "$@"')
    for name in ("f2s", "python"):
        write_command(project / ".venv/bin" / name, 'echo "$F2S_CACHE_DIR" >>caches')
    done = bash([f"jobs/{job}.sh"], project, OUT="runs/o", SLURM_JOB_ID="9", SLURM_NTASKS="4", SLURM_TMPDIR="/local",
                SLURM_SUBMIT_DIR=str(project), LAUNCH="srun -n")
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(line.startswith("-n ") for line in (project / "calls").read_text().splitlines())
    assert set((project / "caches").read_text().splitlines()) == {"/local/kernels"}
    assert "job       9" in (project / "runs/o.jobs.txt").read_text()
    text = (project / "jobs" / f"{job}.sh").read_text()
    assert "#SBATCH --time=" in text
    assert "#SBATCH --signal=B:USR1@" in text or "scaling" in job


TINY = """
    title = "a chain of jobs"
    [domain]
    size = ["36 um", "36 um", "60 um"]
    cell_size = "6 um"
    substrate_height = "12 um"
    particle_layer_height = "48 um"
    [material]
    name = "copper-ge"
    [particles]
    speed = "615 m/s"
    temperature = "450 degC"
    [batches]
    spheres = [["18 um", "18 um", "14 um", "12 um"]]
    [cycles]
    count = 2
    duration = "40 ns"
    [output]
    picture = false
    """


def test_chain_of_real_runs_ends_complete_and_equal_to_one_run(project):
    """The resume chain end to end: links that are signalled early, resumed by the next, give the bits of one run."""
    (project / "tiny.toml").write_text(textwrap.dedent(TINY))
    # each link but the last has no time left after its first step, as if SLURM had signalled it
    write_command(project / ".venv/bin/f2s", f"""
        echo "$1" >>calls
        limit="1 ns"
        [ $(wc -l <calls) -le 2 ] || limit="1 h"
        exec {sys.executable} -m f2s_hpc "$@" --set "run.wall_time=$limit"
        """)
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    chained = bash(["jobs/chain.sh"], project, SCENE="tiny.toml", OUT="runs/chain", PYTHONPATH=str(ROOT))
    assert chained.returncode == 0, chained.stdout + chained.stderr
    assert (project / "calls").read_text().split() == ["run", "resume", "resume"]
    for arguments in (["run", "tiny.toml", "--out", "runs/once"], ["compare", "--exact", "runs/chain", "runs/once"]):
        done = launch([sys.executable, "-m", "f2s_hpc", *arguments], cwd=project)
        assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((project / "runs/chain/summary.json").read_text())["status"] == "complete"


@pytest.mark.parametrize(("body", "code", "said"), [
    ("exit 75", 75, "gained no checkpoint"), ("exit 4", 4, "f2s returned 4")])
def test_chain_ends_when_it_gains_nothing_or_fails(project, body, code, said):
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/f2s", body)
    done = bash(["jobs/chain.sh"], project, OUT="runs/c")
    assert done.returncode == code
    assert said in done.stdout


def test_job_passes_the_signal_to_the_ranks(project):
    """Fails when ``run_ranks`` does not pass SIGUSR1 on, or loses the exit code after it."""
    (project / "ranks.py").write_text(textwrap.dedent("""
        import pathlib, signal, sys, time
        from mpi4py import MPI
        signal.signal(signal.SIGUSR1, lambda number, frame: sys.exit(75))
        pathlib.Path(f"ready-{MPI.COMM_WORLD.Get_rank()}").touch()
        time.sleep(60)
        """))
    write_command(project / ".venv/bin/f2s", f"exec {sys.executable} ranks.py")
    job = subprocess.Popen(["bash", "jobs/section4.sh"], cwd=project, env=plain_environment(),
                           stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 60
    while len(list(project.glob("ready-*"))) < 2 and time.monotonic() < deadline and job.poll() is None:
        time.sleep(0.05)
    job.send_signal(signal.SIGUSR1)
    output, _ = job.communicate(timeout=60)
    assert job.returncode == 75, output
    assert "not finished in this job" in output


def test_scaling_job_measures_steps_not_the_start(project):
    """Real runs. Fails if the table is made of wall time, or one failed run takes it from the others."""
    write_command(project / ".venv/bin/python", f'exec {sys.executable} "$@"')
    write_command(project / ".venv/bin/f2s", "")
    write_command(project / ".venv/bin/mpirun", '[[ $* != *ranks-3* ]] || exit 5\nshift 2\nexec "$@"')
    done = bash(["jobs/strong-scaling.sh"], project, SCENE="quickstart", CELL_SIZE="6 um", DURATION="8 ns",
                OUT="runs/s", RANKS="1 3", PYTHONPATH=str(ROOT))
    assert done.returncode == 5, done.stdout + done.stderr
    assert "the run on 3 ranks ended with 5" in done.stdout
    assert "efficiency" in done.stdout
    row, = json.loads((project / "runs/s/scaling.json").read_text())
    summary = json.loads((project / "runs/s/ranks-1/summary.json").read_text())
    assert 0.0 < row["step_s"] * summary["steps"] < summary["wall_s"]


def test_scaling_table(project):
    """Fails if runs are in the order of their names, or the efficiency is not that of the steps' times."""
    for ranks, step in ((1, 8e-3), (4, 8e-3 / 3.0), (2, 4e-3)):
        folder = project / "study" / f"ranks-{ranks}"
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps({
            "status": "complete", "ranks": ranks, "cells": 1000, "steps": 10, "wall_s": 99.0, "imbalance": 1.0,
            "active_cell_steps": 8000, "peak_memory_bytes": 2**20 * ranks}))
        (folder / "times.json").write_text(json.dumps({"step_s": step, "busy_s": step / 2.0}))
    table = [sys.executable, str(project / "jobs/scaling_table.py")]
    done = launch([*table, "strong", str(project / "study")])
    assert done.returncode == 0, done.stderr
    with open(project / "study" / "scaling.csv", newline="", encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["ranks"]), float(row["memory_per_rank_bytes"])) for row in rows] == [
        (1, 2.0**20), (2, 2.0**20), (4, 2.0**20)]
    assert [float(row["efficiency"]) for row in rows] == pytest.approx([1.0, 1.0, 0.75])
    done = launch([*table, "weak", str(project)])
    assert done.returncode == 1
    assert "holds no complete run" in done.stderr
    assert launch([*table, str(project)]).returncode == 2
