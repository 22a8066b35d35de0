"""Quantities with units: exact parsing and printing, and errors that say what would be right."""

import numpy as np
import pytest

from f2s_hpc import units
from f2s_hpc.units import UnitError, parse, pretty, pretty_bytes, show


@pytest.mark.parametrize(("text", "dimension", "value"), [
    ("3 um", "length", 3e-6), ("3um", "length", 3e-6), ("3 µm", "length", 3e-6), ("0.203 mm", "length", 0.203e-3),
    ("615 m/s", "speed", 615.0), ("0.615 km/s", "speed", 615.0), ("450 degC", "temperature", 723.15),
    ("723.15 K", "temperature", 723.15), ("-10 degC", "temperature", 263.15), ("128 GPa", "pressure", 128e9),
    ("8960 kg/m3", "density", 8960.0), ("8.96 g/cm^3", "density", 8960.0),
    ("384.6 J/kg/K", "specific heat", 384.6), ("384.6 J/(kg*K)", "specific heat", 384.6),
    ("384.6 J/kg/degC", "specific heat", 384.6), ("385 W/m/K", "conductivity", 385.0),
    ("0.325 us", "time", 0.325e-6), ("1/s", "rate", 1.0), ("1e4 1/s", "rate", 1e4), ("1e4/s", "rate", 1e4),
    ("2 h", "time", 7200.0), ("90 min", "time", 5400.0), ("0.0043 1/K", "inverse temperature", 0.0043),
    ("1e-3 1/degC", "inverse temperature", 1e-3),
])
def test_parse_gives_the_nearest_float(text, dimension, value):
    assert parse(text, dimension) == value


@pytest.mark.parametrize(("text", "dimension", "words"), [
    ("3", "length", ["needs a unit", '"3 um"']), (615, "speed", ["needs a unit", '"615 m/s"']),
    (2.5, "length", ["needs a unit", '"2.5 um"']),
    ("3 s", "length", ["this is a time", "a length is needed", '"3 um"']),
    ("25 degC", "length", ["a temperature", "a length is needed"]), ("3 umm", "length", ['"umm"', 'did you mean "um"']),
    ("3 mpa", "pressure", ['did you mean "MPa"', '"128 GPa"']), ("abc", "time", ["not a number", '"0.325 us"']),
    ("1e999 m", "length", ["too large"]), ("1e9999999 um", "length", ["too large", '"3 um"']),
    ("-1e9999999 degC", "temperature", ["too large"]), (f"1e-{10**20} m/s", "speed", ["out of range", '"615 m/s"']),
    (True, "length", ["expected a length"]), (None, "time", ["expected a time"]),
    ("25 C", "temperature", ['did you mean "degC"']), ("6 Microns", "length", ['did you mean "um"']),
    ("600 mps", "speed", ['did you mean "m/s"']), ("0,006 mm", "length", ["a point, not a comma", '"3 um"']),
    ("nan m", "length", ["not a number"]), ("3 m/", "length", ["unknown unit"]),
])
def test_wrong_text_says_what_would_be_right(text, dimension, words):
    with pytest.raises(UnitError) as caught:
        parse(text, dimension)
    for word in words:
        assert word in str(caught.value)


def test_printed_quantities_parse_back_to_the_same_bits():
    """Fails if ``show`` rounds, for example if it formats with ``f"{number:.15g}"``."""
    random = np.random.Generator(np.random.PCG64(7))
    for dimension in units.DIMENSIONS:
        values = random.normal(size=300) * 10.0 ** random.uniform(-20, 15, size=300)
        for value in (random.uniform(0, 4000, size=300) if dimension == "temperature" else values):
            assert parse(show(float(value), dimension), dimension) == value


@pytest.mark.parametrize(("value", "dimension", "text"), [
    (3e-6, "length", "3 um"), (0.35e-3, "length", "350 um"), (128e9, "pressure", "128 GPa"),
    (723.15, "temperature", "450 degC"), (5400.0, "time", "1.5 h"), (61.0, "time", "61 s"), (0.0, "time", "0 s"),
    (1e7, "rate", "1e7 1/s"), (2.5e-10, "length", "0.25 nm"),
])
def test_units_are_chosen_for_people(value, dimension, text):
    assert show(value, dimension) == text


def test_rounded_numbers_for_people():
    assert pretty(3.123456e-7, "time") == "312.3 ns"
    assert pretty(723.15, "temperature") == "450 degC"
    assert pretty_bytes(100) == "100 B"
    assert pretty_bytes(33.75 * 2**20) == "33.8 MiB"
    assert pretty_bytes(3 * 2**40) == "3.0 TiB"


@pytest.mark.parametrize("number", [615, "615"])
def test_a_number_without_unit_is_told_what_it_may_mean_once(number):
    """Fails when ``_needs_unit`` does not look whether the two suggestions are the same."""
    with pytest.raises(UnitError, match=r'needs a unit: write for example "615 m/s"$'):
        parse(number, "speed")
    with pytest.raises(UnitError, match=r'write for example "615 m/s" or "400 m/s"$'):
        parse(400 if number == 615 else "400", "speed")


@pytest.mark.parametrize(("number", "dimension", "suggested"), [
    (3e-6, "length", '"3 um" or "3e-06 m"'), (128e9, "pressure", '"128 GPa" or "128000000000.0 Pa"'),
    (300, "temperature", '"450 degC" or "300 degC" or "300 K"'), (0, "length", '"3 um" or "0 um"'),
    (1e9, "speed curvature", '"-6 m/s/mm2"')])
def test_a_number_in_si_units_is_not_told_to_be_in_others(number, dimension, suggested):
    """Fails when ``_needs_unit`` takes every number as ``likely``: "3e-06 um" for who thinks in metres."""
    with pytest.raises(UnitError) as caught:
        parse(number, dimension)
    assert str(caught.value).endswith(f"needs a unit: write for example {suggested}")
