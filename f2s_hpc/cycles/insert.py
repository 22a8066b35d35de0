"""Painting material into the box: the substrate, and batches of spheres into the particle layer.

A batch may meet material still in the layer (stragglers of the last batch, splashed fragments), and spheres that
waited may meet those of the batch they are joined to. A sphere that would overfill a cell is moved by as little as
frees it, else kept back for the next batch: mass is neither created nor lost, and the report says how many were moved
and how far. Of spheres that overlap each other the later one in the list is moved.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.fields import ORIGIN, VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.pages import sparse_zeros
from f2s_hpc.kernels import momentum, paint, remap
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.packing import settle_in_order
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State
from f2s_hpc.units import count_text

OVERFILL = 1.0 + 1e-3
"""A cell may be overfilled by this much: 0.1 % of compression, far below that of any impact."""

ROUNDS = 60
_ALONE = {"mass": 0}


@dataclass
class InsertReport:
    """What happened when a batch was put in."""

    spheres: int = 0
    moved: int = 0
    largest_move: float = 0.0
    deferred: Batch | None = None
    volume: float = 0.0
    positions: Batch | None = field(default=None, repr=False)

    def message(self, last: bool = False) -> str:
        """Return one sentence for the log; empty when every sphere went where it was asked to.

        ``last``: no batch follows for which one could wait.
        """
        parts = []
        if self.moved:
            parts.append(f"{count_text(self.moved, 'sphere')} moved by up to {self.largest_move * 1e6:.2f} um to clear "
                         "material still in the layer or other spheres")
        if self.deferred is not None and self.deferred.count:
            one = self.deferred.count == 1
            then = (f"{'is' if one else 'are'} left out, as no batch follows" if last else
                    f"{'waits' if one else 'wait'} for the next batch")
            parts.append(f"{count_text(self.deferred.count, 'sphere')} found no free place and {then}")
        return "; ".join(parts)


def mass_quanta(array: np.ndarray, quantum: float) -> int:
    """Return the exact sum of ``array`` in units of ``quantum`` on this rank, plane by plane.

    High and low halves are summed apart: half a million full cells of one plane are 2^63 quanta.
    """
    total = 0
    for plane in array:
        quanta = np.floor(plane / quantum).astype(np.int64)
        total += (int((quanta >> 32).sum()) << 32) + int((quanta & 0xFFFFFFFF).sum())
    return total


def paint_substrate(state: State, height: float, temperature: float) -> None:
    """Fill the box up to ``height`` (m) with material at rest at ``temperature`` (K)."""
    dx = state.part.box.dx
    k0 = state.part.offset[2]
    bottoms = (np.arange(state.part.cell_shape[0]) + k0) * dx
    share = np.clip((height - bottoms) / dx, 0.0, 1.0)
    # a layer thinner than round-off of the height is not material
    share[share < 1e-9] = 0.0
    share[share > 1.0 - 1e-9] = 1.0
    share[:GHOST] = share[GHOST + state.part.count[2]:] = 0.0  # the ghosts follow their owners
    for k in np.flatnonzero(share):
        state.views["mass"][k] = share[k]
        state.views["volume_fraction"][k] = share[k]
        state.views["temperature"][k] = temperature
    state.settle()


def fullest_cells(state: State, batch: Batch, tested: np.ndarray, put_in: np.ndarray) -> np.ndarray:
    """Return the mass of the fullest cell of each ``tested`` sphere with the spheres ``put_in`` (both bool) in it too.

    Cells without material of today do not count: a sphere in free space has 0. Collective.
    """
    added, overlap = sparse_zeros(state.part.cell_shape), np.zeros(batch.count)
    shares = batch.chosen(put_in)
    paint.add_spheres(shares.x, shares.y, shares.z, shares.r, state.part.offset, state.part.box.dx, added)
    paint.sphere_overlaps(batch.x, batch.y, batch.z, batch.r, tested, state.part.offset, state.part.box.dx,
                          state.owned_window(), state.views["mass"], added, overlap)
    return mpi.maximum(overlap)


def shareable_volume(dx: float) -> float:
    """Return the volume (m3) that a sphere may share with others in its place: what a cell may be overfilled by."""
    return (OVERFILL - 1.0) * dx**3


def _inside(place: float, wanted: float, radius: float, width: float) -> float:
    """Return ``place`` kept off the walls; a sphere that a wall cuts stays where it was wanted, so its volume stays."""
    if not radius <= wanted <= width - radius:
        return wanted
    return min(max(place, radius), width - radius)


def _proposal(batch: Batch, index: int, attempt: int, bounds: tuple[float, float, float, float], dx: float,
              generator: np.random.Generator) -> tuple[float, float, float] | None:
    """Return a new place for a sphere: first straight up, then ever wider around; None if another sphere is there."""
    bottom, top, width, depth = bounds
    r = batch.r[index]
    if attempt < 6:
        shift = np.array([0.0, 0.0, (attempt + 1) * 0.5 * dx])
    else:
        shift = generator.normal(size=3) * dx * (attempt - 4)
    x, y, z = np.array([batch.x[index], batch.y[index], batch.z[index]]) + shift
    x, y = _inside(x, batch.x[index], r, width), _inside(y, batch.y[index], r, depth)
    if z - r < bottom or z + r > top:
        return None
    distance = np.sqrt((batch.x - x) ** 2 + (batch.y - y) ** 2 + (batch.z - z) ** 2)
    distance[index] = np.inf
    return None if (distance < batch.r + r).any() else (x, y, z)


def _free_places(state: State, batch: Batch, layer: tuple[float, float], seed: int) -> tuple[Batch, np.ndarray]:
    """Move spheres of ``batch`` (z from the bottom of the box) out of existing material and out of each other.

    Every rank does the same with the same random numbers; only the overlap test is collective.
    Returns the batch with its new places, and which spheres still overlap.
    """
    dx = state.part.box.dx
    width, depth, _ = state.part.box.extents
    generator = np.random.Generator(np.random.PCG64(seed))
    wanted = batch
    batch = batch.chosen(slice(None))
    everyone = np.ones(batch.count, dtype=np.bool_)
    overlapping = fullest_cells(state, batch, everyone, everyone) > OVERFILL
    # what material moves anyway makes no other sphere move
    settle_in_order(batch.x, batch.y, batch.z, batch.r, shareable_volume(dx), np.zeros_like(overlapping), overlapping)
    for attempt in range(ROUNDS):
        if not overlapping.any():
            break
        proposed = np.zeros(batch.count, dtype=np.bool_)
        for index in np.flatnonzero(overlapping):
            before = batch.x[index], batch.y[index], batch.z[index]
            batch.x[index], batch.y[index], batch.z[index] = wanted.x[index], wanted.y[index], wanted.z[index]
            place = _proposal(batch, index, attempt, (*layer, width, depth), dx, generator)
            batch.x[index], batch.y[index], batch.z[index] = place or before
            proposed[index] = place is not None
        # a proposal that still overlaps is replaced in the next round
        overlapping = (fullest_cells(state, batch, proposed, everyone) > OVERFILL) | (overlapping & ~proposed)
    return batch, overlapping


def paint_batch(state: State, model: Model, batch: Batch, layer_bottom: float, velocity: tuple[float, float, float],
                temperature: float, ledger: Ledger, seed: int) -> InsertReport:
    """Put a batch (z from ``layer_bottom``, m) into the box, stress-free, at ``velocity`` and ``temperature`` (K).

    Spheres with velocities of their own fly at those instead of ``velocity`` (m/s), those with temperatures of their
    own have those.
    The parts of spheres beyond the sides of the box are cut off, as the sides are mirrors.
    Collective; all ghosts are valid before and after.
    """
    report = InsertReport(spheres=batch.count)
    asked = batch.raised(layer_bottom)
    layer = (layer_bottom, state.part.box.extents[2])
    placed, blocked = _free_places(state, asked, layer, seed)
    moves = np.sqrt((placed.x - asked.x) ** 2 + (placed.y - asked.y) ** 2 + (placed.z - asked.z) ** 2)[~blocked]
    report.moved, report.largest_move = int((moves > 0.0).sum()), float(moves.max(initial=0.0))
    if blocked.any():
        report.spheres -= int(blocked.sum())
        report.deferred = batch.chosen(blocked)
        placed = placed.chosen(~blocked)
    report.positions = placed
    _add(state, model, placed, velocity, temperature, ledger, report)
    return report


def paint_arrivals(state: State, model: Model, arrived: tuple[Batch, tuple[float, float, float]], temperature: float,
                   ledger: Ledger) -> None:
    """Put spheres at the end of their flight (z from the bottom of the box) into the box; collective.

    Called between two steps. Looks at the planes of the spheres only: of a wide box that is little, and many land.
    The ghosts that the next step reads are valid after.
    """
    batch, velocity = arrived
    ends = np.array([np.floor((batch.z - batch.r).min() / state.part.box.dx),
                     np.ceil((batch.z + batch.r).max() / state.part.box.dx)]).astype(np.int64) - state.part.offset[2]
    top = state.part.cell_shape[0]
    low, high = np.clip(ends, 0, top).tolist()
    if low < high:  # beside a side its ghosts belong to it
        low, high = 0 if low < 2 * GHOST else low, top if high > top - 2 * GHOST else high
    _add(state, model, batch, velocity, temperature, ledger, InsertReport(spheres=batch.count), slice(low, high))


def _add(state: State, model: Model, batch: Batch, velocity: tuple[float, float, float], temperature: float,
         ledger: Ledger, report: InsertReport, planes: slice | None = None) -> None:
    added = sparse_zeros(state.part.cell_shape)
    spheres = (batch.x, batch.y, batch.z, batch.r)
    own = [values for values in (batch.velocity, batch.temperature) if values is not None]
    if own:
        values = np.column_stack(own)
        means = tuple(sparse_zeros(state.part.cell_shape) for _ in range(values.shape[1]))
        paint.add_different_spheres(*spheres, values, state.part.offset, state.part.box.dx, added, means)
        velocity = velocity if batch.velocity is None else means[:3]
        temperature = temperature if batch.temperature is None else means[-1]
    else:
        paint.add_spheres(*spheres, state.part.offset, state.part.box.dx, added)
    quanta = add_material(state, model, added, velocity, temperature, ledger, planes)
    report.volume = sum(mpi.all_gather(quanta)) * model.mass_quantum * state.part.box.dx**3


def add_material(state: State, model: Model, added: np.ndarray,
                 velocity: tuple[float, float, float] | tuple[np.ndarray, np.ndarray, np.ndarray],
                 temperature: float | np.ndarray, ledger: Ledger, planes: slice | None = None) -> int:
    """Add ``added`` (full cells, local cells with ghosts) to the cells, stress-free; return its mass on this rank.

    The mass is in quanta of ``model.mass_quantum``; no cell may be overfilled. ``velocity`` (m/s), one for all
    or as three arrays like ``added``, is mixed into the nodes by momentum, ``temperature`` (K), one or an array like
    ``added``, into the cells by mass.
    ``planes``: the planes (local k) that hold all of ``added``, ghosts included; then only those are looked at, and
    what is active must be known. Mass and kinetic energy enter the ledger. Collective; all ghosts are valid after, or
    with ``planes`` those that the next step reads.
    """
    flat, part = state.flat, state.part
    own, heat = isinstance(velocity[0], np.ndarray), np.atleast_1d(temperature)
    if planes is None:
        planes = slice(0, part.cell_shape[0])
        where, settle = state.around(added), state.settle
        state.update_activity(state.around(state.views["mass"]))
    else:
        chosen = np.zeros(part.cell_shape[0], dtype=np.bool_)
        chosen[planes] = True
        where, settle = state.of_planes(chosen), functools.partial(state.settle_planes, planes)
    # a mirrored normal velocity keeps its sign here, which does not matter: the nodes on its wall are held
    for array in (added, *(velocity if own else ()), *((heat,) if heat.size > 1 else ())):
        state.boundary.fill(array.reshape(-1), _ALONE, ("mass",), where)
    before = _kinetic_quanta(state, model, planes)
    diluted = state.offsets(n for n in state.carried_cells if n != "temperature")
    plane = part.cell_shape[1] * part.cell_shape[2]
    cells = slice(planes.start * plane, planes.stop * plane)
    paint.merge_cells(added.reshape(-1)[cells], *(flat[n][cells] for n in ("mass", "volume_fraction", "temperature")),
                      heat.reshape(-1)[cells] if heat.size > 1 else heat, state.pool.memory, diluted + cells.start)
    if ORIGIN in state.views:
        there, mass, share = added[planes], state.views["mass"][planes], state.views[ORIGIN][planes]
        new = there > 0.0
        share[new] += there[new] / mass[new]  # the old share was diluted just now
    bounds = (planes.start, planes.stop)
    if own:
        paint.merge_moving_nodes(part.cell_shape, bounds, added.reshape(-1), flat["mass"],
                                 tuple(component.reshape(-1) for component in velocity), *state.velocity)
    else:
        paint.merge_nodes(part.cell_shape, bounds, added.reshape(-1), flat["mass"], velocity, *state.velocity)
    state.boundary.hold([state.views[n] for n in VELOCITY])
    settle()
    ledger.add("brought_in", _kinetic_quanta(state, model, planes) - before)
    k0, k1 = max(planes.start, GHOST), min(planes.stop, part.owned_cells[0].stop)
    quanta = mass_quanta(added[k0:max(k0, k1), *part.owned_cells[1:]], model.mass_quantum)
    ledger.add("mass_painted", quanta)
    return quanta


def kinetic_quanta(state: State, model: Model) -> int:
    """Return the kinetic energy of the owned nodes in quanta, an exact sum."""
    state.update_activity(state.around(state.views["mass"]))
    return _kinetic_quanta(state, model, slice(0, state.part.cell_shape[0]))


def _kinetic_quanta(state: State, model: Model, planes: slice) -> int:
    """Return the same for the nodes of some ``planes`` of cells (local k), where what is active is known."""
    k0, k1, *across = state.node_window()
    window = (max(k0, planes.start), min(k1, planes.stop + 1), *across)
    runs, count = state.runs
    shape = state.part.cell_shape[1:]
    remap.nodal_masses(runs, count, window, shape, state.flat["mass"], state.flat["nodal_mass"])
    return int(momentum.kinetic_energy(runs, count, window, shape, state.boundary.weights, state.flat["nodal_mass"],
                                       *state.velocity, model.energy_quantum, model.dx, model.bulk.density))
