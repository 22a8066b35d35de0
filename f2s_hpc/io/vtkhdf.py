"""Frames for people: one VTKHDF ImageData file per frame, float32, and the index over all of them.

A frame is static (one step), so a crash can only cost the frame being written. The index is a small
temporal VTKHDF file of virtual datasets that point into the frames; it is rebuilt from the frames that
exist. Read by VTK 9.3 and later (ParaView 5.12 and later); the XDMF sidecar serves older ones.
Layout: VTK File Formats, "VTKHDF", docs.vtk.org.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence

import h5py
import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import F2SError
from f2s_hpc.fields import BY_NAME, NODE, UNITS
from f2s_hpc.io import layout, xdmf
from f2s_hpc.io.layout import CELL_DATA, POINT_DATA, PROVENANCE, VTK_ROOT, Block, attempt_on_root
from f2s_hpc.io.runs import FrameMeta, list_frames, read_frame_meta
from f2s_hpc.units import count_text


def _located(blocks: Sequence[Block]) -> tuple[tuple[int, int, int], list[str]]:
    """Return the number of cells (nz, ny, nx) and where each block lives: CellData or PointData.

    The smaller of two shapes is that of the cells. With one shape only, the table of fields decides.
    """
    shapes = {tuple(map(int, block.global_shape)) for block in blocks}
    cells = min(shapes)
    if len(shapes) == 1 and all(BY_NAME[b.name].location == NODE if b.name in BY_NAME else False for b in blocks):
        cells = tuple(n - 1 for n in cells)
    nodes = tuple(n + 1 for n in cells)
    if not shapes <= {cells, nodes}:
        raise F2SError(f"a frame holds cell fields (nz, ny, nx) and node fields of one more per axis, not {shapes}")
    return cells, [CELL_DATA if tuple(block.global_shape) == cells else POINT_DATA for block in blocks]


def _image_head(file: h5py.File, version: tuple[int, int], cells: Sequence[int],
                origin: Sequence[float], spacing: Sequence[float]) -> h5py.Group:
    """Create the VTKHDF group of an ImageData file; ``cells`` is (nx, ny, nz)."""
    root = file.create_group(VTK_ROOT)
    # Older readers refuse a variable-length string here.
    root.attrs.create("Type", np.bytes_("ImageData"), dtype=h5py.string_dtype("ascii", 9))
    root.attrs["Version"] = np.array(version, dtype=np.int64)
    root.attrs["WholeExtent"] = np.array([0, cells[0], 0, cells[1], 0, cells[2]], dtype=np.int64)
    root.attrs["Origin"] = np.array(origin, dtype=np.float64)
    root.attrs["Spacing"] = np.array(spacing, dtype=np.float64)
    root.attrs["Direction"] = np.eye(3).ravel()
    root.create_group(CELL_DATA)
    root.create_group(POINT_DATA)
    return root


def write_frame(folder: str | os.PathLike, number: int, time: float, blocks: Sequence[Block],
                origin: Sequence[float], spacing: Sequence[float], provenance: dict) -> pathlib.Path:
    """Write frame ``number`` of the run at ``time`` (s) into ``folder``; return its path. All ranks.

    ``blocks`` are float64 [k, j, i], cells or nodes, saved as float32 (shuffled, gzip level 1).
    ``origin`` and ``spacing`` are (x, y, z), m. ``provenance`` is saved as JSON under ``/f2s``. Each field has its unit
    as the attribute ``units``.
    A frame of the same number is replaced once the new one is whole. Raises ``F2SError`` on all ranks.
    """
    folder = pathlib.Path(folder)
    context = f"cannot write frame {number} in {folder}"
    wrong = layout.check_blocks(blocks) if blocks else "no fields"
    if wrong is not None:
        raise F2SError(f"{context}: {wrong}")
    cells, places = _located(blocks)

    def begin() -> str:
        folder.mkdir(parents=True, exist_ok=True)
        return layout.encode_json(provenance)

    text = attempt_on_root(begin, context)
    head = mpi.broadcast((int(number), float(time), tuple(map(float, origin)), tuple(map(float, spacing))))

    def prepare(file: h5py.File) -> None:
        _image_head(file, (1, 0), cells[::-1], head[2], head[3])
        own = file.create_group(layout.PROVENANCE_GROUP)
        own.attrs["format"] = np.int64(layout.FORMAT_VERSION)
        own.attrs["number"] = np.int64(head[0])
        own.attrs["time_s"] = np.float64(head[1])

    path = folder / layout.frame_name(head[0])
    partial = layout.partial_path(path)
    datasets = [f"{VTK_ROOT}/{place}/{block.name}" for place, block in zip(places, blocks, strict=True)]
    layout.write_shared(partial, datasets, blocks, {PROVENANCE: text}, prepare, "f4", True, F2SError,
                        [UNITS.get(block.name) for block in blocks])
    try:
        layout.attempt_together(lambda: layout.read_back(partial, datasets, blocks), context)
    except F2SError:
        attempt_on_root(lambda: partial.unlink(missing_ok=True), context)
        raise
    attempt_on_root(lambda: layout.publish(partial, path), context)
    return path


def update_index(folder: str | os.PathLike) -> list[str]:
    """Rebuild the index and the XDMF sidecar beside the frames' ``folder``, from the frames that exist.

    Returns what could not be included: a line on all frames that are on another grid than the newest (a view that a
    resumed run has moved), and one on each that is unreadable or not later than the one before. The index holds the
    fields that all its frames have. Called by all ranks, done by rank 0. Raises ``F2SError`` on all ranks when the
    files cannot be written.
    """
    folder = pathlib.Path(folder).absolute()
    return attempt_on_root(lambda: _update_index(folder),
                           f"cannot write {layout.SERIES[folder.name][0]} in {folder.parent}")


def _update_index(folder: pathlib.Path) -> list[str]:
    metas, notes = _usable_frames(folder)
    if not metas:
        return notes
    shared = [field for field in metas[-1].locations if all(
        meta.locations.get(field) == metas[-1].locations[field] for meta in metas)]
    index, sidecar = layout.SERIES[folder.name]
    path = folder.parent / index
    partial = layout.partial_path(path)
    with h5py.File(partial, "w") as file:
        _write_index(file, folder.name, metas, shared)
    layout.publish(partial, path)
    layout.write_text_file(folder.parent / sidecar, xdmf.sidecar_text(folder.name, metas))
    return notes


def _usable_frames(folder: pathlib.Path) -> tuple[list[FrameMeta], list[str]]:
    """Return the frames that belong in the index, in order of time, and what to say of the others."""
    found: list[FrameMeta] = []
    notes: list[str] = []
    elsewhere: list[int] = []
    for number in reversed(list_frames(folder.parent, folder.name)):
        path = folder / layout.frame_name(number)
        try:
            meta = read_frame_meta(path)
        except F2SError as error:
            notes.append(str(error))
            continue
        newest = found[0] if found else meta
        if (meta.cells, meta.origin, meta.spacing) != (newest.cells, newest.origin, newest.spacing):
            elsewhere.append(number)
        elif found and meta.time_s >= found[-1].time_s:
            notes.append(f"{path}: not earlier than {layout.frame_name(found[-1].number)}, left out of the index")
        else:
            found.append(meta)
    if elsewhere:
        span = " to ".join(layout.frame_name(n) for n in dict.fromkeys((elsewhere[-1], elsewhere[0])))
        notes.append(f"{folder}: {count_text(len(elsewhere), 'frame')} on another grid than the newest, left out of "
                     f"the index: {span}")
    return found[::-1], notes[::-1]


def _write_index(file: h5py.File, frames: str, metas: Sequence[FrameMeta], shared: Sequence[str]) -> None:
    last, count = metas[-1], len(metas)
    root = _image_head(file, (2, 0), last.cells, last.origin, last.spacing)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(count)
    times = steps.create_dataset("Values", data=np.array([meta.time_s for meta in metas], dtype=np.float64))
    layout.tell_unit(times, "s")
    offsets = {place: steps.create_group(f"{place}Offsets") for place in (CELL_DATA, POINT_DATA)}
    for name in shared:
        place = last.locations[name]
        more = int(place == POINT_DATA)
        shape = tuple(n + more for n in last.cells[::-1])
        # of one frame alone readers take the file for one without steps, whose arrays have no axis for them
        virtual = h5py.VirtualLayout((count, *shape) if count > 1 else shape, dtype="f4")
        for step, meta in enumerate(metas):
            source = h5py.VirtualSource(f"{frames}/{layout.frame_name(meta.number)}", f"{VTK_ROOT}/{place}/{name}",
                                        shape=shape, dtype="f4")
            virtual[step if count > 1 else ...] = source
        layout.tell_unit(root.create_virtual_dataset(f"{place}/{name}", virtual), UNITS.get(name))
        # Readers have crashed on files without offsets.
        offsets[place].create_dataset(name, data=np.arange(count, dtype=np.int64))
    own = file.create_group(layout.PROVENANCE_GROUP)
    own.attrs["format"] = np.int64(layout.FORMAT_VERSION)
    own.attrs["frames"] = np.array([meta.number for meta in metas], dtype=np.int64)
    file.create_dataset(PROVENANCE, data=np.bytes_(layout.encode_json(last.provenance).encode("utf-8")))
