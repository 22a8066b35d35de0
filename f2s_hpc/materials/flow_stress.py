"""Flow stress of every model, and the implicit radial return that all of them share.

Each model is written as

    sigma(eps, rate, T) = theta(T) [ h(eps) + r(eps) <ln(rate / rate_1)> + b <ln(rate / rate_2)> ]

with <x> = max(x, 0): a strain-hardening part, up to two logarithmic rate terms that act only above
their reference rate, and thermal softening at the temperature of the step's start. ``softening``
gives theta; ``hardening`` gives h, r and their derivatives in eps; ``rate_terms`` gives rate_1,
rate_2 and b. Sources: Ge et al. 2026 (Free2Spray), Eq. (1), with the limits of the authors' hardening
routine, without which the logarithms go negative; Johnson and Cook 1983.
"""

from __future__ import annotations

from numba import types
from numba.extending import overload

from f2s_hpc._jit import POINT_OPTIONS, inlined, kernel
from f2s_hpc.materials.elementary import exponential, logarithm, power
from f2s_hpc.materials.params import Elastic, Ge, JohnsonCook, LinearHardening

MAX_ITERATIONS = 80
"""Bisections that shrink any bracket to round-off; Newton steps take three to six."""

_TINY_STRAIN = 1e-300


def _ge_softening(flow, temperature):
    """Thermal factor of the Ge model: a logistic curve, 1 at room temperature, never zero."""
    cold = 1.0 + exponential((flow.room_temperature - flow.reference_temperature) * flow.eta)
    return cold / (1.0 + exponential((temperature - flow.reference_temperature) * flow.eta))


def _ge_hardening(flow, eps):
    """Return h, r, dh/deps, dr/deps (Pa) of the Ge model."""
    strained = power(max(eps, _TINY_STRAIN), flow.exponent)
    slope = flow.exponent * strained / max(eps, _TINY_STRAIN)
    return (flow.yield_stress + flow.hardening * strained, flow.alpha * strained + flow.beta,
            flow.hardening * slope, flow.alpha * slope)


def _ge_rate_terms(flow):
    """Return rate_1, rate_2 (1/s) and b (Pa) of the Ge model."""
    return flow.rate_normal, flow.rate_high, flow.high_rate


def _jc_softening(flow, temperature):
    """Thermal factor of Johnson-Cook: 1 - T*^m, 1 below the reference, 0 from melting on."""
    star = (temperature - flow.reference_temperature) / (flow.melting_temperature - flow.reference_temperature)
    return 1.0 - power(min(max(star, _TINY_STRAIN), 1.0), flow.softening_exponent)


def _jc_hardening(flow, eps):
    """Return h, r, dh/deps, dr/deps (Pa) of Johnson-Cook; its rate factor multiplies the hardening."""
    strained = power(max(eps, _TINY_STRAIN), flow.exponent)
    slope = flow.exponent * strained / max(eps, _TINY_STRAIN)
    stress = flow.yield_stress + flow.hardening * strained
    return stress, flow.rate_factor * stress, flow.hardening * slope, flow.rate_factor * flow.hardening * slope


def _jc_rate_terms(flow):
    """Return rate_1, rate_2 (1/s) and b (Pa): Johnson-Cook has no second rate term."""
    return flow.reference_rate, flow.reference_rate, 0.0


def _linear_softening(flow, temperature):
    """No thermal softening."""
    return 1.0


def _linear_hardening(flow, eps):
    """Return h, r, dh/deps, dr/deps (Pa) of linear hardening."""
    return flow.yield_stress + flow.modulus * eps, 0.0, flow.modulus, 0.0


def _no_rate_terms(flow):
    """No rate terms."""
    return 1.0, 1.0, 0.0


def _elastic_hardening(flow, eps):
    """A flow stress that no trial stress reaches."""
    return 1e300, 0.0, 0.0, 0.0


_MODELS = {
    Ge: (_ge_softening, _ge_hardening, _ge_rate_terms),
    JohnsonCook: (_jc_softening, _jc_hardening, _jc_rate_terms),
    LinearHardening: (_linear_softening, _linear_hardening, _no_rate_terms),
    Elastic: (_linear_softening, _elastic_hardening, _no_rate_terms),
}


def softening(flow, temperature):
    """Return the thermal factor theta of ``flow`` at ``temperature`` (K)."""
    return _MODELS[type(flow)][0](flow, temperature)


def hardening(flow, eps):
    """Return h, r, dh/deps, dr/deps (Pa) of ``flow`` at equivalent plastic strain ``eps``."""
    return _MODELS[type(flow)][1](flow, eps)


def rate_terms(flow):
    """Return the two reference rates (1/s) and the second rate coefficient b (Pa) of ``flow``."""
    return _MODELS[type(flow)][2](flow)


def _model_part(flow, part):
    return _MODELS[flow.instance_class][part] if isinstance(flow, types.BaseNamedTuple) else None


@overload(softening, jit_options=POINT_OPTIONS)
def _softening_overload(flow, temperature):
    return _model_part(flow, 0)


@overload(hardening, jit_options=POINT_OPTIONS)
def _hardening_overload(flow, eps):
    return _model_part(flow, 1)


@overload(rate_terms, jit_options=POINT_OPTIONS)
def _rate_terms_overload(flow):
    return _model_part(flow, 2)


@inlined
def cold_flow_stress(flow, eps, rate):
    """Return the flow stress over its thermal factor, and its derivatives in strain and rate (Pa, Pa, Pa s).

    Without branches, so that loops over it vectorise.
    """
    h, r, dh, dr = hardening(flow, eps)
    rate_1, rate_2, b = rate_terms(flow)
    above_1, above_2 = max(rate, rate_1), max(rate, rate_2)
    decades = logarithm(above_1 / rate_1)
    stress = (h + r * decades) + b * logarithm(above_2 / rate_2)
    slope_rate = (r / above_1 if rate > rate_1 else 0.0) + (b / above_2 if rate > rate_2 else 0.0)
    return stress, dh + dr * decades, slope_rate


@inlined
def flow_stress(flow, eps, rate, temperature):
    """Return the flow stress and its derivatives in strain and in rate.

    Parameters: ``flow`` a tuple of :mod:`f2s_hpc.materials.params`; ``eps`` equivalent plastic
    strain; ``rate`` its rate (1/s); ``temperature`` (K). Returns (Pa, Pa, Pa s). The derivative in
    strain is infinite at zero strain where the exponent is below one.
    """
    theta = softening(flow, temperature)
    stress, slope_strain, slope_rate = cold_flow_stress(flow, eps, rate)
    return theta * stress, theta * slope_strain, theta * slope_rate


@inlined
def static_flow_stress(flow, eps, temperature):
    """Return the flow stress (Pa) at zero rate: what a trial stress must exceed to flow."""
    return softening(flow, temperature) * hardening(flow, eps)[0]


@inlined
def return_step(flow, theta, trial, stiffness, eps, dt, increment, low, high):
    """Do one bracketed Newton step of the radial return: increment, low, high anew, 1.0 if it was the last, stress.

    ``theta``: thermal factor; ``stiffness``: 3 G. A step that leaves the bracket becomes a bisection. The last step is
    taken where the residual is below 1e-13 of the trial stress, or the bracket has shrunk to round-off; the flow stress
    is that at the increment given (the difference trial - 3 G d has no digits left near melting).
    """
    stress, slope_strain, slope_rate = cold_flow_stress(flow, eps + increment, increment / dt)
    residual = (trial - stiffness * increment) - theta * stress
    low = increment if residual > 0.0 else low
    high = high if residual > 0.0 else increment
    proposal = increment + residual / (stiffness + theta * (slope_strain + slope_rate / dt))
    proposal = proposal if (proposal > low and proposal < high) else 0.5 * (low + high)
    small = abs(residual) <= 1e-13 * trial
    last = small or proposal == increment or high - low <= 1e-16 * high
    return increment if small else proposal, low, high, 1.0 if last else 0.0, theta * stress


@kernel
def return_map(flow, trial, shear_modulus, eps, dt, temperature, guess):
    """Solve the implicit radial return for the plastic strain increment.

    Finds d >= 0 with  trial - 3 G d = sigma(eps + d, d / dt, T)  (backward Euler, J2). The left
    side falls and the right side rises with d, so the root is single and lies between 0 and
    (trial - sigma(eps, 0, T)) / 3G; Newton steps that leave the bracket become bisections, which
    always converges, across the infinite slope at zero strain, the logarithm at zero rate and the
    kinks at the reference rates.

    Parameters: ``trial`` von Mises trial stress (Pa); ``shear_modulus`` (Pa); ``eps`` PEEQ before
    the step; ``dt`` (s); ``temperature`` (K); ``guess`` a first value of d, any number.
    Returns (d, flow stress in Pa, iterations); d = 0 and the static flow stress when elastic.
    """
    stiffness = 3.0 * shear_modulus
    static = static_flow_stress(flow, eps, temperature)
    if trial <= static:
        return 0.0, static, 0
    theta = softening(flow, temperature)
    low, high = 0.0, (trial - static) / stiffness
    increment = guess if low < guess < high else 0.5 * high
    iteration, last, stress = 0, 0.0, static
    while last == 0.0 and iteration < MAX_ITERATIONS:
        increment, low, high, last, stress = return_step(flow, theta, trial, stiffness, eps, dt, increment, low, high)
        iteration += 1
    return increment, stress, iteration


__all__ = ["MAX_ITERATIONS", "cold_flow_stress", "flow_stress", "hardening", "rate_terms", "return_map", "return_step",
           "softening", "static_flow_stress"]
