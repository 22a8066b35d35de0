"""Nodal forces and the Lagrangian step of the cells: balances, rigid motion, closed forms, and an elastic wave."""

from __future__ import annotations

import math

import numpy as np
import pytest
from solver_setup import make_block, make_model, make_setup, never_yields, node_coordinates

from f2s_hpc.fields import FORCE, STRESS, VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.materials.flow_stress import flow_stress
from f2s_hpc.solver import lagrange
from f2s_hpc.verify.heat import mean_stress

DX = 3e-6
MODEL = make_model(DX)
CALM = make_model(DX, viscosity=(0.0, 0.0), hourglass=0.0)
INSIDE = (slice(1, -1),) * 3
MIDDLE = (GHOST + 1,) * 3


def forces(setup):
    """Return the forces (N) on the owned nodes as three arrays, and the power of hourglass control in quanta."""
    power = np.zeros(1, dtype=np.int64)
    setup.activate()
    lagrange.forces(setup.state, setup.model, 0.0, power)
    return [setup.state.owned(name).copy() for name in FORCE], power


def set_stress(setup, rng, scale=1e9):
    """Give every cell with material a random deviatoric stress."""
    state = setup.state
    matter = state.views["mass"] > 0.0
    for name in STRESS:
        state.views[name][...] = np.where(matter, scale * rng.normal(size=matter.shape), 0.0)
    state.views["stress_zz"][...] = -(state.views["stress_xx"] + state.views["stress_yy"])


def test_constant_stress_in_a_full_block_makes_no_force(rng):
    """On all nodes inside, to round-off of stress times face; pressure included (2 % compressed).

    Fails when ``(x - y + z)`` of ``_corner_forces`` becomes ``(x - y - z)``.
    """
    setup = make_block((6, 5, 5), CALM)
    for name, value in zip(STRESS, 1e9 * rng.normal(size=6)):
        setup.state.views[name][...] = value
    setup.state.views["mass"][...] = 1.02
    for force in forces(setup)[0]:
        assert np.abs(force[INSIDE]).max() < 1e-14 * 3e9 * DX**2


def test_linear_stress_makes_its_divergence():
    """sigma_xy = g y: force density g in x on all nodes inside; fails when the 0.25 of ``area`` becomes 0.5."""
    setup = make_block((6, 6, 6), CALM)
    view = setup.state.views["stress_xy"]
    gradient = 1e9 / 1e-5
    view[...] = gradient * DX * np.arange(view.shape[1])[None, :, None]
    force = forces(setup)[0]
    assert force[0][INSIDE] == pytest.approx(gradient * DX**3, rel=1e-12)
    assert np.abs(force[1][INSIDE]).max() < 1e-9 * gradient * DX**3


def test_pressure_pushes_outwards():
    """A full cell at x = 1.01 in void pushes each of its corners with p dx^2 / 4.

    Fails when ``xx[i] - p`` of ``_weigh`` becomes ``xx[i] + p``.
    """
    setup = make_setup((7, 7, 7), CALM)
    for name, value in (("mass", 1.01), ("volume_fraction", 1.0)):
        setup.state.owned(name)[3, 3, 3] = value
    force = forces(setup)[0]
    expected = CALM.bulk.bulk_modulus * math.log(1.01) * DX**2 / 4.0
    for axis in range(3):
        assert np.take(force[axis], 3, axis=2 - axis)[3:5, 3:5] == pytest.approx(-expected, rel=1e-12)
        assert np.take(force[axis], 4, axis=2 - axis)[3:5, 3:5] == pytest.approx(expected, rel=1e-12)


def free_body(rng, model):
    """Return a lone sphere with random stress, compression and velocities, far from all walls."""
    setup = make_setup((14, 13, 12), model, [(7.1, 6.4, 5.8, 4.1)])
    set_stress(setup, rng)
    full = setup.state.views["volume_fraction"] == 1.0
    setup.state.views["mass"][full] = rng.uniform(0.999, 1.02, np.count_nonzero(full))
    for name in VELOCITY:
        setup.state.views[name][...] = rng.uniform(-300.0, 300.0, setup.state.part.node_shape)
    return setup


def test_forces_of_a_free_body_add_up_to_nothing(rng):
    """Force and torque about the origin, all of stress, pressure, shock viscosity and hourglass control, to round-off.

    Fails when ``(h1 - h2 - h3 + h4)`` of ``_corner_forces`` becomes ``(h1 - h2 + h3 + h4)``, or ``(3, 1, 4)`` of
    ``nodal_forces`` becomes ``(3, 1, 5)``.
    """
    setup = free_body(rng, MODEL)
    force, power = forces(setup)
    assert power[0] > 0
    scale = sum(np.abs(f).sum() for f in force)
    for component in force:
        assert abs(component.sum()) < 1e-14 * scale
    x, y, z = (q[tuple(s if n > 1 else slice(None) for s, n in zip(setup.state.part.owned_nodes, q.shape))]
               for q in node_coordinates(setup.state))
    fx, fy, fz = force
    for torque in (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx):
        assert abs(torque.sum()) < 1e-13 * scale


def set_velocity(setup, gradient, offset=(0.0, 0.0, 0.0)):
    """Set v = offset + gradient . x (x in metres)."""
    position = [DX * q for q in node_coordinates(setup.state)]
    for name, row, start in zip(VELOCITY, gradient, offset):
        setup.state.views[name][...] = start + sum(a * q for a, q in zip(row, position))


def test_rigid_motion_feels_no_hourglass_force_and_no_viscosity():
    """Exactly none in translation; fails when ``(s00 - s10)`` of ``_corner_forces`` becomes ``(s00 + s10)``."""
    setup = make_setup((12, 12, 12), MODEL, [(6.1, 6.0, 5.9, 4.2)])
    set_velocity(setup, np.zeros((3, 3)), (123.456, -600.1, 0.3))
    force, power = forces(setup)
    assert all((component == 0.0).all() for component in force)
    assert not power.any()


def test_linear_velocities_feel_no_hourglass_force(rng):
    """Any gradient, rotation included: round-off of the force that an hourglass of that speed would feel.

    Fails when ``(d01 - d00) + (d11 - d10)`` of ``_corner_forces`` becomes ``(d01 + d00) + (d11 - d10)``.
    """
    model = make_model(DX, viscosity=(0.0, 0.0))
    for gradient in (1e7 * rng.normal(size=(3, 3)), 1e7 * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0.0]])):
        setup = make_setup((12, 12, 12), model, [(6.1, 6.0, 5.9, 4.2)])
        set_velocity(setup, gradient)
        force, power = forces(setup)
        mode = model.settings.hourglass * model.bulk.density * 4700.0 * DX**2 * 1e7 * 12 * DX
        assert max(np.abs(component).max() for component in force) < 1e-13 * mode
        assert power[0] < 1e-24 * mode * 1e7 * 12 * DX * 1000 / (model.energy_quantum * 1e9) + 1


PATTERNS = {"xy": lambda x, y, z: x * y, "yz": lambda x, y, z: y * z, "zx": lambda x, y, z: z * x,
            "xyz": lambda x, y, z: x * y * z}


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("component", [0, 1, 2])
def test_hourglass_patterns_are_damped_at_the_documented_rate(pattern, component):
    """The power taken is -F . v, the sum that goes into the ledger, and 8 k h^2 of each cell.

    A cell of a pure mode of amplitude a has h = +-8 a in one of the four: it loses k 64 a^2 = hourglass rho c dx^2 a^2.
    Fails when ``(x + y + z) - (h1 + h2 + h3 - h4)`` adds, or ``/ 64.0`` becomes ``/ 60.0``.
    """
    model = make_model(DX, viscosity=(0.0, 0.0))._replace(energy_quantum=1e-26)
    setup = make_block((6, 6, 6), model)
    signs = [(-1.0) ** q for q in node_coordinates(setup.state)]
    amplitude = 10.0
    velocity = setup.state.views[VELOCITY[component]]
    velocity[...] = amplitude * PATTERNS[pattern](*signs)
    force, power = forces(setup)
    # the forces of a node belong to eight cells; those on the walls count for the part inside the box
    weights = setup.state.boundary.weights
    share = (weights[2][:, None, None] * weights[1][None, :, None] * weights[0][None, None, :])[
        setup.state.part.owned_nodes]
    taken = -float((share * force[component] * setup.state.owned(VELOCITY[component])).sum())
    sound = math.sqrt((model.bulk.bulk_modulus + 4.0 / 3.0 * model.bulk.shear_modulus) / model.bulk.density)
    expected = 6**3 * model.settings.hourglass * model.bulk.density * sound * DX**2 * amplitude**2
    assert taken == pytest.approx(expected, rel=1e-12)
    assert power[0] * model.energy_quantum * 1e9 == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("push", "speed"), [(-0.4, 6.0), (-5.0, 0.0), (-8.0, -6.0), (0.4, 10.8), (-0.4j, 10.0)])
def test_a_force_may_take_all_motion_of_a_light_node_but_drives_it_by_the_floor(push, speed):
    """A node of a fifth of the floor at 10 m/s: pushed back by its own mass until it stands, forth by the floor.

    ``push``: over what stops it; imaginary across its way. Fails when the floor divides a braking force too, or when
    a braking force is divided by the mass alone.
    """
    model = make_model(DX)
    setup, dt, node = make_block((6, 6, 6), model), 1e-9, (6, 6, 6)
    views = setup.state.views
    mass = 0.2 * model.settings.light_mass_floor
    views["nodal_mass"][node], views["velocity_x"][node] = mass, 10.0
    stopping = mass * model.bulk.density * DX**3 * 10.0 / dt
    views["force_x"][node], views["force_y"][node] = complex(push).real * stopping, complex(push).imag * stopping
    lagrange.kick(setup.state, model, dt, dt, setup.ledger)
    assert views["velocity_x"][node] == pytest.approx(speed, abs=1e-9)
    assert views["velocity_y"][node] == pytest.approx(complex(push).imag * 2.0, abs=1e-9)


@pytest.mark.parametrize(("before", "after", "sign"), [(0.0, 1e-9, 1.0), (1e-9, 0.0, -1.0), (1e-9, 1e-9, 0.0)])
def test_a_half_kick_beside_a_remap_is_entered_where_it_happens(before, after, sign):
    """dt^2 F^2 / 8m is lost with the half kick after a remap and gained with the one before; a whole kick has none.

    Fails when ``accelerate`` leaves ``lost`` as it is, or counts with a mass other than that of a full node.
    """
    model = make_model(DX)
    setup, node, force = make_block((6, 6, 6), model), (6, 6, 6), (3e-3, -2e-3, 1e-3)
    views = setup.state.views
    views["nodal_mass"][node] = 0.7
    for name, component in zip(FORCE, force):
        views[name][node] = component
    lagrange.kick(setup.state, model, before, after, setup.ledger)
    mass = 0.7 * model.cell_mass
    wanted = sign * max(before, after)**2 * sum(component**2 for component in force) / (8.0 * mass)
    assert 0.5 * views["lost_energy"][node] * model.cell_mass == pytest.approx(wanted, rel=1e-12, abs=0.0)
    totals = setup.ledger.totals()
    assert totals["half_kicks"] * model.energy_quantum == pytest.approx(wanted, rel=1e-3)
    assert totals["half_kicks_kept"] == totals["half_kicks"]


def rotation_gradient(axis, angle, dt):
    """Return (R - 1) / dt: straight motion over ``dt`` carries a body into its image turned by ``angle`` (rad)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])
    return (math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross) / dt


def stress_matrix(setup):
    """Return the stress of a cell in the middle as a matrix (Pa)."""
    xx, yy, zz, xy, yz, xz = (setup.state.views[name][MIDDLE] for name in STRESS)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def turned_stress(model, steps, angle, rng):
    """Return the stress before and after a body turned by ``angle`` about a skew axis in ``steps``, and R."""
    dt, axis = 1e-10, (1.0, 2.0, -0.5)
    setup = make_block((3, 3, 3), never_yields(model))
    set_stress(setup, rng)
    for name in STRESS:
        setup.state.views[name][...] = setup.state.views[name][MIDDLE]
    before = stress_matrix(setup)
    set_velocity(setup, rotation_gradient(axis, angle / steps, dt))
    for _ in range(steps):
        lagrange.deform(setup.state, setup.model, dt, setup.ledger)
    return before, stress_matrix(setup), rotation_gradient(axis, angle, 1.0) + np.eye(3)


def test_rotation_keeps_the_invariants_exactly(rng):
    """Without stiffness any velocity gradient only turns the stress: its principal values stay, to round-off.

    Fails when ``scale = 2.0 / (1.0 + ...)`` becomes ``2.0 / 1.0``: no rotation then.
    """
    soft = MODEL._replace(bulk=MODEL.bulk._replace(shear_modulus=1e-9), energy_quantum=1.0)
    setup = make_block((3, 3, 3), never_yields(soft))
    set_stress(setup, rng)
    before = np.linalg.eigvalsh(stress_matrix(setup))
    set_velocity(setup, 2e8 * rng.normal(size=(3, 3)))
    for _ in range(50):
        lagrange.deform(setup.state, setup.model, 1e-10, setup.ledger)
    assert np.linalg.eigvalsh(stress_matrix(setup)) == pytest.approx(before, rel=1e-12)


def test_rotation_turns_the_stress_with_the_body(rng):
    """A whole turn about a skew axis, second order: four times closer with half the steps' angle.

    Fails when 0.25 in ``ax, ay, az`` becomes 0.26, or ``half = 0.5 * h`` becomes ``0.0 * h``.
    """
    errors = []
    for steps in (200, 400):
        before, after, turn = turned_stress(MODEL, steps, 2.0 * math.pi, np.random.Generator(np.random.PCG64(5)))
        errors.append(np.abs(after - turn @ before @ turn.T).max() / np.abs(before).max())
        # per step the second-order midpoint strains by theta^4 / 4
        assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before), rel=3e-3 * (200 / steps) ** 3)
    assert errors[0] < 5e-3
    assert errors[0] / errors[1] > 3.7


def test_simple_shear_follows_the_closed_form_of_the_jaumann_rate():
    """sigma_xy = G sin(gamma), sigma_xx = -sigma_yy = G (1 - cos(gamma)) up to gamma = pi, to 1e-6 of G.

    Fails when ``0.25 * (lyx - lxy)`` is turned round, or half of the elastic increment is left out.
    """
    setup = make_block((3, 3, 3), never_yields(MODEL))
    steps, dt = 2000, 1e-12
    set_velocity(setup, [[0, math.pi / steps / dt, 0], [0, 0, 0], [0, 0, 0]])
    modulus = MODEL.bulk.shear_modulus
    for step in range(1, steps + 1):
        lagrange.deform(setup.state, setup.model, dt, setup.ledger)
        if step % (steps // 4) == 0:
            gamma = math.pi * step / steps
            expected = np.zeros((3, 3))
            expected[0, 1] = expected[1, 0] = math.sin(gamma)
            expected[0, 0], expected[1, 1] = 1.0 - math.cos(gamma), math.cos(gamma) - 1.0
            assert np.abs(stress_matrix(setup) / modulus - expected).max() < 1e-6
    assert setup.state.views["peeq"].max() == 0.0
    assert (setup.state.views["temperature"] == 298.15).all()


def test_plastic_work_heats_by_taylor_and_quinney():
    """A sheared cell warms by beta sigma d / (rho c) with its own mean stress and strain increment, to round-off.

    Fails when ``bulk.taylor_quinney *`` of ``_heat_chunk`` goes, or ``peeq[i] += plastic`` adds half of it.
    """
    setup = make_block((3, 3, 3), MODEL, temperature=500.0)
    dt = 2e-10
    set_velocity(setup, [[0, 4e8, 0], [0, 0, 0], [0, 0, 0]])
    peeq, temperature, old = 0.0, 500.0, 0.0
    for _ in range(5):
        lagrange.deform(setup.state, setup.model, dt, setup.ledger)
        increment = setup.state.views["peeq"][MIDDLE] - peeq
        peeq = setup.state.views["peeq"][MIDDLE]
        stress = flow_stress(MODEL.flow, peeq, increment / dt, temperature)[0]
        bulk = MODEL.bulk
        work = increment * mean_stress(old, stress, increment, 4e8 * dt / math.sqrt(3.0), bulk.shear_modulus)
        temperature, old = temperature + bulk.taylor_quinney * work / (bulk.density * bulk.specific_heat), stress
        assert setup.state.views["temperature"][MIDDLE] == pytest.approx(temperature, rel=1e-13)
        deviator = stress_matrix(setup)
        assert math.sqrt(1.5 * (deviator**2).sum()) == pytest.approx(stress, rel=1e-10)
        assert abs(np.trace(deviator)) < 1e-6 * stress
    # all strain but the elastic part is plastic: gamma / sqrt(3)
    assert peeq == pytest.approx(5 * 4e8 * dt / math.sqrt(3.0) - stress / (3.0 * MODEL.bulk.shear_modulus), rel=0.02)


def test_a_squeezed_void_closes_before_material_is_pressed():
    """0.9 full: after 5 % of closing still without pressure, after 10 % more full; a free surface stays at its mass.

    Fails when ``x >= jacobian`` in ``closure`` becomes ``x >= 1.0``.
    """
    setup = make_block((3, 3, 3), never_yields(MODEL))
    state, dt = setup.state, 1e-10
    for name in ("mass", "volume_fraction"):
        state.views[name][...] = 0.9
    set_velocity(setup, [[-0.05 / dt, 0, 0], [0, 0, 0], [0, 0, 0]])
    lagrange.deform(state, setup.model, dt, setup.ledger)
    assert state.views["volume_fraction"][MIDDLE] == pytest.approx(0.9 / 0.95, rel=1e-12)
    for name in ("mass", "volume_fraction"):
        state.views[name][...] = 0.9
    set_velocity(setup, [[-0.15 / dt, 0, 0], [0, 0, 0], [0, 0, 0]])
    lagrange.deform(state, setup.model, dt, setup.ledger)
    assert state.views["volume_fraction"][MIDDLE] == 1.0


def test_full_material_bears_tension_up_to_spall():
    """Stretched by 1 % (1.3 GPa) it stays full, by 2 % (2.6 GPa, spall at 2 GPa) it opens.

    Fails when ``-spall`` of ``closure`` loses its sign.
    """
    for stretch, full in ((0.01, True), (0.02, False)):
        setup = make_block((3, 3, 3), never_yields(MODEL))
        set_velocity(setup, [[stretch / 1e-10, 0, 0], [0, 0, 0], [0, 0, 0]])
        lagrange.deform(setup.state, setup.model, 1e-10, setup.ledger)
        expected = 1.0 if full else 1.0 / (1.0 + stretch)
        assert setup.state.views["volume_fraction"][MIDDLE] == pytest.approx(expected, rel=1e-14)


def standing_wave(cells):
    """Return the error of u (over its amplitude) of a standing P wave after 1.25 periods, and its speed over c_L."""
    model = never_yields(make_model(DX, courant=0.5, viscosity=(0.0, 0.0), hourglass=0.0, conduction=False))
    bulk = model.bulk
    speed = math.sqrt((bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus) / bulk.density)
    setup = make_block((cells, 3, 3), model)
    state = setup.state
    amplitude = 1e-3
    profile = np.sin(math.pi * np.arange(cells + 1) / cells)
    profile[[0, -1]] = 0.0
    state.owned("velocity_x")[...] = amplitude * profile
    state.exchange(state.ghosted)
    frequency = math.pi * speed / (cells * DX)
    setup.advance(round(1.25 * 2.0 * cells / model.settings.courant))
    assert setup.clock.in_cycle == pytest.approx(2.5 * math.pi / frequency, rel=1e-6, abs=0.0)
    phase = frequency * setup.clock.in_cycle
    velocity = state.owned("velocity_x")[1, 1] / amplitude
    coefficient = float(2.0 / cells * (velocity * profile).sum())
    turns = math.asin(math.cos(phase) - coefficient) / abs(math.sin(phase))
    return float(np.abs(velocity - math.cos(phase) * profile).max()), 1.0 + turns / phase


def test_elastic_wave_is_second_order_and_has_the_right_speed():
    """A standing P wave after 1.25 periods, 16 and 32 cells: order >= 1.8, speed within 0.5 % of that of the material.

    Fails when the elastic increment is left out (no 4G/3), velocities end half a step early (without ``second_half``),
    or ``0.25 * dx * dx`` in the forces becomes 2 % larger.
    """
    (coarse, slow), (fine, near) = standing_wave(16), standing_wave(32)
    assert math.log2(coarse / fine) > 1.8
    assert abs(slow - 1.0) < 5e-3
    assert abs(near - 1.0) < 1.5e-3
