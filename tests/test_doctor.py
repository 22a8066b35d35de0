"""The doctor: what it reports, what it finds wrong, and its try of parallel HDF5."""

from __future__ import annotations

import io
import os
import sys

import h5py
import numpy as np
import pytest
from conftest import launch

from f2s_hpc import doctor, mpi
from f2s_hpc.errors import F2SError
from f2s_hpc.io import probe

DOCTOR = [sys.executable, "-m", "f2s_hpc.doctor"]


def test_doctor_alone_says_all_good(tmp_path):
    done = launch(DOCTOR, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == "all good"
    assert any(line.startswith("write, read") and "2 ranks wrote and read 16000 bytes" in line for line in lines)
    assert any(line.startswith("HDF5") and "MPI build" in line for line in lines)
    assert {line.split()[0] for line in lines[:-1]} >= {"python", "numpy", "numba", "MPI", "PETSc", "cores", "memory"}
    assert not list(tmp_path.iterdir())


def test_doctor_under_mpirun_uses_the_ranks_there(tmp_path):
    done = launch(DOCTOR, ranks=3, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("all good") == 1
    assert f"3 ranks wrote and read 24000 bytes in {tmp_path}" in done.stdout
    assert not list(tmp_path.iterdir())


def test_doctor_names_a_missing_package_and_the_mend(tmp_path):
    (tmp_path / "meshio.py").write_text("raise ImportError('no meshio here')\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from f2s_hpc import doctor; sys.exit(doctor.main([]))"
    done = launch([sys.executable, "-c", code])
    assert done.returncode == 1
    assert "meshio: ImportError: no meshio here; run scripts/setup" in done.stdout
    assert "all good" not in done.stdout


def test_doctor_finds_a_missing_launcher(monkeypatch):
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    stream = io.StringIO()
    assert doctor.run_doctor(stream) == 1
    assert "mpirun is not on PATH" in stream.getvalue()


def test_doctor_finds_the_launcher_of_another_mpi(monkeypatch, tmp_path):
    """Fails when the number of ranks that the probe prints is not looked at."""
    other = tmp_path / "mpirun"
    other.write_text('#!/bin/sh\nshift 2\n"$@" && exec "$@"\n')
    other.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    stream = io.StringIO()
    assert doctor.run_doctor(stream) == 1
    assert "belongs to another MPI than mpi4py" in stream.getvalue()


def test_serial_h5py_is_a_fault(monkeypatch):
    monkeypatch.setattr(probe, "hdf5_versions", lambda: ("3.7.0", "1.10.8", False))
    stream = io.StringIO()
    assert doctor.run_doctor(stream) == 1
    said = stream.getvalue()
    assert "HDF5: RuntimeError: h5py 3.7.0 (HDF5 1.10.8) is the serial build; run scripts/setup" in said
    assert "H5PY_ALWAYS_USE_MPI=1" in said
    assert "write, read" not in said


def test_doctor_knows_what_setup_cannot_mend(tmp_path, monkeypatch):
    """A package in ~/.local comes first. Fails if scripts/setup is advised for it, which leaves that as it is."""
    own = tmp_path / "own"
    own.mkdir()
    (own / "h5py.py").write_text("raise ImportError('for another MPI')\n")
    code = (f"import site, sys; site.getusersitepackages = lambda: {str(own)!r}; sys.path.insert(0, {str(own)!r}); "
            "from f2s_hpc import doctor; sys.exit(doctor.main([]))")
    done = launch([sys.executable, "-c", code])
    assert done.returncode == 1
    last = next(line for line in done.stdout.splitlines() if line.startswith("HDF5: ImportError"))
    assert last.endswith(f"it is the user's own, in {own}: set PYTHONNOUSERSITE=1, or pip uninstall it there")
    assert "scripts/setup" not in last


def test_clean_environment_drops_the_launcher_and_keeps_the_user():
    mine = {"OMPI_MCA_io": "^ompio", "OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_ALLOW_RUN_AS_ROOT": "1",
            "PATH": "/bin", "SLURM_JOB_ID": "7"}
    launcher = {"OMPI_COMM_WORLD_SIZE": "2", "PMIX_RANK": "0", "OMPI_MCA_ess": "^singleton",
                "OMPI_MCA_orte_hnp_uri": "1.0", "OMPI_MCA_ess_base_vpid": "0", "PMI_SIZE": "2"}
    assert doctor.clean_mpi_environment(mine | launcher) == mine


@pytest.mark.mpi
def test_write_and_read_together(shared_path):
    path = shared_path / "probe.h5"
    assert probe.write_and_read(path) == 8000 * mpi.size()
    mpi.barrier()
    with h5py.File(path, "r") as file:
        assert np.array_equal(file["rows"][:], np.sqrt(np.arange(1000.0 * mpi.size())))


@pytest.mark.mpi
def test_a_wrong_value_on_one_rank_is_an_error_on_all(shared_path, monkeypatch):
    """Fails when ``write_and_read`` raises for its own rank only: the others then go on."""
    right, calls = probe._rows, []

    def wrong_when_compared(rank: int) -> np.ndarray:
        calls.append(rank)
        return right(rank) + (1.0 if len(calls) == 2 and mpi.rank() == mpi.size() - 1 else 0.0)

    monkeypatch.setattr(probe, "_rows", wrong_when_compared)
    with pytest.raises(F2SError, match="differs from what was written"):
        probe.write_and_read(shared_path / "probe.h5")
