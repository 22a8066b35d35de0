"""Flow stress and radial return at points: published values, differences, and an independent solution."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from f2s_hpc.config.messages import did_you_mean
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library
from f2s_hpc.materials.flow_stress import flow_stress
from f2s_hpc.units import ZERO_CELSIUS
from f2s_hpc.verify.box import make_model
from f2s_hpc.verify.case import MATERIAL, Case, Measured, Options, Stopwatch

GE_VALUES = (
    (0.0, 1e-4, 25.0, 39.000000), (0.0, 1e7, 25.0, 799.083339), (0.1, 1e-4, 25.0, 163.494446),
    (0.1, 1e4, 25.0, 210.685629), (1.0, 1e7, 25.0, 1291.777221), (1.0, 1e7, 350.0, 805.561465),
    (1.0, 1e8, 450.0, 767.990680), (3.0, 1e8, 800.0, 291.579114),
)
"""Ge model of copper-ge: PEEQ, rate (1/s), temperature (degC), flow stress (MPa).

Evaluated by hand from Ge et al. 2026, Eq. (1), with the rate limits of the authors' VUHARD routine."""

JOHNSON_COOK_VALUES = (
    (0.1, 1.0, 298.0, 233.015415), (0.5, 1e4, 298.0, 400.497609), (1.0, 1e6, 298.0, 513.938126),
    (1.0, 1e7, 600.0, 399.273141), (2.0, 1e8, 900.0, 303.110942), (3.0, 1e7, 723.15, 442.221388),
)
"""Johnson-Cook model of copper-johnson-cook: PEEQ, rate (1/s), temperature (K), flow stress (MPa)."""

MODELS = (("Ge", "copper-ge"), ("Johnson-Cook", "copper-johnson-cook"))

_FLOW = f"{MATERIAL}flow_stress"

_PEEQ = (1e-3, 0.03, 0.1, 0.7, 1.0, 3.0, 20.0)
_RATES = (1e-5, 0.3, 30.0, 5e3, 3e4, 1e7, 1e10)
_TEMPERATURES = (150.0, 298.15, 500.0, 723.15, 1100.0)


def _key(override: str) -> str:
    return override.partition("=")[0].strip()


def reaching(material: str, overrides: Sequence[str]) -> tuple[str, ...]:
    """Return those of ``overrides`` whose key a ``material`` of the library has: its flow stress has its own."""
    constants = [f"{_FLOW}.{name}" for name in library.entry(material)["flow_stress"]]
    return tuple(o for o in overrides if not _key(o).startswith(_FLOW) or _key(o) in constants)


def check_models(models: Sequence[tuple[str, str]], options: Options) -> None:
    """Raise ``InputError`` for overrides that none of ``models`` (name, material) has, or that replace one of them."""
    constants = [name for _, material in models for name in library.entry(material)["flow_stress"]]
    known = dict.fromkeys(f"{_FLOW}.{name}" for name in constants if name != "model")
    for override in options.overrides:
        key = _key(override)
        if key in (_FLOW, f"{_FLOW}.model", f"{MATERIAL}name"):
            raise InputError(f"--set {key}: this case is about the models {', '.join(name for name, _ in models)}; "
                             "their constants may be replaced, not they")
        if key.startswith(_FLOW) and key not in known:
            raise InputError(f'--set {key}: unknown key "{key}"; {did_you_mean(key, known)}')
    for _, material in models:
        make_model(1e-6, material, overrides=reaching(material, options.overrides))


def _check(options: Options) -> None:
    check_models(MODELS, options)


def _tables(options: Options) -> list[tuple[str, tuple, list[tuple[float, ...]]]]:
    """Name, flow parameters, and points (PEEQ, rate, K, Pa) of both models; no points where a constant is replaced."""
    points = {"Ge": [(e, r, t + ZERO_CELSIUS, 1e6 * s) for e, r, t, s in GE_VALUES],
              "Johnson-Cook": [(e, r, t, 1e6 * s) for e, r, t, s in JOHNSON_COOK_VALUES]}
    tables = []
    for name, material in MODELS:
        overrides = reaching(material, options.overrides)
        tabulated = not any(_key(o).startswith(_FLOW) for o in overrides)
        tables.append((name, make_model(1e-6, material, overrides=overrides).flow, points[name] if tabulated else []))
    return tables


def _difference_errors(flow: tuple, step: float) -> tuple[float, float]:
    """Largest relative distance of the slopes in PEEQ and in rate from central differences of relative width ``step``.

    Points keep clear of the reference rates, where the slope in rate jumps.
    """
    found: tuple[list[float], list[float]] = ([], [])
    for peeq in _PEEQ:
        for rate in _RATES:
            for temperature in _TEMPERATURES:
                _, in_strain, in_rate = flow_stress(flow, peeq, rate, temperature)
                for which, (slope, e, r) in enumerate(((in_strain, step * peeq, 0.0), (in_rate, 0.0, step * rate))):
                    high = flow_stress(flow, peeq + e, rate + r, temperature)[0]
                    low = flow_stress(flow, peeq - e, rate - r, temperature)[0]
                    difference = (high - low) / (2.0 * (e + r))
                    scale = np.maximum(abs(difference), abs(slope))
                    if scale != 0.0:  # (what is no number must show)
                        found[which].append(abs(slope - difference) / scale)
    return tuple(float(np.max(off, initial=0.0)) for off in found)


def _flow_stress(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        watch, rows = Stopwatch(), []
        finest = number == len(options.levels) - 1
        for name, flow, points in _tables(options):
            if finest and points:
                errors = [abs(flow_stress(flow, *p[:3])[0] / p[3] - 1.0) for p in points]
                at = points[int(np.argmax(errors))]  # (of what is no number, the first)
                rows.append((f"{name}, flow stress", flow_stress(flow, *at[:3])[0], at[3], float(np.max(errors)), 1e-6,
                             False))
            for slope, error in zip(("PEEQ", "rate"), _difference_errors(flow, 1.0 / level)):
                rows.append((f"{name}, slope in {slope}", error, 0.0, error, 1e-6 if finest else None, True))
        spent = watch.read()
        for quantity, value, reference, error, bar, compares in rows:
            yield Measured(quantity, level, 1.0 / level, value, reference, error, bar, compares=compares,
                           steps=1, cell_steps=0, wall_s=spent)


CASES = (
    Case("flow-stress",
         """Ge and Johnson-Cook flow stress against tabulated values, their derivatives against central differences
Relative errors, the largest of all points (the row shows the point where it is). "cells" and "dx" stand for the
inverse width and the width of the differences, relative to PEEQ or rate. A model with other constants
(--set material.flow_stress.KEY) has no tabulated values.""",
         _flow_stress, (100, 1000, 10000), (100, 1000, 10000), least=2, check=_check),
)
