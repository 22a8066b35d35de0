"""f2s export: what other codes read back is the deposit that the run has, and what a format cannot hold is refused."""

from __future__ import annotations

import pathlib
import resource
import shutil

import meshio
import numpy as np
import pytest

from f2s_hpc.analysis.mesh import boundary_triangles, enclosed_volume, height_map_triangles, hexahedra, node_means
from f2s_hpc.cli.main import main
from f2s_hpc.errors import InputError
from f2s_hpc.fields import STRESS
from f2s_hpc.io import layout, runs
from f2s_hpc.io.mesh_file import ABAQUS_STRESS, FORMATS, HEXAHEDRON, TRIANGLE, format_of
from f2s_hpc.report.deposit import FRAME_FIELDS, Deposit, load_deposit

DX = 6e-6
FIELDS = (*FRAME_FIELDS[:-1], "pressure", *STRESS, "particle_fraction")
SCENE = f"""
title = "Six particles on a small patch"

[domain]
size = ["60 um", "72 um", "150 um"]
cell_size = "6 um"
substrate_height = "30 um"
particle_layer_height = "72 um"

[material]
name = "copper-ge"

[particles]
speed = "615 m/s"
temperature = "450 degC"

[batches]
count = 1
particles = 6
seed = 3
diameter_d10 = "20 um"
diameter_d50 = "26 um"
diameter_d90 = "34 um"
diameter_min = "14 um"
diameter_max = "40 um"

[cycles]
count = 1
duration = "0.2 us"

[output]
origin = true
picture = false
fields = {[*FIELDS, "speed"]}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> pathlib.Path:
    """Return the folder of a small run."""
    folder = tmp_path_factory.mktemp("export")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    assert main(["run", str(folder / "scene.toml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def deposit(run) -> Deposit:
    return load_deposit(run)


def exported(run: pathlib.Path, path: pathlib.Path, *options: str) -> meshio.Mesh:
    """Return the mesh that the command writes to ``path``, as meshio reads it."""
    assert main(["export", str(run), "--to", str(path), *options]) == 0
    return meshio.read(path, file_format=format_of(path).name)


def volumes(mesh: meshio.Mesh) -> np.ndarray:
    """Return the volume of each hexahedron from three of its edges, negative where its corners go round wrongly."""
    corners = mesh.points[mesh.cells_dict["hexahedron"]]
    a, b, c = (corners[:, n] - corners[:, 0] for n in (1, 3, 4))
    np.testing.assert_allclose(corners[:, 6] - corners[:, 0], a + b + c, rtol=1e-6)
    return np.einsum("ij,ij->i", np.cross(a, b), c)


def unpaired_edges(triangles: np.ndarray) -> int:
    """Return how many edges are not gone along as often one way as the other: none on a closed, oriented surface."""
    edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).astype(np.int64)
    keys = edges.min(axis=1) * (edges.max() + 1) + edges.max(axis=1)
    _, index = np.unique(keys, return_inverse=True)
    return int(np.count_nonzero(np.bincount(index, np.where(edges[:, 0] < edges[:, 1], 1, -1))))


@pytest.mark.parametrize("ending", [e for e, f in FORMATS.items() if HEXAHEDRON in f.holds and e != ".inp"])
def test_cells_and_their_fields_come_back_in_every_format(run, deposit, tmp_path, ending, capfd):
    """Fails if a field belongs to another cell, is of another unit, or a format loses it (as .msh of Ansys does)."""
    mesh = exported(run, tmp_path / f"deposit{ending}", "--unit", "um")
    assert capfd.readouterr().err == ""
    kept = deposit.landed & (deposit.fraction >= 0.5)
    assert 0 < kept.sum() < deposit.landed.sum()
    np.testing.assert_allclose(volumes(mesh), 216.0, rtol=1e-9)
    assert len(volumes(mesh)) == kept.sum()
    centre = mesh.points[mesh.cells_dict["hexahedron"]].mean(axis=1)
    np.testing.assert_allclose(centre, 6.0 * (np.stack(np.nonzero(kept)[::-1], axis=1) + 0.5), rtol=1e-9)
    frame, _ = runs.open_frame(run, 0)
    assert set(FIELDS) <= set(mesh.cell_data)
    for name in FIELDS:
        unit = 1e-6 if name in ("von_mises", "pressure", *STRESS) else 1.0
        np.testing.assert_allclose(np.ravel(mesh.cell_data[name][0]), frame[name][kept] * unit, rtol=1e-6, atol=1e-12,
                                   err_msg=name)
    assert np.ptp(frame["particle_fraction"][kept]) > 0.5
    assert [path.suffix for path in sorted(tmp_path.iterdir())] == [ending]


def test_lengths_are_in_metres_and_stresses_in_pascals_unless_asked(run, deposit, tmp_path):
    """Fails if a unit of length goes with the wrong one of stress, or temperature and PEEQ are scaled too."""
    meshes = {unit: exported(run, tmp_path / f"{unit}.vtu", "--unit", unit) for unit in ("m", "mm", "um")}
    plain = exported(run, tmp_path / "plain.vtu")
    for unit, length, stress in (("m", 1.0, 1.0), ("mm", 1e3, 1e-6), ("um", 1e6, 1e-6)):
        np.testing.assert_allclose(meshes[unit].points, plain.points * length, rtol=1e-12)
        for name, factor in (("von_mises", stress), ("stress_xy", stress), ("temperature", 1.0), ("peeq", 1.0)):
            np.testing.assert_allclose(meshes[unit].cell_data[name][0], plain.cell_data[name][0] * factor, rtol=1e-12)
    assert volumes(plain).sum() == pytest.approx((deposit.landed & (deposit.fraction >= 0.5)).sum() * DX**3, rel=1e-9)


def test_a_frame_gives_what_its_checkpoint_gives(run, tmp_path):
    """Fails if fields of a frame are lost, or the pressure of a checkpoint is not that which the run shows."""
    other = tmp_path / "other"
    shutil.copytree(run, other)
    shutil.rmtree(other / layout.CHECKPOINTS)
    one, two = exported(run, tmp_path / "a.vtu"), exported(other, tmp_path / "b.vtu", "--cycle", "1")
    assert one.cell_data.keys() == two.cell_data.keys() == set(FIELDS)
    for name, (values,) in one.cell_data.items():
        np.testing.assert_array_equal(values.astype(np.float32), two.cell_data[name][0].astype(np.float32), name)


@pytest.mark.parametrize("least", ["0.01", "0.999"])
def test_least_fraction_and_substrate_choose_the_cells(run, deposit, tmp_path, least):
    """Fails if an option is not heeded, or the substrate is cut one layer off."""
    mesh = exported(run, tmp_path / "a.vtu", "--least-fraction", least, "--no-substrate", "--unit", "um")
    kept = deposit.landed & (deposit.fraction >= float(least))
    assert len(volumes(mesh)) == kept[5:].sum() > 0
    assert mesh.points[:, 2].min() == pytest.approx(30.0)
    whole = exported(run, tmp_path / "b.vtu", "--least-fraction", least)
    assert len(volumes(whole)) == kept.sum() > kept[5:].sum()
    assert (whole.cell_data["volume_fraction"][0] >= float(least)).all()


def test_abaqus_gets_the_fields_as_initial_conditions(run, tmp_path):
    """Fails if components are in the order of the run, the pressure has the wrong sign, or numbers start at 0."""
    path = tmp_path / "deposit.inp"
    mesh, fields = exported(run, path, "--unit", "mm"), exported(run, tmp_path / "a.vtu", "--unit", "mm")
    np.testing.assert_allclose(volumes(mesh), 2.16e-7, rtol=1e-5)
    np.testing.assert_array_equal(mesh.cells_dict["hexahedron"], fields.cells_dict["hexahedron"])
    text = path.read_text(encoding="ascii")
    assert "*ELEMENT, TYPE=C3D8R\n" in text
    blocks = {}
    for part in text.split("*INITIAL CONDITIONS, TYPE=")[1:]:
        name, *lines = part.splitlines()
        blocks[name] = np.array([[float(v) for v in line.split(",")] for line in lines])
        np.testing.assert_array_equal(blocks[name][:, 0], 1 + np.arange(len(lines)))
    data = {name: values for name, (values,) in fields.cell_data.items()}
    cauchy = np.stack([data[name] for name in ("stress_xx", "stress_yy", "stress_zz", "stress_xy", "stress_xz",
                                               "stress_yz")], axis=1)
    cauchy[:, :3] -= data["pressure"][:, None]
    np.testing.assert_allclose(blocks["STRESS"][:, 1:], cauchy, rtol=1e-8)
    np.testing.assert_allclose(blocks["HARDENING"][:, 1], data["peeq"], rtol=1e-8)
    corners, nodes = fields.cells_dict["hexahedron"], blocks["TEMPERATURE"][:, 1]
    assert len(nodes) == len(mesh.points)
    node = int(corners[data["temperature"].argmax(), 6])
    around = (corners == node).any(axis=1)
    assert nodes[node] == pytest.approx(np.average(data["temperature"][around],
                                                   weights=data["volume_fraction"][around]), rel=1e-8)
    below = fields.points[corners][:, :, 2].mean(axis=1) < 30e-3
    assert (mesh.cell_sets["SUBSTRATE"][0].tolist(), mesh.cell_sets["DEPOSIT"][0].tolist()) == (
        np.flatnonzero(below).tolist(), np.flatnonzero(~below).tolist())
    assert len(ABAQUS_STRESS) == 6
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.vtu", "deposit.inp"]


@pytest.mark.parametrize("ending", [e for e, f in FORMATS.items() if TRIANGLE in f.holds])
@pytest.mark.parametrize("what", ["surface", "boundary"])
def test_surfaces_are_closed_and_hold_the_volume_of_the_deposit(run, deposit, tmp_path, what, ending, capfd):
    """Fails if a face is missing or looks inwards, or a format moves points."""
    mesh = exported(run, tmp_path / f"a{ending}", "--what", what, "--unit", "um")
    assert capfd.readouterr().err == ""
    triangles = mesh.cells_dict["triangle"]
    assert unpaired_edges(triangles) == 0
    kept = deposit.landed & (deposit.fraction >= 0.5)
    cells = kept.sum() if what == "boundary" else deposit.surface.sum() / DX
    assert enclosed_volume(mesh.points, triangles) == pytest.approx(216.0 * cells, rel=1e-6)


def test_the_default_is_what_the_format_is_for(run, deposit, tmp_path):
    """Fails if a file of triangles gets the boundary of the cells, or an open surface gets a bottom."""
    assert exported(run, tmp_path / "a.msh").cells_dict.keys() == {"hexahedron"}
    whole, top = exported(run, tmp_path / "a.stl"), exported(run, tmp_path / "b.ply", "--open")
    ny, nx = deposit.surface.shape
    assert len(top.cells_dict["triangle"]) == 4 * (nx + 1) * (ny + 1)
    assert len(whole.cells_dict["triangle"]) == 4 * (nx + 1) * (ny + 1) + 6 * (nx + ny + 2)
    assert top.points[:, 2].max() == pytest.approx(deposit.surface.max(), rel=1e-12)
    assert top.points[:, 2].min() == pytest.approx(deposit.surface.min(), rel=1e-12)


def test_pores_and_edges_in_common_leave_the_boundary_closed(rng):
    """Fails if the wall of a pore is left out, or points of cells that touch by an edge are counted double."""
    kept = rng.random((5, 6, 7)) < 0.6
    points, triangles = boundary_triangles(kept)
    assert enclosed_volume(points, triangles) == pytest.approx(kept.sum(), rel=1e-12)
    assert unpaired_edges(triangles) == 0
    corners = points[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    padded = np.pad(kept, 1).astype(int)
    assert area == pytest.approx(sum(np.abs(np.diff(padded, axis=axis)).sum() for axis in range(3)), rel=1e-12)
    nodes, cells = hexahedra(kept)
    assert len(np.unique(nodes, axis=0)) == len(nodes)
    assert np.ptp(node_means(cells, np.full(len(cells), 300.0), rng.random(len(cells)) + 0.1, len(nodes))) < 1e-9


def test_the_height_map_encloses_the_sum_of_the_heights(rng):
    """Fails if the triangles of a square, or the strips along the sides, weigh the columns unequally, or mirror not."""
    height = 1.0 + rng.random((4, 7))
    points, triangles = height_map_triangles(height)
    assert enclosed_volume(points, triangles) == pytest.approx(height.sum(), rel=1e-12)
    assert unpaired_edges(triangles) == 0
    for image in (height[::-1], height[:, ::-1], height.T):
        assert sorted(height_map_triangles(image)[0][:, 2]) == pytest.approx(sorted(points[:, 2]), rel=1e-14)
    height[2, 3] = 0.0
    with pytest.raises(InputError, match=r"1 columns hold nothing that has landed.*--open"):
        height_map_triangles(height)
    assert len(height_map_triangles(height, closed=False)[1]) == 4 * 5 * 8


@pytest.mark.parametrize(("name", "options", "told"), [
    ("a.stl", ["--what", "cells"], "hexahedra with fields cannot be written as '.stl'; --to may end in .vtu, .vtk"),
    ("a.bdf", [], "hexahedra with fields cannot be written as '.bdf'"),
    ("a", [], "a file without an ending"),
    ("a.inp", ["--what", "boundary"], "triangles cannot be written as '.inp'; --to may end in .vtu"),
    ("a.vtu", ["--least-fraction", "0"], "--least-fraction 0: it must be above 0 and at most 1"),
    ("a.vtu", ["--least-fraction", "nan"], "--least-fraction nan"),
    ("a.stl", ["--least-fraction", "0.4"], "--least-fraction goes with --what cells or boundary"),
    ("a.stl", ["--no-substrate"], "--no-substrate goes with"),
    ("a.vtu", ["--open"], "--open goes with --what surface"),
    ("a.vtu", ["--cycle", "7"], "nothing saved of cycle 7; there is 1"),
    ("no/a.vtu", [], "no folder"),
])
def test_what_cannot_be_exported_is_told_in_one_line(run, tmp_path, name, options, told, capfd):
    """Fails if something is written, or the message does not say what would be right."""
    assert main(["export", str(run), "--to", str(tmp_path / name), *options]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert told in line
    assert list(tmp_path.iterdir()) == []


def test_a_deposit_without_such_cells_is_told(run, tmp_path, monkeypatch, capfd):
    """Fails if a mesh without cells is written."""
    monkeypatch.setattr("f2s_hpc.report.deposit.LANDED", 0.0)
    assert main(["export", str(run), "--to", str(tmp_path / "a.vtu")]) == 2
    assert "no landed cell with a volume fraction of 0.5 or more" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".vtu", ".inp", ".med", ".xdmf", ".msh"])
def test_a_full_disk_leaves_the_older_file(run, tmp_path, ending, capfd):
    """Fails if a file is written in place, what was begun stays, or HDF5 meets the full disk."""
    path = tmp_path / f"a{ending}"
    assert main(["export", str(run), "--to", str(path)]) == 0
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    capfd.readouterr()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        code = main(["export", str(run), "--to", str(path)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2
    assert f"{path}: cannot be written" in capfd.readouterr().err
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
