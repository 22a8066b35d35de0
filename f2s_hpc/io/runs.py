"""A run's folder: made once, and read back serially for analysis, pictures and comparison.

Apart from ``prepare_run_folder`` and ``hold`` nothing here needs MPI: the readers work on a laptop from the files.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import pathlib
import platform
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import h5py
import numpy as np

from f2s_hpc import mpi, places
from f2s_hpc.errors import CheckpointError, F2SError, InputError
from f2s_hpc.io import layout
from f2s_hpc.io.manifest import manifest_path, read_manifest, text_digest


@dataclass(frozen=True)
class FrameMeta:
    """What a frame holds besides arrays.

    ``time_s`` in s; ``cells`` (nx, ny, nz); ``origin`` and ``spacing`` (x, y, z) in m; ``locations``
    maps each field to CellData or PointData; ``provenance`` as it was given when the frame was written.
    """

    number: int
    time_s: float
    cells: tuple[int, int, int]
    origin: tuple[float, float, float]
    spacing: tuple[float, float, float]
    locations: dict[str, str]
    provenance: dict


def check_new_folder(path: str | os.PathLike) -> pathlib.Path:
    """Return the folder ``path`` if a new run may use it. Called by all ranks, looked at by rank 0.

    Raises ``InputError`` on all ranks when it is in use.
    """
    path = pathlib.Path(path)

    def look() -> None:
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; name a new folder with --out")
        if path.is_dir() and any(path.iterdir()):
            if at_work(path):
                raise InputError(f"{path}: another run is at work in it; start a new one in another folder with --out")
            if (path / layout.CHECKPOINTS).is_dir() or (path / layout.SUMMARY_JSON).exists():
                go_on = (f"; continue it with 'f2s resume {shlex.quote(str(path))}', or" if has_checkpoint(path) else
                         ", without a checkpoint to continue from; remove it, or")
                raise InputError(f"{path}: holds a run already{go_on} start a new one in another folder with --out")
            raise InputError(f"{path}: is not empty; name a new or empty folder with --out")
        places.check_folder(path, "--out")

    layout.attempt_on_root(look, f"{path}: cannot be looked at", InputError)
    return path


def prepare_run_folder(path: str | os.PathLike) -> pathlib.Path:
    """Make the folder of a new run, with its sub-folders; return it. Called by all ranks, done by rank 0.

    Raises ``InputError`` on all ranks when the folder is in use, or cannot be made.
    """
    path = check_new_folder(path)

    def make() -> None:
        path.mkdir(parents=True, exist_ok=True)
        try:
            (path / layout.CHECKPOINTS).mkdir()
        except FileExistsError:
            raise InputError(f"{path}: another run has begun in it just now; name a new folder with --out") from None
        (path / layout.FRAMES).mkdir()

    layout.attempt_on_root(make, f"{path}: cannot be made", InputError)
    return path


@contextlib.contextmanager
def hold(path: str | os.PathLike) -> Iterator[None]:
    """Keep other runs out of the folder ``path`` meanwhile; collective.

    Raises ``InputError`` on all ranks when another process holds it. A file system without locks has none.
    """
    place = pathlib.Path(path) / layout.LOCK

    def lock() -> int | None:
        import fcntl  # (not on Windows, where runs are only read)
        try:
            # (a file of its own, that nothing replaces)
            file = os.open(place, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:  # (not ours to write)
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise InputError(f"{path}: another run is at work in it; wait for its end, or stop it") from None
        except OSError:  # (no locks on this file system)
            return file
        with contextlib.suppress(OSError):
            _sign(file)
        return file

    held = layout.attempt_together(lambda: lock() if mpi.is_root() else None, f"{path}: cannot be locked", InputError)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)


def _sign(file: int) -> None:
    """Leave the name of this machine in the lock."""
    name = platform.node().encode()
    if os.pread(file, len(name) + 1, 0) != name:
        os.ftruncate(file, 0)
        os.pwrite(file, name, 0)


def at_work(path: str | os.PathLike) -> bool | None:
    """Tell whether a process holds the run folder ``path`` (see :func:`hold`); None where nobody can know from here.

    That is so without locks, and on another machine than the last run's: some file systems keep locks to each.
    """
    try:
        import fcntl  # (not on Windows)
        with (pathlib.Path(path) / layout.LOCK).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            return False if file.read() == platform.node().encode() else None
    except (ImportError, OSError):
        return None


def has_checkpoint(path: pathlib.Path) -> bool:
    """Tell whether the run folder ``path`` holds a finished checkpoint."""
    return any(layout.checkpoint_key(file.name) is not None and places.kind(manifest_path(file)) == places.FILE
               for file in places.entries(path / layout.CHECKPOINTS))


def read_summary(path: str | os.PathLike) -> dict:
    """Return ``summary.json`` of the run folder ``path``. Raises ``InputError`` when there is none."""
    place = pathlib.Path(path) / layout.SUMMARY_JSON
    try:
        summary = json.loads(place.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{place}: {error.strerror}; is {path} the folder of a run?") from None
    except ValueError as error:  # (not UTF-8 is one too)
        raise InputError(f"{place}: not JSON ({error})") from None
    if not isinstance(summary, dict):
        raise InputError(f"{place}: not a JSON object")
    return summary


def read_cycle_table(path: str | os.PathLike) -> list[dict[str, str]]:
    """Return the rows of ``summary.csv`` of the run folder ``path``, as text; empty when there is none.

    Raises ``InputError`` when it cannot be read.
    """
    place = pathlib.Path(path) / layout.SUMMARY_CSV
    if places.kind(place) == places.NOTHING:
        return []
    try:
        with place.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{place}: not a readable table ({' '.join(str(error).split())})") from None


def list_frames(folder: str | os.PathLike, frames: str = layout.FRAMES) -> list[int]:
    """Return the numbers of the frames in the run folder ``folder``, ascending.

    Raises ``InputError`` when its frames are not ours to read.
    """
    return places.numbers(pathlib.Path(folder) / frames, layout.FRAME_NAME)


def drop_frames_after(folder: str | os.PathLike, number: int, frames: str = layout.FRAMES) -> None:
    """Remove the frames of the run folder ``folder`` that come after ``number``."""
    for later in list_frames(folder, frames):
        if later > number:
            (pathlib.Path(folder) / frames / layout.frame_name(later)).unlink()


def _meta(file: h5py.File) -> FrameMeta:
    root, own = file[layout.VTK_ROOT], file[layout.PROVENANCE_GROUP]
    extent = root.attrs["WholeExtent"]
    locations = {name: place for place in (layout.CELL_DATA, layout.POINT_DATA) for name in root[place]}
    return FrameMeta(int(own.attrs["number"]), float(own.attrs["time_s"]), tuple(int(n) for n in extent[1::2]),
                     tuple(map(float, root.attrs["Origin"])), tuple(map(float, root.attrs["Spacing"])),
                     locations, json.loads(layout.read_text(file, layout.PROVENANCE)))


def read_frame_meta(path: str | os.PathLike) -> FrameMeta:
    """Return what the frame file ``path`` holds. Raises ``F2SError`` when it cannot be read as a frame."""
    try:
        with h5py.File(path, "r") as file:
            return _meta(file)
    except (OSError, KeyError, ValueError) as error:
        raise F2SError(f"{path}: not a readable frame ({' '.join(str(error).split())})") from None


def open_frame(folder: str | os.PathLike, number: int, names: Sequence[str] | None = None,
               frames: str = layout.FRAMES) -> tuple[dict[str, np.ndarray], FrameMeta]:
    """Return the fields of a frame, float32 [k, j, i], whole, and what the frame is; arguments and errors as below."""
    fields, meta = frame_fields(folder, number, names, frames)
    return {name: field[...] for name, field in fields.items()}, meta


@dataclass(frozen=True)
class FrameField:
    """A field of the frame ``path``, float32 [k, j, i], cut as an array is: only what is cut out is read.

    Raises ``F2SError`` when the file is damaged.
    """

    path: pathlib.Path
    dataset: str
    shape: tuple[int, ...]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __getitem__(self, part: object) -> np.ndarray:
        """Read ``part``: slices and numbers, as h5py takes them."""
        try:
            with h5py.File(self.path, "r") as file:
                return file[self.dataset][part]
        except (OSError, KeyError) as error:
            raise F2SError(f"{self.path}: damaged frame ({' '.join(str(error).split())})") from None


def frame_fields(folder: str | os.PathLike, number: int, names: Sequence[str] | None = None,
                 frames: str = layout.FRAMES) -> tuple[dict[str, FrameField], FrameMeta]:
    """Return the fields of a frame to be read part by part, for boxes too large to hold, and what the frame is.

    ``folder`` is the run folder, ``frames`` the series; ``names`` picks fields (default: all). Raises ``InputError``
    when the frame or a field is missing, ``F2SError`` when the file is damaged.
    """
    path = pathlib.Path(folder) / frames / layout.frame_name(number)
    if places.kind(path) == places.NOTHING:
        numbers = list_frames(folder, frames)
        raise InputError(f"{path}: no such frame; {'this run has frames ' + str(numbers) if numbers else 'no frames'}")
    meta = read_frame_meta(path)
    for name in names or ():
        if name not in meta.locations:
            raise InputError(f"{path}: no field {name!r}; it holds {', '.join(meta.locations)}")
    try:
        with h5py.File(path, "r") as file:
            places_of = {name: f"{layout.VTK_ROOT}/{meta.locations[name]}/{name}"
                         for name in (meta.locations if names is None else names)}
            return {name: FrameField(path, place, file[place].shape) for name, place in places_of.items()}, meta
    except (OSError, KeyError) as error:
        raise F2SError(f"{path}: damaged frame ({' '.join(str(error).split())})") from None


def open_checkpoint_serial(path: str | os.PathLike,
                           names: Sequence[str] | None = None) -> tuple[dict[str, np.ndarray], dict]:
    """Return the fields of a checkpoint, float64 [k, j, i], whole, and its attributes.

    ``names`` picks fields (default: all). The manifest, the size and the attributes are tested, the
    fields' checksums are not (``checkpoint.verify_checkpoint`` does). Raises ``CheckpointError``.
    """
    path = pathlib.Path(path)
    manifest = read_manifest(path)
    wanted = list(manifest.fields) if names is None else list(names)
    for name in wanted:
        if name not in manifest.fields:
            raise CheckpointError(f"{path}: no field {name!r}; it holds {', '.join(manifest.fields)}")
    try:
        with h5py.File(path, "r") as file:
            text = layout.read_text(file, layout.ATTRIBUTES)
            arrays = {name: file[f"{layout.FIELDS_GROUP}/{name}"][...] for name in wanted}
        if text_digest(text) != manifest.attributes_sha256:
            raise ValueError("the attributes have another checksum")
        return arrays, json.loads(text)
    except (OSError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path}: damaged checkpoint ({' '.join(str(error).split())})") from None


def within_dwell(attributes: dict) -> bool:
    """Tell whether a checkpoint with these ``attributes`` was written while the deposit dwelt between two cycles."""
    return bool(attributes.get("pause", {}).get("course"))


def ends_cycle(attributes: dict) -> bool:
    """Tell whether a checkpoint with these ``attributes`` stands at the end of a cycle, not within one or a dwell."""
    return not (attributes.get("batch_is_in", True) or within_dwell(attributes))


class CheckpointLayers:
    """A checkpoint opened to read its fields layer by layer, for boxes too large to hold every field whole.

    Use as a context manager. ``attributes``: as saved; ``shapes``: (nz, ny, nx) of each field, one more per axis on
    nodes. Tested as by :func:`open_checkpoint_serial`; raises ``CheckpointError``.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = pathlib.Path(path)
        self.attributes = open_checkpoint_serial(self.path, [])[1]
        self.shapes = {name: record.shape for name, record in read_manifest(self.path).fields.items()}
        self._file: h5py.File | None = None

    def __enter__(self) -> CheckpointLayers:
        try:
            self._file = h5py.File(self.path, "r")
            held = {name: dataset.shape for name, dataset in self._file[layout.FIELDS_GROUP].items()}
        except (OSError, KeyError) as error:
            raise CheckpointError(f"{self.path}: damaged checkpoint ({' '.join(str(error).split())})") from None
        if held != self.shapes:
            self._file.close()
            raise CheckpointError(f"{self.path}: damaged checkpoint (the manifest tells of other fields than it holds)")
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def layers(self, name: str, first: int, last: int) -> np.ndarray:
        """Return the layers ``first`` to ``last`` - 1 (k) of field ``name``, float64 [k, j, i]."""
        if name not in self.shapes:
            raise CheckpointError(f"{self.path}: no field {name!r}; it holds {', '.join(self.shapes)}")
        try:
            return self._file[f"{layout.FIELDS_GROUP}/{name}"][first:last]
        except (OSError, KeyError) as error:
            raise CheckpointError(f"{self.path}: damaged checkpoint ({' '.join(str(error).split())})") from None
