"""From a scene to the objects that run it: the one place that reads the configuration."""

from __future__ import annotations

from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import SIDES, Box
from f2s_hpc.grid.decomposition import Decomposition, Ranges
from f2s_hpc.materials import params
from f2s_hpc.solver import sleep
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model, Settings
from f2s_hpc.state import State

ENERGY_BITS, MASS_BITS = 56, 44
"""Resolution of the exact sums: the box full of material at particle speed is 2**56 quanta, a full cell 2**44."""


def build_flow(flow) -> tuple:
    """Return the parameters of a scene's flow stress as the kernels' tuple."""
    if flow.model == "ge":
        return params.Ge(flow.sigma_y0, flow.hardening_A, flow.hardening_n, flow.alpha, flow.beta, flow.rate_s,
                         flow.rate_u, flow.high_rate_B, flow.room_temperature, flow.reference_temperature, flow.eta)
    if flow.model == "johnson_cook":
        return params.JohnsonCook(flow.A, flow.B, flow.n, flow.C, flow.m, flow.reference_rate,
                                  flow.reference_temperature, flow.melting_temperature)
    if flow.model == "linear_hardening":
        return params.LinearHardening(flow.yield_stress, flow.hardening_modulus)
    return params.Elastic()


def build_model(scene: Scene) -> Model:
    """Return material and settings of a scene, SI."""
    m, n = scene.material, scene.numerics
    bulk = params.Bulk(m.density, m.bulk_modulus, m.shear_modulus, m.specific_heat, m.conductivity, m.taylor_quinney,
                       m.spall_pressure)
    eos = params.LinearPressure(m.bulk_modulus)
    if m.pressure.model == "mie_grueneisen":
        eos = params.MieGrueneisen(m.density, m.pressure.sound_speed, m.pressure.slope_s, m.pressure.gamma)
    speed = max(scene.top_speed, 1.0)
    settings = Settings(
        courant=n.courant, remap_courant=n.remap_courant, steps_per_remap=n.steps_per_remap,
        strain_per_remap=n.strain_per_remap, strain_per_step=n.strain_per_step,
        viscosity=(n.shock_viscosity_linear, n.shock_viscosity_quadratic), viscous_heating=n.viscous_heating,
        loss_heating=n.loss_heating, hourglass=n.hourglass, exchange_strength=n.exchange_strength,
        exchange_mass_limit=n.exchange_mass_limit, light_mass_floor=n.light_mass_floor,
        speed_cap=n.speed_cap_factor * speed, speed_limit=n.speed_limit_factor * speed,
        conduction=n.conduction and m.conductivity > 0.0, second_order=n.remap_order == 2, dust=n.dust,
        largest_strain=n.largest_strain, sleeping_depth=n.sleeping_depth, rest_speed=sleep.REST * speed,
        absorbing_depth=n.absorbing_depth)
    x, y, z = scene.domain.extents
    energy = 0.5 * m.density * x * y * z * speed**2
    return Model(scene.domain.cell_size, bulk, eos, build_flow(m.flow_stress), settings, energy * 2.0**-ENERGY_BITS,
                 2.0**-MASS_BITS)


def build_state(scene: Scene, ranges: Ranges | None = None) -> State:
    """Return the empty, distributed state of a scene (collective); ``ranges``: what each rank owns, even if None."""
    box = Box(scene.domain.cells, scene.domain.cell_size)
    sides = {side: getattr(scene.domain.faces, side) for side in SIDES}
    return State(Decomposition(box, ranges=ranges), sides, scene.needed_fields, scene.numerics.active_rows)


def build_ledger(model: Model) -> Ledger:
    """Return an empty ledger."""
    return Ledger(model.energy_quantum)
