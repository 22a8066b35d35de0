"""Quantities with units: parsed from text into SI at the input edge, printed back at the output edge.

Arithmetic is decimal and exact up to the last rounding: ``parse("3 um", "length") == 3e-6`` to the
last bit, and ``parse(show(x, d), d) == x`` for every finite float ``x`` of dimension ``d``.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from decimal import Context, Decimal, InvalidOperation, Overflow

EXACT = Context(prec=60)
_ZERO_CELSIUS = Decimal("273.15")  # K
ZERO_CELSIUS = float(_ZERO_CELSIUS)
"""0 degC in K."""

# exponents of metre, kilogram, second, kelvin
Exponents = tuple[int, int, int, int]


class UnitError(ValueError):
    """Text that is not a quantity of the wanted dimension; the message says what would be right."""


@dataclass(frozen=True)
class Dimension:
    """What a quantity measures: exponents of (m, kg, s, K), an example, and the units to print in."""

    name: str
    exponents: Exponents
    example: str
    shown: tuple[str, ...]


DIMENSIONS: dict[str, Dimension] = {d.name: d for d in (
    Dimension("length", (1, 0, 0, 0), "3 um", ("m", "mm", "um", "nm")),
    Dimension("time", (0, 0, 1, 0), "0.325 us", ("h", "min", "s", "ms", "us", "ns")),
    Dimension("speed", (1, 0, -1, 0), "615 m/s", ("m/s",)),
    Dimension("temperature", (0, 0, 0, 1), "450 degC", ("degC",)),
    Dimension("pressure", (-1, 1, -2, 0), "128 GPa", ("GPa", "MPa", "kPa", "Pa")),
    Dimension("density", (-3, 1, 0, 0), "8960 kg/m3", ("kg/m3",)),
    Dimension("specific heat", (2, 0, -2, -1), "384.6 J/kg/K", ("J/kg/K",)),
    Dimension("conductivity", (1, 1, -3, -1), "385 W/m/K", ("W/m/K",)),
    Dimension("rate", (0, 0, -1, 0), "1e4 1/s", ("1/s",)),
    Dimension("inverse temperature", (0, 0, 0, -1), "0.0043 1/K", ("1/K",)),
    Dimension("speed curvature", (-1, 0, -1, 0), "-6 m/s/mm2", ("m/s/mm2",)),
    Dimension("speed per diameter", (0, 0, -1, 0), "-0.6 m/s/um", ("m/s/um",)),
    Dimension("temperature per diameter", (-1, 0, 0, 1), "-2 K/um", ("K/um",)),
    Dimension("speed slope", (0, 0, -1, 0), "1.5 m/s/mm", ("m/s/mm",)),
    Dimension("mass flow", (0, 1, -1, 0), "42.2 g/min", ("g/min",)),
    Dimension("volume", (3, 0, 0, 0), "0.04 mm3", ("mm3",)),
    Dimension("mass", (0, 1, 0, 0), "0.127 ug", ("kg", "g", "mg", "ug", "ng")),
    Dimension("energy", (2, 1, -2, 0), "24 uJ", ("J", "mJ", "uJ", "nJ")),
)}

_PREFIXES = {"": 0, "T": 12, "G": 9, "M": 6, "k": 3, "c": -2, "m": -3, "u": -6, "n": -9, "p": -12}
_SI_UNITS: dict[str, tuple[Decimal, Exponents, str]] = {
    "m": (Decimal(1), (1, 0, 0, 0), "kcmunp"),
    "g": (Decimal("1e-3"), (0, 1, 0, 0), "kmunp"),
    "s": (Decimal(1), (0, 0, 1, 0), "munp"),
    "K": (Decimal(1), (0, 0, 0, 1), "m"),
    "N": (Decimal(1), (1, 1, -2, 0), "MkmunG"),
    "Pa": (Decimal(1), (-1, 1, -2, 0), "TGMk"),
    "J": (Decimal(1), (2, 1, -2, 0), "GMkmunp"),
    "W": (Decimal(1), (2, 1, -3, 0), "GMkmun"),
    "bar": (Decimal("1e5"), (-1, 1, -2, 0), "km"),
}


def _unit_table() -> dict[str, tuple[Decimal, Exponents]]:
    table = {prefix + unit: (EXACT.multiply(factor, Decimal(10) ** _PREFIXES[prefix]), exponents)
             for unit, (factor, exponents, prefixes) in _SI_UNITS.items() for prefix in ("", *prefixes)}
    table["min"] = (Decimal(60), (0, 0, 1, 0))
    table["h"] = (Decimal(3600), (0, 0, 1, 0))
    return table


UNITS = _unit_table()
_CELSIUS = ("degC", "°C", "celsius")
_MEANT = {"c": "degC", "deg": "degC", "degree": "degC", "degrees": "degC", "celsius": "degC", "kelvin": "K", "sec": "s",
          "mps": "m/s", "mu": "um", "micron": "um", "microns": "um", "micrometer": "um", "micrometers": "um",
          "micrometre": "um", "micrometres": "um"}
"""What people write for a unit (in small letters), and how it is written here."""
LIKELY = 1e3
"""A number without a unit is hardly in the unit of the example if it is more than so many times larger or smaller."""
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*", re.DOTALL)
_FACTOR = re.compile(r"([A-Za-z]+)\^?(-?\d)?")


def _parse_unit(text: str) -> tuple[Decimal, Exponents]:
    """Return the SI factor and exponents of a unit such as ``J/kg/K``, ``kg/m^3``, ``1/s``, ``W/(m*K)``."""
    factor, exponents = Decimal(1), [0, 0, 0, 0]
    flat = text.replace(" ", "").replace("µ", "u").replace("μ", "u").replace("³", "3").replace("²", "2")
    grouped = re.fullmatch(r"([^()]*/)\(([^()/]*)\)", flat)
    if grouped:
        flat = grouped[1] + grouped[2].replace("*", "/")
    for index, divided in enumerate(flat.split("/")):
        if divided in ("", "1") and index == 0 and "/" in flat:
            continue  # "1/s", also what is left of "1e4/s"
        for one in divided.split("*"):
            match = _FACTOR.fullmatch(one)
            name = match[1] if match else one
            if match is None or (name not in UNITS and name != "degC"):
                close = difflib.get_close_matches(name, UNITS, 1, 0.5)
                known = (_MEANT | {unit.lower(): unit for unit in UNITS}).get(name.lower(), close[0] if close else "")
                raise UnitError(f'unknown unit "{name}"' + (f', did you mean "{known}"' if known else ""))
            scale, dimension = UNITS["K" if name == "degC" else name]  # in a product degC is an interval
            power = int(match[2] or 1) * (-1 if index else 1)
            factor = EXACT.multiply(factor, EXACT.power(scale, power))
            exponents = [e + power * d for e, d in zip(exponents, dimension)]
    return factor, tuple(exponents)


def with_article(noun: str) -> str:
    """Return a noun with its article: "a length", "an energy"."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def _describe(exponents: Exponents) -> str:
    for dimension in DIMENSIONS.values():
        if dimension.exponents == exponents:
            return with_article(dimension.name)
    return "another kind of quantity"


def parse(text: str, dimension: str) -> float:
    """Return the SI value (kelvin for temperatures) of ``text``, for example ``"3 um"``.

    ``dimension`` is a key of ``DIMENSIONS``. Raises UnitError when ``text`` has no unit, an unknown
    unit, or a unit of another dimension; the message ends with an example of the right form.
    """
    want = DIMENSIONS[dimension]
    hint = f'write for example "{want.example}"'
    if not isinstance(text, str):
        if isinstance(text, (int, float)) and not isinstance(text, bool):
            raise UnitError(_needs_unit(text, want, hint))
        raise UnitError(f"expected a {want.name} with its unit as text: {hint}")
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UnitError(f"not a number with a unit: {hint}")
    try:
        return _si_value(match[1], match[2], want, hint)
    except Overflow:
        raise UnitError(f"this is too large: {hint}") from None
    except InvalidOperation:
        raise UnitError(f"the exponent of this number is out of range: {hint}") from None


def _needs_unit(number: object, want: Dimension, hint: str) -> str:
    """Return what to say of a number without a unit: the example, and the number with the units it may be meant in."""
    usual, unit = want.example.split(" ", 1)
    size = abs(float(str(number)) / float(usual))
    likely = size == 0.0 or 1.0 / LIKELY <= size <= LIKELY
    meant = [f"{number} {unit}"] if likely else []
    if want.name == "temperature":
        meant.append(f"{number} K")
    elif not likely:
        meant += [f"{number} {base}" for base in want.shown if _parse_unit(base)[0] == 1]
    return f"{with_article(want.name)} needs a unit: {hint}" + "".join(
        f' or "{text}"' for text in meant if text != want.example)


def _si_value(digits: str, unit: str, want: Dimension, hint: str) -> float:
    """Return the SI value of a number and its unit as :func:`parse` does; ``hint`` ends every message."""
    number = Decimal(digits)
    if not unit:
        raise UnitError(_needs_unit(digits, want, hint))
    if unit[0] == "," and unit[1:2].isdigit():
        raise UnitError(f"decimals have a point, not a comma: {hint}")
    if unit in _CELSIUS:
        if want.name != "temperature":
            raise UnitError(f"this is a temperature, but a {want.name} is needed: {hint}")
        return _checked_float(EXACT.add(number, _ZERO_CELSIUS), hint)
    try:
        factor, exponents = _parse_unit(unit)
    except UnitError as error:
        raise UnitError(f"{error}; {hint}") from None
    if exponents != want.exponents:
        raise UnitError(f"this is {_describe(exponents)}, but a {want.name} is needed: {hint}")
    return _checked_float(EXACT.multiply(number, factor), hint)


def _checked_float(value: Decimal, hint: str) -> float:
    result = float(value)
    if result in (float("inf"), float("-inf")):
        raise UnitError(f"this is too large: {hint}")
    return result


def show(value: float, dimension: str) -> str:
    """Return ``value`` (SI) as text with a unit, such that ``parse`` gives back the same float.

    The unit is the largest of the dimension's units in which the number is at least 1.
    """
    exact = Decimal(repr(float(value)))
    if dimension == "temperature":
        return f"{_plain(EXACT.subtract(exact, _ZERO_CELSIUS))} degC"
    units = DIMENSIONS[dimension].shown
    if exact == 0:
        return f"0 {'s' if dimension == 'time' else units[0]}"
    for unit in units:
        factor = _parse_unit(unit)[0]
        number = EXACT.divide(exact, factor)
        # hours and minutes only where they give a short number
        exactly = len(EXACT.normalize(number).as_tuple().digits) <= 20
        if exactly and (abs(number) >= 1 or unit == units[-1]):
            break
    return f"{_plain(number)} {unit}"


def _plain(number: Decimal) -> str:
    number = EXACT.normalize(number)
    return f"{number:f}" if -7 < number.adjusted() < 7 else f"{number:e}".lower().replace("e+", "e")


def pretty(value: float, dimension: str, digits: int = 4) -> str:
    """Return ``value`` (SI) rounded to ``digits`` significant digits with a unit, for people."""
    if dimension == "temperature":
        return f"{value - ZERO_CELSIUS:.{digits}g} degC"
    return show(float(f"{value:.{digits}g}"), dimension)


def count_text(number: int, noun: str) -> str:
    """Return a number of things for people: "1 particle", "10,236 particles"."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def pretty_bytes(count: float) -> str:
    """Return a number of bytes as text with a binary prefix, for people."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if abs(count) < 1024:
            return f"{count:.{0 if unit == 'B' else 1}f} {unit}"
        count /= 1024
    return f"{count:.1f} TiB"
