"""The table of fields: every array of the simulation, declared once.

Allocation, ghost exchange, remap, checkpoint and output all follow from this table, so a new field
is one new row.
"""

from __future__ import annotations

from dataclasses import dataclass

CELL, NODE = "cell", "node"


@dataclass(frozen=True)
class Field:
    """One scalar array.

    ``mirror_sign`` holds, per axis (x, y, z), the sign that a component takes in the mirror image
    behind a wall normal to that axis (-1 for the odd ones: normal velocity, shear with the normal). ``shown``: frames
    have it where the scene does not say. ``tag``: it tells two kinds of material apart, 0 or 1 but for the cells that
    an interface cuts, and is kept as sharp as that.
    """

    name: str
    location: str
    unit: str
    text: str
    advected: bool = False
    ghosted: bool = False
    saved: bool = False
    shown: bool = False
    mirror_sign: tuple[int, int, int] = (1, 1, 1)
    tag: bool = False


def _stress(component: str, sign: tuple[int, int, int]) -> Field:
    return Field(f"stress_{component}", CELL, "Pa", f"deviatoric Cauchy stress, {component} component",
                 advected=True, ghosted=True, saved=True, mirror_sign=sign)


def _velocity(axis: str, sign: tuple[int, int, int]) -> Field:
    return Field(f"velocity_{axis}", NODE, "m/s", f"{axis} velocity of the node",
                 advected=True, ghosted=True, saved=True, mirror_sign=sign)


def _work(name: str, unit: str, text: str) -> Field:
    return Field(name, NODE, unit, text)


FIELDS: tuple[Field, ...] = (
    Field("mass", CELL, "1", "mass in the cell over the mass of a full cell at zero pressure",
          advected=True, ghosted=True, saved=True),
    Field("volume_fraction", CELL, "1", "volume of material over volume of the cell",
          advected=True, ghosted=True, saved=True, shown=True),
    _stress("xx", (1, 1, 1)),
    _stress("yy", (1, 1, 1)),
    _stress("zz", (1, 1, 1)),
    _stress("xy", (-1, -1, 1)),
    _stress("yz", (1, -1, -1)),
    _stress("xz", (-1, 1, -1)),
    Field("peeq", CELL, "1", "equivalent plastic strain",
          advected=True, ghosted=True, saved=True, shown=True),
    Field("temperature", CELL, "K", "temperature",
          advected=True, ghosted=True, saved=True, shown=True),
    Field("internal_energy", CELL, "J/kg", "specific internal energy (Mie-Grueneisen pressure only)",
          advected=True, ghosted=True, saved=True),
    Field("particle_fraction", CELL, "1", "share of the cell's mass that came with the particles (output.origin only)",
          advected=True, ghosted=True, saved=True, tag=True),
    Field("lent_mass", CELL, "1", "mass (in full cells) that the cell has lent to what lies behind absorbing sides",
          ghosted=True, saved=True),
    _velocity("x", (-1, 1, 1)),
    _velocity("y", (1, -1, 1)),
    _velocity("z", (1, 1, -1)),
    Field("lost_energy", NODE, "m2/s2", "twice the kinetic energy, per mass of a full node, that remap, light-node "
          "exchange and half kicks took in the last step; the next one turns it into heat", ghosted=True, saved=True),
    _work("nodal_mass", "1", "mass of the node over that of a node among full cells"),
    _work("force_x", "N", "x force on the node; later in the step, its velocity change by the light-node exchange; "
          "then volume (in cells) through the low face: swept in a step, material in a sweep; heat in conduction"),
    _work("force_y", "N", "y force on the node, and its velocity change"),
    _work("force_z", "N", "z force on the node, and its velocity change"),
    _work("sweep_x", "1", "volume (in cells) swept by the low x face of the cell since the last remap"),
    _work("sweep_y", "1", "volume (in cells) swept by the low y face of the cell since the last remap"),
    _work("sweep_z", "1", "volume (in cells) swept by the low z face of the cell since the last remap"),
    _work("displacement_x", "1", "x displacement (in cells) of the node since the last remap (several steps a remap)"),
    _work("displacement_y", "1", "y displacement of the node; likewise"),
    _work("displacement_z", "1", "z displacement of the node; likewise"),
    _work("viscous_pressure", "Pa", "shock viscosity of the cell in the present forces"),
    _work("hourglass_power", "W", "power that hourglass control takes in the cell in the present forces"),
    _work("mass_flux", "1", "mass (in full cells) through the low face of the cell in this sweep; before, divergence"),
    _work("dual_flux", "1", "mass (in full nodes) through the low side of the node in the present sweep; before, lost "
          "energy of the node (J/kg)"),
)

DERIVED: tuple[Field, ...] = (
    Field("pressure", CELL, "Pa", "pressure of the material"),
    Field("von_mises", CELL, "Pa", "von Mises stress", shown=True),
    Field("speed", CELL, "m/s", "speed of the material, the mean of the nodes of its cell", shown=True),
)
"""What is computed for output only, from the fields."""

BY_NAME = {field.name: field for field in FIELDS}

UNITS = {field.name: field.unit for field in FIELDS + DERIVED}
"""Unit of everything that can be written; "1" for plain numbers."""

SHOWN = tuple(field.name for field in FIELDS + DERIVED if field.shown)
"""What frames have where the scene does not say."""

STRESS = ("stress_xx", "stress_yy", "stress_zz", "stress_xy", "stress_yz", "stress_xz")
STRESS_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Row and column of each in the tensor."""
VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
FORCE = ("force_x", "force_y", "force_z")
VOLUME_FLUX = FORCE[0]
"""Each kick is the last to read its forces, but for the exchange of light nodes after a step's first, which leaves the
changes of velocity in their place. From the middle of a step to the forces of its second half, and again in the remap,
the volume that passes through faces lies in place of the first."""
SWEEP = ("sweep_x", "sweep_y", "sweep_z")
DISPLACEMENT = ("displacement_x", "displacement_y", "displacement_z")
ORIGIN = "particle_fraction"
LENT = "lent_mass"


def needed(mie_grueneisen: bool, loss_heating: bool = True, origin: bool = False,
           displaced: bool = False, absorbing: bool = False) -> tuple[Field, ...]:
    """Return the fields that a scene needs; the rest are neither allocated nor exchanged.

    ``loss_heating``: do numerical losses become heat? ``origin``: does the scene ask where each cell's material came
    from? ``displaced``: may several steps go by between two remaps? ``absorbing``: is any side of the box absorbing?
    """
    left_out = {name for name, asked in (("internal_energy", mie_grueneisen), ("lost_energy", loss_heating),
                                         (ORIGIN, origin), *((d, displaced) for d in DISPLACEMENT),
                                         (LENT, absorbing)) if not asked}
    return tuple(f for f in FIELDS if f.name not in left_out)
