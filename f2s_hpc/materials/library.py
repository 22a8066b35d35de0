"""Named metals: published constants, each with its source. Text with units, as a scene would write them.

A scene that names an entry gets its keys; keys given in the scene replace them. Nothing here is fitted
by this project. ``spall_pressure`` is left to the scene's default.
"""

from __future__ import annotations

import copy

MELTING_COPPER = "1356 K"

# c_0, s and Gamma of the piston problem; K = rho c_0^2 = 138.62575 GPa
_PISTON_DENSITY, _PISTON_SOUND_SPEED, _PISTON_SHEAR = 8930.0, 3940.0, 45e9


def _piston_elasticity() -> dict[str, str]:
    """Return E and nu such that E / (2 (1 + nu)) is exactly 45 GPa and E / (3 (1 - 2 nu)) is rho c_0^2.

    nu is rounded to ten decimals (K then holds to 1e-9) and E = 2 G (1 + nu) has a finite decimal form.
    """
    bulk = _PISTON_DENSITY * _PISTON_SOUND_SPEED**2
    tenths = round(1e10 * (3.0 * bulk - 2.0 * _PISTON_SHEAR) / (2.0 * (3.0 * bulk + _PISTON_SHEAR)))
    young_tenths = 90 * (10**10 + tenths)  # GPa times 1e10, an exact integer
    young = f"{young_tenths // 10**10}.{young_tenths % 10**10:010d}"
    return {"young_modulus": f"{young} GPa", "poisson_ratio": tenths / 1e10}


def _metal(density: float, young_GPa: float, poisson: float, heat: float, conductivity: float,
           quinney: float, flow_stress: dict) -> dict:
    """Return an entry with linear pressure; density kg/m3, heat J/kg/K, conductivity W/m/K."""
    return {
        "density": f"{density:g} kg/m3", "young_modulus": f"{young_GPa:g} GPa", "poisson_ratio": poisson,
        "specific_heat": f"{heat:g} J/kg/K", "conductivity": f"{conductivity:g} W/m/K",
        "taylor_quinney": quinney, "flow_stress": flow_stress, "pressure": {"model": "linear"},
    }


def _johnson_cook(A: float, B: float, n: float, C: float, m: float, melting: str, reference: str) -> dict:
    """Return Johnson-Cook constants: A and B in MPa, temperatures as text, reference rate 1/s."""
    return {
        "model": "johnson_cook", "A": f"{A:g} MPa", "B": f"{B:g} MPa", "n": n, "C": C, "m": m,
        "reference_rate": "1 1/s", "reference_temperature": reference, "melting_temperature": melting,
    }


_GE_COPPER = {
    "model": "ge", "sigma_y0": "39 MPa", "hardening_A": "320 MPa", "hardening_n": 0.41,
    "alpha": "7.5 MPa", "beta": "0.01 MPa", "rate_s": "0.001 1/s", "rate_u": "1e4 1/s",
    "high_rate_B": "110 MPa", "room_temperature": "25 degC", "reference_temperature": "350 degC",
    "eta": "0.0043 1/K", "melting_temperature": MELTING_COPPER,
}

_ENTRIES: dict[str, tuple[str, dict]] = {
    "copper-ge": (
        "cold-sprayed copper, Ge model: Ge et al. 2026 (Free2Spray), Table 2",
        _metal(8960, 128, 0.34, 384.6, 385, 0.75, _GE_COPPER)),
    "copper-johnson-cook": (
        ("OFHC copper: Johnson and Cook 1983, 7th Int. Symp. on Ballistics, 541-547; elastic and thermal "
         "constants as usual in cold-spray simulations"),
        _metal(8960, 124, 0.34, 385, 386, 0.9,
               _johnson_cook(90, 292, 0.31, 0.025, 1.09, MELTING_COPPER, "298 K"))),
    "copper-taylor": (
        ("copper of the classic Taylor bar comparison (227 m/s), linear hardening: Simo 1992, Comput. Methods "
         "Appl. Mech. Eng. 99, 61-112; the thermal constants play no part in it"),
        _metal(8930, 117, 0.35, 385, 386, 0.9,
               {"model": "linear_hardening", "yield_stress": "400 MPa", "hardening_modulus": "100 MPa",
                "melting_temperature": MELTING_COPPER})),
    "copper-piston": (
        ("copper of the elastic-plastic piston: Udaykumar et al. 2003, J. Comput. Phys. 186, 136-177; E and nu "
         "chosen so that G is exactly 45 GPa and K = rho c0^2; adiabatic, all plastic work is internal energy"),
        {**_metal(_PISTON_DENSITY, 1, 0, 385, 0, 1.0,
                  {"model": "linear_hardening", "yield_stress": "90 MPa", "hardening_modulus": "0 Pa",
                   "melting_temperature": MELTING_COPPER}),
         **_piston_elasticity(),
         "pressure": {"model": "mie_grueneisen", "sound_speed": "3940 m/s", "slope_s": 1.49, "gamma": 2.0}}),
    "aluminium-6061-t6": (
        ("Lesuer, Kay and LeBlanc 2001, Modeling large-strain, high-rate deformation in metals, "
         "UCRL-JC-134118; elastic and thermal constants: handbook values"),
        _metal(2700, 68.9, 0.33, 896, 167, 0.9, _johnson_cook(324, 114, 0.42, 0.002, 1.34, "925 K", "298 K"))),
    "titanium-ti64": (
        ("Ti-6Al-4V: Lesuer 2000, Experimental investigations of material models for Ti-6Al-4V titanium and "
         "2024-T3 aluminum, DOT/FAA/AR-00/25; elastic and thermal constants: handbook values"),
        _metal(4430, 113.8, 0.342, 526.3, 6.7, 0.9, _johnson_cook(1098, 1092, 0.93, 0.014, 1.1, "1878 K", "298 K"))),
    "steel-316l": (
        ("AISI 316L: Umbrello, M'Saoubi and Outeiro 2007, Int. J. Mach. Tools Manuf. 47, 462-470; elastic and "
         "thermal constants: handbook values"),
        _metal(7990, 193, 0.3, 500, 16.3, 0.9, _johnson_cook(305, 1161, 0.61, 0.01, 0.517, "1673 K", "293 K"))),
    "tantalum": (
        ("Chen and Gray 1996, Constitutive behavior of tantalum and tantalum-tungsten alloys, Metall. Mater. "
         "Trans. A 27, 2994-3006; elastic and thermal constants: handbook values"),
        _metal(16600, 186, 0.34, 140, 57.5, 0.9, _johnson_cook(142, 164, 0.3148, 0.057, 0.8836, "3250 K", "298 K"))),
    "tungsten-alloy": (
        ("tungsten alloy with 7 % Ni, 3 % Fe: Johnson and Cook 1983, 7th Int. Symp. on Ballistics, 541-547; "
         "elastic and thermal constants: handbook values"),
        _metal(17000, 345, 0.28, 134, 75, 0.9, _johnson_cook(1506, 177, 0.12, 0.016, 1.0, "1723 K", "298 K"))),
}


def names() -> tuple[str, ...]:
    """Return the names of the entries."""
    return tuple(_ENTRIES)


def entry(name: str) -> dict:
    """Return the keys of entry ``name`` as a fresh dictionary of text with units and plain numbers.

    Raises KeyError for a name that is not in ``names()``.
    """
    return copy.deepcopy(_ENTRIES[name][1])


def source(name: str) -> str:
    """Return where the constants of entry ``name`` were published."""
    return _ENTRIES[name][0]
