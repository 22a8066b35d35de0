"""A disk that fills up while a run writes, or a quota that nobody foresees: one line, no file, no crash, no waiting."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest
from conftest import launch
from test_damaged import SCENE

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.errors import CheckpointError
from f2s_hpc.io import checkpoint, layout
from f2s_hpc.io.layout import Block

QUICK = SCENE + "output = { picture = false }\n"

RUN = """
import sys
from f2s_hpc.io import layout
layout._check_space = lambda folder, size: None  # what df tells is no quota
from f2s_hpc.cli.main import entry
entry()
"""


def _can_mount() -> bool:
    try:
        return subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True,
                              check=False).returncode == 0
    except OSError:
        return False


@pytest.mark.skipif(not _can_mount(), reason="no disk of its own can be mounted here")
@pytest.mark.parametrize("ranks", [1, 2, 3])
@pytest.mark.parametrize("reserves", [True, False])
def test_a_disk_that_is_full_before_it_looks_full_ends_in_one_line(tmp_path, ranks, reserves):
    """In the second cycle; the checkpoint of the first one stands, and nothing is left of what has no room.

    Fails without ``_reserve``: three ranks hang in HDF5's flush, one crashes with a segmentation fault. Where the file
    system cannot reserve, one rank still does not crash: fails when ``entry`` does not look at ``unclosed``.
    """
    if not reserves and ranks > 1:
        pytest.skip("only what is reserved keeps ranks from waiting for each other")
    (tmp_path / "scene.toml").write_text(QUICK, encoding="utf-8")
    script = RUN if reserves else RUN.replace("from f2s_hpc.cli", "layout._reserve = lambda *_: None\nfrom f2s_hpc.cli")
    (tmp_path / "full.py").write_text(script, encoding="utf-8")
    (tmp_path / "disk").mkdir()
    size = 560 if reserves else 420
    work = " ".join([*(["mpirun", "-n", str(ranks)] if ranks > 1 else []), sys.executable, "full.py", "run",
                     "scene.toml", "--out", "disk/run"])
    shell = f"mount -t tmpfs -o size={size}k none disk && {work}; code=$?; ls -A disk/run/checkpoints; exit $code"
    done = launch(["unshare", "-rm", "sh", "-c", shell], cwd=tmp_path, timeout=120)
    assert done.returncode == CheckpointError.exit_code, done.stdout + done.stderr
    assert "f2s: cannot write checkpoint_cycle_0002" in done.stderr
    assert "No space left on device" in done.stderr
    kept = [name for name in done.stdout.splitlines() if "checkpoint_cycle" in name and " " not in name]
    assert [name[:21] for name in kept] == ["checkpoint_cycle_0001"] * 2


@pytest.mark.mpi
def test_files_that_must_not_become_so_large_end_in_one_line(shared_path, capsys):
    """``ulimit -f``. Fails without the look at it: ranks hang when HDF5 closes the file, one crashes."""
    if mpi.is_root():
        (shared_path / "scene.toml").write_text(QUICK, encoding="utf-8")
    mpi.barrier()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
    try:
        code = main(["run", str(shared_path / "scene.toml"), "--out", str(shared_path / "run")])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = capsys.readouterr()
    assert code == (CheckpointError.exit_code), said
    assert not mpi.is_root() or "files of 0.1 MB are allowed" in said.err
    mpi.barrier()
    assert not list((shared_path / "run" / layout.CHECKPOINTS).iterdir())


@pytest.mark.mpi
def test_a_rank_without_memory_for_its_part_does_not_leave_the_others_alone(shared_path, monkeypatch):
    """Fails (the job is aborted) when ``write_collective`` leaves before the call in which the others are."""
    as_type, rows = layout.as_type, 3 * mpi.size()

    def short(data, dtype):
        if mpi.rank() == mpi.size() - 1:
            raise MemoryError
        return as_type(data, dtype)

    data = Block("mass", mpi.rank() + as_type([[[0.0, 1.0]]] * 3, "f8"), (3 * mpi.rank(), 0, 0), (rows, 1, 2))
    monkeypatch.setattr(layout, "as_type", short)
    monkeypatch.setattr(mpi, "PATIENCE_S", 5.0)
    with pytest.raises(CheckpointError, match=r"cannot write checkpoint_cycle_0001.*MemoryError"):
        checkpoint.write_checkpoint(shared_path / "checkpoints", 1, [data], {})
    mpi.barrier()
    assert not list((shared_path / "checkpoints").iterdir())


def test_a_rank_that_fails_alone_ends_the_job(tmp_path):
    """The others wait in a call that it has left. Fails (no end) when ``raise_together`` does not call ``meet``."""
    (tmp_path / "alone.py").write_text("""
from f2s_hpc import mpi
from f2s_hpc.errors import CheckpointError
from f2s_hpc.io import layout

mpi.PATIENCE_S = 1.0
mpi.install_abort_hook()

def work():
    if mpi.rank() == 1:
        raise OSError("this disk is broken")
    mpi.barrier()

layout.attempt_together(work, "cannot write it", CheckpointError)
""", encoding="utf-8")
    done = launch([sys.executable, "alone.py"], ranks=2, cwd=tmp_path, timeout=60)
    assert done.returncode == CheckpointError.exit_code, done.stdout + done.stderr
    assert "f2s: [rank 1] cannot write it: this disk is broken; the other ranks do not come" in done.stderr
