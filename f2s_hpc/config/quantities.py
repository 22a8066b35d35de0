"""Types of the schema: numbers that a scene writes as text with a unit, held as SI floats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict
from pydantic_core import PydanticCustomError

from f2s_hpc import units


@dataclass(frozen=True)
class Unit:
    """Marks a field as a quantity of ``dimension`` (a key of ``units.DIMENSIONS``)."""

    dimension: str


def _quantity(dimension: str, **bounds: float) -> object:
    def parse(value: object) -> float:
        return units.parse(value, dimension)

    return Annotated[float, Unit(dimension), BeforeValidator(parse), Field(**bounds)]


Length = _quantity("length")
PositiveLength = _quantity("length", gt=0)
LengthOrZero = _quantity("length", ge=0)
Time = _quantity("time", gt=0)
Speed = _quantity("speed", gt=0)
Velocity = _quantity("speed")
SpeedSlope = _quantity("speed slope")
SpeedCurvature = _quantity("speed curvature")
SpeedPerDiameter = _quantity("speed per diameter")
TemperaturePerDiameter = _quantity("temperature per diameter")
Temperature = _quantity("temperature", ge=0)
PositivePressure = _quantity("pressure", gt=0)
ElasticModulus = _quantity("pressure", ge=1e6, le=1e13)  # rubber has 10 MPa, diamond 1.2 TPa
PressureOrZero = _quantity("pressure", ge=0)
# no solid comes near these bounds, a wrong unit goes beyond them
Density = _quantity("density", ge=100, le=30_000)
SpecificHeat = _quantity("specific heat", ge=10, le=20_000)
Conductivity = _quantity("conductivity", ge=0, le=1e5)
Rate = _quantity("rate", gt=0)
InverseTemperature = _quantity("inverse temperature", gt=0)

Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]


def _plain_number(value: object) -> object:
    if isinstance(value, (bool, str)):
        raise ValueError("must be a plain number without quotes or unit")
    return value


Number = Annotated[float, BeforeValidator(_plain_number)]


class Section(BaseModel):
    """A part of a scene: immutable, no unknown keys, no infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def wrong(key: str, problem: str) -> PydanticCustomError:
    """Return the error of a check that involves several keys; it is reported under ``key``."""
    return PydanticCustomError("check", "{problem}", {"key": key, "problem": problem})
