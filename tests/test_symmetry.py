"""No axis and no direction is special: a collision in free space, turned or mirrored, is the same collision."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from solver_setup import make_model, make_setup

from f2s_hpc.cycles.insert import paint_batch
from f2s_hpc.fields import STRESS, VELOCITY
from f2s_hpc.grid.box import SIDES
from f2s_hpc.particles.batch import Batch
from f2s_hpc.solver import remap

CELLS = (26, 21, 20)
PLACES = np.array([[9.6, 11.2, 9.8], [16.4, 9.9, 10.3]])
RADII = np.array([3.0, 2.6])
VELOCITIES = np.array([[300.0, 20.0, -35.0], [-280.0, 0.0, 10.0]])
SAME = (0, 1, 2)
ORDERS = remap.SWEEP_ORDERS


def collision(steps_per_remap: int, steps: int, axes: tuple[int, int, int] = SAME, mirrored: int | None = None,
              floor: float = 0.005):
    """Return two spheres after ``steps`` steps in a box whose axis n is ``axes[n]`` of the scene, ``mirrored`` in one.

    The sweeps keep their order in the scene.
    """
    places, velocities = PLACES.copy(), VELOCITIES.copy()
    if mirrored is not None:
        places[:, mirrored] = CELLS[mirrored] - places[:, mirrored]
        velocities[:, mirrored] *= -1.0
    model = make_model(5e-6, speed=300.0, steps_per_remap=steps_per_remap, light_mass_floor=floor)
    setup = make_setup([CELLS[a] for a in axes], model, sides=dict.fromkeys(SIDES, "free"))
    columns = [np.ascontiguousarray(places[:, a] * model.dx) for a in axes]
    batch = Batch(*columns, RADII * model.dx, np.ascontiguousarray(velocities[:, axes]))
    paint_batch(setup.state, model, batch, 0.0, (0.0, 0.0, 0.0), 400.0, setup.ledger, 1)
    setup.activate()
    setup.clock.limits.put_in(300.0, model.dx)
    setup.advance(steps)
    return setup


def seen(setup, axes: tuple[int, int, int] = SAME, mirrored: int | None = None) -> dict[str, np.ndarray]:
    """Return the fields of :func:`collision` as the scene has them, arrays [x, y, z]."""
    found = {}
    for name in ("mass", "temperature", "peeq", *STRESS, *VELOCITY):
        parts = sorted(axes["xyz".index(letter)] for letter in (name.rpartition("_")[2] if "_" in name else ""))
        array = setup.state.owned(name).T.transpose([axes.index(a) for a in SAME])
        if mirrored is not None:
            array = np.flip(array, mirrored) * (-1.0) ** parts.count(mirrored)
        found["_".join([name.partition("_")[0], *("xyz"[a] for a in parts)])] = array
    return found


def nodal_mass(mass: np.ndarray) -> np.ndarray:
    """Return the mass of the nodes (in full ones) of cells that nothing surrounds."""
    around, (a, b, c) = np.pad(mass, 1), (n + 1 for n in mass.shape)
    return 0.125 * sum(around[i:i + a, j:j + b, k:k + c] for i in (0, 1) for j in (0, 1) for k in (0, 1))


@functools.cache
def reference(steps_per_remap: int) -> dict[str, np.ndarray]:
    """Return the fields of the collision as it is."""
    return seen(collision(steps_per_remap, 40))


@pytest.mark.parametrize("steps_per_remap", [1, 8])
@pytest.mark.parametrize(("axes", "mirrored"), [((1, 2, 0), None), ((1, 0, 2), None), (SAME, 0), (SAME, 1), (SAME, 2)])
def test_a_turned_or_mirrored_collision_is_the_same(axes, mirrored, steps_per_remap, monkeypatch):
    """To round-off, but for what little hangs on it: a cell just over a threshold in one and not in the other.

    Fails when ``tp`` and ``tq`` change places in the normal of the second axis in ``interface_normal``.
    """
    expected = reference(steps_per_remap)
    assert expected["peeq"].max() > 0.2
    monkeypatch.setattr(remap, "SWEEP_ORDERS", [tuple(axes.index(a) for a in order) for order in ORDERS])
    found = seen(collision(steps_per_remap, 40, axes, mirrored), axes, mirrored)
    # (by mass: a node that material has just left keeps the velocity that it had)
    weights = {array.shape: array for array in (expected["mass"], nodal_mass(expected["mass"]))}
    for name, array in expected.items():
        weight = weights[array.shape]
        assert (weight * np.abs(found[name] - array)).sum() < 1e-6 * (weight * np.abs(array)).sum(), name


@pytest.mark.parametrize("steps_per_remap", [1, 8])
def test_a_collision_in_free_space_keeps_its_momentum(steps_per_remap):
    """All but what the floor of light masses withholds. Fails when ``/ m`` is dropped from ``exchange_light``."""
    for floor, bar in ((0.005, 1e-4), (1e-12, 1e-13)):
        setup = collision(steps_per_remap, 40, floor=floor)
        nodal = nodal_mass(setup.state.owned("mass"))
        brought = 4.0 / 3.0 * np.pi * RADII**3 @ VELOCITIES
        kept = np.array([(nodal * setup.state.owned(name)).sum() for name in VELOCITY])
        assert np.abs(kept - brought).max() < bar * nodal.sum() * 300.0
