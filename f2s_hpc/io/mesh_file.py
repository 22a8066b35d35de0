"""Meshes in the formats of other codes, through meshio: which ending can hold what, and whole files or none."""

from __future__ import annotations

import io
import os
import pathlib
import tempfile
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc import places
from f2s_hpc.errors import InputError

HEXAHEDRON, TRIANGLE = "hexahedron", "triangle"


@dataclass(frozen=True)
class Format:
    """What one ending stands for: the library's name of the format, what it can hold, settings of its writer."""

    name: str
    holds: tuple[str, ...] = (HEXAHEDRON, TRIANGLE)
    settings: dict = field(default_factory=dict)


_SURFACE = (TRIANGLE,)
FORMATS: dict[str, Format] = {
    ".vtu": Format("vtu"), ".vtk": Format("vtk"),
    ".xdmf": Format("xdmf", settings={"data_format": "XML"}), ".xmf": Format("xdmf", settings={"data_format": "XML"}),
    ".msh": Format("gmsh"),  # (the library's first guess for this ending, Ansys, holds no fields)
    ".med": Format("med"), ".avs": Format("avsucd"), ".dat": Format("tecplot"), ".tec": Format("tecplot"),
    ".inp": Format("abaqus", (HEXAHEDRON,), {"float_fmt": ".9e"}),
    ".stl": Format("stl", _SURFACE, {"binary": True}), ".ply": Format("ply", _SURFACE),
    ".obj": Format("obj", _SURFACE), ".off": Format("off", _SURFACE)}
"""Formats that hold hexahedra hold their fields, too (.inp as initial conditions); others are not in this table."""

ABAQUS_STRESS = ("stress_xx", "stress_yy", "stress_zz", "stress_xy", "stress_xz", "stress_yz")
"""Order of the components in Abaqus: 11, 22, 33, 12, 13, 23."""

ABAQUS_ELEMENT = "C3D8R"  # (the one that Abaqus/Standard and Abaqus/Explicit both have)


@dataclass(frozen=True, eq=False)
class Mesh:
    """What is written: ``points`` (n, 3); ``cells`` (m, 8) or (m, 3), indices of points; ``cell_data`` float64, (m,).

    For Abaqus only: ``node_temperature`` (n,); ``cell_sets``: names and indices of cells; ``heading``: one line.
    """

    points: np.ndarray
    cells: np.ndarray
    cell_data: dict[str, np.ndarray] = field(default_factory=dict)
    node_temperature: np.ndarray | None = None
    cell_sets: dict[str, np.ndarray] = field(default_factory=dict)
    heading: str = ""

    @property
    def kind(self) -> str:
        """Kind of the cells."""
        return HEXAHEDRON if self.cells.shape[1] == 8 else TRIANGLE


def format_of(path: str | os.PathLike) -> Format | None:
    """Return the format that the ending of ``path`` stands for, None for endings that are not in ``FORMATS``."""
    return FORMATS.get(pathlib.Path(path).suffix.lower())


def check_mesh_file(path: str | os.PathLike, kind: str, option: str) -> None:
    """Raise ``InputError`` if cells of this ``kind`` cannot be written to ``path``, which ``option`` names."""
    found = format_of(path)
    if found is None or kind not in found.holds:
        ending = pathlib.Path(path).suffix
        content = "hexahedra with fields" if kind == HEXAHEDRON else "triangles"
        possible = ", ".join(e for e, f in FORMATS.items() if kind in f.holds)
        raise InputError(f"{path}: {content} cannot be written as " + (f"'{ending}'" if ending else
                         "a file without an ending") + f"; {option} may end in {possible}")
    places.check_file(path, option)


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write ``mesh`` in the format of the ending of ``path``, which :func:`check_mesh_file` has let pass.

    Made in a folder beside and then moved: a failure leaves an older file as it was. Raises ``InputError`` for what the
    system refuses.
    """
    # (the file that a link leads to: the link stays)
    place = pathlib.Path(os.path.realpath(path))
    try:
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as folder:
            partial = pathlib.Path(folder) / place.name
            _write(partial, format_of(path), mesh)
            os.replace(partial, place)
    except OSError as error:
        detail = error.strerror or " ".join(str(error).split())
        raise InputError(f"{path}: cannot be written ({detail}); choose a folder with room to write") from None


def initial_conditions(mesh: Mesh) -> dict[str, list[np.ndarray]]:
    """Return the initial conditions of an Abaqus file: type and columns, per element or (TEMPERATURE) per node.

    Equivalent plastic strain as HARDENING; Cauchy stress, the deviator less the pressure, where ``mesh`` has both.
    """
    data = mesh.cell_data
    found = {"HARDENING": [data["peeq"]], "TEMPERATURE": [mesh.node_temperature]}
    if "pressure" in data and set(ABAQUS_STRESS) <= data.keys():
        found["STRESS"] = [data[name] - (data["pressure"] if n < 3 else 0.0) for n, name in enumerate(ABAQUS_STRESS)]
    return found


def _write(path: pathlib.Path, kind: Format, mesh: Mesh) -> None:
    import meshio  # (needed by this command only)

    abaqus = kind.name == "abaqus"
    cells = mesh.cells.astype(np.int32) if kind.name == "ply" else mesh.cells
    whole = meshio.Mesh(mesh.points, [(mesh.kind, cells)],
                        cell_data=None if abaqus else {name: [values] for name, values in mesh.cell_data.items()},
                        cell_sets={name: [indices] for name, indices in mesh.cell_sets.items()} if abaqus else None)
    if kind.name == "med":
        # (through memory: HDF5 does not survive a full disk, and meshio does not close its file)
        content = io.BytesIO()
        meshio.write(content, whole, file_format=kind.name)
        path.write_bytes(content.getbuffer())
        return
    written = path.with_suffix(".mesh") if abaqus else path
    meshio.write(written, whole, file_format=kind.name, **kind.settings)
    if abaqus:
        _complete_abaqus(written, path, mesh)


def _complete_abaqus(source: pathlib.Path, path: pathlib.Path, mesh: Mesh) -> None:
    """Write the Abaqus file ``source`` to ``path`` with heading, element and initial conditions, which meshio lacks."""
    with source.open(encoding="ascii") as plain, path.open("w", encoding="ascii") as file:
        file.write(f"*HEADING\n{mesh.heading}\n")
        inside = False
        for line in plain:
            inside = inside or line.startswith("*NODE")
            if inside:
                file.write(f"*ELEMENT, TYPE={ABAQUS_ELEMENT}\n" if line.startswith("*ELEMENT") else line)
        for name, columns in initial_conditions(mesh).items():
            file.write(f"*INITIAL CONDITIONS, TYPE={name}\n")
            np.savetxt(file, np.column_stack([np.arange(1, len(columns[0]) + 1), *columns]),
                       fmt=", ".join(["%d", *["%.9g"] * len(columns)]))
