"""Schema of the material: elasticity, heat, flow stress and pressure, each model with its own keys."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from f2s_hpc.config.quantities import (
    Conductivity,
    Density,
    ElasticModulus,
    InverseTemperature,
    Number,
    PositivePressure,
    PressureOrZero,
    Rate,
    Section,
    SpecificHeat,
    Speed,
    Temperature,
    wrong,
)
from f2s_hpc.materials import library

_NO_PART_IN_MODEL = "temperature at which nothing may start, K; the model itself does not use it"


class GeFlowStress(Section):
    """Ge model, as the published routine runs it: hardening, rate terms, logistic thermal softening."""

    model: Literal["ge"]
    sigma_y0: PositivePressure = Field(description="initial yield stress, Pa")
    hardening_A: PressureOrZero = Field(description="strain hardening A, Pa")  # noqa: N815
    hardening_n: Number = Field(gt=0, le=1, description="strain hardening exponent n")
    alpha: PressureOrZero = Field(description="rate hardening per PEEQ^n, Pa; acts above rate_s")
    beta: PressureOrZero = Field(description="rate hardening, Pa; acts above rate_s")
    rate_s: Rate = Field(description="normal reference rate, 1/s")
    rate_u: Rate = Field(description="high reference rate, 1/s; the B term acts above it")
    high_rate_B: PressureOrZero = Field(description="high-rate hardening B, Pa")  # noqa: N815
    room_temperature: Temperature = Field(description="temperature of no softening, K")
    reference_temperature: Temperature = Field(description="temperature of fastest softening, K")
    eta: InverseTemperature = Field(description="steepness of the thermal softening, 1/K")
    melting_temperature: Temperature | None = Field(default=None, description=_NO_PART_IN_MODEL)

    @model_validator(mode="after")
    def _rates_in_order(self) -> GeFlowStress:
        if self.rate_u <= self.rate_s:
            raise wrong("rate_u", "must be above rate_s")
        return self


class JohnsonCookFlowStress(Section):
    """Johnson-Cook: (A + B PEEQ^n) (1 + C ln rate) (1 - T*^m)."""

    model: Literal["johnson_cook"]
    A: PositivePressure = Field(description="initial yield stress, Pa")
    B: PressureOrZero = Field(description="strain hardening, Pa")
    n: Number = Field(gt=0, description="strain hardening exponent")
    C: Number = Field(ge=0, description="rate hardening factor")
    m: Number = Field(gt=0, description="thermal softening exponent")
    reference_rate: Rate = Field(description="rate of no rate hardening, 1/s")
    reference_temperature: Temperature = Field(description="temperature of no softening, K")
    melting_temperature: Temperature = Field(description="temperature of no strength, K")

    @model_validator(mode="after")
    def _temperatures_in_order(self) -> JohnsonCookFlowStress:
        if self.melting_temperature <= self.reference_temperature:
            raise wrong("melting_temperature", "must be above reference_temperature")
        return self


class LinearHardeningFlowStress(Section):
    """Flow stress yield_stress + hardening_modulus PEEQ, without rate and temperature."""

    model: Literal["linear_hardening"]
    yield_stress: PositivePressure = Field(description="initial yield stress, Pa")
    hardening_modulus: PressureOrZero = Field(description="slope over PEEQ, Pa")
    melting_temperature: Temperature | None = Field(default=None, description=_NO_PART_IN_MODEL)


class ElasticFlowStress(Section):
    """No yielding."""

    model: Literal["elastic"]


class LinearPressure(Section):
    """Constant bulk modulus E / (3 (1 - 2 nu))."""

    model: Literal["linear"] = "linear"


class MieGrueneisenPressure(Section):
    """Mie-Grueneisen on the shock Hugoniot U = sound_speed + slope_s u."""

    model: Literal["mie_grueneisen"]
    sound_speed: Speed = Field(description="bulk sound speed c0, m/s")
    slope_s: Number = Field(ge=0, description="slope s of the shock speed over the particle speed")
    gamma: Number = Field(ge=0, description="Grueneisen parameter at the density of zero pressure")


FlowStress = Annotated[GeFlowStress | JohnsonCookFlowStress | LinearHardeningFlowStress | ElasticFlowStress,
                       Field(discriminator="model")]
Pressure = Annotated[LinearPressure | MieGrueneisenPressure, Field(discriminator="model")]


class Material(Section):
    """The one material of particles and substrate (SI, kelvin)."""

    name: str = Field(min_length=1, description=(
        f'entry of the library that gives what the scene does not ({", ".join(library.names())}), or "custom"'))
    density: Density = Field(description="density at zero pressure, kg/m3")
    young_modulus: ElasticModulus = Field(description="Young's modulus, Pa")
    poisson_ratio: Number = Field(ge=0, lt=0.5, description="Poisson's ratio")
    specific_heat: SpecificHeat = Field(description="specific heat, J/kg/K")
    conductivity: Conductivity = Field(description="heat conductivity, W/m/K")
    taylor_quinney: Number = Field(ge=0, le=1, description="share of plastic work that becomes heat")
    spall_pressure: PositivePressure = Field(default=2e9, description="tension at which full material opens a void, Pa")
    flow_stress: FlowStress = Field(description="flow stress: model and its constants")
    pressure: Pressure = Field(default_factory=LinearPressure, description="pressure: model and its constants")

    @property
    def shear_modulus(self) -> float:
        """Shear modulus E / (2 (1 + nu)), Pa."""
        return self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus at zero pressure, Pa: E / (3 (1 - 2 nu)), or rho c0^2 with Mie-Grueneisen."""
        if isinstance(self.pressure, MieGrueneisenPressure):
            return self.density * self.pressure.sound_speed**2
        return self.young_modulus / (3.0 * (1.0 - 2.0 * self.poisson_ratio))

    @property
    def longitudinal_sound_speed(self) -> float:
        """Speed of longitudinal elastic waves, sqrt((K + 4 G / 3) / rho), m/s."""
        return math.sqrt((self.bulk_modulus + 4.0 / 3.0 * self.shear_modulus) / self.density)
