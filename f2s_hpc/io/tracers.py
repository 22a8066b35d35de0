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
_VERTICES = {f"{VTK_ROOT}/Vertices/Connectivity": "i8", f"{VTK_ROOT}/Vertices/Offsets": "i8"}
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
    partial = layout.partial_path(path)
    blocks, types = _blocks(cloud)
    datasets = [block.name for block in blocks]
    layout.write_shared(partial, datasets, blocks, {PROVENANCE: text}, lambda file: _prepare(file, cycle, cloud),
                        types, False, F2SError, _UNITS)
    try:
        layout.attempt_together(lambda: layout.read_back(partial, datasets, blocks), context)
    except F2SError:
        attempt_on_root(lambda: partial.unlink(missing_ok=True), context)
        raise
    attempt_on_root(lambda: layout.publish(partial, path), context)
    return path


def _blocks(cloud: TracerCloud) -> tuple[list[Block], list[str]]:
    """Return all that grows with the points and the particles, each rank's share of it, and its types in the file."""
    first, count = cloud.share
    particle = cloud.particle
    columns = (cloud.position, particle, cloud.particles.diameter[particle], cloud.fraction, cloud.peeq,
               cloud.temperature)
    blocks = [Block(f"{VTK_ROOT}/{name}", column, (first, 0)[:column.ndim], (count, *column.shape[1:]))
              for name, column in zip(_POINTS, columns)]
    # a vertex for each point
    last = mpi.rank() == mpi.size() - 1
    blocks += [Block(name, np.arange(first, first + particle.size + more * last), (first,), (count + more,))
               for more, name in enumerate(_VERTICES)]
    types = [*_POINTS.values(), *_VERTICES.values()]
    for name in _PARTICLES:
        array = getattr(cloud.particles, name)
        own = array if mpi.is_root() else array[:0]
        blocks.append(Block(f"{_TABLE}/{name}", own, (0, 0)[:array.ndim], array.shape))
        types.append("i1" if name == "cut" else "f8")
    return blocks, types


def _prepare(file: h5py.File, cycle: int, cloud: TracerCloud) -> None:
    """Make all that does not grow with the points: of vertices, lines and polygons how many there are."""
    count = cloud.share[1]
    root = file.create_group(VTK_ROOT)
    root.attrs.create("Type", np.bytes_("PolyData"), dtype=h5py.string_dtype("ascii", 8))
    root.attrs["Version"] = np.array((2, 0), dtype=np.int64)
    root.create_group(POINT_DATA)
    _filled(root, "NumberOfPoints", [count])
    for kind in ("Vertices", "Lines", "Polygons", "Strips"):
        cells = count if kind == "Vertices" else 0
        group = root.create_group(kind)
        _filled(group, "NumberOfCells", [cells])
        _filled(group, "NumberOfConnectivityIds", [cells])
        if not cells:
            _filled(group, "Offsets", [0])
            _filled(group, "Connectivity", [])
    own = file.create_group(layout.PROVENANCE_GROUP)
    own.attrs["format"] = np.int64(layout.FORMAT_VERSION)
    own.attrs["cycle"] = np.int64(cycle)
    own.attrs["time_s"] = np.float64(cloud.time)


def _filled(group: h5py.Group, name: str, values: list[int]) -> None:
    """Add a dataset of some integers: created by all ranks, filled by rank 0."""
    dataset = group.create_dataset(name, (len(values),), dtype=np.int64)
    if mpi.is_root() and values:
        dataset[...] = values


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
