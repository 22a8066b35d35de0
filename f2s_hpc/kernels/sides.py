"""Ghosts behind the physical sides of the box."""

from __future__ import annotations

from f2s_hpc._jit import kernel

MIRROR, VOID, COPY = 0, 1, 2


@kernel
def fill_side(memory, offsets, shape, axis, high, edge, ghosts, on_nodes, rule, signs):
    """Fill the ghost layers of several fields behind one side of the box.

    ``offsets``: where the fields start in ``memory``; ``shape``: (nz, ny, nx) of their local arrays. ``axis``: 0, 1, 2
    for x, y, z; ``edge``: index of the last layer inside the box; ``on_nodes``: that layer is the wall itself.
    ``rule``: MIRROR reflects with ``signs`` (one per field), VOID writes zero, COPY repeats the edge layer.
    """
    nz, ny, nx = shape
    strides = (1, nx, nx * ny)
    p, q = (strides[1], strides[2]) if axis == 0 else (1, strides[2] if axis == 1 else strides[1])
    np_, nq = (ny, nz) if axis == 0 else (nx, nz if axis == 1 else ny)
    direction = 1 if high else -1
    for f in range(offsets.size):
        for layer in range(1, ghosts + 1):
            target = edge + direction * layer
            source = edge
            if rule == MIRROR:
                source = edge - direction * (layer if on_nodes else layer - 1)
            factor = 0.0 if rule == VOID else (signs[f] if rule == MIRROR else 1.0)
            to, of = offsets[f] + target * strides[axis], offsets[f] + source * strides[axis]
            for b in range(nq):
                for a in range(np_):
                    memory[to + b * q + a * p] = factor * memory[of + b * q + a * p]


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
