"""Ghosts behind the physical sides of the box."""

from __future__ import annotations

from f2s_hpc._jit import kernel

MIRROR, VOID, COPY = 0, 1, 2


@kernel
def fill_side(array, axis, high, edge, ghosts, on_nodes, rule, sign):
    """Fill the ghost layers of a 3-D local array behind one side of the box.

    ``axis``: 0, 1, 2 for x, y, z; ``edge``: index of the first owned layer (low side) or of the
    last owned layer (high side); ``on_nodes``: the edge layer is the wall itself. ``rule``: MIRROR reflects with
    ``sign``, VOID writes zero, COPY repeats the edge layer.
    """
    nz, ny, nx = array.shape
    direction = 1 if high else -1
    for layer in range(1, ghosts + 1):
        target = edge + direction * layer
        source = edge
        if rule == MIRROR:
            source = edge - direction * (layer if on_nodes else layer - 1)
        factor = 0.0 if rule == VOID else (sign if rule == MIRROR else 1.0)
        if axis == 0:
            for k in range(nz):
                for j in range(ny):
                    array[k, j, target] = factor * array[k, j, source]
        elif axis == 1:
            for k in range(nz):
                for i in range(nx):
                    array[k, target, i] = factor * array[k, source, i]
        else:
            for j in range(ny):
                for i in range(nx):
                    array[target, j, i] = factor * array[source, j, i]


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
