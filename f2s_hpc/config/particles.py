"""The section of the particles: which way they fly, how fast by place and size, how hot they are."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, field_validator, model_validator

from f2s_hpc.config.quantities import (
    Number,
    PositiveLength,
    Section,
    Speed,
    SpeedCurvature,
    SpeedPerDiameter,
    SpeedSlope,
    Temperature,
    TemperaturePerDiameter,
    Velocity,
    wrong,
)


class Particles(Section):
    """The particles at the moment they are painted."""

    speed: Speed = Field(description="speed on the jet's axis, and anywhere without a curvature, m/s")
    speed_curvature: SpeedCurvature = Field(
        default=0.0, description="growth of the speed with the squared distance along x from the jet's axis, 1/(m s)")
    speed_per_diameter: SpeedPerDiameter | None = Field(
        default=None, description="growth of the speed with the diameter beyond speed_diameter, 1/s")
    speed_diameter: PositiveLength | None = Field(
        default=None, examples=["20 um"],
        description="diameter of the particles that speed and speed_curvature are meant for, m")
    lateral_velocity: Velocity | None = Field(
        default=None, examples=["2 m/s"], description="velocity along x on the jet's axis, m/s")
    lateral_slope: SpeedSlope | None = Field(
        default=None, description="growth of the velocity along x with x from the jet's axis; above 0: outwards, 1/s")
    lateral_curvature: SpeedCurvature | None = Field(
        default=None, examples=["0.4 m/s/mm2"],
        description="growth of the velocity along x with the squared distance from the axis, 1/(m s)")
    direction: tuple[Number, Number, Number] = Field(default=(0.0, 0.0, -1.0),
                                                     description="flight direction (x, y, z); normalised")
    temperature: Temperature = Field(description="initial temperature; of all particles, or with "
                                                 "temperature_per_diameter of those of temperature_diameter, K")
    temperature_per_diameter: TemperaturePerDiameter | None = Field(
        default=None, description="growth of the temperature with the diameter beyond temperature_diameter, K/m")
    temperature_diameter: PositiveLength | None = Field(
        default=None, examples=["30 um"], description="diameter of the particles that temperature is meant for, m")
    flight: Literal["ballistic", "eulerian"] = Field(
        default="ballistic", description="until they meet something particles fly as analytic spheres, or painted onto "
                                         "the grid from the start (always in the standard scheme)")

    @field_validator("direction")
    @classmethod
    def _normalised(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        norm = math.hypot(*value)
        if norm == 0.0:
            raise ValueError("must not be the zero vector")
        # a vector that is already normalised keeps its bits, so that a dumped scene loads back equal
        return value if abs(norm - 1.0) < 1e-14 else tuple(v / norm for v in value)

    @model_validator(mode="after")
    def _laws_have_their_parts(self) -> Particles:
        for law in ("speed", "temperature"):
            growth, diameter = getattr(self, f"{law}_per_diameter"), getattr(self, f"{law}_diameter")
            if growth is not None and diameter is None:
                raise wrong(f"{law}_diameter", f"is missing: {law}_per_diameter counts from the diameter that has "
                                               f'particles.{law}, for example {law}_diameter = "30 um"')
            if diameter is not None and growth is None:
                raise wrong(f"{law}_diameter", f"has no effect without {law}_per_diameter; leave it out")
        if self.lateral and self.direction[0] != 0.0:
            raise wrong(self.lateral[0], "is a velocity along x, across the jet, but particles.direction leans along "
                                         "x; leave one of them out")
        return self

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Velocity (x, y, z) on the jet's axis, of particles of ``speed_diameter``, m/s."""
        return tuple(self.speed * d for d in self.direction)

    @property
    def lateral(self) -> tuple[str, ...]:
        """Those keys of the lateral velocity that are not zero."""
        return tuple(key for key in ("lateral_velocity", "lateral_slope", "lateral_curvature") if getattr(self, key))

    @property
    def by_place(self) -> bool:
        """Does the velocity depend on x, or is it another than along ``direction``?"""
        return self.speed_curvature != 0.0 or bool(self.lateral)

    def speed_at(self, distance, diameter):
        """Return the speed along ``direction`` (m/s) of particles of ``diameter`` (m) at ``distance`` (m) along x from
        the jet's axis; numbers or arrays.

        speed + speed_curvature distance^2 + speed_per_diameter (diameter - speed_diameter), as in figures 8b and c of
        Ge et al. 2026, which the authors' own simulations take without the diameter.
        """
        speed = self.speed + self.speed_curvature * (distance * distance)
        if not self.speed_per_diameter:
            return speed
        return speed + self.speed_per_diameter * (diameter - self.speed_diameter)

    def temperature_at(self, diameter):
        """Return the temperature (K) of particles of ``diameter`` (m, a number or an array).

        temperature + temperature_per_diameter (diameter - temperature_diameter): the gas heats and cools small
        particles faster than large ones. Ge et al. 2026 take one temperature for all.
        """
        if not self.temperature_per_diameter:
            return self.temperature
        return self.temperature + self.temperature_per_diameter * (diameter - self.temperature_diameter)

    def lateral_at(self, distance):
        """Return the velocity along x (m/s) at ``distance`` (m, a number or an array) along x from the jet's axis.

        lateral_velocity + lateral_slope distance + lateral_curvature distance^2, as in figure 8d of Ge et al. 2026,
        whose authors' own simulations leave it out.
        """
        slope, curvature = self.lateral_slope or 0.0, self.lateral_curvature or 0.0
        return (self.lateral_velocity or 0.0) + distance * (slope + curvature * distance)
