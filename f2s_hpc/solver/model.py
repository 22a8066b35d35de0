"""What the step needs to know besides the state: material tuples and numerical settings."""

from __future__ import annotations

import math
from typing import NamedTuple

from f2s_hpc.materials.params import Bulk


class Settings(NamedTuple):
    """Numerical settings of the scheme (see the scene's ``numerics`` section)."""

    courant: float
    remap_courant: float  # largest share of a cell that material may cross between two remaps
    steps_per_remap: int
    strain_per_remap: float
    strain_per_step: float
    viscosity: tuple[float, float]  # linear, quadratic
    viscous_heating: bool
    loss_heating: bool
    hourglass: float
    exchange_strength: float
    exchange_mass_limit: float  # full nodes
    light_mass_floor: float  # full nodes
    speed_cap: float  # m/s, for nodes lighter than exchange_mass_limit
    speed_limit: float  # m/s, beyond which any node exchanges momentum with its neighbours
    conduction: bool
    second_order: bool
    dust: float  # full cells
    largest_strain: float  # strain per step beyond which a light cell's increment is scaled down
    sleeping_depth: float = 0.0  # m below the surface, from which on material at rest is not stepped; 0: never
    rest_speed: float = 0.0  # m/s, below which it is at rest
    absorbing_depth: float = 0.5e-3  # m, of the material whose static stiffness stands behind absorbing sides


class Model(NamedTuple):
    """Material and settings of a run; ``eos`` and ``flow`` choose the models by their type."""

    dx: float
    bulk: Bulk
    eos: NamedTuple
    flow: NamedTuple
    settings: Settings
    energy_quantum: float  # J, unit of the exact integer sums of energy
    mass_quantum: float  # full cells, unit of the exact integer sums of mass

    @property
    def cell_mass(self) -> float:
        """Mass of a full cell at zero pressure (kg)."""
        return self.bulk.density * self.dx**3

    @property
    def sound(self) -> float:
        """Speed of longitudinal waves in the material at rest (m/s)."""
        return math.sqrt((self.bulk.bulk_modulus + 4.0 / 3.0 * self.bulk.shear_modulus) / self.bulk.density)
