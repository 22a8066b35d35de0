"""The benchmarks: the hook, the counting of operations and bytes, the states, the machine, the scaling studies."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
import types

import numpy as np
import pytest
from conftest import ROOT, launch

from f2s_hpc import mpi
from f2s_hpc.bench import counting, kernels, machine, scaling, states, trial
from f2s_hpc.bench.hook import EXCHANGE, Stopwatches, hooked
from f2s_hpc.bench.launch import reason
from f2s_hpc.config import load_scene
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.fields import BY_NAME
from f2s_hpc.kernels import force
from f2s_hpc.solver import lagrange


@pytest.mark.mpi
def test_hook_sees_every_kernel_of_a_step_and_leaves_nothing_behind():
    """Fails if a caller of kernels is missing in ``hook.CALLERS``."""
    model = states.default_model()
    setup = states.flying(model)
    watches = Stopwatches()
    kept = lagrange.force
    with hooked(watches.wrap):
        setup.advance(1)
        assert lagrange.force is not kept
    assert lagrange.force is kept
    assert lagrange.force is force
    seconds, calls = watches.read()
    assert calls["force.nodal_forces"] == 2  # at the start of the step, and at its end before the remap
    assert calls["flux.volume_fluxes"] == 3
    assert calls["sides.fill_ghosts"] > 3
    assert calls[EXCHANGE] > 3
    assert all(value >= 0.0 for value in seconds.values())
    assert watches.read() == ({}, {})


@pytest.mark.mpi
def test_hooked_step_gives_the_same_bits():
    model = states.default_model()
    one, other = states.flying(model), states.flying(model)
    one.advance(2)
    with hooked(Stopwatches().wrap):
        other.advance(2)
    for name in one.state.saved:
        assert np.array_equal(one.state.owned(name), other.state.owned(name)), name


@pytest.mark.mpi
def test_tiles_step_like_the_patch():
    """Two mirror images side by side: the low one stays the patch, whatever the number of ranks."""
    model = states.default_model()
    saved = states.save(states.flying(model))
    small, wide = (states.tiled(saved, model, tiles) for tiles in ((1, 1), (2, 1)))
    for setup in (small, wide):
        setup.advance(3)
    assert small.clock.dt == wide.clock.dt
    alone, beside = states.save(small), states.save(wide)
    nx = states.PATCH[0]
    for name in ("mass", "velocity_z", "stress_xy", "velocity_x"):
        on_nodes = BY_NAME[name].location != "cell"
        part = beside[name][:, :, :nx + int(on_nodes)]
        assert np.abs(part - alone[name]).max() <= 1e-9 * np.abs(alone[name]).max(), name


def test_counted_numbers_count_what_is_done_and_compute_the_same():
    before = counting._operations[0]
    a, b = counting.Counted(3.0), counting.Counted(4.0)
    value = 2.0 * a + b / 2.0 - np.float64(1.0) * a
    assert value == 5.0
    assert counting._operations[0] - before == 5
    assert isinstance(value, counting.Counted)
    assert math.isinf(a / counting.Counted(0.0))
    assert -a == -3.0
    assert counting._operations[0] - before == 6


def test_traced_arrays_note_what_is_read_and_written():
    memory = np.arange(24.0)
    traced = counting.trace(memory.reshape(2, 3, 4))
    row = traced[1, 2, 1:]
    assert row.size == 3
    assert row[0] == 21.0
    row[2] = 5.0
    assert memory[23] == 5.0
    assert traced.buffer.touched() == (2, 1)
    traced[0, 0] = 7.0
    assert memory[:4].tolist() == [7.0] * 4
    assert traced.buffer.touched() == (6, 5)
    with pytest.raises(IndexError):
        traced[2, 0, 0]


def test_visited_cells_of_runs_and_columns():
    runs = np.array([[4, 4, 0, 16], [4, 5, 8, 30], [9, 4, 0, 16]], dtype=np.int32)
    assert counting.visited((runs, 2, (4, 8, 4, 8, 4, 20), 1.0)) == 12 + 12
    columns = np.array([[4, 0, 10, 0, 16]], dtype=np.int32)
    assert counting.visited((columns, 1, (4, 8, 4, 8, 4, 20))) == 4 * 12
    assert counting.visited((np.ones(3), 2)) is None


def test_machine_limits_count_what_they_move(monkeypatch):
    """By a clock of our own; fails if bytes or operations are left out, or the best is not taken."""
    ticks = itertools.accumulate((0.0, 2.0, 0.0, 1.0, 0.0, 4.0))
    monkeypatch.setattr(machine.time, "thread_time", lambda: next(ticks))
    assert machine.triad_bandwidth(2**20, 3) == 32 * 2**17
    ticks = itertools.accumulate((0.0, 2.0, 0.0, 0.5))
    assert machine.multiply_add_peak(2) == 2 * 16 * 256 * 8000 / 0.5


def test_bench_script_prints_and_writes(tmp_path):
    """The whole of it at the smallest size, with counted bytes and flops."""
    done = launch([sys.executable, str(ROOT / "scripts/bench_kernels.py"), "--states", "flying", "--sizes", "S",
                   "--json", "b.json"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "b.json").read_text())
    rows = {row["kernel"]: row for row in record["rows"]}
    whole = rows[kernels.WHOLE_STEP]
    assert whole["operations"] > max(r["operations"] or 0.0 for r in rows.values() if r is not whole)
    assert 500 < whole["operations"] < 20_000
    assert 500 < whole["bytes"] < 20_000
    for name in ("force.nodal_forces", "remap.nodal_masses"):
        assert rows[name]["roofline"] > 0.0
    # eight masses: seven sums and a product, for each of the calls
    assert rows["remap.nodal_masses"]["operations"] == pytest.approx(8.0 * rows["remap.nodal_masses"]["calls"])
    assert "triad" in done.stdout
    done = launch([sys.executable, str(ROOT / "scripts/bench_kernels.py"), "--sizes", "huge"], cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "no size 'huge'; there are S, M, L, XL\n"


def test_bench_script_looks_at_its_file_before_it_measures(tmp_path):
    """Fails if a place that cannot be written is found out after all has been measured."""
    done = launch([sys.executable, str(ROOT / "scripts/bench_kernels.py"), "--json", "nowhere/b.json"], cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "nowhere/b.json: cannot be written (no folder nowhere)" in done.stderr


@pytest.mark.mpi
def test_counting_starts_a_process_that_is_no_rank(shared_path, monkeypatch):
    """Fails if what counts takes itself for a rank of this job, or the tallies are not kept whole."""
    stand_in = shared_path / "python"
    if mpi.is_root():
        code = "import json; from mpi4py import MPI; print(json.dumps(dict(ranks=MPI.COMM_WORLD.size)))"
        stand_in.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{code}"\n')
        stand_in.chmod(0o755)
    mpi.barrier()
    monkeypatch.setattr(kernels, "cache_directory", lambda: str(shared_path / "cache"))
    monkeypatch.setattr(kernels.sys, "executable", str(stand_in))
    assert kernels.count_work("flying", {}) == {"ranks": 1}
    kept, = (shared_path / "cache").iterdir()
    assert json.loads(kept.read_text()) == {"ranks": 1}
    mpi.barrier()
    if mpi.is_root():
        stand_in.write_text("#!/bin/sh\nexit 3\n")
        kept.write_text('{"half')
    mpi.barrier()
    with pytest.raises(F2SError, match="ended with 3: no word"):
        kernels.count_work("flying", {})


class Paced:
    """Stands for a setup and its stopwatches: the last stretch skips a kernel, the last rank works twice as long."""

    def __init__(self) -> None:
        self.clock = types.SimpleNamespace(active_cell_steps=0, steps=0)
        self.stretch = 0

    def advance_to_remap(self) -> int:
        self.stretch += 1
        self.clock.steps += 2
        self.clock.active_cell_steps += 20
        return 2

    def read(self) -> tuple[dict[str, float], dict[str, int]]:
        slow = 2.0 if mpi.rank() == mpi.size() - 1 else 1.0
        seconds, calls = {"a": 4.0 * slow, EXCHANGE: 9.0 / slow}, {"a": 4, EXCHANGE: 2}
        if self.stretch <= kernels.STRETCHES:  # (the first stretch is not counted)
            seconds["b"], calls["b"] = 1.0 * slow, 2
        return seconds, calls


@pytest.mark.mpi
def test_kernel_times_are_of_the_busiest_rank(monkeypatch):
    """Fails if rank 0's times are taken, or a kernel that the last stretch did not need ends in a ``KeyError``."""
    paced = Paced()
    monkeypatch.setattr(kernels, "Stopwatches", lambda: types.SimpleNamespace(wrap=lambda n, f: f, read=paced.read))
    least, calls, _, active, common = kernels.time_steps(paced, 0.0)
    assert (least["a"], least["b"], least[EXCHANGE]) == (4.0, 1.0, 2.25)
    assert active == 10 * mpi.size()
    assert calls == {"a": 2.0, "b": 0.875, EXCHANGE: 1.0}
    assert common == 2


def test_weak_scaling_repeats_the_patch():
    scene = load_scene("quickstart")
    assert scaling.weak_settings(scene, 6) == ['domain.size=["0.00036 m", "0.00024 m", "0.0003 m"]',
                                               "batches.particles=216"]
    with pytest.raises(InputError, match="batches are generated"):
        scaling.weak_settings(load_scene("splat"), 2)
    assert scaling.rank_list(6) == [1, 2, 4]


def test_scaling_script_runs_and_writes(tmp_path):
    command = [sys.executable, str(ROOT / "scripts/scaling.py"), "--scene", "quickstart", "--ranks", "1,2",
               "--duration", "8 ns", "--out", "study"]
    done = launch(command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "study/scaling.json").read_text())
    assert [(r["kind"], r["ranks"]) for r in rows] == [("strong", 1), ("strong", 2), ("weak", 1), ("weak", 2)]
    assert rows[0]["efficiency"] == rows[2]["efficiency"] == 1.0
    assert rows[3]["cells"] == 2 * rows[2]["cells"]
    assert all(0.0 < r["busy_s"] <= r["step_s"] * 1.05 for r in rows)
    assert (tmp_path / "study/scaling.png").stat().st_size > 5000
    assert len((tmp_path / "study/scaling.csv").read_text().splitlines()) == 5
    again = launch(command, cwd=tmp_path)
    assert again.returncode == 2
    assert "is there already" in again.stderr
    cut = launch([*command, "--out", "other", "--ranks", "1,4096"], cwd=tmp_path)
    assert cut.returncode == 2
    assert "can not be cut into 4096 blocks" in cut.stderr
    assert cut.stdout == ""
    printed = launch([*command, "--dry-run", "--launcher", "srun --mpi=pmix -n", "--kind", "weak"], cwd=tmp_path)
    assert printed.stdout.count("srun --mpi=pmix -n ") == 2


def test_a_late_failure_leaves_what_was_measured(tmp_path, monkeypatch):
    """Fails if rows are written at the end only, or mpirun's closing words pass for the reason."""
    planned = scaling.planned(["strong"], "quickstart", [], "8 ns", [1, 2], tmp_path, "mpirun -n")
    row = {"kind": "strong", "ranks": 1, "cells": 8, "steps": 1, "step_s": 1.0, "busy_s": 1.0, "active_cells": 8,
           "cell_steps_per_s_per_core": 8.0, "imbalance": 1.0, "memory_per_rank_bytes": 1.0}
    said = []

    def run(command, what):
        if command[2] == "2":
            raise F2SError("no more memory")

    monkeypatch.setattr(scaling.launch, "run", run)
    monkeypatch.setattr(scaling, "row_of", lambda kind, folder: row)
    with pytest.raises(F2SError, match="no more memory"):
        scaling.study(planned, tmp_path, said.append)
    assert [r["ranks"] for r in json.loads((tmp_path / "scaling.json").read_text())] == [1]
    assert "100.0%" in said[1]


MPIRUN_SAYS = """particles.speed: 3 um is a length
--------------------------------------------------------------------------
Primary job  terminated normally, but 1 process returned
a non-zero exit code. Per user-direction, the job has been aborted.
--------------------------------------------------------------------------
--------------------------------------------------------------------------
mpirun detected that one or more processes exited with non-zero status, thus causing
the job to be terminated. The first process to do so was:

  Process name: [[46148,1],0]
  Exit code:    2
--------------------------------------------------------------------------
[node:7] 1 more process has sent help message help-mpi-api.txt / mpi-abort
"""


@pytest.mark.parametrize(("said", "found"), [
    (MPIRUN_SAYS, "particles.speed: 3 um is a length"),
    (MPIRUN_SAYS.partition("\n")[2], "Primary job  terminated normally, but 1 process returned"),
    ("no memory\nsrun: error: node: task 0: Exited with exit code 2\n", "no memory"), ("", "no word")])
def test_the_reason_is_what_the_rank_said(said, found):
    """Fails if the last line is taken, a rule of mpirun."""
    assert reason(said) == found


def test_a_trial_run_tells_its_reason(tmp_path):
    """Two real ranks. Fails if mpirun's rule is taken for the reason."""
    (tmp_path / "s.toml").write_text("[domain]\ncolour = 3\n")
    with pytest.raises(F2SError, match=r"on 2 ranks failed: .*s.toml"):
        trial._launch(tmp_path / "s.toml", 1e-9, 2)


def test_counting_needs_numba_switched_off_only_in_its_own_process():
    code = "import numba, f2s_hpc.bench.kernels; print(numba.config.DISABLE_JIT)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.stdout.strip() == "0", done.stderr
    assert mpi.size() == 1
