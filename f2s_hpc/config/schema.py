"""The whole scene, and what its sections must agree on."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from f2s_hpc import fields, units
from f2s_hpc.config.material import Material, MieGrueneisenPressure
from f2s_hpc.config.particles import Particles
from f2s_hpc.config.quantities import Section, wrong
from f2s_hpc.config.sections import (
    Batches,
    Cycles,
    Domain,
    Numerics,
    Output,
    Run,
    Substrate,
    length_text,
)

LEAST_SLEEPING_DEPTH = 8  # cells
MOST_STEPS, FINE = 8, 5.4
"""Steps that go by between two remaps at most, where the median particle has ``FINE`` cells or more to its diameter:
there PEEQ, temperatures and heights change by under 0.5 % against a remap after each step (measured: README)."""

MOST_FRAMES = 1e6
LONGEST_DWELL = 1e4  # s
FASTEST_SOUND = 3e8  # m/s: that of light
MOST_STEPS_OF_RUN = 1e12

RESOLVED = 12.0
SPEED_LIMITS = {"speed_limit_factor": (1.2, 3.0), "speed_cap_factor": (2.0, 4.0)}
"""Defaults below and from ``RESOLVED`` cells per diameter of the median particle on. Jets of symmetric impacts are up
to three times as fast as the particles. A lower limit takes energy from them, however fine the cells: 8 % at 24 and at
36 cells per diameter (``f2s verify sphere-mirror`` at 300 m/s). Where jets are not resolved no heavy node should race,
and fast ones mean more remaps: without the low limit a run of section4 at 4 um took 29 % longer, and lost 15.7 instead
of 16.6 % of its energy; PEEQ and heights changed by under 0.5 %."""

ONLY_WITH = {"internal_energy": 'material.pressure.model = "mie_grueneisen"', fields.ORIGIN: "output.origin = true",
             fields.LENT: "an absorbing side in domain.faces", "lost_energy": "numerics.loss_heating = true"}
"""What a scene must have for a field that not all have."""

HOTTEST = 4000.0  # K: tungsten melts at 3695 K

FASTEST = 1e5  # m/s: no gun comes near, and squares of speeds stay numbers


def by_resolution(median: float, cell_size: float) -> dict[str, float]:
    """Return the numerics that fit a median particle of that diameter and such cells (both m), by their keys."""
    cells = median / cell_size * (1.0 + 1e-9)
    chosen = {"steps_per_remap": MOST_STEPS if cells >= FINE else 1}
    return chosen | {name: pair[cells >= RESOLVED] for name, pair in SPEED_LIMITS.items()}


def _check_spheres(scene: Scene) -> None:
    """Raise if listed spheres leave the particle layer or overlap, or generated ones cannot fit."""
    domain, batches = scene.domain, scene.batches
    layer = domain.particle_layer_height
    if batches.source == "generated":
        room = layer / batches.count if scene.scheme == "standard" else layer
        if room < batches.diameter_max:
            raise wrong("domain.particle_layer_height", f"leaves {length_text(room)} per batch, less than "
                                                        f"batches.diameter_max ({length_text(batches.diameter_max)})")
    slack = 1e-9 * layer
    for index, (x, y, z, r) in enumerate(batches.spheres):
        key = f"batches.spheres[{index}]"
        if z - r < -slack or z + r > layer + slack:
            raise wrong(key, f"spans {length_text(z - r)} to {length_text(z + r)} above the bottom of the particle "
                             f"layer, which ends at {length_text(layer)}")
        if not (0.0 <= x <= domain.size[0] and 0.0 <= y <= domain.size[1]):
            raise wrong(key, "has its centre outside the box; x and y count from the low sides of the box")
        for other, (x2, y2, z2, r2) in enumerate(batches.spheres[:index]):
            if math.dist((x, y, z), (x2, y2, z2)) < (r + r2) * (1.0 - 1e-9):
                raise wrong(key, f"overlaps batches.spheres[{other}]")


def _check_sleep(scene: Scene) -> None:
    """Raise if material would sleep where particles arrive."""
    depth, least = scene.numerics.sleeping_depth, LEAST_SLEEPING_DEPTH * scene.domain.cell_size
    if 0.0 < depth < least * (1.0 - 1e-9):
        raise wrong("numerics.sleeping_depth", f"must be 0 or at least {LEAST_SLEEPING_DEPTH} cells "
                                               f"({length_text(least)}); particles arrive above")


def _check_temperatures(scene: Scene) -> None:
    """Raise if something is molten at the start, or colder than anything is."""
    for key, value in (("particles.temperature", scene.particles.temperature),
                       ("substrate.temperature", scene.substrate.temperature)):
        problem = scene.temperature_problem(value)
        if problem:
            raise wrong(key, problem)
    for diameter in scene.batches.diameter_range:
        value = scene.particles.temperature_at(diameter)
        problem = scene.temperature_problem(value)
        if problem:
            raise wrong("particles.temperature_per_diameter",
                        f"makes {units.pretty(value, 'temperature', 4)} for a diameter of {length_text(diameter)}, "
                        f"which {problem}")


def _check_speeds(scene: Scene) -> None:
    """Raise if the speed law stops or turns particles somewhere in the box, or makes them faster than any are."""
    low, high = scene.speed_range
    if math.isnan(high):
        raise wrong("batches.jet_centre", "is too far from the box for numbers to tell; is its unit right?")
    of_place = [scene.particles.speed_at(d, scene.particles.speed_diameter) for d in scene.distances]
    by_size = min(of_place) > 0.0 and max(of_place) <= FASTEST
    law = "particles.speed_per_diameter" if by_size else "particles.speed_curvature"
    if not high <= FASTEST:
        key = "particles.speed" if scene.particles.speed > FASTEST else law
        raise wrong(key, f"makes {high:.4g} m/s, more than {FASTEST:.0e} m/s; is its unit right?")
    if low <= 0.0:
        sizes = " and ".join(length_text(d) for d in scene.batches.diameter_range)
        where = f"for a diameter between {sizes}" if by_size else "at a side of the box"
        raise wrong(law, f"turns the speed into {low:.4g} m/s {where}; it must stay above 0 everywhere")


def _check_lateral(scene: Scene) -> None:
    """Raise if particles on a mirror would fly through it, or any as fast across the jet as along it."""
    particles, batches = scene.particles, scene.batches
    tolerance = 1e-3 * scene.domain.cell_size
    for side, place in (("x_low", 0.0), ("x_high", scene.domain.size[0])):
        mirror = getattr(scene.domain.faces, side) == "symmetry" and abs(batches.jet_centre - place) <= tolerance
        if particles.lateral_velocity and mirror:
            raise wrong("particles.lateral_velocity", f"must be 0 or left out: the jet's axis lies on the mirror at "
                                                      f"domain.faces.{side}, along which a particle there flies")
    most, low = scene.top_lateral_velocity, scene.speed_range[0]
    if particles.lateral and not most < low:
        far = max(map(abs, scene.distances))
        shares = {"velocity": 1.0, "slope": far, "curvature": far * far}
        key = max(shares, key=lambda name: shares[name] * abs(getattr(particles, f"lateral_{name}") or 0.0))
        raise wrong(f"particles.lateral_{key}", f"makes {most:.4g} m/s across the jet, not less than the lowest speed "
                                                f"along it ({low:.4g} m/s); is its unit right?")


def _check_repeats(scene: Scene) -> None:
    """Raise if a batch that comes again cannot be mirrored as asked."""
    how, (size_x, size_y) = scene.batches.mirror_repeats, scene.domain.size[:2]
    if len(set(how)) < len(how):
        raise wrong("batches.mirror_repeats", "names a mirror twice")
    if "xy" in how and size_x != size_y:
        raise wrong("batches.mirror_repeats", 'has "xy", which exchanges x and y, but domain.size is '
                                              f"{length_text(size_x)} by {length_text(size_y)}; leave it out")
    if scene.has_axis:
        for name in how:
            if "x" in name:
                raise wrong("batches.mirror_repeats", f'has "{name}", which would move the jet, that runs along y; '
                                                      'only "y" is possible')


def _check_dwell(scene: Scene) -> None:
    """Raise where a dwell or what lies below the box would have no effect."""
    dwell, backing = scene.cycles.dwell, scene.substrate.backing
    if dwell is not None and not scene.numerics.conduction:
        raise wrong("cycles.dwell", "has no effect with numerics.conduction = false; leave one of them out")
    if dwell is not None and scene.material.conductivity == 0.0:
        raise wrong("cycles.dwell", "has no effect with material.conductivity = 0; leave one of them out")
    if dwell is not None and scene.scheme == "standard":
        raise wrong("cycles.dwell", "has no effect in the standard scheme, which has one cycle; leave it out")
    if backing is not None and dwell is None:
        raise wrong("substrate.backing", "has no effect without cycles.dwell; leave it out, or give the dwell")
    if backing is not None and scene.domain.faces.z_low not in ("fixed", "absorbing"):
        raise wrong("substrate.backing", f'lies below a side that is "{scene.domain.faces.z_low}"; it needs '
                                         'domain.faces.z_low = "fixed" or "absorbing"')
    if dwell is not None and not dwell <= LONGEST_DWELL:
        raise wrong("cycles.dwell", f"must be at most {units.pretty(LONGEST_DWELL, 'time')}; is its unit right?")


def _check_view(scene: Scene) -> None:
    """Raise if the view is not in the box, or has a place but no time."""
    view = scene.output.view
    for axis, end in zip("xyz", scene.domain.extents):
        span = getattr(view, axis)
        if span is not None and span[1] > end * (1.0 + 1e-9):
            raise wrong(f"output.view.{axis}", f"reaches to {length_text(span[1])}, but the box to {length_text(end)}")
        if span is not None and view.interval is None:
            raise wrong("output.view.interval", f'is missing, without which output.view.{axis} has no effect; for '
                                                'example interval = "20 ns"')


def _check_steps(scene: Scene) -> None:
    """Raise if sound is too fast for any time step, or the steps of the run are too many to end ever."""
    try:
        sound = scene.material.longitudinal_sound_speed
    except (OverflowError, ZeroDivisionError):
        sound = math.inf
    if not 0.0 < sound <= FASTEST_SOUND:
        raise wrong("material.density", f"and the elastic constants give sound {sound:.3g} m/s, {FASTEST_SOUND:.3g} "
                                        "are possible; are their units right?")
    for key in ("frame_interval", "view.interval"):
        interval = scene.output.view.interval if key.startswith("view") else scene.output.frame_interval
        if interval and not scene.cycles.total_time / interval <= MOST_FRAMES:
            raise wrong(f"output.{key}", f"asks for {scene.cycles.total_time / interval:.3g} frames, "
                                         f"{MOST_FRAMES:.3g} are possible; is its unit right?")
    steps = scene.cycles.total_time * sound / (scene.numerics.courant * scene.domain.cell_size)
    if not steps <= MOST_STEPS_OF_RUN:
        raise wrong("cycles.duration", f"takes {steps:.3g} time steps at this cell size, {MOST_STEPS_OF_RUN:.3g} are "
                                       "possible; is its unit right?")


class Scene(Section):
    """All of a simulation."""

    title: str = Field(min_length=1, description="what the scene shows")
    scheme: Literal["recurring", "standard"] = Field(
        default="recurring", description="one batch per cycle, or all batches at once in one tall box")
    domain: Domain = Field(description="the box")
    material: Material = Field(description=(
        "the material of particles and substrate: that of the library by its name, but for what is written here"))
    substrate: Substrate = Field(default_factory=Substrate, description="the substrate at the start")
    particles: Particles = Field(description="the particles when painted")
    batches: Batches = Field(description="the spheres")
    cycles: Cycles = Field(description="number and duration of the cycles")
    numerics: Numerics = Field(default_factory=Numerics, validate_default=True,
                               description="the scheme's own numbers")
    output: Output = Field(default_factory=Output, description="what is written")
    run: Run = Field(default_factory=Run, description="the run itself")

    @field_validator("numerics")
    @classmethod
    def _by_resolution(cls, value: Numerics, info: ValidationInfo) -> Numerics:
        """Settle the steps between two remaps and the speed limits where the scene does not say."""
        if not {"domain", "batches"} <= info.data.keys():
            return value
        chosen = by_resolution(info.data["batches"].median_diameter, info.data["domain"].cell_size)
        return value.model_copy(update={n: v for n, v in chosen.items() if getattr(value, n) is None})

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        if self.scheme == "standard" and self.cycles.count != 1:
            raise wrong("cycles.count", "must be 1 in the standard scheme, which paints all batches at once")
        _check_spheres(self)
        _check_repeats(self)
        _check_sleep(self)
        _check_temperatures(self)
        _check_speeds(self)
        _check_lateral(self)
        _check_dwell(self)
        if self.output.archive_every and not self.output.checkpoints:
            raise wrong("output.archive_every", "has no effect with output.checkpoints = false; leave one of them out")
        _check_view(self)
        _check_steps(self)
        there = {field.name for field in self.needed_fields}
        for name, need in ONLY_WITH.items():
            if name in self.output.fields and name not in there:
                raise wrong("output.fields", f"{name} exists only with {need}")
        return self

    @property
    def has_axis(self) -> bool:
        """Is there a jet, whose axis over x matters?"""
        return self.batches.distribution == "sech" or self.particles.by_place

    @property
    def distances(self) -> tuple[float, float, float]:
        """Distances (m) along x from the jet's axis: of both sides of the box, and the smallest in it."""
        low, high = -self.batches.jet_centre, self.domain.size[0] - self.batches.jet_centre
        return low, high, min(max(0.0, low), high)

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed (m/s) along the jet that the speed law has in the box, for all diameters."""
        speeds = [self.particles.speed_at(distance, diameter)
                  for distance in self.distances for diameter in self.batches.diameter_range]
        return min(speeds), max(speeds)

    @property
    def top_lateral_velocity(self) -> float:
        """Largest size (m/s) of the lateral velocity in the box; 0 without."""
        low, high, _ = self.distances
        places, curvature = [low, high], self.particles.lateral_curvature
        if curvature:  # where the parabola turns
            places.append(min(max(-0.5 * (self.particles.lateral_slope or 0.0) / curvature, low), high))
        return max(abs(self.particles.lateral_at(place)) for place in places) if self.particles.lateral else 0.0

    @property
    def top_speed(self) -> float:
        """Highest speed (m/s) of any particle: what the numerics' speed limits and the energies refer to."""
        across = self.top_lateral_velocity
        return math.hypot(self.speed_range[1], across) if across else self.speed_range[1]

    def temperature_problem(self, value: float) -> str:
        """Return what is wrong with material of ``value`` (K) at its start, as "must be ..."; "" if nothing."""
        melting = self.melting_temperature
        if not value >= 0.0:
            return "must be above absolute zero"
        if melting is not None and value >= melting:
            return f"must be below the melting temperature ({units.pretty(melting, 'temperature')})"
        if value > HOTTEST:
            hottest = units.pretty(HOTTEST, "temperature")
            return f"must be at most {hottest}, where no metal is solid; is its unit right?"
        return ""

    @property
    def ballistic(self) -> bool:
        """Do particles fly as analytic spheres?"""
        return self.scheme == "recurring" and self.particles.flight == "ballistic"

    @property
    def mie_grueneisen(self) -> bool:
        """Does the pressure depend on the internal energy?"""
        return isinstance(self.material.pressure, MieGrueneisenPressure)

    @property
    def needed_fields(self) -> tuple[fields.Field, ...]:
        """Fields that a run of the scene allocates."""
        return fields.needed(self.mie_grueneisen, self.numerics.loss_heating, self.output.origin,
                             self.numerics.steps_per_remap > 1, self.domain.faces.absorbing)

    @property
    def melting_temperature(self) -> float | None:
        """Melting temperature, K, where the flow stress is given one."""
        return getattr(self.material.flow_stress, "melting_temperature", None)
