"""Tracer points at the end of a cycle: a VTKHDF file of points that ParaView 5.12 and newer open.

``tracers/tracers_000003.vtkhdf`` is the third cycle's. Per point: particle (its index), diameter (m), volume_fraction,
peeq and temperature (K) of its cell. Under ``/f2s/particles``: diameter, centre and time (s) when it was put onto the
grid, and whether a side of the box cuts it, per particle.
"""

from __future__ import annotations

import os
import pathlib
import re
from dataclasses import dataclass

import h5py
import numpy as np

from f2s_hpc import mpi, places
from f2s_hpc.errors import F2SError
from f2s_hpc.io import layout
from f2s_hpc.io.layout import POINT_DATA, PROVENANCE, VTK_ROOT, Block, attempt_on_root

_TABLE = f"{layout.PROVENANCE_GROUP}/particles"
_PARTICLES = ("diameter", "centre", "time", "cut")
_POINTS = {"Points": "f4", f"{POINT_DATA}/particle": "i4", f"{POINT_DATA}/diameter": "f4",
           f"{POINT_DATA}/volume_fraction": "f4", f"{POINT_DATA}/peeq": "f4", f"{POINT_DATA}/temperature": "f4"}
_UNITS = ("m", None, "m", "1", "1", "K")
_NAME = re.compile(r"tracers_(\d+)\.vtkhdf")


@dataclass(frozen=True, eq=False)
class ParticleTable:
    """Particles in the order in which they were put onto the grid.

    ``diameter`` (p,) and ``centre`` (p, 3) in m, ``time`` (s): when they were; ``cut``: a side of the box cuts it.
    """

    diameter: np.ndarray
    centre: np.ndarray
    time: np.ndarray
    cut: np.ndarray

    @classmethod
    def empty(cls) -> ParticleTable:
        """Return a table without particles."""
        return cls(np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.bool_))

    def with_more(self, more: ParticleTable) -> ParticleTable:
        """Return this table with those of ``more`` behind its own."""
        return ParticleTable(*(np.concatenate([getattr(self, name), getattr(more, name)])
                               for name in _PARTICLES))


@dataclass(frozen=True, eq=False)
class TracerCloud:
    """Points at ``time`` (s): ``particle`` (n,), index into ``particles``; ``position`` (n, 3), m; then of its cell,
    (n,), ``fraction`` (volume fraction), ``peeq`` and ``temperature`` (K).

    ``share``: number of the first point held here, and of all points there are.
    """

    time: float
    particle: np.ndarray
    position: np.ndarray
    fraction: np.ndarray
    peeq: np.ndarray
    temperature: np.ndarray
    particles: ParticleTable
    share: tuple[int, int]

    @staticmethod
    def bytes_per_point() -> int:
        """Return what a point takes in the file (bytes)."""
        return 4 * (len(_POINTS) + 2) + 16  # three places; a vertex is an offset and an index


def tracer_path(folder: str | os.PathLike, cycle: int) -> pathlib.Path:
    """Return the file of the points at the end of ``cycle`` in the run folder ``folder``."""
    return pathlib.Path(folder) / layout.TRACERS / f"tracers_{cycle:06d}.vtkhdf"


def list_tracers(folder: str | os.PathLike) -> list[int]:
    """Return the cycles at whose ends there are points in the run folder ``folder``, ascending.

    Raises ``InputError`` when they are not ours to read.
    """
    return places.numbers(pathlib.Path(folder) / layout.TRACERS, _NAME)


def write_tracers(folder: str | os.PathLike, cycle: int, cloud: TracerCloud, provenance: dict) -> pathlib.Path:
    """Write the points at the end of ``cycle`` into the run folder ``folder``; return the file's path. Collective.

    Each rank gives its own share of the numbers. There must be at least one point. Raises ``F2SError`` on all ranks.
    """
    path = tracer_path(folder, cycle)
    context = f"cannot write {path.name} in {path.parent}"

    def begin() -> str:
        path.parent.mkdir(exist_ok=True)
        return layout.encode_json(provenance)

    text = attempt_on_root(begin, context)
    first, count = cloud.share
    columns = (cloud.position, cloud.particle, cloud.particles.diameter[cloud.particle], cloud.fraction, cloud.peeq,
               cloud.temperature)
    blocks = [Block(name, column, (first, 0)[:column.ndim], (count, *column.shape[1:]))
              for name, column in zip(_POINTS, columns)]
    partial = layout.partial_path(path)
    datasets = [f"{VTK_ROOT}/{name}" for name in _POINTS]
    layout.write_shared(partial, datasets, blocks, {PROVENANCE: text}, lambda file: _prepare(file, cycle, cloud),
                        tuple(_POINTS.values()), False, F2SError, _UNITS)
    try:
        layout.attempt_together(lambda: layout.read_back(partial, datasets, blocks), context)
    except F2SError:
        attempt_on_root(lambda: partial.unlink(missing_ok=True), context)
        raise
    attempt_on_root(lambda: layout.publish(partial, path), context)
    return path


def _prepare(file: h5py.File, cycle: int, cloud: TracerCloud) -> None:
    """Make all but the points' own data: a vertex for each point, no lines or polygons, and the particles."""
    count = cloud.share[1]
    root = file.create_group(VTK_ROOT)
    root.attrs.create("Type", np.bytes_("PolyData"), dtype=h5py.string_dtype("ascii", 8))
    root.attrs["Version"] = np.array((2, 0), dtype=np.int64)
    root.create_group(POINT_DATA)
    _filled(root, "NumberOfPoints", np.array([count], dtype=np.int64))
    for kind in ("Vertices", "Lines", "Polygons", "Strips"):
        cells = count if kind == "Vertices" else 0
        group = root.create_group(kind)
        _filled(group, "NumberOfCells", np.array([cells], dtype=np.int64))
        _filled(group, "NumberOfConnectivityIds", np.array([cells], dtype=np.int64))
        _counted(group, "Offsets", cells + 1)
        _counted(group, "Connectivity", cells)
    own = file.create_group(layout.PROVENANCE_GROUP)
    own.attrs["format"] = np.int64(layout.FORMAT_VERSION)
    own.attrs["cycle"] = np.int64(cycle)
    own.attrs["time_s"] = np.float64(cloud.time)
    table = file.create_group(_TABLE)
    for name in _PARTICLES:
        array = getattr(cloud.particles, name)
        _filled(table, name, array.astype("i1") if name == "cut" else array)


def _filled(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Add a dataset: created by all ranks, filled by rank 0."""
    dataset = group.create_dataset(name, values.shape, dtype=values.dtype)
    if mpi.is_root() and values.size:
        dataset[...] = values


def _counted(group: h5py.Group, name: str, size: int) -> None:
    """Add a dataset of the integers from 0 on, which only rank 0 makes."""
    dataset = group.create_dataset(name, (size,), dtype=np.int64)
    if mpi.is_root() and size:
        dataset[...] = np.arange(size, dtype=np.int64)


def read_columns(path: pathlib.Path) -> tuple[dict[str, np.ndarray], float]:
    """Return the columns of points and particles as the file ``path`` holds them, and their time (s). No MPI.

    Those of particles are called ``particles/diameter`` and so on. Raises ``F2SError`` for a file that cannot be read.
    """
    try:
        with h5py.File(path, "r") as file:
            columns = {name.rpartition("/")[2]: file[f"{VTK_ROOT}/{name}"][...] for name in _POINTS}
            columns |= {f"particles/{name}": file[f"{_TABLE}/{name}"][...] for name in _PARTICLES}
            return columns, float(file[layout.PROVENANCE_GROUP].attrs["time_s"])
    except (OSError, KeyError) as error:
        raise F2SError(f"{path}: damaged file of tracers ({' '.join(str(error).split())})") from None


def read_tracers(folder: str | os.PathLike, cycle: int) -> TracerCloud | None:
    """Return the points at the end of ``cycle`` of the run in ``folder``; None when there is no such file. No MPI.

    Raises ``F2SError`` for a file that cannot be read.
    """
    path = tracer_path(folder, cycle)
    if places.kind(path) == places.NOTHING:
        return None
    columns, time = read_columns(path)
    table = {name: columns[f"particles/{name}"] for name in _PARTICLES}
    table["cut"] = table["cut"].astype(np.bool_)
    return TracerCloud(time, columns["particle"].astype(np.int64), columns["Points"].astype(float),
                       columns["volume_fraction"], columns["peeq"], columns["temperature"], ParticleTable(**table),
                       (0, columns["particle"].size))
