"""Which cells are worth touching: blocks of a grid row that hold material or border on it.

A row (k, j) is divided into blocks of ``BLOCK`` cells. A block is active if it holds a cell that
material can reach in the step, at most one cell away in any direction, or a node of such a cell;
nodes carry the index of the cell above them, so the margin is one on the low side and two on the
high side. Everything outside is void and all its fields are zero, so kernels that skip it give the
same bits as kernels that do not.
"""

from __future__ import annotations

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.materials.pressure import pressure

BLOCK = 16

SPARE = 0.25
"""Columns that differ by less than this share of their length are walked as one."""


@kernel
def mark_material(mass, shape, ghosts, active, holds):
    """Note in ``holds`` which blocks contain material: looks at the active ones and at those with ghosts.

    Material of another rank appears in the ghosts, also of blocks at rest. ``mass`` flat cell array;
    ``shape`` (nz, ny, nx) of it; ``ghosts``: layers of them on each side; ``active``, ``holds`` uint8 arrays (nz, ny,
    blocks). Bits of ``holds``: 1 any cell, 2 the first
    cell, 4 one of the last two cells of the block.
    """
    nz, ny, nx = shape
    for k in range(nz):
        for j in range(ny):
            row = (k * ny + j) * nx
            outside = k < ghosts or k >= nz - ghosts or j < ghosts or j >= ny - ghosts
            for b in range(active.shape[2]):
                first = b * BLOCK
                last = min(first + BLOCK, nx)
                flag = 0
                if active[k, j, b] or outside or first < ghosts or last > nx - ghosts:
                    for i in range(first, last):
                        if mass[row + i] != 0.0:
                            flag = 1
                            break
                    if flag and mass[row + first] != 0.0:
                        flag |= 2
                    if flag and (mass[row + last - 1] != 0.0 or mass[row + max(last - 2, first)] != 0.0):
                        flag |= 4
                holds[k, j, b] = flag


@kernel
def grow_active(holds, active):
    """Set ``active`` to the blocks that material or its nodes can reach, from the marks of ``holds``."""
    nz, ny, blocks = holds.shape
    filled = np.zeros(nz, dtype=np.bool_)
    for k in range(nz):
        filled[k] = holds[k].any()
    for k in range(nz):
        if not filled[max(k - 2, 0):min(k + 2, nz)].any():
            # the empty height of a box costs nothing
            active[k] = 0
            continue
        for j in range(ny):
            for b in range(blocks):
                flag = 0
                for kk in range(max(k - 2, 0), min(k + 2, nz)):
                    for jj in range(max(j - 2, 0), min(j + 2, ny)):
                        flag |= holds[kk, jj, b] & 1
                        if b > 0:
                            flag |= holds[kk, jj, b - 1] & 4
                        if b + 1 < blocks:
                            flag |= holds[kk, jj, b + 1] & 2
                active[k, j, b] = flag != 0


@kernel
def list_runs(active, row_length, runs):
    """List the maximal runs of active cells as rows (k, j, first cell, end) of ``runs`` (int32).

    Returns the number of runs; when that exceeds the length of ``runs``, only the first were
    written and the caller calls again with a longer array.
    """
    nz, ny, blocks = active.shape
    count = 0
    for k in range(nz):
        for j in range(ny):
            b = 0
            while b < blocks:
                if active[k, j, b]:
                    first = b
                    while b < blocks and active[k, j, b]:
                        b += 1
                    if count < runs.shape[0]:
                        runs[count, 0] = k
                        runs[count, 1] = j
                        runs[count, 2] = first * BLOCK
                        runs[count, 3] = min(b * BLOCK, row_length)
                    count += 1
                b += 1
    return count


@kernel
def _segment(active, axis, fixed, block, start):
    """Return first and end row of the next active rows of a column from ``start`` on; equal when there are none."""
    length = active.shape[1] if axis == 1 else active.shape[0]
    t = start
    while t < length and not (active[fixed, t, block] if axis == 1 else active[t, fixed, block]):
        t += 1
    first = t
    while t < length and (active[fixed, t, block] if axis == 1 else active[t, fixed, block]):
        t += 1
    return first, t


@kernel
def _inactive(active, axis, fixed, first_block, end_block, first, end):
    """Return whether no block of a part of a plane is active."""
    for b in range(first_block, end_block):
        for t in range(first, end):
            if active[fixed, t, b] if axis == 1 else active[t, fixed, b]:
                return False
    return True


@kernel
def _joined(active, axis, column, block, first, end):
    """Return the rows that ``column`` and the stretch of the next ``block`` can share, or an empty stretch."""
    low, high = min(first, column[1]), max(end, column[2])
    if high - low > (1.0 + SPARE) * min(end - first, column[2] - column[1]):
        return 0, 0
    fixed, b0 = column[0], column[3] // BLOCK
    if (_inactive(active, axis, fixed, block, block + 1, low, first)
            and _inactive(active, axis, fixed, block, block + 1, end, high)
            and _inactive(active, axis, fixed, b0, block, low, column[1])
            and _inactive(active, axis, fixed, b0, block, column[2], high)):
        return low, high
    return 0, 0


@kernel
def list_columns(active, row_length, axis, columns):
    """List the columns of active blocks that a sweep across the rows walks.

    ``axis`` 1 (y): fixed index k, walking j; 2 (z): fixed index j, walking k. Rows of ``columns``
    (int32): fixed index, first row, end row, first cell, end cell. Stretches of neighbouring blocks that are much
    the same share a column over both: the inactive cells it takes in are void, stay void, and cost less than short
    rows.
    Returns the number of columns (see :func:`list_runs` for overflow).
    """
    nz, ny, blocks = active.shape
    count, most = 0, columns.shape[0]
    for fixed in range(nz if axis == 1 else ny):
        own = count
        for b in range(blocks):
            before = count
            first, end = _segment(active, axis, fixed, b, 0)
            while end > first:
                merged = False
                for c in range(own, min(before, most)):
                    if columns[c, 4] != b * BLOCK:
                        continue
                    low, high = _joined(active, axis, columns[c], b, first, end)
                    if high > low:
                        columns[c, 1], columns[c, 2] = low, high
                        columns[c, 4] = min((b + 1) * BLOCK, row_length)
                        merged = True
                        break
                if not merged:
                    if count < most:
                        columns[count, 0] = fixed
                        columns[count, 1] = first
                        columns[count, 2] = end
                        columns[count, 3] = b * BLOCK
                        columns[count, 4] = min((b + 1) * BLOCK, row_length)
                    count += 1
                first, end = _segment(active, axis, fixed, b, end)
    return count


@kernel
def retire(before, active, shape, memory, cells, nodes):
    """Zero every field on blocks that were active and are no more, so that all outside is zero.

    ``shape``: (ny, nx) of a cell array; ``cells``, ``nodes``: offsets into ``memory`` of the cell arrays and of the
    node and face arrays.
    """
    ny, nx = shape
    for k in range(active.shape[0]):
        for j in range(active.shape[1]):
            for b in range(active.shape[2]):
                if active[k, j, b] or not before[k, j, b]:
                    continue
                first, last = b * BLOCK, min((b + 1) * BLOCK, nx)
                cell, node = (k * ny + j) * nx, (k * (ny + 1) + j) * (nx + 1)
                for f in range(cells.size):
                    for i in range(first, last):
                        memory[cells[f] + cell + i] = 0.0
                for f in range(nodes.size):
                    for i in range(first, last):
                        memory[nodes[f] + node + i] = 0.0


@kernel
def look_at_planes(cells, nodes, shape, first, eos, mass, fraction, energy, u, v, w, filled, pressures, square):
    """Add up what each plane of cells holds, find its largest pressure and the largest speed of each plane of nodes.

    ``cells``, ``nodes``: (k0, k1, j0, j1, i0, i1) of those to look at; ``shape``: (ny, nx) of a cell array; ``first``:
    plane of the box that is the local plane 0. ``filled`` int64 takes the volume fractions in units of 2^-20,
    ``pressures`` the largest pressure, compressive or tensile (Pa), ``square`` the largest squared speed (m2/s2).
    """
    ny, nx = shape
    for k in range(cells[0], cells[1]):
        total, most = np.int64(0), 0.0
        for j in range(cells[2], cells[3]):
            row = (k * ny + j) * nx
            for c in range(row + cells[4], row + cells[5]):
                total += np.int64(fraction[c] * 1048576.0)
                if fraction[c] >= 1.0:
                    most = max(most, abs(pressure(eos, mass[c], energy[c] if energy.size > 1 else 0.0)))
        filled[first + k] += total
        pressures[first + k] = max(pressures[first + k], most)
    for k in range(nodes[0], nodes[1]):
        most = 0.0
        for j in range(nodes[2], nodes[3]):
            row = (k * (ny + 1) + j) * (nx + 1)
            for n in range(row + nodes[4], row + nodes[5]):
                most = max(most, u[n] * u[n] + v[n] * v[n] + w[n] * w[n])
        square[first + k] = max(square[first + k], most)


def block_count(row_length: int) -> int:
    """Return the number of blocks in a row of ``row_length`` cells."""
    return -(-row_length // BLOCK)


def empty_list(length: int, entries: int) -> np.ndarray:
    """Return an array for ``length`` runs (4 entries) or columns (5 entries)."""
    return np.empty((length, entries), dtype=np.int32)
