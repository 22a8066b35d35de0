"""Shared by all tests: one report for all ranks, seeds, strict numpy, and the real command by subprocess.

Under ``mpirun`` every rank executes the tests marked ``mpi``. Only rank 0 prints. A test that fails
on any rank fails on rank 0, with the text of the rank that failed; the other ranks are told, so all
end with the same exit code. If the other ranks do not come (they wait in a collective call that the
failed rank left), the whole job is aborted after ``F2S_TEST_PATIENCE_S`` seconds.
"""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.doctor import launch_environment

ROOT = pathlib.Path(__file__).resolve().parents[1]
SEED = 20240122
PATIENCE_S = float(os.environ.get("F2S_TEST_PATIENCE_S", "60"))
F2S = (sys.executable, "-m", "f2s_hpc")
COUNTED = ("failed", "passed", "skipped", "xfailed", "xpassed", "error")

_reports = mpi.world().Dup() if mpi.size() > 1 else None


def pytest_configure(config: pytest.Config) -> None:
    """Make unexpected exceptions outside tests end the whole job; give each rank its temporary folders."""
    if mpi.size() > 1:
        mpi.install_abort_hook()
        # Ranks that tidy up one folder at once get into each other's way.
        root = pathlib.Path(tempfile.gettempdir()) / f"f2s-pytest-{os.getuid()}-rank-{mpi.rank()}"
        root.mkdir(mode=0o700, exist_ok=True)
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(root)


@pytest.hookimpl(trylast=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Silence the reports of all ranks but rank 0."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and not mpi.is_root():
        reporter._tw._file = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (lives as long as pytest)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Under several ranks a test without the ``mpi`` marker would race with itself: refuse it."""
    if mpi.size() > 1:
        for item in items:
            if item.get_closest_marker("mpi") is None:
                item.add_marker(pytest.mark.skip(reason="not written for several ranks (no mpi marker)"))


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    """Let all ranks agree on the outcome of each phase of each test."""
    outcome = yield
    if _reports is None:
        return
    report = outcome.get_result()
    text = f"{item.nodeid} ({call.when})\n{report.longreprtext}" if report.failed else ""
    _meet(item.nodeid, text)
    texts = _reports.allgather(text)
    if any(texts) and not text:
        report.outcome = "failed"
        report.longrepr = "\n".join(f"on rank {rank}: {said}" for rank, said in enumerate(texts) if said)


def _meet(place: str, failure: str = "") -> None:
    """Wait for all ranks; a rank with a ``failure`` waits only so long, then tells it and ends the job."""
    request, start = _reports.Ibarrier(), time.monotonic()
    while not request.Test():
        if failure and time.monotonic() - start > PATIENCE_S:
            sys.stdout.flush()
            sys.stderr.write(f"\n[rank {mpi.rank()}] failed: {failure}\n"
                             f"[rank {mpi.rank()}] the other ranks hang in {place}: job aborted\n")
            sys.stderr.flush()
            mpi.world().Abort(1)
        time.sleep(1e-4)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Give all ranks one exit code; a selection that holds no ``mpi`` test is not a failure."""
    if _reports is None:
        return
    if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and os.environ.get("F2S_TEST_SELECTION"):
        session.exitstatus = pytest.ExitCode.OK
    # A rank that ended with an error makes mpirun end the others: rank 0 must have printed by then.
    session.exitstatus = max(_reports.allgather(int(session.exitstatus)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Add the counts of this part to the file that ``scripts/test`` sums up."""
    tally = os.environ.get("F2S_TEST_TALLY")
    if tally and mpi.is_root() and not hasattr(terminalreporter.config, "workerinput"):
        with open(tally, "a", encoding="ascii") as file:
            for kind in COUNTED:
                file.write(f"{kind} {len(terminalreporter.getreports(kind))}\n")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Let no rank end before rank 0 has printed its report."""
    if _reports is not None:
        sys.stdout.flush()
        _meet("the end of the tests")


@pytest.fixture(autouse=True)
def strict_numpy() -> Iterator[None]:
    """Make division by zero, overflow and invalid operations errors in every test."""
    with np.errstate(divide="raise", over="raise", invalid="raise", under="ignore"):
        yield


@pytest.fixture
def seed() -> int:
    """Return the seed of the tests."""
    return SEED


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that draws the same numbers in every run and on every rank."""
    return np.random.Generator(np.random.PCG64(SEED))


@pytest.fixture
def shared_path(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return one temporary folder for all ranks (rank 0's ``tmp_path``)."""
    return mpi.broadcast(tmp_path)


@pytest.fixture(scope="session")
def paper_data() -> pathlib.Path:
    """Return the folder with the authors' batches (``spheres_info-01.csv``, ``-02.csv``), or skip.

    Looked for where ``F2S_PAPER_DATA`` says, else in ``shared/data/free2spray`` beside the repository.
    """
    folder = pathlib.Path(os.environ.get("F2S_PAPER_DATA", ROOT.parent / "shared" / "data" / "free2spray"))
    if not list(folder.glob("spheres_info-*.csv")):
        pytest.skip(f"the authors' batches are not in {folder}; F2S_PAPER_DATA may name their folder")
    return folder


def launch(command: Sequence[str], ranks: int = 1, cwd: pathlib.Path | None = None, timeout: float = 600,
           environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``command`` on ``ranks`` new ranks (1: alone) and return what it printed and its exit code.

    ``environment`` adds variables. On timeout the whole job is ended and the test fails.
    """
    # Several mpirun on one machine would all bind their ranks to the same first cores.
    # A rank that waits must leave the core to the tests beside it.
    variables = launch_environment(os.environ) | {"OMPI_MCA_hwloc_base_binding_policy": "none",
                                                  "OMPI_MCA_mpi_yield_when_idle": "1"}
    variables["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    variables |= environment or {}
    if ranks > 1:
        mpirun = shutil.which("mpirun")
        if mpirun is None:
            pytest.fail("mpirun is not on PATH")
        command = [mpirun, "-n", str(ranks), *command]
    process = subprocess.Popen(list(command), cwd=cwd, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    try:
        output, errors = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        # Terminated, not killed: mpirun then ends its ranks too.
        process.terminate()
        try:
            output, errors = process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            output, errors = process.communicate()
        pytest.fail(f"{' '.join(command)}: no end in {timeout} s; it printed\n{output}\n{errors}")
    return subprocess.CompletedProcess(list(command), process.returncode, output, errors)


def f2s(*arguments: object, ranks: int = 1, cwd: pathlib.Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the real f2s command in ``cwd``; its exit code must be ``code``."""
    done = launch([*F2S, *map(str, arguments)], ranks, cwd)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture
def run_f2s(tmp_path: pathlib.Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return ``run(args, ranks=1, cwd=None, timeout=600, environment=None)``: the real f2s command.

    It runs in ``cwd`` (the test's temporary folder if not given) and is not checked: look at
    ``returncode``, ``stdout``, ``stderr`` of the returned ``CompletedProcess``.
    """
    if mpi.size() > 1:
        pytest.fail("run_f2s starts ranks of its own: use it in tests without the mpi marker")

    def run(args: Sequence[str], ranks: int = 1, cwd: pathlib.Path | None = None, timeout: float = 600,
            environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        return launch([*F2S, *map(str, args)], ranks, cwd or tmp_path, timeout, environment)

    return run


@pytest.fixture
def project(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return a copy of the scripts with an empty ``.venv/bin``, to be filled with stand-ins of the commands."""
    for folder in ("scripts", "jobs", ".ci"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    return tmp_path
