"""Run folders, and the comparison of two runs: every saved bit counts, how it was computed does not."""

from __future__ import annotations

import csv
import math
import pathlib

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.errors import CheckpointError, F2SError, InputError
from f2s_hpc.io import checkpoint, layout, runs, tracers, vtkhdf
from f2s_hpc.io.compare import compare_arrays, compare_runs, format_comparison
from f2s_hpc.io.layout import Block

SHAPE = (4, 3, 5)


def field(name: str, cycle: int) -> np.ndarray:
    data = np.random.Generator(np.random.PCG64(cycle + len(name))).standard_normal(SHAPE)
    data[0, 0, 0] = np.nan
    return data


def make_run(path: pathlib.Path, cycles=(1, 2), changed=None, **table) -> pathlib.Path:
    """Write a small run; ``changed`` maps (cycle, field) to a function that edits the field."""
    run = runs.prepare_run_folder(path)
    rows = []
    for cycle in cycles:
        blocks = []
        for name in ("mass", "peeq"):
            data = field(name, cycle)
            (changed or {}).get((cycle, name), lambda _: None)(data)
            blocks.append(Block(name, data, (0, 0, 0), SHAPE))
        attributes = {"step": 100 * cycle, "time_s": 0.1 * cycle, "ledger": {"heat_J": table.get("heat_J", 1 / 3)},
                      "quanta": str(2**70 + table.get("more", 0)),
                      "wall_s": table.get("wall_s", 1.0), "ranks": table.get("ranks", 1),
                      "host": str(table.get("ranks", 1)), "seed": table.get("ranks", 1)}
        checkpoint.write_checkpoint(run / "checkpoints", cycle, blocks, attributes)
        vtkhdf.write_frame(run / "frames", cycle, 1e-7 * cycle, blocks, (0, 0, 0), (1e-6,) * 3, {"cycle": cycle})
        rows.append({"cycle": cycle, "height_mean_m": 1e-6 * cycle, "dt_limit": "sound", "wall_s": 1.0, "ranks": 1,
                     "peak_memory_bytes": 7, "active_cells": 5, "cells_per_s": 1e6, "eta_s": 3.0,
                     "phases_remap_mean_s": 1.0} | table)
    with (run / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return run


def test_same_run_is_identical(tmp_path):
    """Fails when NaN is compared as a number (each field holds one), or host, ranks or seed of a checkpoint count."""
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b", wall_s=9.0, ranks=4, peak_memory_bytes=1,
                                              active_cells=1, cells_per_s=2.0, eta_s=0.0, phases_remap_mean_s=2.0)
    result = compare_runs(a, b)
    assert result.identical
    assert result.missing == result.notes == []
    places = {d.place for d in result.differences}
    assert places == {"frame 1", "frame 2", "checkpoint cycle 1 step 100", "checkpoint cycle 2 step 200",
                      "table row 1", "table row 2"}
    names = {d.name for d in result.differences if d.place == "table row 1"}
    assert names == {"cycle", "height_mean_m", "dt_limit"}
    names = {d.name for d in result.differences if d.place.startswith("checkpoint cycle 1")}
    assert names == {"mass", "peeq", "step", "time_s", "ledger.heat_J", "quanta"}
    assert format_comparison(result).startswith("identical in every saved bit")


def test_one_bit_is_found(tmp_path):
    """Fails when values are compared with a tolerance, or when the frames alone are (float32 hides the bit)."""
    def flip(data: np.ndarray) -> None:
        data.view(np.uint64)[1, 2, 3] ^= np.uint64(1)

    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b", changed={(2, "peeq"): flip})
    result = compare_runs(a, b)
    assert not result.identical
    (found,) = [d for d in result.differences if d.different]
    assert (found.place, found.cycle, found.name) == ("checkpoint cycle 2 step 200", 2, "peeq")
    assert (found.different, found.bits, found.values) == (1, 1, 60)
    assert found.maximum == np.spacing(abs(field("peeq", 2)[1, 2, 3]))
    assert "1 of 60" in format_comparison(result)
    assert format_comparison(result).splitlines()[-1].startswith("not identical: 1 of")


def test_signed_zero_and_nan_payload_are_bits(tmp_path):
    def signed(data: np.ndarray) -> None:
        data[3, 2, 4] = -0.0

    def unsigned(data: np.ndarray) -> None:
        data[3, 2, 4] = 0.0

    result = compare_runs(make_run(tmp_path / "a", (1,), {(1, "mass"): signed}),
                          make_run(tmp_path / "b", (1,), {(1, "mass"): unsigned}))
    assert not result.identical
    assert [(d.name, d.maximum, d.different) for d in result.differences if d.different] == [("mass", 0.0, 1)] * 2


def test_array_numbers():
    """Hand values. Fails when ``relative`` divides by the largest value instead of the range."""
    a = np.array([1.0, 2.0, 5.0, np.nan, np.nan])
    b = np.array([1.0, 2.5, 5.0, np.nan, np.nan])
    found = compare_arrays("here", None, "x", a, b)
    assert (found.maximum, found.relative, found.different, found.values) == (0.5, 0.125, 1, 5)
    b[3] = 0.0
    found = compare_arrays("here", None, "x", a, b)
    assert (found.maximum, found.relative, found.different) == (math.inf, math.inf, 2)
    assert compare_arrays("here", None, "x", a, a[:4]).different == 5
    assert compare_arrays("here", None, "x", a, a.astype(np.float32)).different == 5
    assert compare_arrays("here", None, "x", np.ones(3), np.full(3, 2.0)).relative == 1.0
    same_infinity = compare_arrays("here", None, "x", np.array([np.inf]), np.array([np.inf]))
    assert (same_infinity.maximum, same_infinity.different) == (0.0, 0)


def test_missing_files_and_rows_count(tmp_path):
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    (b / "frames" / layout.frame_name(1)).unlink()
    result = compare_runs(a, b)
    assert not result.identical
    assert len(result.missing) == 1
    assert "frame_000001" in result.missing[0]
    (a / "frames" / layout.frame_name(1)).unlink()
    assert compare_runs(a, b).identical
    table = b / "summary.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:2]) + "\n")
    assert "1 in" in compare_runs(a, b).missing[0]
    table.unlink()
    assert not compare_runs(a, b).identical


def test_table_values_and_attributes_count(tmp_path):
    """Fails when ``_numbers`` does not go into nested attributes."""
    a = make_run(tmp_path / "a", (1,))
    b = make_run(tmp_path / "b", (1,), height_mean_m=2e-6, dt_limit="strain")
    changed = {d.name: d for d in compare_runs(a, b).differences if d.different}
    assert set(changed) == {"height_mean_m", "dt_limit"}
    assert changed["height_mean_m"].maximum == 1e-6
    assert changed["height_mean_m"].relative == 0.5
    c = make_run(tmp_path / "c", (1,), heat_J=np.nextafter(1 / 3, 1))
    assert {d.name for d in compare_runs(a, c).differences if d.different} == {"ledger.heat_J"}
    d = make_run(tmp_path / "d", (1,), more=1)
    assert {d.name for d in compare_runs(a, d).differences if d.different} == {"quanta"}


@pytest.mark.parametrize(("key", "time", "origin", "spacing"), [
    ("time_s", 2e-7, 0.0, 1e-6), ("origin", 1e-7, 1e-9, 1e-6), ("spacing", 1e-7, 0.0, 2e-6)])
def test_time_and_place_of_a_frame_count(tmp_path, key, time, origin, spacing):
    """The same values elsewhere are no equal frame; fails when ``_compare_frames`` leaves out one of the four keys."""
    a, b = make_run(tmp_path / "a", (1,)), make_run(tmp_path / "b", (1,))
    blocks = [Block(name, field(name, 1), (0, 0, 0), SHAPE) for name in ("mass", "peeq")]
    vtkhdf.write_frame(b / "frames", 1, time, blocks, (0, 0, origin), (1e-6, spacing, 1e-6), {"cycle": 1})
    result = compare_runs(a, b)
    assert not result.identical
    assert {(d.place, d.name) for d in result.differences if d.different} == {("frame 1", key)}


def add_view_and_tracers(run: pathlib.Path, speed: float = 1.0, peeq: float = 0.5,
                         centre: float = 2e-5) -> pathlib.Path:
    """Add a view of one frame and the points of one particle to a run."""
    blocks = [Block("speed", np.full(SHAPE, speed), (0, 0, 0), SHAPE)]
    vtkhdf.write_frame(run / layout.VIEW, 0, 1e-8, blocks, (0, 0, 0), (1e-6,) * 3, {})
    table = tracers.ParticleTable(np.full(1, 1e-5), np.full((1, 3), centre), np.zeros(1), np.zeros(1, dtype=bool))
    points = [np.full(2, value) for value in (1.0, peeq, 300.0)]
    cloud = tracers.TracerCloud(1e-7, np.zeros(2, dtype=np.int64), np.full((2, 3), 1e-5), *points, table, (0, 2))
    tracers.write_tracers(run, 1, cloud, {})
    return run


@pytest.mark.parametrize(("changed", "place", "name"), [
    ({"speed": 1.5}, "view 0", "speed"), ({"peeq": 0.25}, "tracers of cycle 1", "peeq"),
    ({"centre": 3e-5}, "tracers of cycle 1", "particles/centre")])
def test_view_and_tracers_count(tmp_path, changed, place, name):
    """Fails when ``compare_runs`` looks at the frames alone, or leaves out ``_compare_tracers``."""
    a, b, c = (make_run(tmp_path / folder, (1,)) for folder in "abc")
    for run in (a, b):
        add_view_and_tracers(run)
    result = compare_runs(a, b)
    assert result.identical
    assert {"view 0", "tracers of cycle 1"} <= {d.place for d in result.differences}
    result = compare_runs(a, add_view_and_tracers(c, **changed))
    assert not result.identical
    assert {(d.place, d.name) for d in result.differences if d.different} == {(place, name)}


def test_a_view_and_tracers_of_one_run_only_are_missing(tmp_path):
    a, b = add_view_and_tracers(make_run(tmp_path / "a", (1,))), make_run(tmp_path / "b", (1,))
    result = compare_runs(a, b)
    assert not result.identical
    assert result.missing == [str(b / layout.VIEW / layout.frame_name(0)), str(tracers.tracer_path(b, 1))]
    add_view_and_tracers(b)
    tracers.tracer_path(b, 1).write_bytes(b"no points")
    assert ["damaged file of tracers" in text for text in compare_runs(a, b).missing] == [True]


def test_what_only_one_run_has_is_missing(tmp_path):
    """A field of a frame, a field and a number of a checkpoint, a number in a list, a column of the table.

    Fails when only what both have is looked at, or lists in the attributes are not gone into.
    """
    a, b = make_run(tmp_path / "a", (1,)), make_run(tmp_path / "b", (1,), more_m=1.0)
    mass, peeq = (Block(name, field(name, 1), (0, 0, 0), SHAPE) for name in ("mass", "peeq"))
    result = compare_runs(a, b)
    assert not result.identical
    assert [text.split(": ")[1:] for text in result.missing] == [["table row 1", "more_m"]]
    b = make_run(tmp_path / "c", (1,))
    vtkhdf.write_frame(b / "frames", 1, 1e-7, [mass], (0, 0, 0), (1e-6,) * 3, {"cycle": 1})
    for run, blocks, attributes in ((a, [mass, peeq], {"step": 200, "list": [1, 2.5], "one": 1}),
                                    (b, [mass], {"step": 200, "list": [1, 2.0], "two": 1})):
        checkpoint.write_checkpoint(run / "checkpoints", 2, blocks, attributes)
    result = compare_runs(a, b)
    place = "checkpoint cycle 2 step 200"
    assert [text.split(": ")[1:] for text in result.missing] == [["frame 1", "peeq"], [place, "peeq"], [place, "one"],
                                                                 [place, "two"]]
    assert {(d.place, d.name) for d in result.differences if d.different} == {(place, "list[1]")}


def test_runs_of_which_nothing_can_be_compared_are_not_identical(tmp_path):
    """Both hold an unfinished checkpoint only; fails when ``identical`` leaves out ``bool(self.differences)``."""
    for name in ("a", "b"):
        folder = runs.prepare_run_folder(tmp_path / name) / "checkpoints"
        (folder / layout.checkpoint_name(1, 1)).touch()
    result = compare_runs(tmp_path / "a", tmp_path / "b")
    assert (result.missing, result.differences) == ([], [])
    assert not result.identical


def test_only_the_newest_checkpoint_must_be_the_same(tmp_path):
    """A stop and resume leaves another set of older checkpoints: told, no difference."""
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    blocks = [Block("mass", field("mass", 1), (0, 0, 0), SHAPE)]
    checkpoint.write_checkpoint(b / "checkpoints", 2, blocks, {"step": 150})
    result = compare_runs(a, b)
    assert result.identical
    assert ["step 150 only in" in note for note in result.notes] == [True]
    checkpoint.write_checkpoint(b / "checkpoints", 3, blocks, {"step": 300})
    result = compare_runs(a, b)
    assert not result.identical
    assert "newest checkpoint" in result.missing[0]


def test_damaged_files_are_told(tmp_path):
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    (b / "frames" / layout.frame_name(2)).write_bytes(b"no frame")
    (b / "checkpoints" / layout.checkpoint_name(2, 200)).write_bytes(b"short")
    result = compare_runs(a, b)
    assert not result.identical
    assert any("not a readable frame" in text for text in result.missing)
    assert any("the manifest says" in text for text in result.notes)
    assert any("newest checkpoint" in text for text in result.missing)


def test_compare_wants_two_runs(tmp_path):
    a = make_run(tmp_path / "a", (1,))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no such folder"):
        compare_runs(a, tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no frames"):
        compare_runs(tmp_path / "empty", a)


@pytest.mark.mpi
def test_run_folder_is_made_once(shared_path):
    """Fails when ``prepare_run_folder`` only looks for a summary: a run that died early has none.

    Fails, too, when it advises to resume a run that has no finished checkpoint.
    """
    run = runs.prepare_run_folder(shared_path / "deep" / "run")
    assert sorted(path.name for path in run.iterdir()) == ["checkpoints", "frames"]
    with pytest.raises(InputError, match="holds a run already, without a checkpoint to continue from; remove it, or"):
        runs.prepare_run_folder(run)
    mpi.barrier()
    if mpi.is_root():
        for ending in (".h5", ".json"):
            (run / "checkpoints" / layout.checkpoint_name(1, 20)).with_suffix(ending).touch()
    mpi.barrier()
    with pytest.raises(InputError, match=r"f2s resume .*run"):
        runs.prepare_run_folder(run)
    mpi.barrier()
    if mpi.is_root():
        run.rename(run.with_name("my run"))
    mpi.barrier()
    with pytest.raises(InputError, match=r"'f2s resume '.*my run''"):  # (a shell must get it as one word)
        runs.prepare_run_folder(run.with_name("my run"))
    mpi.barrier()
    if mpi.is_root():
        (shared_path / "other").mkdir()
        (shared_path / "other" / "thesis.tex").touch()
        (shared_path / "empty").mkdir()
    mpi.barrier()
    with pytest.raises(InputError, match="is not empty"):
        runs.prepare_run_folder(shared_path / "other")
    with pytest.raises(InputError, match="is a file"):
        runs.prepare_run_folder(shared_path / "other" / "thesis.tex")
    with pytest.raises(InputError, match="cannot be made"):
        runs.prepare_run_folder(shared_path / "other" / "thesis.tex" / "run")
    assert runs.prepare_run_folder(shared_path / "empty") == shared_path / "empty"


def test_summary(tmp_path):
    with pytest.raises(InputError, match=r"is .* the folder of a run"):
        runs.read_summary(tmp_path)
    (tmp_path / "summary.json").write_text('{"status": "complete", "steps": 7}')
    assert runs.read_summary(tmp_path) == {"status": "complete", "steps": 7}
    (tmp_path / "summary.json").write_text('{"status": ')
    with pytest.raises(InputError, match="not JSON"):
        runs.read_summary(tmp_path)
    (tmp_path / "summary.json").write_text("[]")
    with pytest.raises(InputError, match="not a JSON object"):
        runs.read_summary(tmp_path)


def test_serial_readers_name_what_is_there(tmp_path):
    run = make_run(tmp_path / "a")
    assert runs.list_frames(run) == [1, 2]
    with pytest.raises(InputError, match=r"no such frame.*\[1, 2\]"):
        runs.open_frame(run, 3)
    with pytest.raises(InputError, match="no field 'speed'; it holds mass, peeq"):
        runs.open_frame(run, 1, ["speed"])
    path = checkpoint.list_checkpoints(run / "checkpoints")[-1]
    arrays, attributes = runs.open_checkpoint_serial(path, ["mass"])
    assert list(arrays) == ["mass"]
    assert attributes["time_s"] == 0.2
    with pytest.raises(CheckpointError, match="no field 'speed'"):
        runs.open_checkpoint_serial(path, ["speed"])
    path.with_suffix(".json").unlink()
    with pytest.raises(CheckpointError, match="never finished"):
        runs.open_checkpoint_serial(path)
    (run / "frames" / layout.frame_name(1)).write_bytes(b"")
    with pytest.raises(F2SError, match="not a readable frame"):
        runs.open_frame(run, 1)
