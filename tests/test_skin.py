"""Cells with material and void: what opens and closes there is void, along a surface, in a gap, or in a pore."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import make_block, make_model, never_yields, node_coordinates

from f2s_hpc.fields import FORCE, STRESS, VELOCITY
from f2s_hpc.solver import lagrange

DX, DT = 3e-6, 1e-11
MODEL = never_yields(make_model(DX, viscosity=(0.0, 0.0), hourglass=0.0))
SHEAR = MODEL.bulk.shear_modulus
HELD = 0.4
"""Share of the cells that hold void."""
RATE = 1e7


def block(filled):
    """Return a box of 7 x 7 x 7 cells, each as full as ``filled((x, y, z))`` of its index says."""
    setup = make_block((7, 7, 7), MODEL)
    state = setup.state
    k, j, i = np.indices(state.views["mass"].shape)
    share = filled([a + o for a, o in zip((i, j, k), state.part.offset)])
    for name in ("mass", "volume_fraction"):
        state.views[name][...] = share
    return setup


def strain(setup, gradient):
    """Deform by a velocity gradient (1/s) for one step; return the stress tensor of the middle cell over 2 G dt."""
    state = setup.state
    places = [DX * q for q in node_coordinates(state)]
    for name, row in zip(VELOCITY, gradient):
        state.views[name][...] = sum(a * q for a, q in zip(row, places))
    lagrange.deform(state, setup.model, DT, setup.ledger)
    xx, yy, zz, xy, yz, xz = (state.owned(name)[3, 3, 3] for name in STRESS)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) / (2.0 * SHEAR * DT)


def uniaxial(axis, rate):
    """Return the velocity gradient of ``rate`` (1/s) along an axis."""
    gradient = np.zeros((3, 3))
    gradient[axis, axis] = rate
    return gradient


@pytest.mark.parametrize("rate", [RATE, -RATE])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gap_closes_and_opens_without_straining(axis, rate):
    """A layer of void across ``axis``, closing: no stress of shape. Squeezed along another axis: that of full material.

    Fails when the gap has no direction, as with the mean gradient of the volume fraction, which is zero there: the
    deviator is then two thirds of the rate.
    """
    def layer(index):
        return np.where(index[axis] == 3, HELD, 1.0)

    # (a step of 1e-4: what the middle of the step leaves is of second order)
    assert np.abs(strain(block(layer), uniaxial(axis, rate))).max() < 1e-3 * RATE
    other = (axis + 1) % 3
    found = strain(block(layer), uniaxial(other, rate))
    # at constant volume, since the gap gives way: the gap's faces part as fast as the layer is squeezed
    expected = uniaxial(other, rate) - uniaxial(axis, rate)
    assert np.abs(found - expected).max() < 1e-3 * RATE


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_free_surface_lets_void_open_along_its_normal(axis):
    """Material below, void above: pulled off along the normal the partly filled cell is not strained.

    Fails when ``surface_strain`` is left out: two thirds of the rate.
    """
    def below(index):
        return np.where(index[axis] == 3, HELD, index[axis] < 3)

    assert np.abs(strain(block(below), uniaxial(axis, RATE))).max() < 1e-3 * RATE


def test_the_void_of_a_pore_closes_alike_from_all_sides():
    """One cell with void amid full ones: the trace is taken evenly, and none of a squeeze along z goes missing.

    Fails when a pore is given the direction of an axis.
    """
    def pore(index):
        return np.where(np.all(np.array(index) == 3, axis=0), HELD, 1.0)

    found = strain(block(pore), uniaxial(2, -RATE))
    assert np.allclose(found, -RATE * np.diag([-1.0, -1.0, 2.0]) / 3.0, atol=1e-3 * RATE)


def test_void_that_hardly_is_there_has_no_direction():
    """A layer 0.1 % empty is strained as full material is: in a tenth of a per cent there is only noise.

    Fails when the tensor is that of what prevails however small it is.
    """
    found = strain(block(lambda index: np.where(index[2] == 3, 0.999, 1.0)), uniaxial(2, -RATE))
    assert np.allclose(found, -RATE * np.diag([-1.0, -1.0, 2.0]) / 3.0, atol=0.03 * RATE)


def test_pressure_and_strain_belong_together(rng):
    """Random masses, stresses and velocities: the forces' work is that of the stress on the strain, in the middle cell.

    Only that cell has stress, so the power of all forces on the nodes is that of the cell: VF (s - p) : D V. Fails when
    either kernel weighs a direction in which void opens otherwise than the other.
    """
    setup = make_block((7, 7, 7), MODEL)
    state = setup.state
    for name in ("mass", "volume_fraction"):
        state.views[name][...] = 0.2 + 0.6 * rng.random(state.views["mass"].shape) ** 2
    state.views["volume_fraction"][...] = state.views["mass"]
    for name in VELOCITY:
        state.views[name][...] = 0.1 * rng.normal(size=state.views[name].shape)
    stress = rng.normal(size=(3, 3))
    stress = 1e8 * (stress + stress.T)
    stress -= np.eye(3) * np.trace(stress) / 3.0
    middle = tuple(np.array(state.views["mass"].shape) // 2)
    for name, value in zip(STRESS, (*np.diag(stress), stress[0, 1], stress[1, 2], stress[0, 2])):
        state.views[name][middle] = value
    velocity = [state.views[name].copy() for name in VELOCITY]
    lagrange.forces(state, setup.model, 0.0, np.zeros(1, dtype=np.int64))
    power = sum(float((state.views[f] * u).sum()) for f, u in zip(FORCE, velocity))
    before = stress.copy()
    lagrange.deform(state, setup.model, DT, setup.ledger)
    xx, yy, zz, xy, yz, xz = (state.views[name][middle] for name in STRESS)
    # elastic: what the stress of shape gained over a step, but for the rotation, which does not change s : s
    after = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    gained = ((after * after).sum() - (before * before).sum()) / (4.0 * SHEAR * DT)
    work = state.views["mass"][middle] * DX**3 * gained
    assert abs(power) > 0.0
    assert -power == pytest.approx(work, rel=1e-3)
