"""Checkpoints: every bit back on any number of ranks, and damage found, on all ranks together."""

from __future__ import annotations

import itertools
import json
import os
import pathlib
import shutil

import h5py
import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.errors import CheckpointError, InputError
from f2s_hpc.grid.pages import real_bytes
from f2s_hpc.io import checkpoint, layout, manifest, runs
from f2s_hpc.io.layout import Block

CELLS = (11, 7, 9)
NODES = tuple(n + 1 for n in CELLS)
SPLITS = ("z", "x", "brick")


def cut(count: int, parts: int) -> list[int]:
    """Return uneven bounds: each part is about twice as long as the one before."""
    weights = np.cumsum([0, *(2.0**n for n in range(parts))])
    bounds = np.maximum(np.round(count * weights / weights[-1]).astype(int), np.arange(parts + 1))
    return [*bounds[:-1].tolist(), count]


def box(split: str, cells: tuple[int, int, int], node: bool, rank: int, size: int):
    """Return (start, shape) (k, j, i) of ``rank``; the last part of an axis owns its extra node."""
    ranks = {"z": (size, 1, 1), "x": (1, 1, size)}.get(split, (1, 2, size // 2) if size % 2 == 0 else (1, size, 1))
    place = list(itertools.product(*(range(n) for n in ranks)))[rank]
    start, shape = [], []
    for count, parts, number in zip(cells, ranks, place, strict=True):
        bounds = cut(count, parts)
        last = bounds[number + 1] + (node and number == parts - 1)
        start.append(bounds[number])
        shape.append(last - bounds[number])
    return tuple(start), tuple(shape)


def whole_field(name: str) -> np.ndarray:
    """Return a field with every kind of float in it, the same on all ranks."""
    shape = NODES if name.startswith("velocity") else CELLS
    data = np.random.Generator(np.random.PCG64(sum(map(ord, name)))).standard_normal(shape)
    data.ravel()[:6] = [-0.0, np.inf, np.nan, 5e-324, np.nextafter(1.0, 2.0), 1.7e308]
    data.view(np.uint64).ravel()[6] = 0x7FF8000000000123  # a NaN that carries a number
    return data


def my_block(name: str, split: str, whole: np.ndarray | None = None) -> Block:
    """Return this rank's block, as a view into an array with two ghost layers."""
    whole = whole_field(name) if whole is None else whole
    start, shape = box(split, CELLS, name.startswith("velocity"), mpi.rank(), mpi.size())
    ghosted = np.full(tuple(n + 4 for n in shape), 1e99)
    data = ghosted[2:-2, 2:-2, 2:-2]
    data[...] = whole[layout.box_selection(start, shape)]
    return Block(name, data, start, whole.shape)


def my_blocks(split: str = "z") -> list[Block]:
    return [my_block(name, split) for name in ("mass", "velocity_x", "peeq")]


def requests(split: str) -> dict:
    return {block.name: (block.start, block.data.shape) for block in my_blocks(split)}


@pytest.fixture
def folder(shared_path: pathlib.Path) -> pathlib.Path:
    """Return one folder for all ranks, not made yet."""
    return shared_path / "checkpoints"


def on_root(task) -> None:
    if mpi.is_root():
        task()
    mpi.barrier()


def equal_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and np.array_equal(np.ascontiguousarray(a).view(np.uint64), b.view(np.uint64))


@pytest.mark.mpi
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("at_once", [1, 2**20])
def test_file_holds_the_bytes_of_the_whole_field(folder, split, at_once, monkeypatch):
    """Fails when ``write_collective`` selects at (0, 0, 0) instead of ``start`` (2 ranks or more), when ``in_slab``
    leaves out ``low``, or when ``write_checkpoint`` asks for "f4" instead of "f8"."""
    monkeypatch.setattr(layout, "AT_ONCE", at_once)
    path = checkpoint.write_checkpoint(folder, 3, my_blocks(split), {"step": 12})
    assert path.name == "checkpoint_cycle_0003_step_00000012.h5"
    arrays, _ = runs.open_checkpoint_serial(path)
    for name in ("mass", "velocity_x", "peeq"):
        assert equal_bits(arrays[name], whole_field(name))


@pytest.mark.mpi
@pytest.mark.parametrize(("written", "read"), [("z", "x"), ("x", "brick"), ("brick", "z")])
def test_read_on_another_decomposition(folder, written, read):
    """Fails when ``read_checkpoint`` reads from (0, 0, 0) instead of ``start`` (2 ranks or more)."""
    path = checkpoint.write_checkpoint(folder, 1, my_blocks(written), {"step": 5})
    arrays, _ = checkpoint.read_checkpoint(path, requests(read))
    for block in my_blocks(read):
        assert equal_bits(block.data, arrays[block.name])


@pytest.mark.mpi
def test_what_is_void_takes_no_memory_when_it_is_read(folder):
    """A run of a mostly void box is resumed in the memory that it ran in. Fails with ``dataset[...]`` as it is read."""
    shape, whole = (200, 40, 64), (200, 40, 64 * mpi.size())
    data = np.zeros(shape)
    data[3], data[5, 0, 0] = 1.5, -0.0
    path = checkpoint.write_checkpoint(folder, 1, [Block("mass", data, (0, 0, 64 * mpi.rank()), whole)], {})
    found = checkpoint.read_checkpoint(path, {"mass": ((0, 0, 64 * mpi.rank()), shape)})[0]["mass"]
    assert real_bytes(found) < data.nbytes / 20
    assert equal_bits(found, data)


@pytest.mark.mpi
def test_read_overlapping_and_partial_boxes(folder):
    path = checkpoint.write_checkpoint(folder, 1, my_blocks(), {})
    wanted = ((2, 1, 3), (5 + mpi.rank() % 2, 4, 2))
    arrays, _ = checkpoint.read_checkpoint(path, {"mass": wanted})
    assert equal_bits(whole_field("mass")[layout.box_selection(*wanted)], arrays["mass"])
    with pytest.raises(CheckpointError, match="no field 'pressure'"):
        checkpoint.read_checkpoint(path, {"pressure": wanted} if mpi.is_root() else {"mass": wanted})
    with pytest.raises(CheckpointError, match="not in it"):
        checkpoint.read_checkpoint(path, {"mass": ((9, 0, 0), (3, 1, 1))})


@pytest.mark.mpi
def test_attributes_come_back_exactly(folder):
    """Fails when ``encode_json`` rounds, e.g. writes floats with ``format(value, '.15g')``."""
    attributes = {
        "step": 9_007_199_254_740_993, "time_s": 0.1 + 0.2, "tiny": 5e-324, "nan": float("nan"), "title": "Kupfer µm",
        "seed": np.int64(-(2**63)), "counter": np.uint64(2**64 - 1), "ledger": {"heat_J": np.float64(1 / 3)},
        "table": np.array([[0.1, 1e-310], [np.pi, -0.0]]), "toml": 'size = "3 um"\n' * 9000,
    }
    path = checkpoint.write_checkpoint(folder, 1, my_blocks(), attributes if mpi.is_root() else {"step": 1})
    _, found = checkpoint.read_checkpoint(path, requests("z"))
    assert found["step"] == 9_007_199_254_740_993
    assert found["title"] == "Kupfer µm"
    assert found["time_s"].hex() == (0.1 + 0.2).hex()
    assert found["tiny"] == 5e-324
    assert np.isnan(found["nan"])
    assert found["seed"] == -(2**63)
    assert found["counter"] == 2**64 - 1
    assert found["ledger"] == {"heat_J": 1 / 3}
    assert str(found["table"]) == str([[0.1, 1e-310], [np.pi, -0.0]])
    assert found["toml"] == attributes["toml"]


def test_checksum_formula():
    """The checksum, against the formula in Python integers.

    Fails when ``partial_checksums`` forgets ``start`` in k, or ``mix`` one of its shifts.
    """
    mask = 2**64 - 1

    def mix(bits: int) -> int:
        bits = (bits * 0x9E3779B97F4A7C15) & mask
        bits = ((bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9) & mask
        bits = ((bits ^ (bits >> 27)) * 0x94D049BB133111EB) & mask
        return bits ^ (bits >> 31)

    data = whole_field("mass")
    expected = sum(mix(int(bits) ^ mix(index + 1)) for index, bits in enumerate(data.view(np.uint64).ravel())) & mask
    for parts in (1, 2, 4):
        for split in SPLITS:
            boxes = [box(split, CELLS, False, rank, parts) for rank in range(parts)]
            blocks = [[Block("mass", data[layout.box_selection(*b)], b[0], CELLS)] for b in boxes]
            shares = [int(share) for block in blocks for share in manifest.partial_checksums(block)]
            assert sum(shares) & mask == expected


def test_checksum_sees_every_change(monkeypatch):
    """Fails when ``place`` is left out of the sum (a swap goes unseen), or when the values are multiplied by
    it instead of mixed (two flipped signs go unseen)."""
    def checksum(data: np.ndarray) -> int:
        return int(manifest.partial_checksums([Block("mass", data, (0, 0, 0), data.shape)])[0])

    data = whole_field("mass")
    seen = {checksum(data)}
    for cells, bit in [([0], 63), ([0], 0), ([40], 52), ([data.size - 1], 63), ([7, 8], 63)]:
        changed = data.copy()
        changed.view(np.uint64).ravel()[cells] ^= np.uint64(1 << bit)
        seen.add(checksum(changed))
    swapped = data.copy()
    swapped.ravel()[[20, 21]] = swapped.ravel()[[21, 20]]
    seen.add(checksum(swapped))
    assert len(seen) == 7
    monkeypatch.setattr(manifest, "CELLS_AT_ONCE", 100)
    assert checksum(data) in seen


def flip_bit_in_field(path: pathlib.Path) -> None:
    with h5py.File(path, "r") as file:
        place = file["fields/peeq"].id.get_offset() + 8 * 300
    with path.open("r+b") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 16]))


def change_attributes(path: pathlib.Path) -> None:
    with h5py.File(path, "r+") as file:
        text = layout.read_text(file, "attributes")
        file["attributes"][()] = np.bytes_(text.replace("0.25", "0.26").encode())


def truncate(path: pathlib.Path) -> None:
    os.truncate(path, path.stat().st_size - 2000)


def truncate_and_lie(path: pathlib.Path) -> None:
    """Cut the file and make the manifest's size agree: only opening it tells."""
    truncate(path)
    place = manifest.manifest_path(path)
    place.write_text(json.dumps({**json.loads(place.read_text()), "size": path.stat().st_size}))


DAMAGE = {
    "bit": (flip_bit_in_field, "peeq"),
    "attributes": (change_attributes, "attributes have another checksum"),
    "truncated": (truncate, "the manifest says"),
    "unreadable": (truncate_and_lie, "damaged checkpoint"),
    "no manifest": (lambda path: manifest.manifest_path(path).unlink(), "never finished"),
    "half manifest": (lambda path: os.truncate(manifest.manifest_path(path), 40), "damaged manifest"),
    "empty manifest": (lambda path: manifest.manifest_path(path).write_text("[]"), "damaged manifest"),
    "no file": (lambda path: path.unlink(), "no valid checkpoint|file is missing"),
}


@pytest.mark.mpi
@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_checkpoint_is_refused_and_the_older_taken(folder, kind):
    """Fails when ``verify_checkpoint`` skips the checksums ("bit"), the digest of the attributes
    ("attributes"), or ``read_manifest`` the size ("truncated")."""
    damage, message = DAMAGE[kind]
    older = checkpoint.write_checkpoint(folder, 1, my_blocks(), {"step": 100, "time_s": 0.25})
    newer = checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 200, "time_s": 0.25})
    assert checkpoint.newest_valid_checkpoint(folder) == (newer, [])
    on_root(lambda: damage(newer))
    with pytest.raises(CheckpointError, match=message):
        checkpoint.read_checkpoint(newer, requests("z"))
    with pytest.raises(CheckpointError, match=message):
        checkpoint.read_checkpoint(newer, {"mass": ((0, 0, 0), (1, 1, 1))})
    path, skipped = checkpoint.newest_valid_checkpoint(folder)
    assert path == older
    if kind != "no file":
        assert len(skipped) == 1
        assert newer.name.split(".")[0] in skipped[0]
    on_root(lambda: damage(older))
    with pytest.raises(CheckpointError, match=f"no valid checkpoint.*{message}|{message}"):
        checkpoint.newest_valid_checkpoint(folder)


@pytest.mark.mpi
def test_no_checkpoint_at_all(folder):
    with pytest.raises(InputError, match="no such folder"):
        checkpoint.newest_valid_checkpoint(folder / "nowhere")
    folder.mkdir(exist_ok=True)
    with pytest.raises(CheckpointError, match="no valid checkpoint to continue from"):
        checkpoint.newest_valid_checkpoint(folder)
    with pytest.raises(CheckpointError, match="no manifest"):
        checkpoint.read_checkpoint(folder / "checkpoint_cycle_0001_step_00000001.h5", requests("z"))


@pytest.mark.mpi
def test_newest_is_by_cycle_then_step_then_rewrite(folder):
    """Fails when ``list_checkpoints`` sorts by name: step 100000000 has one digit more."""
    blocks = my_blocks()
    for cycle, step in [(2, 100_000_000), (2, 99_999_999), (1, 200_000_000)]:
        checkpoint.write_checkpoint(folder, cycle, blocks, {"step": step})
    first, _ = checkpoint.newest_valid_checkpoint(folder)
    assert layout.checkpoint_key(first.name) == (2, 100_000_000, 1)
    again = checkpoint.write_checkpoint(folder, 2, blocks, {"step": 100_000_000})
    assert first.exists()
    assert again != first
    assert checkpoint.newest_valid_checkpoint(folder)[0] == again


@pytest.mark.mpi
def test_every_so_many_cycles_a_checkpoint_stays(folder):
    """The end of a cycle, not what was saved in the middle of the next. Fails when ``_ends_of_cycles`` takes the last.
    """
    for cycle in (1, 2, 3, 4, 5):
        checkpoint.write_checkpoint(folder, cycle, my_blocks(), {"step": 10 * cycle})
        checkpoint.write_checkpoint(folder, cycle, my_blocks(), {"step": 10 * cycle + 5})
        mpi.barrier()
        checkpoint.prune(folder, 1, 2)
    kept = [layout.checkpoint_key(path.name)[:2] for path in checkpoint.list_checkpoints(folder)]
    assert kept == [(2, 20), (4, 40), (5, 50), (5, 55)]  # (the newest end of a cycle besides)


@pytest.mark.mpi
def test_prune_keeps_the_newest_and_sweeps_leftovers(folder):
    """Fails when ``remove`` compares with ``<=`` instead of ``<``."""
    for cycle in (1, 2, 3, 4):
        checkpoint.write_checkpoint(folder, cycle, my_blocks(), {"step": cycle})
    leftover = folder / ".checkpoint_cycle_0004_step_00000009.h5.partial"
    on_root(lambda: leftover.write_bytes(b"half"))
    orphan = folder / layout.checkpoint_name(2, 2)
    on_root(lambda: manifest.manifest_path(orphan).unlink())
    deleted = checkpoint.prune(folder, 2)
    assert deleted == [layout.checkpoint_name(1, 1), layout.checkpoint_name(2, 2)]
    kept = [folder / layout.checkpoint_name(cycle, cycle) for cycle in (3, 4)]
    assert sorted(folder.iterdir()) == sorted([*kept, *(path.with_suffix(".json") for path in kept)])
    on_root(lambda: flip_bit_in_field(kept[1]))
    assert checkpoint.prune(folder, 1) == []
    assert kept[0].exists()
    with pytest.raises(ValueError, match="keep = 0"):
        checkpoint.prune(folder, 0)


@pytest.mark.mpi
def test_wrong_blocks_end_all_ranks_alike(folder):
    """Each fault is on the last rank only."""
    last = mpi.rank() == mpi.size() - 1
    good = my_block("mass", "z")
    for bad, message in [
        (Block("mass", good.data[:, :, :-1], good.start, good.global_shape), "do not tile"),
        (Block("mass", np.zeros(good.data.shape, np.float32), good.start, good.global_shape), "not a float64"),
        (Block("mass", good.data, (good.start[0] + 1, 0, 0), good.global_shape), "outside"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            checkpoint.write_checkpoint(folder, 1, [bad if last else good], {})
    with pytest.raises(CheckpointError, match="share a name"):
        checkpoint.write_checkpoint(folder, 1, [good, good], {})
    with pytest.raises(CheckpointError, match="object cannot be saved as JSON"):
        checkpoint.write_checkpoint(folder, 1, [good], {"thing": object()})
    if mpi.size() > 1:
        other = [Block("peeq", good.data, good.start, good.global_shape)]
        with pytest.raises(CheckpointError, match="other fields than rank 0"):
            checkpoint.write_checkpoint(folder, 1, other if last else [good], {})
    assert not folder.exists() or not list(folder.iterdir())


@pytest.mark.mpi
def test_overlapping_blocks_do_not_read_back(folder):
    """Blocks that overlap and leave a gap of the same size pass the count; the read-back finds them."""
    good = my_block("mass", "z")
    if mpi.size() == 1:
        pytest.skip("one rank has no overlap")
    shifted = Block("mass", good.data, (good.start[0] - (mpi.rank() == mpi.size() - 1), 0, 0), good.global_shape)
    with pytest.raises(CheckpointError, match="does not read back"):
        checkpoint.write_checkpoint(folder, 1, [shifted], {})
    mpi.barrier()
    assert not list(folder.iterdir())


@pytest.mark.mpi
def test_failure_before_the_manifest_leaves_the_older_one(folder, monkeypatch):
    """Of a full disk nothing is left, of a crash a file that does not count. Fails when ``finish`` removes nothing."""
    older = checkpoint.write_checkpoint(folder, 1, my_blocks(), {"step": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_manifest", full)
    with pytest.raises(CheckpointError, match="No space left"):
        checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    monkeypatch.undo()
    mpi.barrier()
    assert sorted(folder.iterdir()) == [older, manifest.manifest_path(older)]
    killed = checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 1})
    on_root(manifest.manifest_path(killed).unlink)
    path, skipped = checkpoint.newest_valid_checkpoint(folder)
    assert path == older
    assert "never finished" in skipped[0]
    again = checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    assert checkpoint.newest_valid_checkpoint(folder)[0] == again


@pytest.mark.mpi
def test_full_disk_ends_all_ranks_alike(folder, monkeypatch):
    """Too little space is told before writing; a write that fails on one rank ends all and leaves no file."""
    older = checkpoint.write_checkpoint(folder, 1, my_blocks(), {"step": 1})
    usage = shutil.disk_usage(folder)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=210_000))
    with pytest.raises(CheckpointError, match=r"cannot write checkpoint_cycle_0002.*needs 0.2 MB, 0.2 MB are free"):
        checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**9 if not told else 1000))
    told, check = [], layout._check_space
    monkeypatch.setattr(layout, "_check_space", lambda *arguments: (check(*arguments), told.append(1)))
    with pytest.raises(CheckpointError, match=r"0\.0 MB are free"):
        checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    monkeypatch.undo()
    write, calls = layout.write_collective, []

    def fail_on_last(dataset, block, slab):
        write(dataset, block, slab)
        calls.append(block.name)
        if mpi.rank() == mpi.size() - 1 and len(calls) == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(layout, "write_collective", fail_on_last)
    with pytest.raises(CheckpointError, match=r"cannot write checkpoint_cycle_0002.*No space left"):
        checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    assert calls == ["mass", "velocity_x"]
    monkeypatch.undo()
    mpi.barrier()
    assert sorted(folder.iterdir()) == [older, manifest.manifest_path(older)]
    assert checkpoint.newest_valid_checkpoint(folder) == (older, [])


@pytest.mark.mpi
def test_silent_write_failure_is_found(folder, monkeypatch):
    """MPI libraries have reported success on a full disk. Fails when ``write_checkpoint`` skips the read-back."""
    write = layout.write_collective

    def lose_the_last(dataset, block, slab):
        if block.name == "peeq":
            block = Block(block.name, np.zeros_like(block.data), block.start, block.global_shape)
        write(dataset, block, slab)

    monkeypatch.setattr(layout, "write_collective", lose_the_last)
    with pytest.raises(CheckpointError, match="'peeq' does not read back as written"):
        checkpoint.write_checkpoint(folder, 2, my_blocks(), {"step": 2})
    mpi.barrier()
    assert not list(folder.iterdir())


@pytest.mark.mpi
def test_folder_that_cannot_be_made(folder):
    on_root(lambda: folder.write_text("a file"))
    with pytest.raises(CheckpointError, match="cannot write a checkpoint"):
        checkpoint.write_checkpoint(folder, 1, my_blocks(), {})
