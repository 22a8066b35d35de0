"""The scripts, the pins and the report of the tests under several ranks."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib

import pytest
from conftest import ROOT, launch
from script_setup import FAKE_MPIRUN, bash, write_command

SHELL_FILES = ["scripts/setup", "scripts/quickstart", "scripts/test", "scripts/env.sh", ".ci/run", "jobs/common.sh",
               "jobs/section4.sh", "jobs/wide-100k.sh", "jobs/multitrack.sh", "jobs/chain.sh",
               "jobs/strong-scaling.sh", "jobs/weak-scaling.sh"]


@pytest.mark.parametrize("name", SHELL_FILES)
def test_shell_syntax(name):
    done = bash(["-n", str(ROOT / name)], ROOT)
    assert done.returncode == 0, done.stderr
    assert os.access(ROOT / name, os.X_OK) or name in ("scripts/env.sh", "jobs/common.sh")


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


def test_the_reader_wants_the_environment(project):
    """Fails when ``install_reader`` does not look for .venv: Python is not found in the words of the shell then."""
    (project / ".venv" / "bin").rmdir()
    done = bash(["scripts/setup", "--reader"], project)
    assert done.returncode == 1
    assert done.stderr == "setup: there is no .venv to add VTK to yet: run scripts/setup first\n"


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


def test_a_test_of_a_shared_part_counts_once(tmp_path):
    """Fails if the processes that share a part add their counts to those of the part."""
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for name in "ab":
        (tmp_path / f"test_{name}.py").write_text("def test_one():\n    pass\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-n", "2", "--dist", "loadfile", "."]
    done = launch(command, cwd=tmp_path, environment={"F2S_TEST_TALLY": str(tmp_path / "tally")})
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
    lines = (tmp_path / "tally").read_text().splitlines()
    counts = dict(line.split() for line in lines)
    assert counts["passed"] == "2"
    assert len(counts) == len(lines)


def test_rank_that_leaves_a_collective_call_ends_the_job(tmp_path):
    """Fails when ``_meet`` waits without a limit."""
    done = pytest_on_two_ranks(tmp_path, hang=True)
    assert done.returncode != 0
    assert "the other ranks hang in test_ranked.py::test_one_rank_is_wrong" in done.stderr
    assert "this rank is wrong" in done.stderr
