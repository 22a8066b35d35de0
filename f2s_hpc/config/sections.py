"""Sections of a scene: what may be written in each, in which unit and range. After loading every number is SI."""

from __future__ import annotations

import itertools
import math
import statistics
from typing import Literal

from pydantic import Field, field_validator, model_validator

from f2s_hpc import fields, units
from f2s_hpc.config.quantities import (
    Length,
    LengthOrZero,
    Number,
    PositiveLength,
    Section,
    Switch,
    Temperature,
    Time,
    Whole,
    wrong,
)

Face = Literal["symmetry", "fixed", "free", "outflow", "absorbing"]
DERIVED_FIELDS = tuple(f.name for f in fields.DERIVED)
POSSIBLE_FIELDS = tuple(f.name for f in fields.FIELDS if f.saved) + DERIVED_FIELDS
LEAST_TRACERS = 10
MAX_NODES = 2**31 - 1  # PETSc of the distributions counts with 32-bit integers


def length_text(value: float) -> str:
    """Return a length (m) as messages write it."""
    return units.pretty(value, "length", 6)


class Faces(Section):
    """Condition on each side of the box."""

    x_low: Face = Field(default="symmetry", description="side at x = 0")
    x_high: Face = Field(default="symmetry", description="side at the largest x")
    y_low: Face = Field(default="symmetry", description="side at y = 0")
    y_high: Face = Field(default="symmetry", description="side at the largest y")
    z_low: Face = Field(default="fixed", description="bottom")
    z_high: Face = Field(default="fixed", description="top")

    @property
    def absorbing(self) -> bool:
        """Is any side absorbing?"""
        return any(getattr(self, side) == "absorbing" for side in Faces.model_fields)


class Domain(Section):
    """The box: substrate at the bottom, the layer where batches are painted at the top."""

    size: tuple[PositiveLength, PositiveLength, PositiveLength] = Field(
        description="edge lengths (x, y, z) of the box, m; rounded to whole cells")
    cell_size: PositiveLength = Field(description="edge length of the cubic cells, m")
    substrate_height: LengthOrZero = Field(description="height of the substrate, m")
    particle_layer_height: PositiveLength = Field(description="height of the particle layer at the top, m")
    faces: Faces = Field(default_factory=Faces, description=(
        "condition on each side; symmetry: a mirror, fixed: a wall that holds what touches it, free: nothing, so that "
        "material may leave and is lost (outflow is another name of it), absorbing: more of the same material"))

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of cells (nx, ny, nz)."""
        return tuple(max(1, round(length / self.cell_size)) for length in self.size)

    @property
    def extents(self) -> tuple[float, float, float]:
        """Edge lengths of the box that is computed: whole cells, m."""
        return tuple(n * self.cell_size for n in self.cells)

    @property
    def layer_bottom(self) -> float:
        """Height of the bottom of the particle layer above the bottom of the box, m."""
        return self.extents[2] - self.particle_layer_height

    @model_validator(mode="after")
    def _possible(self) -> Domain:
        smallest, height = min(self.size), self.size[2]
        if self.cell_size > smallest:
            raise wrong("cell_size", f"is larger than the box ({length_text(smallest)} in its shortest direction)")
        edges = max(self.size) / self.cell_size  # (the rounding to whole cells knows no infinity)
        nodes = math.prod(n + 1 for n in self.cells) if edges <= MAX_NODES else edges
        if nodes > MAX_NODES:
            raise wrong("cell_size", f"gives {nodes:.4g} nodes, {MAX_NODES:.4g} are possible; is its unit right?")
        if self.substrate_height >= height:
            raise wrong("substrate_height", f"must be lower than the box ({length_text(height)})")
        room = height - self.substrate_height
        if self.particle_layer_height > room * (1.0 + 1e-12):
            raise wrong("particle_layer_height", f"does not fit: {length_text(room)} is left above the substrate; "
                                                 "a higher domain.size[2] makes room")
        return self


class Substrate(Section):
    """The substrate at the start."""

    temperature: Temperature = Field(default=298.15, description="initial temperature, K")
    backing: LengthOrZero | None = Field(
        default=None, examples=["3 mm"],
        description="thickness of the substrate below the box, m, through which heat leaves while the deposit dwells, "
                    "to a far side that keeps substrate.temperature; if not given, none leaves")


class Batches(Section):
    """The spheres: read from files, listed here, or generated from a seed."""

    count: Whole = Field(default=0, ge=0, le=10_000, description="number of batches to generate")
    particles: Whole = Field(default=0, ge=0, le=1_000_000, description="particles in each generated batch")
    files: tuple[str, ...] = Field(default=(), description="CSV files (x,y,z,r in mm; where spheres have "
                                                           "their own, vx,vy,vz in m/s and temperature in degC "
                                                           "too), one per batch")
    spheres: tuple[tuple[Length, Length, Length, PositiveLength], ...] = Field(
        default=(), description="spheres [x, y, z, r], m; z from the bottom of the particle layer")
    distribution: Literal["uniform", "sech"] = Field(
        default="uniform", description="number of generated particles over x: even, or the sech of a jet")
    jet_width: PositiveLength | None = Field(
        default=None, description="width of the sech, 0.76 of the distance from its axis to half its height, m")
    jet_centre: Length = Field(default=0.0, description="x of the jet's axis, for sech and speed curvature, m")
    seed: Whole = Field(default=1, ge=0, lt=2**63, description="seed of sizes, positions and order")
    gap_factor: Number = Field(default=1.02, ge=1, le=1000, description="least centre distance over the sum of radii")
    attempts: Whole = Field(default=2000, ge=1, le=10**9, description="tries to place one sphere before giving up")
    diameter_d10: PositiveLength = Field(default=19e-6, description="10 % of the volume is in smaller particles, m")
    diameter_d50: PositiveLength = Field(default=30e-6, description="50 % of the volume is in smaller particles, m")
    diameter_d90: PositiveLength = Field(default=52e-6, description="90 % of the volume is in smaller particles, m")
    diameter_min: PositiveLength = Field(default=10e-6, description="smallest particle, m")
    diameter_max: PositiveLength = Field(default=85e-6, description="largest particle, m")
    shuffle: Switch = Field(default=True, description="shuffle the order of the batches once, from the seed")
    mirror_repeats: tuple[Literal["x", "y", "xy"], ...] = Field(
        default=(), description='what a batch that comes again is mirrored by, in turn: ["x", "y", "xy"] ("xy" '
                                "exchanges x and y) make 8 images, none uses it as it is, as the paper does")
    even_sides: Switch = Field(
        default=False, description="generated spheres may have their centres beyond the sides too, so that as much "
                                   "powder falls there as in the middle; without, as in the paper, up to half of it is "
                                   "missing there")

    @property
    def median_diameter(self) -> float:
        """Diameter that stands for all particles, m: the median of listed spheres, else ``diameter_d50``."""
        return 2.0 * statistics.median(r for *_, r in self.spheres) if self.spheres else self.diameter_d50

    @property
    def diameter_range(self) -> tuple[float, float]:
        """Smallest and largest diameter, m: of listed spheres, else what may be generated or read."""
        if not self.spheres:
            return self.diameter_min, self.diameter_max
        radii = [r for *_, r in self.spheres]
        return 2.0 * min(radii), 2.0 * max(radii)

    @property
    def source(self) -> Literal["files", "spheres", "generated"]:
        """Where the spheres come from."""
        return "files" if self.files else "spheres" if self.spheres else "generated"

    @property
    def number(self) -> int:
        """Number of different batches."""
        return len(self.files) if self.files else 1 if self.spheres else self.count

    @model_validator(mode="after")
    def _one_source(self) -> Batches:
        given = [name for name, there in (("files", self.files), ("spheres", self.spheres),
                                          ("count and particles", self.count * self.particles)) if there]
        if not given:
            raise wrong("", "has no particles: give files, or spheres, or both count and particles above 0")
        if len(given) > 1:
            raise wrong("", f"has {' as well as '.join(given)}; keep exactly one source of particles")
        if self.distribution == "sech" and self.jet_width is None:
            raise wrong("jet_width", 'is missing: a sech distribution needs it, for example jet_width = "1.4 mm"')
        sizes = ("diameter_min", "diameter_d10", "diameter_d50", "diameter_d90", "diameter_max")
        for low, high in itertools.pairwise(sizes):
            if getattr(self, low) >= getattr(self, high):
                raise wrong(high, f"must be above {low} ({length_text(getattr(self, low))})")
        return self


class Cycles(Section):
    """Each cycle paints one batch and runs for its duration."""

    count: Whole = Field(ge=1, le=100_000, description="number of cycles")
    duration: Time = Field(description="duration of each cycle but the last, s")
    last_duration: Time = Field(default_factory=lambda data: data["duration"],
                                description="duration of the last cycle, s; default: as the others")
    dwell: Time | None = Field(default=None, examples=["10 ms"], description=(
        "time between the end of a cycle and the next batch, s, in which nothing moves and heat is conducted; none by "
        "default"))

    @property
    def durations(self) -> tuple[float, ...]:
        """Duration of every cycle, s."""
        return (self.duration,) * (self.count - 1) + (self.last_duration,)

    @property
    def total_time(self) -> float:
        """Simulated time of the whole run, s."""
        return self.duration * (self.count - 1) + self.last_duration


class Numerics(Section):
    """The scheme's own numbers; the defaults are the measured choice."""

    courant: Number = Field(default=0.7, gt=0, lt=1, description="time step over the sound crossing time of a cell")
    remap_courant: Number = Field(default=0.25, gt=0, le=0.45,
                                  description="largest share of a cell that material crosses between two remaps")
    steps_per_remap: Whole | None = Field(
        default=None, ge=1, description="most time steps between two remaps; by default 8, but 1, a remap after each, "
                                        "where the median particle has less than 5.4 cells to its diameter")
    strain_per_remap: Number = Field(default=0.4, gt=0, le=1, description="largest strain between two remaps")
    strain_per_step: Number = Field(default=0.1, gt=0, le=1, description="largest strain increment in a step")
    shock_viscosity_linear: Number = Field(default=0.1, ge=0, le=10, description="linear shock viscosity")
    shock_viscosity_quadratic: Number = Field(default=1.2, ge=0, le=10, description="quadratic shock viscosity")
    viscous_heating: Switch = Field(default=True, description="work of the shock viscosity becomes heat")
    loss_heating: Switch = Field(default=True, description="kinetic energy that remap, hourglass control and "
                                                           "light-node exchange take heats as plastic work does")
    hourglass: Number = Field(default=0.01, ge=0, le=1,
                              description="share of an hourglass mode removed per sound crossing of a cell")
    # six neighbours that each pass 1/6 overshoot: measured, energy grows from 0.16 on
    exchange_strength: Number = Field(default=0.02, ge=0, le=0.1, description="momentum exchange of light nodes")
    exchange_mass_limit: Number = Field(default=0.3, ge=0, le=1,
                                        description="nodes lighter than this share of a full one exchange momentum")
    # what the floor withholds from a node its cells have stored already: measured, energy grows from 0.15 on
    light_mass_floor: Number = Field(default=0.005, gt=0, le=0.1,
                                     description="least mass that divides a force, over a full node's mass")
    speed_limit_factor: Number | None = Field(
        default=None, ge=1, description="speed, over the particles' own, beyond which any node exchanges momentum with "
                                        "its neighbours; by default 1.2, but 3 where the median particle has 12 cells "
                                        "or more to its diameter, since jets are resolved there")
    speed_cap_factor: Number | None = Field(
        default=None, ge=1, description="speed cap of light nodes over the largest particle speed; by default 2, but 4 "
                                        "where jets are resolved")
    # its static stiffness: waves shorter than a quarter of it come back with under 2 %
    absorbing_depth: PositiveLength = Field(
        default=0.5e-3, description="depth of the material that stands behind an absorbing side, m")
    conduction: Switch = Field(default=True, description="heat conduction")
    remap_order: Literal[1, 2] = Field(default=2, description=(
        "reconstruction by the remap; 2: of what cells hold at third order with a limiter, of node velocities at fifth "
        "order without one; 1: of both at first order"))
    largest_strain: Number = Field(default=0.5, gt=0, le=2, description="strain per step that a light cell may see")
    active_rows: Switch = Field(default=True, description="skip the rows without material; the results are the same")
    sleeping_depth: LengthOrZero = Field(default=0.0, description="depth below the surface from which on material at "
                                                                  "rest is not stepped, m; 0: all is stepped")
    dust: Number = Field(default=1e-12, ge=0, lt=1e-3, description="volume fraction below which a cell is empty")


_SPAN = ("from where to where along {}, m; one length without brackets: the layer of cells there; if not given, the "
         "whole box")


class View(Section):
    """A part of the box that is written often, as a series of its own: a film of a section."""

    x: tuple[LengthOrZero, LengthOrZero] | None = Field(default=None, description=_SPAN.format("x"))
    y: tuple[LengthOrZero, LengthOrZero] | None = Field(default=None, description=_SPAN.format("y"))
    z: tuple[LengthOrZero, LengthOrZero] | None = Field(default=None, description=_SPAN.format("z"))
    interval: Time | None = Field(default=None, examples=["20 ns"], description=(
        "simulated time between two pictures, s; without it there is no view"))

    @field_validator("x", "y", "z", mode="before")
    @classmethod
    def _one_layer(cls, value: object) -> object:
        if value is None or isinstance(value, (list, tuple)):
            return value
        if not isinstance(value, str):
            raise ValueError('must be a length, as in "30 um", or two in brackets, from where to where')
        return (value, value)

    @field_validator("x", "y", "z")
    @classmethod
    def _in_order(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and value[0] > value[1]:
            raise ValueError("must begin below its end")
        return value

    def cells(self, domain: Domain) -> tuple[tuple[int, int], ...]:
        """Return first cell and number of cells along x, y and z: all cells of the box that it touches, one at least.

        It must lie in the box.
        """
        found = []
        for span, count in zip((self.x, self.y, self.z), domain.cells):
            low, high = span or (0.0, count * domain.cell_size)
            # what ends on the side of a cell, but for round-off, does not touch the next one
            first = min(math.floor(low / domain.cell_size + 1e-6), count - 1)
            found.append((first, max(1, min(math.ceil(high / domain.cell_size - 1e-6), count) - first)))
        return tuple(found)


class Output(Section):
    """What is written while running."""

    fields: tuple[str, ...] = Field(default=fields.SHOWN, min_length=1,
                                    description=(
        f"fields of the frames; there are {', '.join(POSSIBLE_FIELDS)}; stress_ is the deviatoric stress, the whole "
        "along x is stress_xx - pressure"))
    frames: Literal["cycle", "none"] = Field(default="cycle", description="a frame after each cycle, or none")
    frame_interval: Time | None = Field(default=None, examples=["50 ns"],
                                        description="simulated time between extra frames, s")
    view: View = Field(default_factory=View, description="a part of the box that is written more often")
    checkpoints: Switch = Field(default=True, description="a checkpoint after each cycle")
    keep_checkpoints: Whole = Field(default=2, ge=1, description="number of checkpoints kept")
    archive_every: Whole = Field(default=0, ge=0, description="the checkpoint after each so many cycles is kept "
                                                              "besides, for good; 0: none")
    progress_seconds: Time = Field(default=5.0, description="wall time between progress lines, s")
    picture: Switch = Field(default=True, description="a picture at the end")
    picture_each_cycle: Switch = Field(default=False, description="the picture is made anew after each cycle, to look "
                                                                  "at a run that goes on")
    origin: Switch = Field(default=False, description="follow which share of each cell came with the particles")
    tracers: Whole = Field(
        default=0, ge=0, le=100000, description="material points that follow each particle, for its exact shape and "
                                                f"flattening, at least {LEAST_TRACERS}; 0: none")

    @field_validator("fields")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in POSSIBLE_FIELDS:
                raise ValueError(f'there is no field "{name}"; possible: {", ".join(POSSIBLE_FIELDS)}')
        if len(set(value)) < len(value):
            raise ValueError("a field is named twice")
        return value

    @field_validator("tracers")
    @classmethod
    def _enough(cls, value: int) -> int:
        if 0 < value < LEAST_TRACERS:
            raise ValueError(f"must be 0, or at least {LEAST_TRACERS}: fewer points have no shape")
        return value


class Run(Section):
    """The run itself."""

    wall_time: Time | None = Field(default=None, examples=["90 min"],
                                   description="wall time from the start of the command, saving included, after which "
                                               "the run stops with a checkpoint, s")
    checkpoint_interval: Time = Field(
        default=1800.0, description="wall time after which a cycle that still runs gets a checkpoint within, s")
