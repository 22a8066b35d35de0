"""Absorbing sides: they carry away the waves that meet them, as more of the same material would.

Nodes on such a side bear the traction of an outgoing plane wave, -rho c_p v_n along its normal and -rho c_s v_t across
(Lysmer and Kuhlemeyer 1969, J. Eng. Mech. Div. 95, 859), times the share of material around them. Dashpots alone give
way to a steady load for ever: an impulse I per area leaves the side displaced by I / (rho c_p), as it leaves an endless
bar, and a cycle of section 4 (182 Pa s) by 4.3 um. So a spring of the static stiffness M / H of a layer of depth H
(``numerics.absorbing_depth``; M = rho c_p^2) acts beside each normal dashpot (Deeks and Randolph 1994, J. Eng. Mech.
120, 25): displacement decays in H / c_p (0.1 us for 0.5 mm of copper), and a harmonic wave of length l comes back with
1 / sqrt(1 + (4 pi H / l)^2) of its amplitude. There is no spring across: nothing pushes that way for long between
lateral walls.

The face does not move for the remap. No volume crosses it, and no material is carried through it; but pressure follows
from mass, so a full cell whose outer face gave way by u must let go of the mass in u, or it would act as a rigid wall.
It lends that mass at its own density, stress and velocity, to take it back when the spring returns the face. What is
lent is counted per cell (the field ``lent_mass``, the displacement of the spring) and in the ledger, so mass is exact;
kinetic energy of what is lent and the work of the traction are "through_faces", elastic energy "remap_elastic".
"""

from __future__ import annotations

from f2s_hpc.fields import LENT, SWEEP
from f2s_hpc.grid.box import SIDES
from f2s_hpc.kernels import absorbing, momentum, remap
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.state import State


def wave_speeds(model: Model) -> tuple[float, float]:
    """Return the speeds (m/s) of longitudinal and shear waves in the material at rest."""
    bulk = model.bulk
    longitudinal = bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus
    return (longitudinal / bulk.density) ** 0.5, (bulk.shear_modulus / bulk.density) ** 0.5


def apply_traction(state: State, model: Model, before: float, after: float, ledger: Ledger) -> None:
    """Add the traction of the touched absorbing sides to the forces of a kick, and enter its work.

    ``before``, ``after``: the steps (s) of which the kick spans half each.
    """
    boundary = state.boundary
    if not boundary.absorbing:
        return
    speeds = wave_speeds(model)
    stiffness = model.bulk.density * speeds[0] ** 2 / model.settings.absorbing_depth
    runs, count = state.runs
    work = absorbing.outgoing_traction(
        runs, count, state.node_window(), state.part.cell_shape[1:], before, after, model.dx, model.bulk.density,
        model.settings.light_mass_floor, speeds, stiffness, boundary.weights, boundary.inward, boundary.free_motion,
        state.flat["nodal_mass"], state.flat[LENT], state.flat["mass"], state.force, state.velocity,
        model.energy_quantum)
    # the kick enters the work of all forces; that of the cells alone goes into the balance with what they received
    ledger.add("work", work)
    ledger.add("through_faces", work)


def lend_mass(state: State, model: Model, ledger: Ledger) -> None:
    """Bring the touched absorbing sides to rest for the remap: lend mass, and let no face on them sweep any volume.

    Reads and writes mass and volume fraction, all ghosts valid before and after.
    """
    boundary = state.boundary
    if not boundary.absorbing:
        return
    runs, count = state.runs
    beside = _nodes_beside(state)
    before = _kinetic_energy(state, model, beside)
    sweeps = tuple(state.views[name] for name in SWEEP)
    ledger.add("mass_lent", absorbing.lend_mass(
        runs, count, state.cell_window(), state.part.cell_shape[1:], boundary.inward, state.sweep, state.flat["mass"],
        state.flat["volume_fraction"], state.flat[LENT], model.mass_quantum))
    for side in boundary.absorbing:
        axis, plane = SIDES.index(side) // 2, boundary.wall_plane(side)
        sweeps[axis][(slice(None),) * (2 - axis) + (plane,)] = 0.0
    memory, offsets = state.pool.memory, state.pool.offsets
    boundary.mirror_sweeps(memory, [offsets[name] for name in SWEEP], state.active)
    boundary.fill(memory, offsets, ("mass", "volume_fraction", LENT), state.active)
    for window in beside:
        remap.nodal_masses(runs, count, window, state.part.cell_shape[1:], state.flat["mass"], state.flat["nodal_mass"])
    ledger.add("through_faces", before - _kinetic_energy(state, model, beside))


def _nodes_beside(state: State) -> list[tuple[int, ...]]:
    """Return windows that together hold every owned node of the cells beside the touched absorbing sides once."""
    windows, rest = [], list(state.node_window())
    for side in state.boundary.absorbing:
        axis, plane = SIDES.index(side) // 2, state.boundary.wall_plane(side)
        low, high = 2 * (2 - axis), 2 * (2 - axis) + 1
        slab = list(rest)
        if side.endswith("high"):
            slab[low], rest[high] = max(plane - 1, rest[low]), plane - 1
        else:
            slab[high], rest[low] = min(plane + 2, rest[high]), plane + 2
        windows.append(tuple(slab))
    return windows


def _kinetic_energy(state: State, model: Model, windows: list[tuple[int, ...]]) -> int:
    """Return the kinetic energy (quanta) of the owned nodes in the windows."""
    runs, count = state.runs
    return sum(momentum.kinetic_energy(
        runs, count, window, state.part.cell_shape[1:], state.boundary.weights, state.flat["nodal_mass"],
        *state.velocity, model.energy_quantum, model.dx, model.bulk.density) for window in windows)
