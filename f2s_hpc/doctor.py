"""``f2s doctor``: what is installed, and whether ranks can write and read one HDF5 file together.

Every import of a third-party package is made inside the check that needs it, so that a missing or
broken one becomes a line of the report instead of a traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import os
import pathlib
import platform
import shutil
import site
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from typing import TextIO

from f2s_hpc import one_rank
from f2s_hpc._cache import cache_directory
from f2s_hpc.errors import F2SError

PROBE_RANKS = 2
PROBE_TIMEOUT_S = 120
PACKAGES = {"MPI": "mpi4py", "PETSc": "petsc4py", "HDF5": "h5py"}
PLAIN_PACKAGES = ("numpy", "scipy", "numba", "pydantic", "matplotlib", "meshio")
LAUNCHER_PREFIXES = ("OMPI_", "PMIX_", "PMI_", "PRTE_", "HYDRA_", "MPI_LOCAL")
KEPT_PREFIXES = ("OMPI_MCA_", "OMPI_ALLOW_")
# Open MPI tells its own children these as parameters; a second mpirun must not inherit them.
LAUNCHER_PARAMETERS = ("ess", "orte_", "pmix", "initial_wdir", "mpi_oversubscribe", "shmem_RUNTIME_QUERY_hint")

SETUP_AGAIN = "run scripts/setup"
COMPUTING = ("MPI", "PETSc", "HDF5", "write, read")
MEASURES = "to measure what a run left (analyse, report, compare, inspect, export) nothing is missing"
OF_THE_USER = "it is the user's own, in {}: set PYTHONNOUSERSITE=1, or pip uninstall it there"


def clean_mpi_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return ``environment`` without what an MPI launcher told this process.

    A command started with the result can start MPI, or an ``mpirun``, of its own. The user's own
    settings (``OMPI_MCA_*``, ``OMPI_ALLOW_*``) stay.
    """
    def own(name: str) -> bool:
        if name.startswith("OMPI_MCA_"):
            return not name.removeprefix("OMPI_MCA_").startswith(LAUNCHER_PARAMETERS)
        return name.startswith(KEPT_PREFIXES) or not name.startswith(LAUNCHER_PREFIXES)

    return {name: value for name, value in environment.items() if own(name)}


def launch_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment in which ``mpirun`` works for root and with more ranks than cores."""
    ready = clean_mpi_environment(environment)
    ready.setdefault("OMPI_MCA_rmaps_base_oversubscribe", "1")
    ready.setdefault("OMP_NUM_THREADS", "1")
    if os.geteuid() == 0:
        ready.setdefault("OMPI_ALLOW_RUN_AS_ROOT", "1")
        ready.setdefault("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1")
    return ready


class _Report:
    """Prints one line per fact on rank 0 and remembers what is wrong."""

    def __init__(self, stream: TextIO, speaks: bool) -> None:
        self.stream, self.speaks = stream, speaks
        self.wrong: list[str] = []

    def fact(self, name: str, text: str) -> None:
        if self.speaks:
            print(f"{name:<12} {text}", file=self.stream, flush=True)

    def fault(self, name: str, text: str, mend: str) -> None:
        self.fact(name, f"WRONG: {text}")
        self.wrong.append(f"{name}: {text}; {mend}")

    def attempt(self, name: str, check: Callable[[], str], mend: str) -> bool:
        """Print what ``check`` returns; turn any exception into a fault, on this rank."""
        try:
            self.fact(name, check())
        except Exception as error:
            lines = str(error).strip().splitlines() or [""]
            self.fault(name, f"{type(error).__name__}: {lines[0]}", _own_of_user(PACKAGES.get(name, name)) or mend)
            return False
        return True


def _own_of_user(package: str) -> str | None:
    """Return what to do about a ``package`` of the user's own folder: no scripts/setup puts another before it."""
    with contextlib.suppress(ImportError, ValueError, AttributeError):
        place = importlib.util.find_spec(package).origin or ""
        folder = site.getusersitepackages()
        if pathlib.Path(place).is_relative_to(folder):
            return OF_THE_USER.format(folder)
    return None


def _cores() -> str:
    there = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else there
    return f"{there}" if usable == there else f"{there}, of which this process may use {usable}"


def _memory() -> str:
    if not hasattr(os, "sysconf"):  # (Windows)
        return "unknown"
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    with contextlib.suppress(OSError, StopIteration, ValueError), open("/proc/meminfo", encoding="ascii") as table:
        free = next(int(row.split()[1]) for row in table if row.startswith("MemAvailable"))
        return f"{total:.1f} GiB, of which {free / 2**20:.1f} GiB free"
    return f"{total:.1f} GiB"


def _cache_folder() -> str:
    folder = pathlib.Path(cache_directory())
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return f"{folder} (compiled kernels; F2S_CACHE_DIR moves it)"


def _mpi() -> str:
    from f2s_hpc import mpi

    version = importlib.import_module("mpi4py").__version__
    return f"mpi4py {version}, {mpi.library_version()}, {mpi.size()} rank{'s' if mpi.size() > 1 else ''}"


def _petsc() -> str:
    from f2s_hpc.grid import probe

    bindings, library, scalar = probe.petsc_versions()
    if scalar != "float64":
        raise RuntimeError(f"PETSc's scalar is {scalar}; float64 is needed")
    return f"petsc4py {bindings}, PETSc {library}, scalar {scalar}"


def _hdf5() -> str:
    from f2s_hpc.io import probe

    bindings, library, parallel = probe.hdf5_versions()
    if not parallel:
        raise RuntimeError(f"h5py {bindings} (HDF5 {library}) is the serial build")
    return f"h5py {bindings}, HDF5 {library}, MPI build"


def _reads_hdf5() -> bool:
    try:
        importlib.import_module("f2s_hpc.io.runs")
    except Exception:
        return False
    return True


def _describe(report: _Report) -> bool:
    """Report versions and machine; tell whether MPI and parallel HDF5 are there to be tried."""
    report.fact("python", f"{platform.python_version()} ({sys.executable})")
    for package in PLAIN_PACKAGES:
        report.attempt(package, lambda package=package: importlib.import_module(package).__version__, SETUP_AGAIN)
    mpi_ready = report.attempt("MPI", _mpi, f"{SETUP_AGAIN} (Debian: python3-mpi4py, openmpi-bin)")
    report.attempt("PETSc", _petsc, f"{SETUP_AGAIN} (Debian: python3-petsc4py, numpy below 2), or set PETSC_DIR")
    hdf5_ready = report.attempt("HDF5", _hdf5,
                                f"{SETUP_AGAIN} (Debian: python3-h5py-mpi), and set H5PY_ALWAYS_USE_MPI=1")
    report.fact("cores", _cores())
    report.fact("memory", _memory())
    report.attempt("cache", _cache_folder, "set F2S_CACHE_DIR to a folder that can be written")
    return mpi_ready and hdf5_ready


def _probe_here(path: pathlib.Path) -> str:
    """Write and read ``path`` from the ranks of this run (collective)."""
    from f2s_hpc import mpi
    from f2s_hpc.io import probe

    count = probe.write_and_read(path)
    return f"{mpi.size()} ranks wrote and read {count} bytes in {path.parent}"


def _probe_on_these_ranks() -> str:
    """Use a folder made by rank 0 where the command runs, since every rank must see it."""
    from f2s_hpc import mpi

    def shared_folder() -> str:
        try:
            return tempfile.mkdtemp(prefix="f2s-doctor-", dir=pathlib.Path.cwd())
        except OSError as error:
            raise F2SError(f"the current folder can not be written ({error.strerror})") from None

    folder = mpi.run_together(shared_folder)
    try:
        return _probe_here(pathlib.Path(folder) / "probe.h5")
    finally:
        if mpi.is_root():
            shutil.rmtree(folder, ignore_errors=True)


def _probe_in_new_ranks() -> str:
    """Start two ranks of this module in a temporary folder and return what they say."""
    launcher = shutil.which("mpirun")
    if launcher is None:
        raise RuntimeError("mpirun is not on PATH")
    environment = launch_environment(os.environ)
    root = str(pathlib.Path(__file__).resolve().parents[1])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
    with tempfile.TemporaryDirectory(prefix="f2s-doctor-") as folder:
        command = [launcher, "-n", str(PROBE_RANKS), sys.executable, "-m", "f2s_hpc.doctor",
                   "--probe", os.path.join(folder, "probe.h5")]
        try:
            done = subprocess.run(command, cwd=folder, env=environment, timeout=PROBE_TIMEOUT_S, check=False,
                                  stdin=subprocess.DEVNULL, capture_output=True, text=True)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"no answer from mpirun -n {PROBE_RANKS} in {PROBE_TIMEOUT_S} s") from None
    if done.returncode:
        said = [line for line in (done.stderr + done.stdout).splitlines() if line.strip(" -*")] or ["nothing"]
        cause = next((line for line in said if "Error" in line), said[0])
        raise RuntimeError(f"mpirun -n {PROBE_RANKS} ended with code {done.returncode}: {cause.strip()}")
    if not done.stdout.startswith(f"{PROBE_RANKS} ranks"):
        raise RuntimeError(f"{launcher} belongs to another MPI than mpi4py: it starts {PROBE_RANKS} single ranks")
    return done.stdout.strip()


def run_doctor(stream: TextIO = sys.stdout) -> int:
    """Print what is installed and try parallel HDF5; return 0 if all is good, else 1.

    Under ``mpirun`` the ranks of the run write and read together (all of them must call this; rank
    0 prints). Alone, two ranks are started for it.
    """
    try:
        from f2s_hpc import mpi

        ranks, speaks = mpi.size(), mpi.is_root()
    except Exception:
        ranks, speaks = 1, one_rank.launched_rank() == 0
    report = _Report(stream, speaks)
    ready = _describe(report)
    mend = "see the lines above; on a network file system try HDF5_USE_FILE_LOCKING=FALSE or OMPI_MCA_io=^ompio"
    if ranks > 1 and not mpi.any_rank(not ready):
        report.attempt("write, read", _probe_on_these_ranks, mend)
    elif ready:
        report.attempt("write, read", _probe_in_new_ranks, mend)
    if ranks > 1:
        # In rank order; a fault that all ranks share is told once.
        report.wrong = list(dict.fromkeys(line for lines in mpi.all_gather(report.wrong) for line in lines))
    if speaks:
        print("\n".join(report.wrong) or "all good", file=stream, flush=True)
        if report.wrong and all(line.startswith(COMPUTING) for line in report.wrong) and _reads_hdf5():
            print(MEASURES, file=stream, flush=True)
    return 1 if report.wrong else 0


def main(arguments: list[str] | None = None) -> int:
    """Run ``python -m f2s_hpc.doctor [--probe FILE]``; with ``--probe``, only the write and read."""
    parser = argparse.ArgumentParser(prog="python -m f2s_hpc.doctor", description=__doc__)
    parser.add_argument("--probe", metavar="FILE", type=pathlib.Path, help="only write and read FILE from these ranks")
    chosen = parser.parse_args(arguments)
    if chosen.probe is None:
        return run_doctor(sys.stdout)
    from f2s_hpc import mpi

    mpi.install_abort_hook()
    said = _probe_here(chosen.probe)
    if mpi.is_root():
        print(said)
    return 0


if __name__ == "__main__":
    sys.exit(main())
