"""Flow stress of every model, and the implicit radial return that all of them share.

Each model is written as

    sigma(eps, rate, T) = theta(T) [ h(eps) + r(eps) <ln(rate / rate_1)> + b <ln(rate / rate_2)> ]

with <x> = max(x, 0): a strain-hardening part, up to two logarithmic rate terms that act only above
their reference rate, and thermal softening at the temperature of the step's start. ``softening``
gives theta; ``hardening`` gives h, r and their derivatives in ln eps; ``rate_terms`` gives rate_1,
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
"""Bisections that shrink any bracket to round-off; most states take one step."""

_TINY_STRAIN = 1e-300
LOWEST, _HIGHEST = -700.0, 700.0
"""Range of the logarithm of a plastic strain increment."""
_NEAR = 2e-3
"""Largest relative change of the increment after which the fourth-order step leaves less than 1e-13 of it."""
_ROUND_OFF = 5e-13
"""Some units in the last place of the largest logarithm."""


def _ge_softening(flow, temperature):
    """Thermal factor of the Ge model: a logistic curve, 1 at room temperature, never zero."""
    cold = 1.0 + exponential((flow.room_temperature - flow.reference_temperature) * flow.eta)
    return cold / (1.0 + exponential((temperature - flow.reference_temperature) * flow.eta))


def _ge_hardening(flow, eps):
    """Return h, r, dh/dln eps, dr/dln eps (Pa) of the Ge model, and n."""
    strained = power(max(eps, _TINY_STRAIN), flow.exponent)
    slope = flow.exponent * strained
    return (flow.yield_stress + flow.hardening * strained, flow.alpha * strained + flow.beta,
            flow.hardening * slope, flow.alpha * slope, flow.exponent)


def _ge_rate_terms(flow):
    """Return rate_1, rate_2 (1/s) and b (Pa) of the Ge model."""
    return flow.rate_normal, flow.rate_high, flow.high_rate


def _jc_softening(flow, temperature):
    """Thermal factor of Johnson-Cook: 1 - T*^m, 1 below the reference, 0 from melting on."""
    star = (temperature - flow.reference_temperature) / (flow.melting_temperature - flow.reference_temperature)
    return 1.0 - power(min(max(star, _TINY_STRAIN), 1.0), flow.softening_exponent)


def _jc_hardening(flow, eps):
    """Return h, r, dh/dln eps, dr/dln eps (Pa) of Johnson-Cook, and n; its rate factor multiplies the hardening."""
    hardened = flow.hardening * power(max(eps, _TINY_STRAIN), flow.exponent)
    stress, slope = flow.yield_stress + hardened, flow.exponent * hardened
    return stress, flow.rate_factor * stress, slope, flow.rate_factor * slope, flow.exponent


def _jc_rate_terms(flow):
    """Return rate_1, rate_2 (1/s) and b (Pa): Johnson-Cook has no second rate term."""
    return flow.reference_rate, flow.reference_rate, 0.0


def _linear_softening(flow, temperature):
    """No thermal softening."""
    return 1.0


def _linear_hardening(flow, eps):
    """Return h, r, dh/dln eps, dr/dln eps (Pa) of linear hardening, and its exponent, 1."""
    return flow.yield_stress + flow.modulus * eps, 0.0, flow.modulus * max(eps, _TINY_STRAIN), 0.0, 1.0


def _no_rate_terms(flow):
    """No rate terms."""
    return 1.0, 1.0, 0.0


def _elastic_hardening(flow, eps):
    """A flow stress that no trial stress reaches."""
    return 1e300, 0.0, 0.0, 0.0, 1.0


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
    """Return h, r, dh/dln eps, dr/dln eps (Pa) of ``flow`` at equivalent plastic strain ``eps``, and n.

    Both derivatives go with eps**n: every further one in ln eps multiplies by n.
    """
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
def flow_stress(flow, eps, rate, temperature):
    """Return the flow stress and its derivatives in strain and in rate.

    Parameters: ``flow`` a tuple of :mod:`f2s_hpc.materials.params`; ``eps`` equivalent plastic
    strain; ``rate`` its rate (1/s); ``temperature`` (K). Returns (Pa, Pa, Pa s). The derivative in
    strain is infinite at zero strain where the exponent is below one.
    """
    theta = softening(flow, temperature)
    h, r, h_slope, r_slope, _ = hardening(flow, eps)
    rate_1, rate_2, b = rate_terms(flow)
    above_1, above_2 = max(rate, rate_1), max(rate, rate_2)
    decades = logarithm(above_1 / rate_1)
    stress = (h + r * decades) + b * logarithm(above_2 / rate_2)
    slope_strain = (h_slope + r_slope * decades) / max(eps, _TINY_STRAIN)
    slope_rate = (r / above_1 if rate > rate_1 else 0.0) + (b / above_2 if rate > rate_2 else 0.0)
    return theta * stress, theta * slope_strain, theta * slope_rate


@inlined
def static_flow_stress(flow, eps, temperature):
    """Return the flow stress (Pa) at zero rate: what a trial stress must exceed to flow."""
    return softening(flow, temperature) * hardening(flow, eps)[0]


@inlined
def rate_onsets(flow, dt):
    """Return the logarithms of the plastic strain increments at which the two rate terms set in, for a step ``dt``."""
    rate_1, rate_2, _ = rate_terms(flow)
    return logarithm(rate_1 * dt), logarithm(rate_2 * dt)


@inlined
def fourth_order(residual, first, second, third):
    """Return Householder's step of fourth order towards the root of a falling function, or Newton's.

    ``residual``: the function; ``first`` to ``third``: its derivatives with their signs turned (Householder 1970, The
    Numerical Treatment of a Single Nonlinear Equation). From far on the side of the strong curvature the higher orders
    lead astray; Newton's step is safe there.
    """
    over = 1.0 / first
    newton = residual * over
    p, q = newton * (second * over), newton * newton * (third * over)
    return newton * (6.0 + 3.0 * p) / ((6.0 + 6.0 * p) + q) if p > -0.5 else newton


@inlined
def return_start(flow, theta, excess, stiffness, eps, r, h_slope, r_slope, onset_1, onset_2, guess):
    """Return a first value of the logarithm of the plastic strain increment, and an upper bound of it.

    ``excess``: trial less static flow stress (Pa), above zero; ``r`` and the slopes: of ``hardening`` at ``eps``.
    Elastic unloading or either rate term alone would take up the whole excess at some increment: all bound the root.
    ``guess`` replaces the first of them where it is smaller (unless it is of no use: not above a hundredth of it).
    From there one step on the stress with hardening that needs no power: with y = d / eps,
    ((1 + y)**n - 1) / n is about y / (1 + (1 - n) y / 2). It leaves most roots within 2e-3.
    """
    b, n = rate_terms(flow)[2], hardening(flow, 1.0)[4]
    widest = max(excess / stiffness, _TINY_STRAIN)
    near = guess if (guess < widest and guess > 0.01 * widest) else widest
    free = excess / max(theta, _TINY_STRAIN)
    bound = min(onset_1 + free / max(r, _TINY_STRAIN),
                ((free + r * onset_1) + b * onset_2) / max(r + b, _TINY_STRAIN))
    x = logarithm(near)
    # ln(w) <= ln(n) + w / n - 1; the margin is for round-off
    high = max(min(min(x + (widest / near - 1.0), bound) + 1e-6, _HIGHEST), LOWEST)
    x = max(min(x, bound), LOWEST)
    d, eps = exponential(x), max(eps, _TINY_STRAIN)
    over = 1.0 / (eps + max(0.5 - 0.5 * n, 0.0) * d)
    gained, slope = d * over, (d * over) * (eps * over)
    above_1, above_2 = max(x - onset_1, 0.0), max(x - onset_2, 0.0)
    elastic, hardening_1 = stiffness * d, h_slope + r_slope * above_1
    residual = (excess - elastic) - theta * ((hardening_1 * gained + r * above_1) + b * above_2)
    rate = (r + r_slope * gained if x > onset_1 else 0.0) + (b if x > onset_2 else 0.0)
    first = elastic + theta * (hardening_1 * slope + rate)
    second = elastic + theta * (hardening_1 + (2.0 * r_slope if x > onset_1 else 0.0)) * slope
    found = x + fourth_order(residual, first, second, second)
    return (found if (found > LOWEST and found < high) else x), high


@inlined
def return_step(flow, theta, trial, stiffness, eps, onset_1, onset_2, x, low, high):
    """Do one step towards the root of the radial return in x, the logarithm of the plastic strain increment d.

    In x the residual  trial - 3 G d - sigma(eps + d, d / dt)  is concave and falls, with bends only where a rate term
    sets in. Its second and third derivatives cost no further powers, so the step is of fourth order; one that leaves
    the bracket ``low`` to ``high`` becomes a bisection. The last step is one below 2e-3 that meets no bend: it leaves
    less than 1e-13, and increment and flow stress follow from the derivatives. It ends too where the residual is below
    1e-14 of the trial stress, or the bracket has shrunk to round-off.

    ``theta``: thermal factor; ``stiffness``: 3 G; ``eps``: PEEQ before; ``onset_1``, ``onset_2``: of ``rate_onsets``.
    Returns x, low, high anew, 1.0 if it was the last step, the increment and the flow stress (Pa) there.
    """
    d = exponential(x)
    strain = max(eps + d, _TINY_STRAIN)
    h, r, h_slope, r_slope, n = hardening(flow, strain)
    b = rate_terms(flow)[2]
    share = d / strain
    above_1, above_2 = max(x - onset_1, 0.0), max(x - onset_2, 0.0)
    elastic, stress = stiffness * d, theta * ((h + r * above_1) + b * above_2)
    residual = (trial - elastic) - stress
    low = x if residual > 0.0 else low
    high = high if residual > 0.0 else x
    # derivatives of the flow stress in x
    bend = 1.0 + (n - 1.0) * share
    hardened = (h_slope + r_slope * above_1) * share
    r_first = share * r_slope if x > onset_1 else 0.0
    first = theta * ((hardened + (r if x > onset_1 else 0.0)) + (b if x > onset_2 else 0.0))
    second = theta * (hardened * bend + 2.0 * r_first)
    third = theta * (hardened * (bend * bend + (bend - 1.0) * (1.0 - share)) + 3.0 * (r_first * bend))
    step = fourth_order(residual, elastic + first, elastic + second, elastic + third)
    found = x + step
    inside = (1.0 if found >= low else 0.0) * (1.0 if found <= high else 0.0)
    found = found if inside > 0.0 else 0.5 * (low + high)
    # both ends of the step on one side of either onset; across one only a step of round-off is the last
    below, beyond = min(found, x), max(found, x)
    smooth = ((1.0 if below > onset_1 else 0.0) + (1.0 if beyond <= onset_1 else 0.0)) * (
        (1.0 if below > onset_2 else 0.0) + (1.0 if beyond <= onset_2 else 0.0))
    near = inside * (1.0 if abs(step) <= (_NEAR if smooth > 0.0 else _ROUND_OFF) else 0.0)
    step = step if near > 0.0 else 0.0
    last = 1.0 if (high - low <= _ROUND_OFF or abs(residual) <= 1e-14 * trial) else near
    d *= 1.0 + step * (1.0 + step * (0.5 + step * (1.0 / 6.0 + step * (1.0 / 24.0))))
    stress += step * (first + step * (0.5 * second + step * (1.0 / 6.0 * third)))
    return found, low, high, last, d, stress


@kernel
def return_map(flow, trial, shear_modulus, eps, dt, temperature, guess):
    """Solve the implicit radial return for the plastic strain increment.

    Finds d >= 0 with  trial - 3 G d = sigma(eps + d, d / dt, T)  (backward Euler, J2). The left
    side falls and the right side rises with d, so the root is single and lies between 0 and
    (trial - sigma(eps, 0, T)) / 3G; steps that leave a bracket become bisections, which
    always converges, across the infinite slope at zero strain, the logarithm at zero rate and the
    kinks at the reference rates.

    Parameters: ``trial`` von Mises trial stress (Pa); ``shear_modulus`` (Pa); ``eps`` PEEQ before
    the step; ``dt`` (s); ``temperature`` (K); ``guess`` a first value of d, any number.
    Returns (d, flow stress in Pa, iterations); d = 0 and the static flow stress when elastic.
    """
    stiffness = 3.0 * shear_modulus
    theta = softening(flow, temperature)
    h, r, h_slope, r_slope, _ = hardening(flow, eps)
    if trial <= theta * h:
        return 0.0, theta * h, 0
    onset_1, onset_2 = rate_onsets(flow, dt)
    x, high = return_start(flow, theta, trial - theta * h, stiffness, eps, r, h_slope, r_slope, onset_1, onset_2,
                           guess)
    low, iteration, last, increment, stress = LOWEST, 0, 0.0, 0.0, 0.0
    while last == 0.0 and iteration < MAX_ITERATIONS:
        x, low, high, last, increment, stress = return_step(flow, theta, trial, stiffness, eps, onset_1, onset_2, x,
                                                            low, high)
        iteration += 1
    return increment, stress, iteration


__all__ = ["LOWEST", "MAX_ITERATIONS", "flow_stress", "hardening", "rate_onsets", "rate_terms", "return_map",
           "return_start", "return_step", "softening", "static_flow_stress"]
