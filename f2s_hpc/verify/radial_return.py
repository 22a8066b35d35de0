"""Radial return of random states against a solution in extended precision that shares no code with the solver."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from f2s_hpc.materials.flow_stress import MAX_ITERATIONS, return_map
from f2s_hpc.materials.params import Ge, JohnsonCook
from f2s_hpc.units import ZERO_CELSIUS
from f2s_hpc.verify.box import make_model
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.material import check_models, reaching
from f2s_hpc.verify.setting import Setting

SEED = 20240501
Extended = np.longdouble
MODELS = (("Ge", "copper-ge"), ("Johnson-Cook", "copper-johnson-cook"), ("linear hardening", "copper-taylor"))


@dataclass
class States:
    """Random states: trial stress (Pa), PEEQ, step (s), temperature (K), first guess of the increment."""

    trial: np.ndarray
    peeq: np.ndarray
    dt: np.ndarray
    temperature: np.ndarray
    guess: np.ndarray


def reference_flow(flow: tuple) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Return the flow stress (Pa) of (PEEQ, rate, K) in extended precision, written anew from the publications.

    Ge et al. 2026 (Free2Spray), Eq. (1) with the limits of the authors' VUHARD routine; Johnson and Cook 1983; linear
    hardening. Numbers of the tuple are taken as they are.
    """
    p = type(flow)(*(Extended(value) for value in flow))

    def over(rate: np.ndarray, limit: np.ndarray) -> np.ndarray:
        return np.log(np.maximum(rate / limit, Extended(1)))

    if isinstance(flow, Ge):
        def ge(strain: np.ndarray, rate: np.ndarray, temperature: np.ndarray) -> np.ndarray:
            power = strain**p.exponent
            cold = 1 + np.exp((p.room_temperature - p.reference_temperature) * p.eta)
            softening = cold / (1 + np.exp((temperature - p.reference_temperature) * p.eta))
            return softening * (p.yield_stress + p.hardening * power
                                + (p.alpha * power + p.beta) * over(rate, p.rate_normal)
                                + p.high_rate * over(rate, p.rate_high))
        return ge
    if isinstance(flow, JohnsonCook):
        def johnson_cook(strain: np.ndarray, rate: np.ndarray, temperature: np.ndarray) -> np.ndarray:
            star = (temperature - p.reference_temperature) / (p.melting_temperature - p.reference_temperature)
            star = np.clip(star, Extended(0), Extended(1))
            return ((p.yield_stress + p.hardening * strain**p.exponent)
                    * (1 + p.rate_factor * over(rate, p.reference_rate)) * (1 - star**p.softening_exponent))
        return johnson_cook
    return lambda strain, rate, temperature: p.yield_stress + p.modulus * strain + 0 * rate


def solve(flow: tuple, shear_modulus: float, states: States) -> np.ndarray:
    """Return the plastic increments d: roots of trial - 3 G d = sigma(PEEQ + d, d / dt, T).

    Bisections between steps of the regula falsi (Illinois), until the bracket is as narrow as
    extended precision allows.
    """
    stress = reference_flow(flow)
    stiffness = 3 * Extended(shear_modulus)
    trial, peeq, dt, temperature = (a.astype(Extended) for a in (states.trial, states.peeq, states.dt,
                                                                 states.temperature))

    def residual(d: np.ndarray, at: np.ndarray) -> np.ndarray:
        return trial[at] - stiffness * d - stress(peeq[at] + d, d / dt[at], temperature[at])

    low, high = np.zeros(trial.size, dtype=Extended), trial / stiffness
    at = np.arange(trial.size)
    at_low, at_high = residual(low, at), residual(high, at)
    low[at_low <= 0] = high[at_low <= 0] = 0
    at = np.flatnonzero(at_low > 0)
    for iteration in range(400):
        a, b, fa, fb = low[at], high[at], at_low[at], at_high[at]
        middle = 0.5 * (a + b)
        if iteration % 3:
            falsi = (a * fb - b * fa) / (fb - fa)
            middle = np.where((falsi > a) & (falsi < b), falsi, middle)
        value = residual(middle, at)
        positive = value > 0
        low[at], high[at] = np.where(positive, middle, a), np.where(positive, b, middle)
        # Illinois: the end that stays counts half, so both ends close in
        at_low[at] = np.where(positive, value, 0.5 * fa)
        at_high[at] = np.where(positive, 0.5 * fb, value)
        exact = value == 0
        low[at[exact]] = high[at[exact]] = middle[exact]
        at = at[high[at] - low[at] > 4 * np.finfo(Extended).eps * high[at]]
        if not at.size:
            break
    return 0.5 * (low + high)


def random_states(flow: tuple, shear_modulus: float, count: int, largest_trial: float) -> States:
    """Return states over the whole range: PEEQ 0..50, rate 1e-8..1e12 1/s, -200..1300 degC, trial to 100 times yield.

    Even in the logarithm of rate and of the trial stress over the static flow stress; PEEQ zero, even in logarithm and
    even. Where a molten material has no strength, trial stresses refer to the cold yield stress.
    """
    random = np.random.Generator(np.random.PCG64(SEED))
    kind = random.integers(0, 10, count)
    peeq = np.where(kind == 0, 0.0, np.where(kind < 5, 10.0 ** random.uniform(-12.0, math.log10(50.0), count),
                                             random.uniform(0.0, 50.0, count)))
    temperature = random.uniform(-200.0, 1300.0, count) + ZERO_CELSIUS
    static = reference_flow(flow)(peeq.astype(Extended), np.zeros(count, dtype=Extended),
                                  temperature.astype(Extended)).astype(float)
    ratio = np.exp(random.uniform(0.0, math.log(largest_trial), count)) * (1.0 + 1e-9)
    trial = ratio * np.maximum(static, 1e-3 * flow.yield_stress)
    rate = 10.0 ** random.uniform(-8.0, 12.0, count)
    widest = (trial - static) / (3.0 * shear_modulus)
    guess = widest * random.choice([0.0, 0.5, 1.0, 2.0, -1.0], count)
    return States(trial, peeq, widest / rate, temperature, guess)


def _solver(flow: tuple, shear_modulus: float, states: States) -> np.ndarray:
    """Return increment, flow stress and iterations of the solver's radial return for each state."""
    columns = zip(*(a.tolist() for a in (states.trial, states.peeq, states.dt, states.temperature, states.guess)))
    return np.array([return_map(flow, trial, shear_modulus, peeq, dt, kelvin, guess)
                     for trial, peeq, dt, kelvin, guess in columns])


def _check(options: Options) -> None:
    check_models(MODELS, options)


def _run(options: Options) -> Iterator[Measured]:
    for name, material in MODELS:
        model = make_model(1e-6, material, overrides=reaching(material, options.overrides))
        shear = model.bulk.shear_modulus
        for level in options.levels:
            states = random_states(model.flow, shear, round(level), options["trial"])
            _solver(model.flow, shear, States(*(a[:2] for a in vars(states).values())))
            watch = Stopwatch()
            increment, stress, iterations = _solver(model.flow, shear, states).T
            wall = watch.read()
            exact = solve(model.flow, shear, states)
            exact_stress = states.trial.astype(Extended) - 3 * Extended(shear) * exact
            apart = np.abs(stress - exact_stress) / np.maximum(exact_stress, 1e-6 * states.trial)
            strain = np.abs(increment - exact) * 3 * Extended(shear) / states.trial
            finite = bool(np.isfinite([increment, stress]).all())
            yield Measured(f"{name}: flow stress", level, 1.0 / level, float(apart.max()), 0.0,
                           float(apart.max()) if finite else math.inf, 1e-10, compares=False, steps=round(level),
                           wall_s=wall)
            yield Measured(f"{name}: 3 G increment over trial stress", level, 1.0 / level, float(strain.max()), 0.0,
                           float(strain.max()) if finite else math.inf, 1e-10, compares=False, steps=round(level),
                           wall_s=wall)
            yield Measured(f"{name}: iterations", level, 1.0 / level, float(iterations.max()), MAX_ITERATIONS,
                           float(iterations.max()), MAX_ITERATIONS - 1, compares=False, steps=round(level),
                           wall_s=wall)


CASES = (
    Case("radial-return", """Implicit radial return of random states against extended precision
PEEQ 0..50, rate 1e-8..1e12 1/s, -200..1300 degC, trial stress up to 100 times the static flow stress, any first guess.
Relative error of the flow stress, of the plastic increment over trial / 3G, and the iterations, which must end
before their limit; a number that is not finite fails. "cells" and "steps" stand for the number of states.""",
         _run, (3000, 10000, 30000), (10000, 30000, 100000), {"trial": Setting("100", above=1.0)}, 2,
         whole=True, check=_check),
)
