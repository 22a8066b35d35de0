"""What a cycle is judged by: heights, PEEQ, temperature, mass, energy; the same numbers on any rank count."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.analysis.surface import HALF_FULL, LANDED, grounded_cells, with_skin
from f2s_hpc.cycles.insert import kinetic_quanta, mass_quanta
from f2s_hpc.fields import BY_NAME, CELL, STRESS
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.pages import sparse_zeros
from f2s_hpc.kernels import derived
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State
from f2s_hpc.units import ZERO_CELSIUS

_BINS = 8192


def derived_field(state: State, model: Model, name: str) -> np.ndarray:
    """Return the owned part [k, j, i] of a field that is shown: a stored one, or pressure, von_mises, speed."""
    if name in BY_NAME:
        return state.owned(name)
    return _derived_with_ghosts(state, model, name)[state.part.owned_cells]


def _derived_with_ghosts(state: State, model: Model, name: str) -> np.ndarray:
    """Return pressure, von_mises or speed on the local cells [k, j, i]; right on owned cells and one layer around."""
    out = sparse_zeros(state.part.cell_shape)
    flat = state.flat
    if name == "pressure":
        derived.cell_pressure(model.eos, flat["mass"], flat["volume_fraction"], state.energy, out.reshape(-1))
    elif name == "von_mises":
        derived.cell_von_mises(tuple(flat[n] for n in STRESS), out.reshape(-1))
    else:
        derived.cell_speed(state.part.cell_shape, flat["mass"], *state.velocity, out.reshape(-1))
    return out


def location(name: str) -> str:
    """Return whether a shown field lives on cells or nodes."""
    return BY_NAME[name].location if name in BY_NAME else CELL


def percentiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> list[float | None]:
    """Return weighted percentiles over all ranks, from an exact integer histogram; None without material.

    ``values``, ``weights``: this rank's cells, 1-D; ``shares`` in 0..1. Resolution: range / 8192, linear inside a bin.
    What is not finite does not count, so that a run that failed still tells where it was.
    """
    finite = np.isfinite(values) & np.isfinite(weights)
    if not finite.all():
        values, weights = values[finite], weights[finite]
    if not mpi.total(np.int64(values.size)):
        return [None] * len(shares)
    low = float(mpi.minimum(values.min() if values.size else np.inf))
    high = float(mpi.maximum(values.max() if values.size else -np.inf))
    if high <= low:
        return [low] * len(shares)
    bins = np.minimum(((values - low) * (_BINS / (high - low))).astype(np.int64), _BINS - 1)
    quanta = np.rint(weights * 2**20)
    counts = mpi.total(np.bincount(bins, weights=quanta, minlength=_BINS).astype(np.int64))
    cumulative = np.concatenate([[0], np.cumsum(counts)])
    found = []
    for share in shares:
        target = share * cumulative[-1]
        b = min(int(np.searchsorted(cumulative, target, side="right")) - 1, _BINS - 1)
        inside = (target - cumulative[b]) / counts[b] if counts[b] else 0.0
        found.append(low + (b + inside) * (high - low) / _BINS)
    return found


def landed_cells(state: State, model: Model, particle_speed: float) -> np.ndarray:
    """Return which local cells have landed (bool, ghosts included; right on owned cells and one layer around).

    Slower than ``LANDED`` times ``particle_speed`` (m/s) and attached to the bottom of the box, as in
    :func:`f2s_hpc.analysis.surface.attached_material`. What hangs together is found on rank 0, from a bit per cell.
    """
    part = state.part
    slow = _derived_with_ghosts(state, model, "speed") < LANDED * particle_speed
    solid = slow & (state.views["volume_fraction"] >= HALF_FULL)
    own, (nx, ny, nz) = solid[part.owned_cells], part.count
    # (planes above the highest that any rank has are neither sent nor held)
    filled = np.flatnonzero(own.any(axis=(1, 2)))
    top = mpi.maximum(np.int64(part.start[2] + filled[-1] + 1 if filled.size else 1))
    nz = int(np.clip(top - part.start[2], 0, nz))
    pieces = mpi.gather((part.start, (nx, ny, nz), np.packbits(own[:nz])))
    ring = mpi.scatter(_grounded_rings(part.box.shape, pieces) if mpi.is_root() else None)
    firm = np.zeros(part.cell_shape, dtype=bool)
    shape = (nz + 2, ny + 2, nx + 2)
    inner = tuple(slice(GHOST - 1, GHOST - 1 + n) for n in shape)
    firm[inner] = np.unpackbits(ring, count=math.prod(shape)).reshape(shape)
    return with_skin(firm, state.views["volume_fraction"], slow)


def _grounded_rings(shape: tuple[int, int, int], pieces: list[tuple]) -> list[np.ndarray]:
    """Return, per rank, which of its cells and of one layer around them are grounded, packed into bits.

    ``pieces``: start, count (x, y, z; up to the highest solid cell) and packed solid cells of each rank. Takes 2 bytes
    per cell below that (``workload.memory.GROUNDED``).
    """
    around = np.zeros([n + 2 for n in shape], dtype=bool)
    whole = around[1:-1, 1:-1, 1:-1]
    for start, count, bits in pieces:
        nx, ny, nz = count
        own = np.unpackbits(bits, count=nx * ny * nz).reshape(nz, ny, nx)
        whole[tuple(slice(s, s + n) for s, n in zip(start[::-1], count[::-1]))] = own
    top = max(start[2] + count[2] for start, count, _ in pieces if count[2])
    whole[:top] = grounded_cells(whole[:top])
    return [np.packbits(around[tuple(slice(s, s + n + 2) for s, n in zip(start[::-1], count[::-1]))])
            for start, count, _ in pieces]


def deposit_cells(state: State, landed: np.ndarray, substrate_height: float) -> np.ndarray:
    """Return which owned cells are deposit (bool): ``landed``, half full, with a centre above ``substrate_height`` (m).

    ``landed``: local cells, as :func:`landed_cells` returns.
    """
    part = state.part
    centre = (part.start[2] + np.arange(part.count[2]) + 0.5) * part.box.dx
    return (landed[part.owned_cells] & (state.owned("volume_fraction") >= HALF_FULL)
            & (centre[:, None, None] > substrate_height))


def surface_map(state: State, landed: np.ndarray) -> np.ndarray:
    """Return the height (m, from the bottom of the box) of the landed material's surface, (ny, nx), on all ranks.

    Per column: the top of the highest cell at least half full of landed material, plus what landed in the cell above;
    0 where there is none. ``landed``: bool, local cells with ghosts.
    """
    part = state.part
    fraction = sparse_zeros(part.cell_shape)
    np.copyto(fraction, state.views["volume_fraction"], where=landed)
    own = fraction[part.owned_cells]
    above = fraction[GHOST + 1:GHOST + 1 + part.count[2], part.owned_cells[1], part.owned_cells[2]]
    solid = own >= 0.5
    nz = part.count[2]
    top = nz - 1 - np.argmax(solid[::-1], axis=0)
    rows, columns = np.indices(top.shape)
    over = above[top, rows, columns]
    height = part.start[2] + top + own[top, rows, columns] + np.where(over < 0.5, over, 0.0)
    local = np.where(solid.any(axis=0), height * part.box.dx, 0.0)
    whole = np.zeros((part.box.cells[1], part.box.cells[0]))
    x0, y0, _ = part.start
    whole[y0:y0 + part.count[1], x0:x0 + part.count[0]] = local
    return mpi.maximum(whole)


def material_quanta(state: State, model: Model) -> int:
    """Return the mass in the box in quanta of ``model.mass_quantum`` full cells, exact, over all ranks."""
    return sum(mpi.all_gather(mass_quanta(state.owned("mass"), model.mass_quantum)))


def heat_quanta(state: State, model: Model) -> int:
    """Return the sum of mass (full cells) times temperature (K) in quanta of ``model.mass_quantum``, over all ranks."""
    own = sum(mass_quanta((mass * temperature)[None], model.mass_quantum)
              for mass, temperature in zip(state.owned("mass"), state.owned("temperature")))
    return sum(mpi.all_gather(own))


def measure_material(state: State, model: Model, substrate_height: float, particle_speed: float) -> dict:
    """Return heights (m, above the substrate top), PEEQ and temperature percentiles of what has landed."""
    fraction, mass = state.owned("volume_fraction"), state.owned("mass")
    landed = landed_cells(state, model, particle_speed)
    deposit = deposit_cells(state, landed, substrate_height)
    surface = surface_map(state, landed) - substrate_height
    peeq, temperature = state.owned("peeq"), state.owned("temperature")
    solid = fraction > 0.5
    peeq_max = mpi.maximum(peeq[solid].max() if solid.any() else 0.0)
    p50, p95 = percentiles(peeq[deposit], mass[deposit], (0.5, 0.95))
    t50, t95 = percentiles(temperature[deposit] - ZERO_CELSIUS, mass[deposit], (0.5, 0.95))
    return {
        "height_mean_m": float(surface.mean()), "height_p95_m": float(np.percentile(surface, 95)),
        "height_max_m": float(surface.max()), "peeq_p50": p50, "peeq_p95": p95, "peeq_max": float(peeq_max),
        "temperature_p50_degC": t50, "temperature_p95_degC": t95,
    }


def measure_balance(state: State, model: Model, ledger: Ledger, substrate_quanta: int) -> dict:
    """Return the mass balance (kg, relative to the painted mass) and the energy ledger (J)."""
    totals = ledger.totals()
    width, depth, _ = state.part.box.extents
    now = material_quanta(state, model)
    missing, painted = missing_quanta(totals, now, substrate_quanta)
    lent = totals["mass_lent"]
    kilogram = model.mass_quantum * model.cell_mass
    kinetic = sum(mpi.all_gather(kinetic_quanta(state, model)))
    energy = ledger.energy(totals, kinetic, elastic_quanta(state, model))
    brought = energy["brought_in"]
    lost = sum(energy[name] for name in ("hourglass", "light_nodes", "remap_kinetic", "remap_elastic", "half_kicks",
                                             "closing", "time_step", "put_to_sleep", "remainder"))
    if not model.settings.viscous_heating:
        lost += energy["shock_viscosity"]
    # what came back as heat came with the share of plastic work that heats
    unheated = lost - energy["returned_heat"] / max(model.bulk.taylor_quinney, 1e-300)
    return {
        "painted_volume_m3": painted * model.mass_quantum * model.dx**3,
        "mass_drift_relative": missing / painted if painted else 0.0,
        "mass_left_kg": totals["mass_left"] * kilogram, "mass_capped_kg": totals["mass_capped"] * kilogram,
        "dense_height_m": (now + lent - substrate_quanta) * model.mass_quantum * model.dx**3 / (width * depth),
        "numerical_loss_fraction": lost / brought if brought else 0.0,
        "numerical_loss_unheated_fraction": unheated / brought if brought else 0.0, "energy": energy,
        "nodes_capped": totals["nodes_capped"],
    }


def missing_quanta(totals: dict[str, int], now: int, substrate_quanta: int) -> tuple[int, int]:
    """Return the mass that nothing accounts for, and what was painted, in quanta of the ledger.

    What was painted and the substrate either are in the box (``now``, quanta), have left, or were counted as capped or
    lent. ``totals``: of the ledger.
    """
    out = totals["mass_left"] + totals["mass_capped"] + totals["mass_lent"]
    painted = totals["mass_painted"]
    return painted + substrate_quanta - out - now, painted


def elastic_quanta(state: State, model: Model) -> int:
    """Return the elastic energy of the material in quanta, an exact sum over all ranks."""
    runs, count = state.all_runs
    quanta = derived.elastic_energy(runs, count, state.owned_window(), state.part.cell_shape[1:], model.bulk,
                                    model.eos, state.flat["mass"], state.flat["volume_fraction"], state.stress,
                                    model.dx**3, model.energy_quantum)
    return sum(mpi.all_gather(int(quanta)))
