"""Ghosts behind the physical sides of the box."""

from __future__ import annotations

from f2s_hpc._jit import kernel

NONE, MIRROR, VOID, COPY = 0, 1, 2, 3


@kernel
def _copy(memory, offsets, signs, rule, to, of, first, last, stride):
    """Fill ghosts ``first`` to ``last`` of a row of every field: ``to``, ``of`` start of the row filled and copied."""
    for f in range(offsets.size):
        factor = 0.0 if rule == VOID else (signs[f] if rule == MIRROR else 1.0)
        a, b = offsets[f] + to, offsets[f] + of
        for i in range(first, last):
            memory[a + i * stride] = factor * memory[b + i * stride]


@kernel
def _fill_row(memory, offsets, signs, rule, active, k, j, row_length, to, of, block):
    """Fill the ghosts of one row (k, j) behind a side normal to y or z, where its blocks are active."""
    blocks = active.shape[2]
    kk, jj = min(k, active.shape[0] - 1), min(j, active.shape[1] - 1)
    b = 0
    while b < blocks:
        if active[kk, jj, b]:
            first = b
            while b < blocks and active[kk, jj, b]:
                b += 1
            last = row_length if b == blocks else b * block
            _copy(memory, offsets, signs, rule, to, of, first * block, last, 1)
        b += 1


@kernel
def fill_ghosts(memory, offsets, shape, axis, rules, edges, ghosts, on_nodes, signs, active, block):
    """Fill the ghost layers of several fields behind both sides of the box normal to ``axis``, where blocks are active.

    ``offsets``: where the fields start in ``memory``; ``shape``: (nz, ny, nx) of their local arrays. ``axis``: 0, 1, 2
    for x, y, z. Per side, low and high: ``rules`` NONE leaves it alone (another rank is there), MIRROR reflects with
    ``signs`` (one per field), VOID writes zero, COPY repeats the edge layer; ``edges``: index of the last layer inside
    the box. ``on_nodes``: that layer is the wall itself. ``active``: blocks (nz, ny, blocks) of ``block`` cells;
    elsewhere all is zero. Layers of both sides take turns, since in a box thinner than the ghosts the mirror image of
    one lies behind the other.
    """
    nz, ny, nx = shape
    strides = (1, nx, nx * ny)
    for layer in range(1, ghosts + 1):
        for high in range(2):
            rule, edge, direction = rules[high], edges[high], 2 * high - 1
            if rule == NONE:
                continue
            target = edge + direction * layer
            source = edge
            if rule == MIRROR:
                source = edge - direction * (layer if on_nodes else layer - 1)
            if axis == 0:
                b = min(target // block, active.shape[2] - 1)
                for k in range(nz):
                    for j in range(ny):
                        if active[min(k, active.shape[0] - 1), min(j, active.shape[1] - 1), b]:
                            row = k * strides[2] + j * nx
                            _copy(memory, offsets, signs, rule, row + target, row + source, 0, 1, 1)
            elif axis == 1:
                for k in range(nz):
                    plane = k * strides[2]
                    _fill_row(memory, offsets, signs, rule, active, k, target, nx, plane + target * nx,
                              plane + source * nx, block)
            else:
                for j in range(ny):
                    _fill_row(memory, offsets, signs, rule, active, target, j, nx, target * strides[2] + j * nx,
                              source * strides[2] + j * nx, block)


@kernel
def block_inflow(flux, mass_flux, axis, plane, outward):
    """Zero what would enter through the plane ``plane`` of faces; ``outward`` is +1 on a high side, -1 on a low one."""
    nz, ny, nx = flux.shape
    n1, n2 = (nz, ny) if axis == 0 else ((nz, nx) if axis == 1 else (ny, nx))
    for b in range(n1):
        for a in range(n2):
            if axis == 0:
                k, j, i = b, a, plane
            elif axis == 1:
                k, j, i = b, plane, a
            else:
                k, j, i = plane, b, a
            if flux[k, j, i] * outward < 0.0:
                flux[k, j, i] = 0.0
                mass_flux[k, j, i] = 0.0
