"""What HDF5 is here, and whether all ranks can write and read one file together."""

from __future__ import annotations

import pathlib

import h5py
import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import F2SError

ROWS_PER_RANK = 1000


def hdf5_versions() -> tuple[str, str, bool]:
    """Return the version of h5py, that of HDF5, and whether h5py is the parallel (MPI) build."""
    return h5py.version.version, h5py.version.hdf5_version, bool(h5py.get_config().mpi)


def write_and_read(path: pathlib.Path) -> int:
    """Write one file from all ranks, read each rank's part on its neighbour; return the bytes written.

    Collective over all ranks. The file is left in place. Raises ``F2SError`` on every rank if h5py
    is the serial build, or if a rank read something else than its neighbour wrote.
    """
    if not h5py.get_config().mpi:
        raise F2SError("h5py is the serial build: it can not write one file from several ranks")
    ranks, rank = mpi.size(), mpi.rank()
    with h5py.File(path, "w", driver="mpio", comm=mpi.world()) as file:
        dataset = file.create_dataset("rows", (ranks * ROWS_PER_RANK,), dtype="f8")
        with dataset.collective:
            dataset[rank * ROWS_PER_RANK:(rank + 1) * ROWS_PER_RANK] = _rows(rank)
    neighbour = (rank + 1) % ranks
    with h5py.File(path, "r", driver="mpio", comm=mpi.world()) as file:
        dataset = file["rows"]
        with dataset.collective:
            found = dataset[neighbour * ROWS_PER_RANK:(neighbour + 1) * ROWS_PER_RANK]
    wrong = not np.array_equal(found, _rows(neighbour))
    if mpi.any_rank(wrong):
        raise F2SError(f"{path}: what was read back differs from what was written")
    return ranks * ROWS_PER_RANK * 8


def _rows(rank: int) -> np.ndarray:
    return np.sqrt(np.arange(rank * ROWS_PER_RANK, (rank + 1) * ROWS_PER_RANK, dtype=np.float64))
