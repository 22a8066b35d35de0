"""What ``f2s export`` does: a deposit as a mesh for other codes. Alone, on one process, from the files of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from f2s_hpc.analysis.mesh import (
    boundary_triangles,
    enclosed_volume,
    height_map_triangles,
    hexahedra,
    node_means,
)
from f2s_hpc.analysis.surface import HALF_FULL
from f2s_hpc.build import build_model
from f2s_hpc.errors import InputError
from f2s_hpc.fields import ORIGIN, STRESS, UNITS
from f2s_hpc.io import layout, runs
from f2s_hpc.io.mesh_file import (
    HEXAHEDRON,
    TRIANGLE,
    Mesh,
    check_mesh_file,
    format_of,
    initial_conditions,
    write_mesh,
)
from f2s_hpc.kernels import derived
from f2s_hpc.report.commands import alone
from f2s_hpc.report.deposit import Deposit, load_deposit
from f2s_hpc.units import count_text

CELLS, BOUNDARY, SURFACE = "cells", "boundary", "surface"
WHAT = (CELLS, BOUNDARY, SURFACE)

SCALES = {"m": (1.0, 1.0, "Pa"), "mm": (1e3, 1e-6, "MPa"), "um": (1e6, 1e-6, "MPa")}
"""Factor of lengths, factor and unit of stresses of each unit of length: those that other codes take together."""

MORE_FIELDS = ("pressure", *STRESS, ORIGIN)
"""Written besides the fields of a :class:`Deposit` where the file of the run has them."""

_LAYERS_AT_ONCE = 16


@dataclass(frozen=True)
class ExportSettings:
    """What is exported. ``what``: one of ``WHAT``, or None for that which suits the ending of the file.

    ``unit``: a key of ``SCALES``; ``least_fraction``: cells with a volume fraction below it are left out (None:
    ``HALF_FULL``); ``substrate``: False leaves out cells that lie below the top of the substrate as it was at the
    start; ``closed``: give the height map sides and a bottom.
    """

    what: str | None = None
    unit: str = "m"
    least_fraction: float | None = None
    substrate: bool = True
    closed: bool = True


def export(folder: str, path: str, settings: ExportSettings, cycle: int | None = None) -> int:
    """Write the deposit of the run in ``folder`` at the end of ``cycle`` (default: the last) to ``path``.

    Prints what was written; returns the exit code. Raises ``InputError`` before anything is written for what the
    format cannot hold, settings that do not go together, and a deposit without such cells.
    """
    alone("export")
    what = _checked(path, settings)
    deposit = load_deposit(folder, cycle)
    mesh, text = (_surface_mesh(deposit, settings) if what == SURFACE else
                  _cell_mesh(deposit, settings, what == BOUNDARY))
    write_mesh(path, mesh)
    if deposit.skipped:
        print(f"note: {deposit.skipped}")
    told = f"lengths in {settings.unit}"
    if mesh.cell_data:
        told += f", stresses in {SCALES[settings.unit][2]}, temperatures in K; "
        told += (f"initial conditions {', '.join(initial_conditions(mesh))}" if format_of(path).name == "abaqus" else
                 f"fields {', '.join(mesh.cell_data)}")
    print(f"{deposit.scene.title}, end of cycle {deposit.cycle}, from {deposit.source}: {text}")
    print(f"written to {path}; {told}")
    return 0


def _checked(path: str, settings: ExportSettings) -> str:
    """Return what is exported; raise ``InputError`` for settings that do not fit it, or a file that cannot hold it."""
    kind = format_of(path)
    what = settings.what or (SURFACE if kind is not None and HEXAHEDRON not in kind.holds else CELLS)
    least = settings.least_fraction
    if least is not None and not 0.0 < least <= 1.0:
        raise InputError(f"--least-fraction {least:g}: it must be above 0 and at most 1")
    if what == SURFACE and least is not None:
        raise InputError("--least-fraction goes with --what cells or boundary, not with the surface")
    if what == SURFACE and not settings.substrate:
        raise InputError("--no-substrate goes with --what cells or boundary; for the surface alone there is --open")
    if what != SURFACE and not settings.closed:
        raise InputError(f"--open goes with --what surface, not with {what}")
    check_mesh_file(path, HEXAHEDRON if what == CELLS else TRIANGLE, "--to")
    return what


def _surface_mesh(deposit: Deposit, settings: ExportSettings) -> tuple[Mesh, str]:
    """Return the height map as a mesh, and what to say of it."""
    scale = deposit.dx * SCALES[settings.unit][0]
    points, triangles = height_map_triangles(deposit.surface / deposit.dx, settings.closed)
    shape = (f"closed by sides and bottom around {enclosed_volume(points, triangles) * _mm3(deposit):.6g} mm3"
             if settings.closed else "open")
    return Mesh(points * scale, triangles), f"its surface, {count_text(len(triangles), 'triangle')}, {shape}"


def _mm3(deposit: Deposit) -> float:
    """Return the volume of a cell in mm3."""
    return (1e3 * deposit.dx)**3


def _cell_mesh(deposit: Deposit, settings: ExportSettings, boundary: bool) -> tuple[Mesh, str]:
    """Return the cells that are exported, or only their ``boundary``, as a mesh, and what to say of it."""
    length, stress, _ = SCALES[settings.unit]
    scale = deposit.dx * length
    least = HALF_FULL if settings.least_fraction is None else settings.least_fraction
    landed = deposit.landed.copy()
    ground = round(deposit.ground / deposit.dx)
    if not settings.substrate:
        landed[:ground] = False
    kept = landed & (deposit.fraction >= least)
    if not kept.any():
        where = "" if settings.substrate else f" above the substrate ({1e6 * deposit.ground:g} um)"
        raise InputError(f"{deposit.source}: no landed cell with a volume fraction of {least:g} or more{where}; a "
                         "lower --least-fraction, or another --cycle, may have some")
    total = deposit.fraction[landed].sum(dtype=np.float64)
    held = deposit.fraction[kept].sum(dtype=np.float64)
    text = (f"{count_text(int(kept.sum()), 'cell')}, {kept.sum() * _mm3(deposit):.6g} mm3, with "
            f"{100 * held / total:.2f} % of the landed material")
    if boundary:
        points, triangles = boundary_triangles(kept)
        return Mesh(points * scale, triangles), f"boundary of {text}; {count_text(len(triangles), 'triangle')}"
    points, corners = hexahedra(kept)
    data = {name: values * (stress if UNITS[name] == "Pa" else 1.0)
            for name, values in cell_fields(deposit, kept).items()}
    above = np.nonzero(kept)[0] >= ground
    sets = {name: np.flatnonzero(cells) for name, cells in (("SUBSTRATE", ~above), ("DEPOSIT", above)) if cells.any()}
    temperature = node_means(corners, data["temperature"], data["volume_fraction"], len(points))
    heading = (f"Deposit at the end of cycle {deposit.cycle}; units {settings.unit}, {SCALES[settings.unit][2]}, K")
    return Mesh(points * scale, corners, data, temperature, sets, heading), text


def cell_fields(deposit: Deposit, kept: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of the ``kept`` cells (bool, (nz, ny, nx)), SI, float64, in the order of the cells.

    Those of the deposit, and of ``MORE_FIELDS`` what its file has: a checkpoint all that the scene has, a frame what
    ``output.fields`` asked for. ``stress_xx`` to ``stress_xz`` are deviatoric, as everywhere in a run. Raises
    ``CheckpointError`` or ``F2SError`` for a damaged file.
    """
    found = {"volume_fraction": deposit.fraction, "peeq": deposit.peeq, "temperature": deposit.temperature,
             "von_mises": deposit.von_mises}
    found = {name: values[kept].astype(np.float64) for name, values in found.items()}
    if layout.checkpoint_key(deposit.source.name) is not None:
        return found | _more_of_checkpoint(deposit, kept)
    number = int(layout.FRAME_NAME.fullmatch(deposit.source.name)[1])
    names = [n for n in MORE_FIELDS if n in runs.read_frame_meta(deposit.source).locations]
    arrays, _ = runs.open_frame(deposit.folder, number, names)
    return found | {name: values[kept].astype(np.float64) for name, values in arrays.items()}


def _more_of_checkpoint(deposit: Deposit, kept: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``MORE_FIELDS`` of the kept cells of a checkpoint, read in slabs of layers."""
    eos = build_model(deposit.scene).eos
    with runs.CheckpointLayers(deposit.source) as file:
        parts = {name: [] for name in MORE_FIELDS if name in file.shapes or name == "pressure"}
        for first in range(0, kept.shape[0], _LAYERS_AT_ONCE):
            last = min(first + _LAYERS_AT_ONCE, kept.shape[0])
            inside = kept[first:last]
            if not inside.any():
                continue
            for name, part in parts.items():
                part.append(_pressure(file, eos, first, last)[inside] if name == "pressure" else
                            file.layers(name, first, last)[inside])
    return {name: np.concatenate(part) for name, part in parts.items()}


def _pressure(file: runs.CheckpointLayers, eos: object, first: int, last: int) -> np.ndarray:
    """Return the pressure (Pa) of layers of a checkpoint, as the run shows it."""
    mass, fraction = (file.layers(name, first, last) for name in ("mass", "volume_fraction"))
    energy = file.layers("internal_energy", first, last) if "internal_energy" in file.shapes else np.zeros(1)
    out = np.zeros(mass.shape)
    derived.cell_pressure(eos, mass.reshape(-1), fraction.reshape(-1), energy.reshape(-1), out.reshape(-1))
    return out
