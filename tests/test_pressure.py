"""Pressure, its stored energy and its stiffness, as kernels compile them, against closed forms and differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from solver_setup import make_model

from f2s_hpc._jit import kernel
from f2s_hpc.kernels.strain import closure
from f2s_hpc.materials.pressure import pressure, stiffness, stored_energy, unloaded

LINEAR = make_model(3e-6).eos
GRUENEISEN = make_model(3e-6, "copper-piston").eos


@kernel
def evaluate(eos, x, energy):
    """Return pressure, stiffness and stored energy, compiled."""
    return pressure(eos, x, energy), stiffness(eos, x, energy), stored_energy(eos, x)


def test_linear_pressure_is_the_logarithm_as_exactly_as_it_says():
    """Below 1e-12 for 0.9 < x < 1.1, below 1e-6 up to x = 2; fails when ``y / 13`` and ``1.0 / 11 +`` are dropped."""
    for x in np.linspace(0.9, 1.1, 2001):
        if x != 1.0:
            assert evaluate(LINEAR, x, 0.0)[0] == pytest.approx(LINEAR.bulk_modulus * math.log(x), rel=1e-12)
    for x in np.linspace(0.5, 2.0, 1001):
        if x != 1.0:
            assert evaluate(LINEAR, x, 0.0)[0] == pytest.approx(LINEAR.bulk_modulus * math.log(x), rel=1e-6)
    assert evaluate(LINEAR, 1.0, 0.0) == (0.0, LINEAR.bulk_modulus, 0.0)


@pytest.mark.parametrize("x", [0.92, 0.99, 0.99999, 1.00001, 1.01, 1.08, 1.5])
def test_stored_energy_is_the_integral_of_the_pressure(x):
    """Stored energy over mass against -int p dv, v = 1 / x, by Gauss quadrature.

    Fails when ``(1.0 + _logarithm(x)) / x`` in ``_linear_energy`` loses the ``1.0 +``.
    """
    nodes, weights = np.polynomial.legendre.leggauss(20)
    middle, half = 0.5 * (1.0 + 1.0 / x), 0.5 * (1.0 / x - 1.0)
    work = -half * sum(w * LINEAR.bulk_modulus * -math.log(middle + half * n) for n, w in zip(nodes, weights))
    # close to x = 1 the closed form loses the digits of 1 - (1 + ln x) / x
    assert evaluate(LINEAR, x, 0.0)[2] == pytest.approx(work, rel=1e-6, abs=1e-15 * LINEAR.bulk_modulus)


@pytest.mark.parametrize("x", [0.93, 0.999, 1.0001, 1.02, 1.1])
def test_linear_stiffness_is_the_slope_of_the_pressure(x):
    """Density times dp/drho by central difference; fails when ``_linear_stiffness`` returns K / x."""
    step = 1e-5
    slope = (evaluate(LINEAR, x + step, 0.0)[0] - evaluate(LINEAR, x - step, 0.0)[0]) / (2.0 * step)
    assert evaluate(LINEAR, x, 0.0)[1] == pytest.approx(x * slope, rel=1e-8)


def isentropic_slope(x, energy, step=1e-5):
    """Return x dp/dx along the isentrope, de = p dx / (rho_0 x^2)."""
    work = evaluate(GRUENEISEN, x, energy)[0] / (GRUENEISEN.density * x * x)
    high = evaluate(GRUENEISEN, x + step, energy + step * work)
    low = evaluate(GRUENEISEN, x - step, energy - step * work)
    return x * (high[0] - low[0]) / (2.0 * step)


@pytest.mark.parametrize("energy", [0.0, 200.0, 4e4])
@pytest.mark.parametrize("x", [1.0001, 1.005, 1.05, 1.15])
def test_grueneisen_stiffness_is_the_isentropic_slope(x, energy):
    """In compression exactly; fails when ``eos.gamma * max(pressure, 0.0) / x`` is dropped."""
    assert evaluate(GRUENEISEN, x, energy)[1] == pytest.approx(isentropic_slope(x, energy), rel=1e-7)


@pytest.mark.parametrize("x", [0.95, 0.98, 0.995])
def test_grueneisen_stiffness_in_tension_is_never_too_small(x):
    """There a bound is enough, for it limits the time step: not below the slope, and within 5 % of it.

    Fails when ``max(pressure, 0.0)`` in ``_grueneisen_stiffness`` becomes ``-1e10``.
    """
    slope = isentropic_slope(x, 100.0)
    assert slope * (1.0 - 1e-6) <= evaluate(GRUENEISEN, x, 100.0)[1] <= 1.05 * slope


@pytest.mark.parametrize("speed", [1.0, 20.0, 100.0, 300.0, 600.0])
def test_grueneisen_pressure_lies_on_its_hugoniot(speed):
    """Behind a shock at U = c + s u the jump conditions give rho = rho_0 U / (U - u), e = u^2 / 2, p = rho_0 U u.

    Fails when ``eos.slope - 1.0`` becomes ``eos.slope`` in ``_grueneisen_pressure``.
    """
    shock = GRUENEISEN.sound_speed + GRUENEISEN.slope * speed
    computed = evaluate(GRUENEISEN, shock / (shock - speed), 0.5 * speed**2)[0]
    assert computed == pytest.approx(GRUENEISEN.density * shock * speed, rel=1e-9)


def test_grueneisen_pressure_is_linear_in_tension_and_in_energy():
    """rho_0 c^2 mu (1 - Gamma / 2 mu / x) + Gamma rho_0 e to second order in mu; fails when ``mu < 0.0`` is negated."""
    cold = GRUENEISEN.density * GRUENEISEN.sound_speed**2
    for mu in (-1e-3, -1e-2):
        expected = cold * mu * (1.0 - 0.5 * GRUENEISEN.gamma * mu)
        assert evaluate(GRUENEISEN, 1.0 + mu, 0.0)[0] == pytest.approx(expected, rel=2.0 * mu * mu)
    gain = evaluate(GRUENEISEN, 1.01, 1000.0)[0] - evaluate(GRUENEISEN, 1.01, 0.0)[0]
    assert gain == pytest.approx(GRUENEISEN.gamma * GRUENEISEN.density * 1000.0, rel=1e-9)
    assert evaluate(GRUENEISEN, 1.01, 1000.0)[2] == 0.0


@kernel
def density_of_no_pressure(eos, energy):
    """Return that of :func:`unloaded`, compiled."""
    return unloaded(eos, energy)


@pytest.mark.parametrize("energy", [-5e4, 0.0, 1e4, 1e5, 4e5, 8e5])
def test_hot_material_has_no_pressure_at_its_own_density(energy):
    """Up to 0.8 MJ/kg, where copper boils long since; fails when the bracket of ``_grueneisen_unloaded`` is dropped."""
    x = density_of_no_pressure(GRUENEISEN, energy)
    heat = GRUENEISEN.gamma * GRUENEISEN.density * abs(energy)
    assert abs(evaluate(GRUENEISEN, x, energy)[0]) <= 0.02 * heat
    assert density_of_no_pressure(LINEAR, energy) == 1.0


def test_hot_material_closes_at_its_own_density():
    """Fails if ``closure`` takes cold density for that of no pressure: hot cells then open, and close under 2 GPa."""
    energy = 1.3e5
    free = density_of_no_pressure(GRUENEISEN, energy)
    assert free < 0.99
    assert closure(1.001 * free, 0.9, 1.0, energy, GRUENEISEN, 2e9) == 1.0
    assert closure(0.98 * free, 0.9, 1.0, energy, GRUENEISEN, 2e9) == pytest.approx(0.98, rel=1e-12)
    assert closure(0.999 * free, 1.0, 1.0, energy, GRUENEISEN, 2e9) == 1.0
