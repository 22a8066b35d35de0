"""Ghosts behind the physical sides of the box."""

from __future__ import annotations

from f2s_hpc._jit import borrowed, inlined, kernel

NONE, MIRROR, VOID, COPY, EVEN = 0, 1, 2, 3, 4


@kernel
def _fill_row(memory, offsets, signs, rule, active, k, j, row_length, to, of, block):
    """Fill the ghosts of one row (k, j) behind a side normal to y or z, where its blocks are active."""
    blocks = active.shape[2]
    kk, jj = min(k, active.shape[0] - 1), min(j, active.shape[1] - 1)
    b = 0
    while b < blocks:
        if active[kk, jj, b]:
            first = b * block
            while b < blocks and active[kk, jj, b]:
                b += 1
            n = (row_length if b == blocks else b * block) - first
            for f in range(offsets.size):
                factor = 0.0 if rule == VOID else (signs[f] if rule == MIRROR else 1.0)
                target, source = memory[offsets[f] + to + first:], memory[offsets[f] + of + first:]
                for i in range(n):
                    target[i] = factor * source[i]
        b += 1


@inlined
def _fill_end(memory, offsets, signs, rule, edge, direction, first, end, on_nodes, active, k, j, row, block):
    """Fill the ghost layers ``first`` to ``end`` - 1 at one end of a row (k, j) that starts at ``row``, where active.

    ``edge``: index of the last layer inside the box; ``direction``: -1 at the low end, +1 at the high one.
    """
    last = active.shape[2] - 1
    near, far = min((edge + direction * first) // block, last), min((edge + direction * (end - 1)) // block, last)
    if not active[k, j, near] and not active[k, j, far]:
        return
    mirrored, inner = rule == MIRROR or rule == EVEN, 0 if on_nodes else 1
    for f in range(offsets.size):
        factor = 0.0 if rule == VOID else (signs[f] if rule == MIRROR else 1.0)
        place = offsets[f] + row + edge
        for layer in range(first, end):
            if active[k, j, min((edge + direction * layer) // block, last)]:
                source = place - direction * (layer - inner) if mirrored else place
                memory[place + direction * layer] = factor * memory[source]


@inlined
def _is_empty(active, k):
    """Return whether no block of plane ``k`` is active."""
    blocks = 0
    for j in range(active.shape[1]):
        for b in range(active.shape[2]):
            blocks += active[k, j, b]
    return blocks == 0


@kernel
def fill_ghosts(memory, offsets, shape, axis, rules, edges, layers, on_nodes, signs, active, block):
    """Fill the ghost layers of several fields behind both sides of the box normal to ``axis``, where blocks are active.

    ``offsets``: where the fields start in ``memory``; ``shape``: (nz, ny, nx) of their local arrays. ``axis``: 0, 1, 2
    for x, y, z. Per side, low and high: ``rules`` NONE leaves it alone (another rank is there), MIRROR reflects with
    ``signs`` (one per field), EVEN without a change of sign, VOID writes zero, COPY repeats the edge layer; ``edges``:
    index of the last layer inside the box. ``on_nodes``: that layer is the wall itself. ``active``: blocks (nz, ny,
    blocks) of ``block`` cells; elsewhere all is zero. Layers of both sides take turns, since in a box thinner than the
    ghosts the mirror image of one lies behind the other.
    """
    nz, ny, nx = shape
    memory = borrowed(memory)
    strides = (1, nx, nx * ny)
    if axis == 0:
        together = layers if edges[1] - edges[0] > layers else 1
        for k in range(nz):
            kk = min(k, active.shape[0] - 1)
            if _is_empty(active, kk):
                continue
            for j in range(ny):
                jj = min(j, active.shape[1] - 1)
                for first in range(1, layers + 1, together):
                    for high in range(2):
                        if rules[high] != NONE:
                            _fill_end(memory, offsets, signs, rules[high], edges[high], 2 * high - 1, first,
                                      first + together, on_nodes, active, kk, jj, k * strides[2] + j * nx, block)
        return
    for layer in range(1, layers + 1):
        for high in range(2):
            rule, edge, direction = rules[high], edges[high], 2 * high - 1
            if rule == NONE:
                continue
            target = edge + direction * layer
            source = edge
            if rule == MIRROR or rule == EVEN:
                source = edge - direction * (layer if on_nodes else layer - 1)
            if axis == 1:
                for k in range(nz):
                    plane = k * strides[2]
                    _fill_row(memory, offsets, signs, rule, active, k, target, nx, plane + target * nx,
                              plane + source * nx, block)
            else:
                for j in range(ny):
                    _fill_row(memory, offsets, signs, rule, active, target, j, nx, target * strides[2] + j * nx,
                              source * strides[2] + j * nx, block)
