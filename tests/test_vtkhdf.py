"""Frames and their index: what the files hold, and what the reader of ParaView makes of them."""

from __future__ import annotations

import itertools
import os
import pathlib
import xml.etree.ElementTree as ET

import h5py
import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.errors import F2SError, InputError
from f2s_hpc.io import layout, runs, vtkhdf
from f2s_hpc.io.layout import Block

CELLS = (9, 6, 11)  # z, y, x
NODES = tuple(n + 1 for n in CELLS)
ORIGIN, SPACING = (1e-6, -2e-6, 3e-6), (1e-6, 1.5e-6, 2e-6)
CELL_FIELDS = ("volume_fraction", "peeq", "temperature")


def whole_field(name: str, number: int) -> np.ndarray:
    """Return a smooth field that tells x, y, z, field and frame apart."""
    shape = NODES if name.startswith("velocity") else CELLS
    k, j, i = np.indices(shape)
    return (len(name) + 100.0 * number) + 1e-3 * i + 0.1 * j + 3.0 * k + 1e-11


def boxes(split: str, node: bool) -> list[tuple]:
    """Return per rank (start, shape) (k, j, i): uneven slabs along z or x, or a grid of 2 along y."""
    size = mpi.size()
    ranks = {"z": (size, 1, 1), "x": (1, 1, size)}.get(split, (1, 2, size // 2) if size % 2 == 0 else (1, size, 1))
    axes = []
    for count, parts in zip(CELLS, ranks, strict=True):
        bounds = [*range(parts), count]  # all but the last one are a single layer
        axes.append([(a, b - a + (node and b == count)) for a, b in itertools.pairwise(bounds)])
    return [tuple(zip(*axis, strict=True)) for axis in itertools.product(*axes)]


def my_blocks(number: int, split: str = "z", names=(*CELL_FIELDS, "velocity_z")) -> list[Block]:
    """Return this rank's blocks, as views into arrays with a ghost layer."""
    blocks = []
    for name in names:
        whole = whole_field(name, number)
        start, shape = boxes(split, name.startswith("velocity"))[mpi.rank()]
        ghosted = np.full(tuple(n + 2 for n in shape), np.nan)
        ghosted[1:-1, 1:-1, 1:-1] = whole[layout.box_selection(start, shape)]
        blocks.append(Block(name, ghosted[1:-1, 1:-1, 1:-1], start, whole.shape))
    return blocks


def write(frames: pathlib.Path, number: int, split: str = "z", **options) -> pathlib.Path:
    return vtkhdf.write_frame(frames, number, 1e-7 * (number + 1), my_blocks(number, split, **options), ORIGIN, SPACING,
                              {"cycle": number, "scene": 'size = "3 µm"\n' * 6000})


@pytest.fixture
def frames(shared_path: pathlib.Path) -> pathlib.Path:
    """Return the frames folder of one run folder for all ranks."""
    return runs.prepare_run_folder(shared_path / "run") / "frames"


@pytest.mark.mpi
@pytest.mark.parametrize("split", ["z", "x", "grid"])
@pytest.mark.parametrize("at_once", [1, 2**20])
def test_frame_holds_the_whole_field_in_float32(frames, split, at_once, monkeypatch):
    """Fails when ``write_collective`` ignores ``start`` (2 ranks or more), or writes float64."""
    monkeypatch.setattr(layout, "AT_ONCE", at_once)
    path = write(frames, 3, split)
    arrays, meta = runs.open_frame(frames.parent, 3)
    for name in (*CELL_FIELDS, "velocity_z"):
        assert arrays[name].dtype == np.float32
        assert np.array_equal(arrays[name], whole_field(name, 3).astype(np.float32))
    assert (meta.number, meta.time_s, meta.cells) == (3, 4e-7, (11, 6, 9))
    assert (meta.origin, meta.spacing) == (ORIGIN, SPACING)
    assert meta.locations == {**dict.fromkeys(sorted(CELL_FIELDS), "CellData"), "velocity_z": "PointData"}
    assert meta.provenance == {"cycle": 3, "scene": 'size = "3 µm"\n' * 6000}
    assert path.name == "frame_000003.vtkhdf"
    assert list(runs.open_frame(frames.parent, 3, ["peeq"])[0]) == ["peeq"]
    part = runs.frame_fields(frames.parent, 3, ["peeq"])[0]["peeq"]
    assert part.shape == arrays["peeq"].shape
    assert np.array_equal(part[2:4, :, 1], arrays["peeq"][2:4, :, 1])


@pytest.mark.mpi
def test_frame_follows_the_format(frames):
    """The attributes that readers insist on. Fails when ``Type`` is written as a plain Python string."""
    path = write(frames, 0)
    with h5py.File(path, "r") as file:
        root = file["VTKHDF"]
        kind = root.attrs.get_id("Type").get_type()
        assert not kind.is_variable_str()
        assert (kind.get_size(), root.attrs["Type"]) == (9, b"ImageData")
        assert root.attrs["WholeExtent"].tolist() == [0, 11, 0, 6, 0, 9]
        assert root.attrs["Version"].tolist() == [1, 0]
        assert root.attrs["Direction"].tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        assert "Steps" not in root
        assert (root["CellData/peeq"].compression, root["CellData/peeq"].shuffle) == ("gzip", True)


@pytest.mark.mpi
def test_every_array_tells_its_unit(frames):
    """In the frame and in the index. Fails when ``write_frame`` or ``_write_index`` does not pass the units on."""
    expected = {"peeq": b"1", "temperature": b"K", "von_mises": b"Pa", "velocity_x": b"m/s", "stress_xx": b"Pa"}
    path = write(frames, 0, names=tuple(expected))
    vtkhdf.update_index(frames)
    for name in (path, frames.parent / "deposit.vtkhdf"):
        with h5py.File(name, "r") as file:
            root = file["VTKHDF"]
            found = {field: dataset.attrs["units"] for place in ("CellData", "PointData")
                     for field, dataset in root[place].items()}
            assert found == expected
            assert not root["CellData/peeq"].attrs.get_id("units").get_type().is_variable_str()
            if "Steps" in root:
                assert root["Steps/Values"].attrs["units"] == b"s"


@pytest.mark.mpi
def test_cells_or_nodes_by_shape_and_by_name(frames):
    """Fails when ``_located`` leaves out the table of fields: velocities alone then pass for cells."""
    write(frames, 0, names=("velocity_x", "velocity_z"))
    write(frames, 1, names=("peeq", "von_mises"))
    metas = [runs.open_frame(frames.parent, number)[1] for number in (0, 1)]
    assert metas[0].cells == metas[1].cells == (11, 6, 9)
    assert set(metas[0].locations.values()) == {"PointData"}
    assert set(metas[1].locations.values()) == {"CellData"}


@pytest.mark.mpi
def test_refused_frames_leave_nothing(frames, monkeypatch):
    blocks = my_blocks(0, names=("peeq",))
    odd = Block("odd", np.zeros((1, 1, 2)), (0, 0, 2 * mpi.rank()), (1, 1, 2 * mpi.size()))
    with pytest.raises(F2SError, match="one more per axis"):
        vtkhdf.write_frame(frames, 0, 0.0, [*blocks, odd], ORIGIN, SPACING, {})
    with pytest.raises(F2SError, match="no fields"):
        vtkhdf.write_frame(frames, 0, 0.0, [], ORIGIN, SPACING, {})
    write_as_told = layout.write_collective

    def lose(dataset, block, slab):
        write_as_told(dataset, Block(block.name, 0.0 * block.data, block.start, block.global_shape), slab)

    monkeypatch.setattr(layout, "write_collective", lose)
    with pytest.raises(F2SError, match=r"frame 0.*'peeq' does not read back"):
        vtkhdf.write_frame(frames, 0, 0.0, blocks, ORIGIN, SPACING, {})
    mpi.barrier()
    assert not list(frames.iterdir())


@pytest.mark.mpi
def test_values_beyond_float32(frames):
    """A value too large for float32 is shown as infinite; NaN stays NaN."""
    whole = np.full(CELLS, 1e300)
    start, shape = boxes("z", False)[mpi.rank()]
    whole[0, 0, 0] = np.nan
    block = Block("peeq", whole[layout.box_selection(start, shape)], start, CELLS)
    vtkhdf.write_frame(frames, 0, 0.0, [block], ORIGIN, SPACING, {})
    peeq = runs.open_frame(frames.parent, 0)[0]["peeq"]
    assert np.isnan(peeq[0, 0, 0])
    assert np.isinf(peeq.ravel()[1:]).all()


@pytest.mark.mpi
def test_index_follows_the_frames_that_exist(frames):
    """Fails when ``_write_index`` maps step s to frame number s: frame 1 is missing here."""
    numbers = (0, 2, 5)
    for number in numbers:
        write(frames, number)
    assert vtkhdf.update_index(frames) == []
    index = frames.parent / "deposit.vtkhdf"
    with h5py.File(index, "r") as file:
        root = file["VTKHDF"]
        assert root.attrs["Version"].tolist() == [2, 0]
        assert root["Steps"].attrs["NSteps"] == 3
        assert root["Steps/Values"][...].tolist() == [1e-7 * (n + 1) for n in numbers]
        for place, name in [*(("CellData", n) for n in CELL_FIELDS), ("PointData", "velocity_z")]:
            assert root[f"{place}/{name}"].is_virtual
            assert root[f"Steps/{place}Offsets/{name}"][...].tolist() == [0, 1, 2]
            for step, number in enumerate(numbers):
                assert np.array_equal(root[f"{place}/{name}"][step], whole_field(name, number).astype(np.float32))
    mpi.barrier()
    if mpi.is_root():
        (frames / "frame_000002.vtkhdf").unlink()
        (frames / ".frame_000009.vtkhdf.partial").write_bytes(b"half")
        os.truncate(frames / "frame_000005.vtkhdf", 3000)
    mpi.barrier()
    notes = vtkhdf.update_index(frames)
    assert len(notes) == 1
    assert "frame_000005.vtkhdf: not a readable frame" in notes[0]
    with h5py.File(index, "r") as file:
        assert file["VTKHDF/Steps/Values"][...].tolist() == [1e-7]


@pytest.mark.mpi
def test_index_survives_a_move_of_the_run(frames):
    """Fails when the index names its sources by absolute path."""
    write(frames, 0)
    write(frames, 1)
    vtkhdf.update_index(frames)
    moved = frames.parent.with_name("moved")
    if mpi.is_root():
        frames.parent.rename(moved)
    mpi.barrier()
    with h5py.File(moved / "deposit.vtkhdf", "r") as file:
        assert np.array_equal(file["VTKHDF/CellData/peeq"][0], whole_field("peeq", 0).astype(np.float32))


@pytest.mark.mpi
def test_one_frame_alone_is_read_without_an_axis_for_the_steps(frames):
    """As VTK 9.3 to 9.6 take a file of one step. Fails when its arrays are (1, nz, ny, nx): none of them is read."""
    write(frames, 0)
    vtkhdf.update_index(frames)
    with h5py.File(frames.parent / "deposit.vtkhdf", "r") as file:
        assert np.array_equal(file["VTKHDF/CellData/peeq"][...], whole_field("peeq", 0).astype(np.float32))
        assert file["VTKHDF/Steps"].attrs["NSteps"] == 1


@pytest.mark.mpi
def test_frames_that_do_not_fit_stay_out_of_the_index(frames):
    """Another grid, a later time under a lower number, and a field that one frame lacks."""
    vtkhdf.write_frame(frames, 0, 0.0, my_blocks(0), ORIGIN, (2e-6, 2e-6, 2e-6), {})
    vtkhdf.write_frame(frames, 1, 9e-7, my_blocks(1), ORIGIN, SPACING, {})
    write(frames, 2, names=("peeq", "velocity_z"))
    write(frames, 3)
    notes = vtkhdf.update_index(frames)
    assert ["another grid" in notes[0], "not earlier than frame_000002" in notes[1], len(notes)] == [True, True, 2]
    with h5py.File(frames.parent / "deposit.vtkhdf", "r") as file:
        assert file["f2s"].attrs["frames"].tolist() == [2, 3]
        assert sorted(file["VTKHDF/CellData"]) == ["peeq"]


@pytest.mark.mpi
def test_of_two_frames_of_one_time_the_index_takes_the_newer(frames):
    """Times must rise for ParaView; fails when ``>=`` of ``_usable_frames`` becomes ``>``."""
    for number in (0, 1):
        vtkhdf.write_frame(frames, number, 1e-7, my_blocks(number), ORIGIN, SPACING, {})
    (note,) = vtkhdf.update_index(frames)
    assert "frame_000000.vtkhdf: not earlier than frame_000001" in note
    with h5py.File(frames.parent / "deposit.vtkhdf", "r") as file:
        assert file["f2s"].attrs["frames"].tolist() == [1]


@pytest.mark.mpi
def test_an_index_that_cannot_be_renewed_stays_as_it_was(frames, monkeypatch):
    """Fails when ``_update_index`` writes into the index itself: a full disk would leave half of it."""
    write(frames, 0)
    vtkhdf.update_index(frames)
    index = frames.parent / "deposit.vtkhdf"
    before = index.read_bytes()
    write(frames, 1)

    def half(file, *_):
        file.create_group("VTKHDF")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(vtkhdf, "_write_index", half)
    with pytest.raises(F2SError, match=r"cannot write deposit\.vtkhdf.*No space left"):
        vtkhdf.update_index(frames)
    assert index.read_bytes() == before


@pytest.mark.mpi
def test_no_frames_no_index(frames):
    assert vtkhdf.update_index(frames) == []
    assert not (frames.parent / "deposit.vtkhdf").exists()
    with pytest.raises(InputError, match="no frames"):
        runs.open_frame(frames.parent, 0)


@pytest.mark.mpi
def test_sidecar_points_at_the_same_values(frames):
    """The XDMF text, read as XML. Fails when ``_grid`` gives origin and spacing in x, y, z order."""
    for number in (0, 4):
        write(frames, number)
    vtkhdf.update_index(frames)
    tree = ET.parse(frames.parent / "deposit.xmf")
    grids = tree.findall("./Domain/Grid[@CollectionType='Temporal']/Grid")
    assert [float(grid.find("Time").get("Value")) for grid in grids] == [1e-7, 5e-7]
    assert grids[0].find("Topology").get("Dimensions") == "10 7 12"
    items = [item.text.split() for item in grids[0].findall("Geometry/DataItem")]
    assert [[float(v) for v in item] for item in items] == [list(ORIGIN[::-1]), list(SPACING[::-1])]
    for grid, number in zip(grids, (0, 4), strict=True):
        attributes = {a.get("Name"): a for a in grid.findall("Attribute")}
        assert {name: a.get("Center") for name, a in attributes.items()} == {
            **dict.fromkeys(CELL_FIELDS, "Cell"), "velocity_z": "Node"}
        for name, attribute in attributes.items():
            item = attribute.find("DataItem")
            source, dataset = item.text.split(":")
            with h5py.File(frames.parent / source, "r") as file:
                assert np.array_equal(file[dataset][...], whole_field(name, number).astype(np.float32))
                assert item.get("Dimensions") == " ".join(map(str, file[dataset].shape))


def vtk_arrays(hdf, path: pathlib.Path, time: float | None = None) -> tuple:
    """Read a file as ParaView does; return the image and its arrays [k, j, i]."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = hdf.vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    if time is None:
        reader.Update()
    else:
        reader.UpdateTimeStep(time)
    image = reader.GetOutput()
    arrays = {}
    for data, shape in [(image.GetCellData(), CELLS), (image.GetPointData(), NODES)]:
        for number in range(data.GetNumberOfArrays()):
            arrays[data.GetArrayName(number)] = vtk_to_numpy(data.GetArray(number)).reshape(shape)
    return reader, image, arrays


def check_image(image, arrays: dict, number: int) -> None:
    assert image.GetDimensions() == (12, 7, 10)
    assert np.allclose(image.GetOrigin(), ORIGIN, rtol=1e-15, atol=0.0)
    assert np.allclose(image.GetSpacing(), SPACING, rtol=1e-15, atol=0.0)
    for name in (*CELL_FIELDS, "velocity_z"):
        assert np.array_equal(arrays[name], whole_field(name, number).astype(np.float32))


def test_vtk_reads_frames_and_index(tmp_path, monkeypatch):
    """The reader of ParaView gives geometry, values and times back.

    Fails when ``_image_head`` gives the extent in z, y, x order, or ``_write_index`` the times in us.
    """
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    frames = runs.prepare_run_folder(tmp_path / "run") / "frames"
    for number in (0, 2, 5):
        write(frames, number)
    vtkhdf.update_index(frames)
    _, image, arrays = vtk_arrays(hdf, frames / "frame_000002.vtkhdf")
    check_image(image, arrays, 2)
    monkeypatch.chdir(tmp_path)
    for number in (5, 0, 2):
        reader, image, arrays = vtk_arrays(hdf, frames.parent / "deposit.vtkhdf", 1e-7 * (number + 1))
        check_image(image, arrays, number)
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    assert list(times) == [1e-7 * (n + 1) for n in (0, 2, 5)]
