"""Several steps to a remap: the displaced mesh turns, shears and is squeezed as the material is."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import make_block, make_model, make_setup, never_yields, node_coordinates

from f2s_hpc.fields import DISPLACEMENT, STRESS, SWEEP, VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.solver import lagrange

DX = 3e-6
MODEL = never_yields(make_model(DX))
MIDDLE = (GHOST + 2,) * 3
DT = 1e-10
SPIN = np.array([[0.0, -2.0, 1.0], [2.0, 0.0, -3.0], [-1.0, 3.0, 0.0]])


def volume_ratio(state) -> float:
    """Return the volume ratio of the middle cell from what its faces have swept."""
    k, j, i = MIDDLE
    x, y, z = (state.views[name] for name in SWEEP)
    return 1.0 + (x[k, j, i + 1] - x[k, j, i]) + (y[k, j + 1, i] - y[k, j, i]) + (z[k + 1, j, i] - z[k, j, i])


def deform(setup, gradient, steps):
    """Take ``steps`` steps without a remap; every node has the velocity gradient . (its present place)."""
    state = setup.state
    places = [np.broadcast_to(c, state.part.node_shape) for c in node_coordinates(state)]
    for step in range(steps):
        now = [c + (state.views[n] if step else 0.0) for c, n in zip(places, DISPLACEMENT)]
        for name, row in zip(VELOCITY, gradient):
            state.views[name][...] = DX * sum(g * c for g, c in zip(row, now))
        lagrange.deform(state, setup.model, DT, setup.ledger, step > 0)
        lagrange.displace(state, setup.model, DT, step > 0)


def stress(setup):
    """Return the stress of the middle cell as a matrix (Pa)."""
    xx, yy, zz, xy, yz, xz = (setup.state.views[name][MIDDLE] for name in STRESS)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_a_turning_mesh_sweeps_and_strains_nothing():
    """Six steps of 0.1 rad about a skew axis: the volume ratio stays one, the strain is of fourth order.

    On the undisplaced mesh the sixth step would strain by some 2 %. Fails when ``to_deformed`` is left out of
    ``lagrangian_step``, or ``x3[i] - x0[i]`` of ``_swept_row`` becomes 0.
    """
    setup = make_block((5, 5, 5), MODEL)
    spin = SPIN / np.sqrt(14.0)
    turn = np.eye(3) + np.sin(0.1) * spin + (1.0 - np.cos(0.1)) * spin @ spin
    deform(setup, (turn - np.eye(3)) / DT, 6)
    assert volume_ratio(setup.state) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(stress(setup)).max() < 6 * 0.1**4 * 2.0 * MODEL.bulk.shear_modulus
    assert setup.state.views["volume_fraction"][MIDDLE] == 1.0
    assert (setup.state.views["temperature"][MIDDLE] == 298.15).all()


def test_volume_ratio_is_the_determinant():
    """Eight steps of a gradient of all components: J against det(F), of second order in the steps.

    Fails when ``s[VOLUME_BEFORE * W ...]`` or the area vectors of ``sweep_faces`` are those of the undisplaced mesh.
    """
    total = np.array([[-0.12, 0.05, 0.02], [0.03, 0.08, -0.06], [0.04, -0.05, -0.1]])
    errors = []
    for steps in (8, 16):
        setup = make_block((5, 5, 5), MODEL)
        deform(setup, total / steps / DT, steps)
        now = np.linalg.matrix_power(np.eye(3) + total / steps, steps)
        errors.append(abs(volume_ratio(setup.state) / np.linalg.det(now) - 1.0))
    assert errors[0] < 2e-3
    assert errors[0] / errors[1] > 1.9


def test_displaced_forces_follow_from_the_cofactors(rng):
    """Force on a node inside = - sum over its cells of V sigma cof(F) grad N, for any stress and a homogeneous motion.

    So the forces' power is the stress power of the displaced cells. Fails when ``cofactors`` is left out of
    ``nodal_forces``, or when its rows and columns change places.
    """
    model = MODEL._replace(settings=MODEL.settings._replace(viscosity=(0.0, 0.0), hourglass=0.0))
    setup = make_block((6, 5, 5), model)
    state = setup.state
    step = np.array([[-0.1, 0.3, 0.0], [-0.2, 0.1, 0.1], [0.1, 0.0, 0.05]]) / 3.0
    deform(setup, step / DT, 3)
    motion = np.linalg.matrix_power(np.eye(3) + step, 3)
    cofactor = np.linalg.det(motion) * np.linalg.inv(motion).T
    for name in STRESS:
        state.views[name][...] = 1e9 * rng.normal(size=state.part.cell_shape)
    state.views["mass"][...] = volume_ratio(state)  # at no pressure
    state.views["volume_fraction"][...] = 1.0
    lagrange.forces(state, model, 0.0, np.zeros(1, dtype=np.int64), True)
    k, j, i = (n + 2 for n in (GHOST, GHOST, GHOST))
    expected = np.zeros(3)
    for c in (0, 1):
        for b in (0, 1):
            for a in (0, 1):
                here = (k - c, j - b, i - a)
                xx, yy, zz, xy, yz, xz = (state.views[name][here] for name in STRESS)
                sigma = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                expected -= sigma @ cofactor @ (2.0 * np.array([a, b, c]) - 1.0) * 0.25 * DX**2
    found = [state.views[f"force_{axis}"][k, j, i] for axis in "xyz"]
    assert found == pytest.approx(expected, abs=1e-11 * 1e9 * DX**2)


@pytest.mark.parametrize("name", ["mass", "velocity_z"])
def test_a_sphere_in_flight_is_the_same_however_often_it_is_remapped(name):
    """A sphere that flies three cells: mass and velocity with a remap after each step, and after up to eight.

    Fails when ``move_nodes`` forgets a component, or ``remap_all`` is given the swept volumes of the last step only.
    """
    found = []
    for most in (1, 8):
        model = make_model(DX, steps_per_remap=most)
        setup = make_setup((16, 16, 24), model, [(8.0, 8.0, 16.0, 5.0)], (80.0, 40.0, -500.0))
        setup.clock.limits.heavy_speed = 510.0
        setup.advance_to(3.0 * DX / 500.0)
        found.append((setup.state.owned(name).copy(), setup.clock.remaps))
    (often, many), (seldom, few) = found
    assert few < 0.6 * many
    if name == "mass":
        assert np.abs(often - seldom).max() < 0.06
    else:
        solid = (often != 0.0) & (seldom != 0.0)
        assert solid.sum() > 500
        assert np.abs(often + 500.0)[solid].max() < 1e-9 * 500.0
        assert np.abs(seldom + 500.0)[solid].max() < 1e-9 * 500.0
