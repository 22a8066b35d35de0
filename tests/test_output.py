"""The run folder: batches come back in their order, and what cannot be written stops all ranks alike, or is a note."""

from __future__ import annotations

import json
import os
import re
import signal
import types

import numpy as np
import pytest
from conftest import F2S, f2s, launch
from matplotlib.text import Text
from test_cli import SCENE

from f2s_hpc import mpi
from f2s_hpc.analysis import picture, stream
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene
from f2s_hpc.cycles import output
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.cycles.stop import SIGNALS, StopRequest
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.io import layout, runs
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.plan import BatchPlan


def numbered_batches(count: int) -> list[Batch]:
    """Return batches of one sphere each, told apart by x = number of the batch in um."""
    return [Batch(np.array([number * 1e-6]), *(np.array([1e-5]),) * 3) for number in range(1, count + 1)]


def saved_run(path, batches: int, order: list[int]) -> RunFolder:
    """Return a folder with the input of a run of splat, one cycle for each of ``order``."""
    folder = RunFolder(runs.prepare_run_folder(path), load_scene("splat", [f"cycles.count={len(order)}"]))
    folder.write_input(BatchPlan(numbered_batches(batches), order))
    return folder


def numbers(plan: BatchPlan) -> list[int]:
    return [round(1e6 * batch.x[0]) for batch in plan.batches]


# --- batches ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("named", [True, False])
def test_more_than_999_batches_come_back_in_their_order(tmp_path, named):
    """Fails if the files are sorted as text: batch-1000 then comes before batch-101. Old folders do not name them."""
    folder = saved_run(tmp_path / "run", 1002, [1001, 0, 100])
    place = folder.path / output.BATCHES / output.ORDER
    if not named:
        place.write_text(json.dumps({"order": [1001, 0, 100]}) + "\n", encoding="utf-8")
    plan = folder.read_plan()
    assert numbers(plan) == list(range(1, 1003))
    assert plan.order == [1001, 0, 100]


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("lost", [2, 3])
def test_a_lost_batch_is_named(tmp_path, named, lost):
    """Fails if the batches that are left take the places of those that are not."""
    folder = saved_run(tmp_path / "run", 3, [2, 0])
    if not named:
        (folder.path / output.BATCHES / output.ORDER).write_text('{"order": [2, 0]}', encoding="utf-8")
    path = folder.path / output.BATCHES / f"batch-{lost:03d}.csv"
    path.unlink()
    with pytest.raises(InputError) as caught:
        folder.read_plan()
    assert str(caught.value).startswith(f"{path}: no such file")


@pytest.mark.mpi
@pytest.mark.parametrize(("text", "words"), [
    ('{"order": []}', '"order" must be a list'), ("[0]", '"order" must be a list'), ("{", "not JSON"),
    ('{"order": ["0", "1"]}', '"order" must be a list'), ('{"order": [0]}', "of 1 cycles, but the run has 2"),
    ('{"order": [0, 7], "batches": ["batch-001.csv"]}', "holds 1 batches, order.json asks for 8"),
    ('{"order": [0, 0], "batches": ["../x.csv"]}', '"batches" must be a list of files')])
def test_a_damaged_order_is_one_line_on_every_rank(shared_path, text, words):
    """Fails if an empty or foreign order passes for one (``max`` of nothing), or raises on rank 0 only."""
    folder = saved_run(shared_path / "run", 1, [0, 0])
    if mpi.is_root():
        (folder.path / output.BATCHES / output.ORDER).write_text(text, encoding="utf-8")
    mpi.barrier()
    with pytest.raises(InputError) as caught:
        folder.read_plan()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


# --- what cannot be written ---------------------------------------------------------------------------------


@pytest.mark.mpi
def test_input_that_cannot_be_written_ends_all_ranks_and_leaves_no_folder(shared_path, monkeypatch):
    """Fails if the error is raised on rank 0 only (the others wait in a barrier), or if a half-made folder stays."""
    plain = output.write_csv

    def full(path, batch) -> None:
        if path.name == "batch-002.csv":
            raise InputError(f"{path}: cannot be written (No space left on device)")
        plain(path, batch)

    monkeypatch.setattr(output, "write_csv", full)
    with pytest.raises(InputError, match=r"batch-002\.csv: cannot be written \(No space left"):
        saved_run(shared_path / "run", 3, [0, 1, 2])
    assert not (shared_path / "run").exists()


@pytest.mark.mpi
@pytest.mark.parametrize("status", ["running", "failed", "complete", "timeout"])
def test_tables_that_cannot_be_written_cost_no_checkpoint(shared_path, capsys, status):
    """Before the end a note, so that the cycle's checkpoint follows; at the end one error for all ranks.

    Fails if an ``OSError`` leaves ``write_tables``, or on rank 0 only.
    """
    folder = RunFolder(runs.prepare_run_folder(shared_path / "run"), load_scene("splat"))
    if mpi.is_root():
        (folder.path / layout.SUMMARY_JSON).mkdir()
    mpi.barrier()
    if status in ("running", "failed"):
        folder.write_tables([{"cycle": 1}], {"status": status})
        said = capsys.readouterr().out.splitlines()
        assert len(said) == int(mpi.is_root())
        assert all("the cycle table cannot be written" in line for line in said)
    else:
        with pytest.raises(F2SError, match="the cycle table cannot be written"):
            folder.write_tables([{"cycle": 1}], {"status": status})
    mpi.barrier()
    assert not list(folder.path.glob(".*"))


def test_a_table_that_cannot_be_renewed_stays_as_it_was(tmp_path, monkeypatch):
    """Fails when ``write_text_file`` writes into the file itself: a full disk would cost the numbers of all cycles."""
    folder = RunFolder(tmp_path, load_scene("splat"))
    folder.write_tables([{"cycle": 1}], {"status": "running"})
    before = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert set(before) == {layout.SUMMARY_CSV, layout.SUMMARY_JSON}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(layout, "publish", full)
    folder.write_tables([{"cycle": 1}, {"cycle": 2}], {"status": "running"})
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_run_resumed_with_more_fields_than_its_frames_ends_without_a_picture(tmp_path, ranks):
    """Fails if what the newest frame lacks raises on rank 0 only: rank 1 then waits in the barrier for ever."""
    (tmp_path / "two.toml").write_text(SCENE, encoding="utf-8")
    f2s("run", "two.toml", "--out", "run", "--set", "cycles.duration=2 ns", "--set",
        'output.fields=["volume_fraction"]', cwd=tmp_path)
    done = launch([*F2S, "resume", "run", "--set", 'output.fields=["volume_fraction","peeq","temperature","speed"]'],
                  ranks, tmp_path, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    notes = [line for line in done.stdout.splitlines() if line.startswith("note: no picture; ")]
    assert len(notes) == 1
    assert "no field 'peeq'; it holds volume_fraction" in notes[0]


# --- why a run stops ----------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["SIGUSR1", "SIGTERM", "SIGINT"])
def test_a_signal_to_any_rank_is_the_reason_on_all(name):
    """Fails if rank 0 looks at its own signal only: it then blames the wall-time budget.

    Or if one of the two signals of batch systems is not listened to: the run would be killed without a checkpoint.
    """
    numbers = SIGNALS
    before = [signal.getsignal(number) for number in numbers]
    try:
        stop = StopRequest(None)
        if mpi.rank() == mpi.size() - 1:
            assert signal.getsignal(signal.Signals[name]) != signal.SIG_DFL
            os.kill(os.getpid(), signal.Signals[name])
        mpi.barrier()
        assert stop.asked() == (mpi.rank() == mpi.size() - 1)
        assert stop.reason() == f"signal {name}"
        assert StopRequest(1e-9).reason() == "the wall-time budget is spent"
    finally:
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)


def test_the_wall_time_counts_from_the_start_of_the_command_and_leaves_time_to_save(monkeypatch):
    """Fails if ``_is_spent`` counts from ``start``, or leaves out ``reserve``; or if ``saving`` takes the last time."""
    before, now = {number: signal.getsignal(number) for number in SIGNALS}, [80.0]
    monkeypatch.setattr("f2s_hpc.cycles.stop.time", types.SimpleNamespace(monotonic=lambda: now[0]))
    try:
        request = StopRequest(60.0, started=70.0)
        assert (request.elapsed(), request.asked()) == (0.0, False)
        for took in (15.0, 2.0):
            with request.saving():
                now[0] += took
        now[0] = 115.0
        assert not request.asked()
        now[0] = 116.0
        assert request.asked()  # (15 s are to be left until 130)
        assert not StopRequest(60.0).asked()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_all_figures_write_the_micrometre_alike(tmp_path, monkeypatch):
    """Fails when the picture of a run, of its batches, or of a measured stream has "um" or "us" for µm or µs."""
    texts = []

    def keep(figure, path, what):
        texts.append([text.get_text() for text in figure.findobj(Text)])

    for module in (picture, stream):
        monkeypatch.setattr(module, "save", keep)
    (tmp_path / "short.toml").write_text(SCENE, encoding="utf-8")
    assert main(["run", str(tmp_path / "short.toml"), "--out", str(tmp_path / "run")]) == 0
    assert main(["particles", str(tmp_path / "short.toml"), "--out", str(tmp_path / "batches")]) == 0
    assert main(["stream", "synthetic", "--out", str(tmp_path / "stream")]) == 0
    assert len(texts) == 3
    for of_figure in texts:
        assert any("µm" in text for text in of_figure)
        assert not any(re.search(r"\bu[ms]\b", text) for text in of_figure)
