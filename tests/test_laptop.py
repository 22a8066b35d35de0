"""A laptop with neither mpi4py nor petsc4py: what works there gives the same, what does not says so in one line."""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import sys

import pytest
from conftest import F2S, ROOT, launch
from test_report import SCENE

from f2s_hpc.cli.main import main

CUTOFF = ["--cutoff", "30 um"]
NOTE = "hand-over between cycles: not checked; it takes the solver, and mpi4py and petsc4py are not installed"
LAPTOP = """
import os, sys
os.environ.pop("H5PY_ALWAYS_USE_MPI", None)  # (Debian has both builds of h5py)
for name in ("mpi4py", "petsc4py"):
    sys.modules[name] = None
"""
WINDOWS = LAPTOP + """
import signal
for name in ("fcntl", "resource"):
    sys.modules[name] = None
del signal.SIGUSR1, signal.SIGHUP, signal.SIGPIPE, os.sysconf, os.geteuid, os.getuid
if hasattr(os, "sched_getaffinity"):
    del os.sched_getaffinity
"""


def machine(folder: pathlib.Path, code: str, files: dict[str, str] | None = None) -> dict[str, str]:
    """Return the variables with which python runs ``code`` first and finds ``files`` before all that is installed."""
    folder.mkdir()
    for name, text in {"sitecustomize.py": code, **(files or {})}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}


def run_there(there: dict[str, str], *arguments: object, cwd: pathlib.Path, ranks: int = 1,
              **more: str) -> subprocess.CompletedProcess[str]:
    return launch([*F2S, *map(str, arguments)], ranks, cwd, environment=there | more)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> pathlib.Path:
    """Return a folder with two small finished runs, ``one`` and ``two``, and their scene."""
    folder = tmp_path_factory.mktemp("laptop")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    for name, duration in (("one", "100 ns"), ("two", "90 ns")):
        assert main(["run", str(folder / "scene.toml"), "--out", str(folder / name), "--set", "output.tracers=20",
                     "--set", f'cycles.duration="{duration}"', "--set", f'cycles.last_duration="{duration}"']) == 0
    return folder


@pytest.fixture(scope="module", params=[LAPTOP, WINDOWS], ids=["laptop", "windows"])
def there(request, tmp_path_factory) -> dict[str, str]:
    """Return the variables of a machine without MPI and PETSc, and of one that has not even what only Unix has."""
    found = machine(tmp_path_factory.mktemp("machine") / "own", request.param)
    if launch([sys.executable, "-c", "import h5py"], environment=found).returncode:
        pytest.skip("the h5py here does not load without mpi4py, so this is no machine to measure on")
    return found


def test_analyse_gives_the_same_numbers(place, there, tmp_path, monkeypatch):
    """Fails if a measurement needs MPI or PETSc, or if the hand-over is left out without a word."""
    monkeypatch.chdir(place)
    assert main(["analyse", "one", *CUTOFF, "--out", str(tmp_path / "a"), "--json", str(tmp_path / "here.json")]) == 0
    done = run_there(there, "analyse", "one", *CUTOFF, "--out", tmp_path / "b", "--json", tmp_path / "there.json",
                     cwd=place)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"note: {NOTE}" in done.stdout.splitlines()
    here, found = (json.loads((tmp_path / f"{name}.json").read_text("utf-8")) for name in ("here", "there"))
    assert here.pop("handover")["exact"]
    assert found == here | {"notes": [*here["notes"], NOTE]}
    tables = sorted(path.name for path in (tmp_path / "a").glob("*.csv"))
    assert len(tables) > 5
    for name in tables:
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes(), name


def test_report_writes_the_same_page(place, there, tmp_path, monkeypatch, capsys):
    """Without the hand-over on both sides: every number and every picture. Fails if the page needs MPI or PETSc."""
    monkeypatch.chdir(place)
    assert main(["report", "one", "--with", "two", *CUTOFF, "--no-handover", "--out", str(tmp_path / "page.html")]) == 0
    here = (tmp_path / "page.html").read_bytes()
    said = capsys.readouterr().out
    done = run_there(there, "report", "one", "--with", "two", *CUTOFF, "--no-handover", "--out",
                     tmp_path / "page.html", cwd=place)
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")
    assert (tmp_path / "page.html").read_bytes() == here


@pytest.mark.parametrize(("arguments", "code"), [
    (["compare", "one", "two", *CUTOFF], 0), (["compare", "one", "two", "--exact"], 1), (["inspect", "one"], 0),
    (["scenes"], 0), (["scenes", "track-120"], 0), (["scenes", "--keys"], 0), (["materials"], 0),
    (["check", "scene.toml"], 0), (["feed"], 0),
    (["stream", "synthetic", "--json", "fits.json"], 0), (["particles", "scene.toml", "--out", "batches"], 0),
    (["export", "one", "--to", "made.vtu"], 0), (["export", "one", "--to", "made.stl"], 0),
    (["verify", "--list"], 0), (["inspect", "nothing"], 2)], ids=lambda value: " ".join(value[:1] + value[-1:])
    if isinstance(value, list) else "")
def test_what_needs_no_solver_prints_the_same(place, there, tmp_path, monkeypatch, capsys, arguments, code):
    """Fails if one of these commands needs MPI or PETSc to start, or prints or writes otherwise without."""
    for name in ("one", "two", "scene.toml"):
        (tmp_path / name).symlink_to(place / name)
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == code
    here = capsys.readouterr()
    files = {path: path.read_bytes() for path in [*tmp_path.glob("batches/*"), *tmp_path.glob("made.*")]}
    for path in files:
        path.unlink()
    done = run_there(there, *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (code, here.out, here.err)
    assert {path: path.read_bytes() for path in files} == files


@pytest.mark.parametrize("arguments", [["run", "scene.toml", "--out", "new"], ["resume", "one"], ["verify"],
                                       ["plan", "scene.toml", "--json", "plan.json"]], ids=lambda value: value[0])
def test_what_needs_the_solver_says_so_in_one_line(place, there, arguments):
    """Fails without ``needs.solver`` in the command: it then ends in a traceback, or after it has begun to write."""
    before = sorted(place.rglob("*"))
    done = run_there(there, *arguments, cwd=place)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"f2s {arguments[0]}: mpi4py and petsc4py are not installed; run scripts/setup")
    assert sorted(place.rglob("*")) == before


def test_doctor_lists_what_is_missing(there, tmp_path):
    """Fails if the doctor breaks where a machine is not Linux, or calls a machine that can measure useless."""
    done = run_there(there, "doctor", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    lines = done.stdout.splitlines()
    wrong = {line.partition(":")[0]: line for line in lines if line.startswith(("MPI:", "PETSc:"))}
    assert "import of mpi4py halted; None in sys.modules; run scripts/setup" in wrong["MPI"]
    assert "import of petsc4py halted; None in sys.modules; run scripts/setup" in wrong["PETSc"]
    assert not any("meshio:" in line or "AttributeError" in line for line in lines)
    assert lines[-1] == "to measure what a run left (analyse, report, compare, inspect, export) nothing is missing"


def test_petsc_alone_is_missed_on_all_ranks_at_once(place, tmp_path):
    """Fails if a rank goes on by itself: the line then comes twice, or the job hangs."""
    there = machine(tmp_path / "own", "import sys; sys.modules['petsc4py'] = None")
    done = run_there(there, "run", place / "scene.toml", "--out", "new", cwd=tmp_path, ranks=2)
    assert done.returncode == 2
    assert [line[:40] for line in done.stderr.splitlines() if "petsc4py" in line] == [
        "f2s run: petsc4py is not installed; run "]
    assert not (tmp_path / "new").exists()


def test_petsc_that_does_not_load_is_one_line(place, tmp_path):
    """Fails if only a package that is not there at all is looked for."""
    there = machine(tmp_path / "own", "", {"petsc4py/__init__.py": "raise ImportError('libpetsc.so: not found')"})
    done = run_there(there, "run", place / "scene.toml", "--out", "new", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("f2s run: petsc4py does not load (libpetsc.so: not found); run scripts/setup")
    assert done.stderr.count("\n") == 1


def test_no_copies_of_one_rank_work_under_mpirun(place, tmp_path):
    """Fails if the stand-in is taken whenever mpi4py is missing: two ranks then write the same files."""
    there = machine(tmp_path / "own", LAPTOP)
    done = run_there(there, "analyse", place / "one", *CUTOFF, "--out", tmp_path / "out", cwd=tmp_path, ranks=2)
    assert done.returncode == 2
    assert done.stderr.count("mpi4py is not installed, so the 2 processes that a launcher has started cannot work") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("size", "rank"), [("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"), ("PMI_SIZE", "PMI_RANK"),
                                            ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID")])
def test_each_launcher_is_known_and_one_rank_speaks(tmp_path, size, rank):
    """Fails if a launcher is forgotten, or every process prints the line. One process of it may go on alone."""
    there = machine(tmp_path / "own", LAPTOP)
    first, second = (run_there(there, "scenes", cwd=tmp_path, **{size: "8", rank: number}) for number in "03")
    assert (first.returncode, second.returncode, second.stdout + second.stderr) == (2, 2, "")
    assert first.stderr.startswith("mpi4py is not installed, so the 8 processes")
    assert run_there(there, "scenes", cwd=tmp_path, **{size: "1", rank: "0"}).returncode == 0


@pytest.mark.parametrize("files", [
    {"mpi4py/__init__.py": "", "mpi4py/MPI.py": "raise ImportError('libmpi.so.40: no such file')"},
    {"mpi4py/__init__.py": "", "mpi4py/MPI.py": "raise RuntimeError('libmpi.so.40: cannot load MPI library')"},
    {"mpi4py/__init__.py": "import libmpi_loader"}], ids=["no library", "no library, newer", "no module"])
def test_a_broken_mpi_is_not_passed_over(tmp_path, files):
    """Fails if any failure to import mpi4py counts as its absence: a mended machine would then run N single ranks."""
    done = run_there(machine(tmp_path / "own", "", files), "scenes", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("f2s does not start: ")
    assert "libmpi" in line
    assert "f2s doctor" in line


def test_without_h5py_that_is_what_is_said(place, tmp_path):
    """Fails if a package that the measurements do need ends in a traceback."""
    there = machine(tmp_path / "own", LAPTOP + "sys.modules['h5py'] = None")
    done = run_there(there, "inspect", place / "one", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("h5py is not installed; 'f2s doctor' tells")
    doctor = run_there(there, "doctor", cwd=tmp_path).stdout
    assert "HDF5: ModuleNotFoundError: import of h5py halted" in doctor
    assert "nothing is missing" not in doctor
