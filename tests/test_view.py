"""The view: a part of the box that is written more often than the whole, as a series of its own."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from conftest import f2s
from test_damaged import SCENE

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.config import dump_scene, parse_scene
from f2s_hpc.cycles import simulation
from f2s_hpc.errors import UnstableStep
from f2s_hpc.io import layout, runs, vtkhdf
from f2s_hpc.io.runs import read_frame_meta

FIELDS = ("volume_fraction", "speed", "velocity_x")
VIEWED = SCENE + f"""
[output]
picture = false
fields = {list(FIELDS)}
frame_interval = "5 ns"

[output.view]
x = ["9 um", "31 um"]
y = "13 um"
interval = "5 ns"
"""


def pictures(folder) -> list:
    """Return the frames of the view in a run folder, in order."""
    return sorted((folder / layout.VIEW).glob("frame_*.vtkhdf"))


def held(path, fields=FIELDS) -> tuple[dict, runs.FrameMeta]:
    """Return the arrays of a frame file and what it is."""
    meta = read_frame_meta(path)
    with h5py.File(path) as file:
        return {name: file[f"{layout.VTK_ROOT}/{meta.locations[name]}/{name}"][...] for name in fields}, meta


@pytest.mark.mpi
def test_a_view_holds_what_a_frame_holds_there(shared_path, capsys):
    """Cells and nodes, cut out of the frames of the same steps, on any rank count.

    Fails if ``write_view`` mistakes the first cell of a rank, or leaves the last layer of nodes out.
    """
    scene, folder = shared_path / "scene.toml", shared_path / "run"
    if mpi.is_root():
        scene.write_text(VIEWED, encoding="utf-8")
    mpi.barrier()
    assert main(["run", str(scene), "--out", str(folder)]) == 0
    said = capsys.readouterr().out
    if not mpi.is_root():
        return
    assert f"view {folder / 'view.vtkhdf'}" in said
    dx = parse_scene(VIEWED, "scene").domain.cell_size
    frames = {read_frame_meta(path).time_s: path for path in (folder / layout.FRAMES).glob("*.vtkhdf")}
    places = pictures(folder)
    assert len(places) >= 4
    first_x, last_x, row = int(9e-6 / dx), -int(-31e-6 // dx), int(13e-6 / dx)
    for number, path in enumerate(places):
        view, meta = held(path)
        assert meta.number == number
        np.testing.assert_allclose(meta.origin, (first_x * dx, row * dx, 0.0), atol=1e-15)
        whole, _ = held(frames[meta.time_s])
        for name in FIELDS:
            more = int(meta.locations[name] == layout.POINT_DATA)
            np.testing.assert_array_equal(
                view[name], whole[name][:, row:row + 1 + more, first_x:last_x + more], err_msg=f"{name} of {path}")
        assert view["volume_fraction"].any()
    with h5py.File(folder / "view.vtkhdf") as index:
        assert index[layout.VTK_ROOT].attrs["Type"] == b"ImageData"
        steps = index[f"{layout.VTK_ROOT}/Steps/Values"][...]
        assert len(steps) == len(places)
        last = index[f"{layout.VTK_ROOT}/CellData/speed"][-1]
    np.testing.assert_array_equal(last, held(places[-1])[0]["speed"])
    assert "view/frame_000000.vtkhdf" in (folder / "view.xmf").read_text(encoding="utf-8")


def test_a_stopped_run_goes_on_with_its_view(tmp_path, monkeypatch, capsys):
    """At another interval: what is there stays, what came after the checkpoint is replaced.

    Fails if the number of the next picture is reckoned from the time and the new interval.
    """
    scene, folder = tmp_path / "scene.toml", tmp_path / "run"
    scene.write_text(VIEWED, encoding="utf-8")
    advance = simulation.advance

    def stopped(state, model, clock, *more):
        advance(state, model, clock, *more)
        clock.stop = clock.time > 11e-9

    monkeypatch.setattr(simulation, "advance", stopped)
    assert main(["run", str(scene), "--out", str(folder)]) == 75
    before = {path: path.read_bytes() for path in pictures(folder)}
    assert len(before) == 2
    (folder / layout.VIEW / layout.frame_name(7)).write_bytes(next(iter(before.values())))
    monkeypatch.setattr(simulation, "advance", advance)
    assert main(["resume", str(folder), "--set", "output.view.interval=8 ns"]) == 0
    assert "left out" not in capsys.readouterr().out
    times = [read_frame_meta(path).time_s for path in pictures(folder)]
    assert times == sorted(times)
    assert all(path.read_bytes() == held_before for path, held_before in before.items())
    with h5py.File(folder / "view.vtkhdf") as index:
        np.testing.assert_array_equal(index[f"{layout.VTK_ROOT}/Steps/Values"][...], times)
    total = parse_scene(VIEWED, "scene").cycles.total_time
    # those of before, and one for each 8 ns from then on
    assert len(times) == 2 + int(total / 8e-9 + 1e-9) - 1
    assert vtkhdf.update_index(folder / layout.VIEW) == []


def test_a_view_that_is_moved_on_the_way_is_told_once(tmp_path, monkeypatch, capsys):
    """Fails if each picture of before gets a line of its own, or all of them one again after each cycle."""
    scene, folder, advance = tmp_path / "scene.toml", tmp_path / "run", simulation.advance
    scene.write_text(VIEWED, encoding="utf-8")

    def stopped(state, model, clock, *more):
        advance(state, model, clock, *more)
        clock.stop = clock.time > 11e-9

    monkeypatch.setattr(simulation, "advance", stopped)
    assert main(["run", str(scene), "--out", str(folder)]) == 75
    monkeypatch.setattr(simulation, "advance", advance)
    capsys.readouterr()
    assert main(["resume", str(folder), "--set", "output.view.y=21 um"]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    names = f"{layout.frame_name(0)} to {layout.frame_name(1)}"
    assert told == [(f"note: {folder / layout.VIEW}: 2 frames on another grid than the newest, left out of the index: "
                     f"{names}")]
    assert len(pictures(folder)) > 4


@pytest.mark.mpi
def test_a_view_shows_what_led_to_a_failure(shared_path, monkeypatch):
    """Fails if the index is renewed at the end of cycles and at stops only: nobody sees the film of what went wrong."""
    scene, folder, advance = shared_path / "scene.toml", shared_path / "run", simulation.advance
    if mpi.is_root():
        scene.write_text(VIEWED, encoding="utf-8")
    mpi.barrier()

    def fails(state, model, clock, *more):
        if clock.time > 11e-9:
            raise UnstableStep("the time step collapsed")
        advance(state, model, clock, *more)

    monkeypatch.setattr(simulation, "advance", fails)
    assert main(["run", str(scene), "--out", str(folder)]) == UnstableStep.exit_code
    if mpi.is_root():
        with h5py.File(folder / "view.vtkhdf") as index:
            assert len(index[f"{layout.VTK_ROOT}/Steps/Values"]) == len(pictures(folder)) == 2


def test_a_view_is_written_back_with_its_scene():
    """Fails where ``dump`` does not look into a tuple that may be absent."""
    scene = parse_scene(VIEWED, "scene")
    assert parse_scene(dump_scene(scene), "again") == scene
    assert scene.output.view.x == pytest.approx((9e-6, 31e-6))
    assert scene.output.view.z is None
    dx = scene.domain.cell_size
    assert scene.output.view.cells(scene.domain)[1] == (int(13e-6 / dx), 1)


@pytest.mark.parametrize(("setting", "says"), [
    ('view.y = "9 mm"', "reaches to 9 mm, but the box to"),
    ('view.y = ["9 um", "3 um"]', "must begin below its end"),
    ('view.y = "9 um"', "without which output.view.y has no effect"),
    ("view.y = 5", 'must be a length, as in "30 um", or two in brackets'),
    ('view.interval = "1e-30 s"', "is its unit right?"),
])
def test_a_view_that_cannot_be_is_refused(setting, says, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE + "\n[output]\n" + setting + "\n", encoding="utf-8")
    done = f2s("check", "scene.toml", cwd=tmp_path, code=2)
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_view_ends_with_the_box():
    """Fails if a layer beyond the box is asked for, or one more because of round-off."""
    scene = parse_scene(VIEWED, "scene")
    nx = scene.domain.cells[0]
    top = scene.domain.extents[0]
    view = scene.output.view.model_copy(update={"x": (0.0, top)})
    assert view.cells(scene.domain)[0] == (0, nx)
    edge = scene.output.view.model_copy(update={"x": (top, top)})
    assert edge.cells(scene.domain)[0] == (nx - 1, 1)
