"""The scripts, the job templates, the pins and the report of the tests under several ranks."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import tomllib

import pytest
from conftest import ROOT, launch

from f2s_hpc.doctor import launch_environment

SHELL_FILES = ["scripts/setup", "scripts/quickstart", "scripts/test", "scripts/env.sh", ".ci/run", "jobs/common.sh",
               "jobs/section4.sh", "jobs/wide-100k.sh", "jobs/multitrack.sh", "jobs/chain.sh",
               "jobs/strong-scaling.sh", "jobs/weak-scaling.sh"]
JOBS = ["section4", "wide-100k", "multitrack", "chain", "strong-scaling", "weak-scaling"]
FAKE_MPIRUN = 'shift 2\nexec "$@"'


def write_command(path: pathlib.Path, body: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/usr/bin/env bash\n" + textwrap.dedent(body) + "\n")
    path.chmod(0o755)


def plain_environment() -> dict[str, str]:
    """What the tests were started with, without what would lead the scripts elsewhere."""
    return {name: value for name, value in launch_environment(os.environ).items()
            if not name.startswith(("SLURM_", "F2S_", "PYTEST_"))}


def bash(command: list[str], cwd: pathlib.Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", *command], cwd=cwd, env=plain_environment() | variables, stdin=subprocess.DEVNULL,
                          timeout=120, capture_output=True, text=True, check=False)


@pytest.fixture
def project(tmp_path):
    """A copy of the scripts with an empty ``.venv/bin``, to be filled with stand-ins of the commands."""
    for folder in ("scripts", "jobs", ".ci"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize("name", SHELL_FILES)
def test_shell_syntax(name):
    done = bash(["-n", str(ROOT / name)], ROOT)
    assert done.returncode == 0, done.stderr
    assert os.access(ROOT / name, os.X_OK) or name in ("scripts/env.sh", "jobs/common.sh")


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
    assert 0.0 < row["step_s"] * summary["steps"] < 0.9 * summary["wall_s"]


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


@pytest.mark.parametrize(("there", "said"), [
    ([], "this is not Debian (no apt-get)"), (["apt-get", "dpkg-query"], "neither root nor sudo")])
def test_setup_without_apt_or_rights_names_the_packages(project, there, said):
    """A machine where nothing is installed and nothing may be: the packages, other routes, and no .venv made."""
    tools = project / "tools"
    for name in ("bash", "dirname", "cat", "sha256sum", "cut", "grep", "env", "rm"):
        tools.mkdir(exist_ok=True)
        (tools / name).symlink_to(shutil.which(name))
    write_command(tools / "id", "echo 1000")
    for name in there:
        write_command(tools / name, "exit 1")
    (project / ".venv" / "bin").rmdir()
    done = bash(["scripts/setup"], project, PATH=str(tools))
    assert done.returncode == 1, done.stdout
    assert said in done.stderr
    assert "python3-petsc4py python3-mpi4py python3-h5py-mpi openmpi-bin python3-venv" in done.stderr
    assert "conda create" in done.stderr
    assert bash(["scripts/setup", "--check"], project, PATH=str(tools)).returncode == 1
    assert not (project / ".venv" / "bin").exists()


def environment_made_by_setup() -> None:
    if bash(["scripts/setup", "--check"], ROOT).returncode:
        pytest.skip("this environment was not made by scripts/setup")


def test_setup_again_needs_no_network():
    environment_made_by_setup()
    nowhere = "http://127.0.0.1:9/"
    done = bash(["scripts/setup"], ROOT, PIP_INDEX_URL=nowhere, http_proxy=nowhere, https_proxy=nowhere)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "setup: everything is in place: .venv/bin/f2s\n"


def test_environment_needs_no_exported_variable():
    environment_made_by_setup()
    code = "import h5py, petsc4py.PETSc, os; assert h5py.get_config().mpi; print(os.environ['OMP_NUM_THREADS'])"
    done = subprocess.run([ROOT / ".venv/bin/python", "-c", code], env={"PATH": os.environ["PATH"]}, check=False,
                          capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr


def test_packages_of_the_user_do_not_come_before_the_distribution(project):
    """A serial h5py in ~/.local, for one. Fails if setup leaves that folder in the path of .venv."""
    text = (project / "scripts/setup").read_text()
    (project / "scripts/setup").write_text(text.removesuffix('main "$@"\n'))  # (its functions alone)
    shutil.rmtree(project / ".venv")
    make = ('. scripts/setup; "$SYSTEM_PYTHON" -m venv --system-site-packages --without-pip .venv; '
            "write_environment_hook")
    made = bash(["-c", make], project, F2S_SYSTEM_PYTHON=sys.executable)
    assert made.returncode == 0, made.stderr
    version = ".".join(map(str, sys.version_info[:2]))
    own = project / "home" / ".local" / "lib" / f"python{version}" / "site-packages"
    own.mkdir(parents=True)
    (own / "h5py.py").write_text("")
    code = "import importlib.util as u; found = u.find_spec('h5py'); print(found and found.origin)"
    done = subprocess.run([project / ".venv/bin/python", "-c", code], capture_output=True, text=True, check=True,
                          env={"PATH": os.environ["PATH"], "HOME": str(project / "home")})
    assert str(own) not in done.stdout


def test_pins_are_what_is_installed():
    """What was tested together is what is pinned."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = table["dependencies"] + table["optional-dependencies"]["test"] + table["optional-dependencies"]["pins"]
    for pin in pins:
        name, version = pin.split("==")
        assert importlib.metadata.version(name) == version, name


def test_quickstart_numbers_its_folders_and_reports(project):
    write_command(project / "scripts/setup", "exit 0")
    (project / ".venv/bin/python").symlink_to(sys.executable)
    write_command(project / ".venv/bin/mpirun", 'echo "$*" >>calls\nshift 2\nexec "$@"')
    write_command(project / ".venv/bin/f2s", """
        mkdir -p "$4"
        echo '{"status": "complete", "particles": 40, "dense_height_m": 3.1e-5}' >"$4/summary.json"
        touch "$4/deposit.png" "$4/summary.csv" "$4/deposit.vtkhdf"
        """)
    for arguments in ([], ["--ranks", "3", "--", "--set", "a=1"]):
        done = bash(["scripts/quickstart", *arguments], project)
        assert done.returncode == 0, done.stderr
    assert (project / "calls").read_text().splitlines() == [
        "-n 2 f2s run quickstart --out runs/quickstart-1",
        "-n 3 f2s run quickstart --out runs/quickstart-2 --set a=1"]
    assert re.search(r"mean dense height +31 um", done.stdout)
    for name in ("deposit.png", "summary.json", "summary.csv", "deposit.vtkhdf"):
        assert f"runs/quickstart-2/{name}\n" in done.stdout
    assert bash(["scripts/quickstart", "--ranks", "none"], project).returncode == 2
    for words in (["--out", "mine"], ["--out=mine"]):
        done = bash(["scripts/quickstart", "--", *words], project)
        assert done.returncode == 2
        assert "each run gets a folder of its own" in done.stderr
    assert len((project / "calls").read_text().splitlines()) == 2


@pytest.mark.parametrize(("variables", "policy"), [
    ({}, "none"), ({"SLURM_JOB_ID": "7"}, ""), ({"OMPI_MCA_hwloc_base_binding_policy": "core"}, "core")])
def test_runs_side_by_side_do_not_share_a_core(project, variables, policy):
    """Fails if env.sh lets Open MPI bind each run from core 0 on, binds off in a batch job, or overrules the user."""
    done = subprocess.run(["bash", "-c", '. scripts/env.sh; echo "$OMPI_MCA_hwloc_base_binding_policy"'], cwd=project,
                          env={"PATH": os.environ["PATH"]} | variables, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == policy


@pytest.mark.parametrize(("linter", "code", "last"), [
    ("exit 0", 0, "8 passed, 4 skipped in"), ("exit 1", 1, "8 passed, 4 skipped, 1 error in")])
def test_test_script_sums_up_all_parts(project, linter, code, last):
    write_command(project / "scripts/setup", "exit 0")
    write_command(project / ".venv/bin/ruff", linter)
    write_command(project / ".venv/bin/lint-imports", "exit 0")
    write_command(project / ".venv/bin/mpirun", FAKE_MPIRUN)
    write_command(project / ".venv/bin/python", """
        echo "$*" >>calls
        printf 'failed 0\\npassed 2\\nskipped 1\\n' >>"$F2S_TEST_TALLY"
        """)
    done = bash([".ci/run"], project)
    assert done.returncode == code, done.stdout + done.stderr
    assert re.fullmatch(rf"=+ {last} [\d.]+s =+", done.stdout.splitlines()[-1])
    calls = (project / "calls").read_text().splitlines()
    assert [line.endswith("-m mpi") for line in calls] == [False, True, True, True]


RANKED_TEST = """
    import sys
    import pytest
    from f2s_hpc import mpi

    @pytest.mark.mpi
    def test_one_rank_is_wrong():
        if {hang}:
            if mpi.rank() == 0:
                mpi.barrier()
        assert mpi.rank() == 0, "this rank is wrong"

    @pytest.mark.mpi
    def test_right():
        assert mpi.size() == 2
    """


def pytest_on_two_ranks(folder: pathlib.Path, hang: bool) -> subprocess.CompletedProcess[str]:
    shutil.copy(ROOT / "tests" / "conftest.py", folder)
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / "test_ranked.py").write_text(textwrap.dedent(RANKED_TEST).format(hang=hang))
    command = [sys.executable, "-m", "pytest", "--color=no", "-p", "no:cacheprovider", "test_ranked.py"]
    inner = {"F2S_TEST_PATIENCE_S": "2", "F2S_TEST_TALLY": "", "F2S_TEST_SELECTION": ""}
    return launch(command, ranks=2, cwd=folder, timeout=60, environment=inner)


def test_failure_on_another_rank_fails_the_test_once(tmp_path):
    """Fails when the outcome of the other ranks is not asked for: rank 0 then reports two passed tests."""
    done = pytest_on_two_ranks(tmp_path, hang=False)
    assert done.returncode == 1
    assert done.stdout.count("1 failed, 1 passed") == 1
    assert "on rank 1: " in done.stdout
    assert "this rank is wrong" in done.stdout


def test_rank_that_leaves_a_collective_call_ends_the_job(tmp_path):
    """Fails when ``_meet`` waits without a limit."""
    start = time.monotonic()
    done = pytest_on_two_ranks(tmp_path, hang=True)
    assert done.returncode != 0
    assert "the other ranks hang in test_ranked.py::test_one_rank_is_wrong" in done.stderr
    assert "this rank is wrong" in done.stderr
    assert time.monotonic() - start < 30
