"""How a run lies on disk: file names, blocks of fields, and their collective transfer to HDF5.

A run folder holds::

    scene.toml                                             the resolved scene
    .lock                                                  locked while a run is at work in the folder
    STOP                                                   made by a user who wants the run to stop
    checkpoints/checkpoint_cycle_0003_step_00001234.h5     every saved field, float64
    checkpoints/checkpoint_cycle_0003_step_00001234.json   its manifest, written last
    frames/frame_000003.vtkhdf                             chosen fields, float32, one file per frame
    tracers/tracers_000003.vtkhdf                          points of the particles at the end of a cycle
    deposit.vtkhdf  deposit.xmf                            what ParaView opens as a time series
    view/frame_000003.vtkhdf  view.vtkhdf  view.xmf        the same of a part of the box, written more often
    summary.json  summary.csv                              the run, and one row per cycle

Readers never see a file that is being written: it carries another name until it is whole.
"""

from __future__ import annotations

import ctypes
import errno
import json
import math
import os
import pathlib
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import h5py
import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import F2SError

FORMAT_VERSION = 2
CHECKPOINTS, FRAMES, TRACERS, VIEW = "checkpoints", "frames", "tracers", "view"
SCENE_FILE, LOCK, STOP_FILE = "scene.toml", ".lock", "STOP"
SUMMARY_JSON, SUMMARY_CSV = "summary.json", "summary.csv"
INDEX, SIDECAR = "deposit.vtkhdf", "deposit.xmf"
SERIES = {FRAMES: (INDEX, SIDECAR), VIEW: (f"{VIEW}.vtkhdf", f"{VIEW}.xmf")}
"""The index and the sidecar of each folder of frames, beside it."""
PARTIAL, DELETED, DAMAGED = ".partial", ".deleted", ".damaged"
FIELDS_GROUP, ATTRIBUTES = "fields", "attributes"
VTK_ROOT, CELL_DATA, POINT_DATA = "VTKHDF", "CellData", "PointData"
UNIT_ATTRIBUTE = "units"
PROVENANCE_GROUP, PROVENANCE = "f2s", "f2s/provenance"
CHECKPOINT_NAME = re.compile(r"checkpoint_cycle_(\d+)_step_(\d+)(?:_(\d+))?\.h5")
FRAME_NAME = re.compile(r"frame_(\d+)\.vtkhdf")
LARGEST_CHUNK = 64
AT_ONCE = 2**20  # values that a rank writes or reads at once, so that no copy of a whole field is made
SPARE_BYTES = 200_000
_UNCLOSED: list[tuple[h5py.File, list[h5py.Dataset]]] = []
_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of fallocate(2)

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class Block:
    """This rank's owned part of one field.

    ``data`` is float64, indexed [k, j, i] (x fastest), and may be a view into a ghosted array;
    ``start`` is its first global index (k0, j0, i0); ``global_shape`` is (nz, ny, nx), with one
    more per axis for a node field. The blocks of all ranks tile the field.
    """

    name: str
    data: np.ndarray
    start: Shape
    global_shape: Shape


def box_selection(start: Sequence[int], shape: Sequence[int]) -> tuple[slice, slice, slice]:
    """Return the slices of the box of ``shape`` whose first index is ``start``, both (k, j, i)."""
    return tuple(slice(first, first + count) for first, count in zip(start, shape, strict=True))


def checkpoint_name(cycle: int, step: int, attempt: int = 1) -> str:
    """Return the file name of a checkpoint; ``attempt`` tells apart rewrites of the same step."""
    return f"checkpoint_cycle_{cycle:04d}_step_{step:08d}" + (f"_{attempt}" if attempt > 1 else "") + ".h5"


def checkpoint_key(name: str) -> tuple[int, int, int] | None:
    """Return (cycle, step, attempt) of a checkpoint's file name, ``None`` for any other name."""
    match = CHECKPOINT_NAME.fullmatch(name)
    return None if match is None else (int(match[1]), int(match[2]), int(match[3] or 1))


def frame_name(number: int) -> str:
    """Return the file name of frame ``number``."""
    return f"frame_{number:06d}.vtkhdf"


def partial_path(path: pathlib.Path) -> pathlib.Path:
    """Return the name that ``path`` carries while it is being written (same folder, hidden)."""
    return path.with_name(f".{path.name}{PARTIAL}")


def encode_json(values: dict) -> str:
    """Return ``values`` as JSON text; floats and integers read back bit for bit.

    numpy numbers and arrays are written as plain ones; other types raise ``TypeError``.
    """
    def plain(value):
        if isinstance(value, (np.generic, np.ndarray)):
            return value.tolist()
        if isinstance(value, os.PathLike):
            return os.fspath(value)
        raise TypeError(f"{type(value).__name__} cannot be saved as JSON")

    return json.dumps(values, default=plain, indent=1)


def raise_together(failure: str | None, kind: type[F2SError] = F2SError) -> None:
    """Raise ``kind`` on all ranks, with the first rank's message, if any rank has a ``failure``.

    Ends the job where the others do not come: they may wait in HDF5 for a rank that has left it with an error.
    """
    mpi.meet(failure, kind.exit_code)
    found = [message for message in mpi.all_gather(failure) if message is not None]
    if found:
        raise kind(found[0])


def attempt_together(task: Callable, context: str, kind: type[F2SError] = F2SError):
    """Call ``task`` on every rank; return its value, or raise ``kind`` on all ranks if one failed.

    ``context`` opens the message, such as "cannot write FILE"; an ``F2SError`` brings its own message.
    """
    outcome, failure = None, None
    try:
        outcome = task()
    except Exception as error:  # whatever it is, the other ranks must not wait for this one
        text = " ".join(str(error).split())
        kind_of_bug = "" if isinstance(error, OSError) else f"{type(error).__name__} "
        failure = text if isinstance(error, F2SError) else f"{context}: {kind_of_bug}{text}"
    raise_together(failure, kind)
    return outcome


def attempt_on_root(task: Callable, context: str, kind: type[F2SError] = F2SError):
    """Call ``task`` on rank 0; return its value on all ranks, or raise ``kind`` on all of them."""
    outcome = attempt_together(lambda: task() if mpi.is_root() else None, context, kind)
    return mpi.broadcast(outcome)


def check_blocks(blocks: Sequence[Block]) -> str | None:
    """Return what is wrong with the blocks, ``None`` if they tile their fields. Call on all ranks."""
    names = [(block.name, tuple(map(int, block.global_shape))) for block in blocks]
    wrong = None
    if mpi.broadcast(names) != names:
        wrong = f"rank {mpi.rank()} holds other fields than rank 0"
    elif len({name for name, _ in names}) != len(names):
        wrong = "two fields share a name"
    for block in blocks:
        last = [first + count for first, count in zip(block.start, block.data.shape, strict=False)]
        if block.data.dtype != np.float64 or block.data.ndim != 3:
            wrong = f"field {block.name!r} is not a float64 array [k, j, i]"
        elif min(block.start) < 0 or any(end > n for end, n in zip(last, block.global_shape, strict=True)):
            wrong = f"field {block.name!r}: the block reaches outside of the field"
    found = [message for message in mpi.all_gather(wrong) if message is not None]
    if found:
        return found[0]
    counts = mpi.total(np.array([block.data.size for block in blocks], dtype=np.int64))
    for block, count in zip(blocks, counts, strict=True):
        if count != np.prod(block.global_shape, dtype=np.int64):
            return f"field {block.name!r}: the blocks of the ranks do not tile it"
    return None


def open_shared(path: pathlib.Path, mode: str) -> h5py.File:
    """Open an HDF5 file on all ranks at once (one rank: the plain driver)."""
    if mpi.size() == 1:
        # No chunk cache: a full disk then shows at the write, not at the close, which HDF5 does not survive.
        return h5py.File(path, mode, rdcc_nbytes=0)
    if not h5py.get_config().mpi:
        raise RuntimeError("h5py is the serial build; set H5PY_ALWAYS_USE_MPI=1 or install h5py with MPI")
    return h5py.File(path, mode, driver="mpio", comm=mpi.world())


def brick(blocks: Sequence[Block]) -> list[Shape]:
    """Return per block the chunk shape: the largest rank's part, at most 64 per axis."""
    largest = mpi.maximum(np.array([block.data.shape for block in blocks], dtype=np.int64).reshape(-1, 3))
    return [tuple(int(max(1, min(n, LARGEST_CHUNK))) for n in shape) for shape in largest]


def as_type(data: np.ndarray, dtype: np.dtype | str) -> np.ndarray:
    """Return ``data`` contiguous and in the file's type; what float32 cannot hold becomes infinite."""
    with np.errstate(over="ignore", under="ignore"):
        return np.ascontiguousarray(data, dtype=dtype)


def slabs(dataset: h5py.Dataset, first: int = 0, end: int | None = None,
          width: int | None = None) -> Iterator[tuple[int, int]]:
    """Yield ranges of planes that cover a dataset, or its planes ``first`` to ``end``, ``AT_ONCE`` values each.

    ``width``: how many values of a plane are meant (default: all). Of a whole dataset the ranges are of whole chunks.
    """
    end = dataset.shape[0] if end is None else end
    width = math.prod(dataset.shape[1:]) if width is None else width
    depth = dataset.chunks[0] if dataset.chunks else 1
    planes = depth * max(1, AT_ONCE // (depth * max(1, width)))
    for low in range(first, end, planes):
        yield low, min(low + planes, end)


def in_slab(block: Block, slab: tuple[int, int]) -> tuple[np.ndarray, Shape]:
    """Return what of ``block`` lies in a range of planes of its field, and its first global index."""
    low, high = (min(max(plane - block.start[0], 0), len(block.data)) for plane in slab)
    return block.data[low:high], (block.start[0] + low, *block.start[1:])


def write_collective(dataset: h5py.Dataset, block: Block, slab: tuple[int, int]) -> None:
    """Write the ranks' blocks in a range of planes in one collective call; a rank with nothing there takes part too.

    The cast to the file's type happens in memory first: HDF5 refuses to convert within a filtered
    collective write.
    """
    part, start = in_slab(block, slab)
    data, failure = part[:0], None
    try:
        data = as_type(part, dataset.dtype)
    except MemoryError as error:  # (the others are in the call below, or will be)
        failure = error
    file_space = dataset.id.get_space()
    memory_space = h5py.h5s.create_simple(data.shape if data.size else (1, 1, 1))
    if data.size:
        file_space.select_hyperslab(tuple(map(int, start)), data.shape)
    else:
        file_space.select_none()
        memory_space.select_none()
        data = np.zeros((1, 1, 1), dtype=dataset.dtype)
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    if mpi.size() > 1:
        transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    dataset.id.write(memory_space, file_space, data, dxpl=transfer)
    if failure is not None:
        raise failure


def write_text(file: h5py.File, name: str, text: str) -> None:
    """Write a scalar string dataset: created by all ranks, which have the same ``text``, filled by rank 0."""
    encoded = text.encode("utf-8")
    dataset = file.create_dataset(name, (), dtype=h5py.string_dtype("utf-8", max(1, len(encoded))))
    if mpi.is_root():
        dataset[()] = np.bytes_(encoded)


def tell_unit(dataset: h5py.Dataset, unit: str | None) -> None:
    """Give a dataset its unit as the attribute ``units``, on all ranks alike; readers of VTKHDF pass over it."""
    if unit:
        dataset.attrs.create(UNIT_ATTRIBUTE, np.bytes_(unit), dtype=h5py.string_dtype("ascii", len(unit)))


def read_text(file: h5py.File, name: str) -> str:
    """Return a scalar string dataset."""
    value = file[name][()]
    return (value if isinstance(value, bytes) else bytes(value)).decode("utf-8")


def write_shared(path: pathlib.Path, places: Sequence[str], blocks: Sequence[Block], texts: dict[str, str],
                 prepare: Callable[[h5py.File], None], dtype: str | Sequence[str], compress: bool,
                 kind: type[F2SError], units: Sequence[str | None] = ()) -> None:
    """Write ``blocks`` to the datasets ``places`` of a new HDF5 file, all ranks together, and flush it.

    ``dtype``: of all datasets, or one for each; ``units``: of each, where it has one. ``prepare`` adds groups and
    attributes, the same on all ranks. Any failure on any rank raises ``kind`` on all ranks and removes the file.
    """
    context = f"cannot write {path.name.removeprefix('.').removesuffix(PARTIAL)} in {path.parent}"
    types = [dtype] * len(blocks) if isinstance(dtype, str) else dtype
    size = sum(np.dtype(t).itemsize * int(np.prod(block.global_shape, dtype=np.int64))
               for t, block in zip(types, blocks, strict=True))
    attempt_on_root(lambda: _find_room(path, size), context, kind)
    file = attempt_together(lambda: open_shared(path, "w"), context, kind)
    chunks = brick(blocks) if compress else [None] * len(blocks)
    filters = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compress else {}

    datasets: list[h5py.Dataset] = []

    def structure() -> None:
        prepare(file)
        for name, text in texts.items():
            write_text(file, name, text)
        datasets.extend(file.create_dataset(place, block.global_shape, dtype=t, chunks=chunk, **filters)
                        for place, block, t, chunk in zip(places, blocks, types, chunks, strict=True))
        for dataset, unit in zip(datasets, units):
            tell_unit(dataset, unit)

    try:
        attempt_on_root(lambda: _reserve(path, size), context, kind)  # (again, of the file itself)
        attempt_together(structure, context, kind)
        for dataset, block in zip(datasets, blocks, strict=True):
            # (alike on all ranks; each call costs them a meeting, so that they share its values)
            for slab in slabs(dataset, width=math.prod(dataset.shape[1:]) // mpi.size()):
                attempt_together(lambda d=dataset, b=block, s=slab: write_collective(d, b, s), context, kind)
        # Open MPI may report success on a full disk, and the flush would then hang.
        attempt_on_root(lambda: _check_space(path.parent, 0), context, kind)
        attempt_together(file.flush, context, kind)
        attempt_together(file.close, context, kind)
        # what was reserved and not used is given back
        attempt_on_root(lambda: os.truncate(path, path.stat().st_size), context, kind)
    except F2SError:
        _abandon(file, path, datasets)
        raise


def read_back(path: pathlib.Path, places: Sequence[str], blocks: Sequence[Block]) -> None:
    """Compare this rank's part of the file with memory: some MPI libraries report success on a full disk."""
    with h5py.File(path, "r") as file:
        for place, block in zip(places, blocks, strict=True):
            for slab in slabs(file[place]):
                part, start = in_slab(block, slab)
                found = file[place][box_selection(start, part.shape)]
                if found.tobytes() != as_type(part, found.dtype).tobytes():
                    raise OSError(f"field {block.name!r} does not read back as written")


def _check_space(folder: pathlib.Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < size + SPARE_BYTES:
        raise OSError(f"it needs {size / 1e6 + SPARE_BYTES / 1e6:.1f} MB, {free / 1e6:.1f} MB are free")


def _find_room(path: pathlib.Path, size: int) -> None:
    """Raise ``OSError`` where a file of ``size`` (bytes) cannot be written: before HDF5 has one open."""
    _check_space(path.parent, size)
    import resource  # (not on Windows, where runs are only read)
    largest = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    if largest != resource.RLIM_INFINITY and largest < size + SPARE_BYTES:
        raise OSError(f"it needs {size / 1e6 + SPARE_BYTES / 1e6:.1f} MB, files of {largest / 1e6:.1f} MB are allowed "
                      "(ulimit -f)")
    path.touch()
    try:
        _reserve(path, size)
    finally:
        path.unlink()


def _reserve(path: pathlib.Path, size: int) -> None:
    """Take the space of a file of ``size`` (bytes) from the file system, which does not change what is in the file.

    What HDF5 cannot write on a full disk it writes again when it closes the file: it crashes, or ranks wait for each
    other. Free space says little: there may be a quota, or others who write. Raises ``OSError``. A file system that
    cannot reserve (or another system than Linux) does nothing.
    """
    fallocate = getattr(ctypes.CDLL(None, use_errno=True), "fallocate", None)
    if fallocate is None:
        return
    handle = os.open(path, os.O_RDWR)
    try:
        ctypes.set_errno(errno.EINTR)
        while ctypes.get_errno() == errno.EINTR:
            ctypes.set_errno(0)
            fallocate(handle, _KEEP_SIZE, ctypes.c_int64(0), ctypes.c_int64(size + SPARE_BYTES))
        if (code := ctypes.get_errno()) in (errno.ENOSPC, errno.EDQUOT):
            raise OSError(code, os.strerror(code))
    finally:
        os.close(handle)


def _abandon(file: h5py.File, path: pathlib.Path, datasets: list[h5py.Dataset]) -> None:
    """Close and remove a file that could not be written, on all ranks.

    HDF5 crashes when it closes a file on a full disk, so its space is given back first.
    """
    if mpi.is_root() and path.exists():
        os.truncate(path, 0)
    mpi.barrier()
    try:
        file.close()
    except (OSError, RuntimeError):
        _UNCLOSED.append((file, datasets))
    mpi.barrier()
    if mpi.is_root():
        path.unlink(missing_ok=True)


def unclosed() -> bool:
    """Tell whether HDF5 still has a file that it could not close, and would crash over at the end of the program."""
    return bool(_UNCLOSED)


def make_durable(path: pathlib.Path) -> None:
    """Flush a file or a folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def publish(partial: pathlib.Path, path: pathlib.Path) -> None:
    """Give a finished file its real name, so that it survives a crash right after."""
    make_durable(partial)
    os.replace(partial, path)
    make_durable(path.parent)


def write_text_file(path: pathlib.Path, text: str) -> None:
    """Write a small text file under another name, then give it its real one; a failure leaves nothing of it."""
    partial = partial_path(path)
    try:
        partial.write_text(text, encoding="utf-8", newline="")
        publish(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
