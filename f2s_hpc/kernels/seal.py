"""Cells inside material, that geometry left with a trace of void: they stay full.

Reconstructed planes and split sweeps leave a part in a thousand of void in cells far behind the surface. Under pressure
such void closes. Where material spreads, pulled along a wall or around a rim, it grows instead, since a cell with any
void bears no pressure: the material tears along the cells that geometry has marked. Metal has no such marks; what opens
it is tension beyond its spall strength, and to that sealed cells are held as all full ones are.
"""

from __future__ import annotations

from f2s_hpc._jit import borrowed, kernel
from f2s_hpc.materials.pressure import stiffness, unloaded

TRACE = 2e-3
"""Share of void up to which a cell is sealed: what geometry leaves there. Bulk modulus times this is its tension."""

INSIDE = 0.9
"""Fill from which a neighbour counts as material: a cell between six such ones has no surface of its own."""


@kernel
def seal_cells(runs, count, window, shape, spall, eos, energy, mass, peeq, fraction):
    """Set the volume fraction of sealed cells in ``window`` to one; mass stays, so they bear tension.

    Sealed is what has at most ``TRACE`` of void, has yielded (``peeq`` above zero: in purely geometric motion nothing
    pulls the void shut again), bears less tension than ``spall`` (Pa), and lies between six cells that are filled to
    ``INSIDE``. ``mass``: in full cells, valid one layer around the window; ``energy`` (J/kg, a field of one number
    where the pressure does not depend on it): hot material fills a cell with less mass.
    """
    ny, nx = shape
    row, plane = nx, nx * ny
    least = max(1.0 - TRACE, 1.0 - spall / stiffness(eos, 1.0, 0.0))
    mass, peeq, fraction, energy = borrowed(mass), borrowed(peeq), borrowed(fraction), borrowed(energy)
    carried = energy.size > 1
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        cell = (k * ny + j) * nx
        for c in range(cell + max(runs[r, 2], window[4]), cell + min(runs[r, 3], window[5])):
            if fraction[c] >= 1.0 or peeq[c] <= 0.0:
                continue
            free = unloaded(eos, energy[c] if carried else 0.0)
            if mass[c] < least * free:
                continue
            around = min(mass[c - 1], mass[c + 1], mass[c - row], mass[c + row], mass[c - plane], mass[c + plane])
            if around >= INSIDE * free:
                fraction[c] = 1.0
