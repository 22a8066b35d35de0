"""What flies meets the sides of the box and what rests there as if both had always been on the grid."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc.cycles import measure
from f2s_hpc.cycles.supply import Supply
from f2s_hpc.grid.box import SIDES
from f2s_hpc.particles.batch import Batch, clipped_volume
from f2s_hpc.verify.scenes import prepare, run_cycles, scene_setup, write_scene

pytestmark = pytest.mark.mpi

CELLS = (11, 12, 13)
DX = 2.5e-6


def scene_towards(side: str, kind: str, *overrides: str):
    """Return a sphere of 5 um in an empty box, 4 cells before ``side``, that flies there at 500 m/s."""
    axis, up = SIDES.index(side) // 2, side.endswith("high")
    place = [0.5 * n * DX for n in CELLS]
    place[axis] = CELLS[axis] * DX - 15e-6 if up else 15e-6
    direction = [0, 0, 0]
    direction[axis] = 1 if up else -1
    return write_scene(CELLS, DX, "copper-ge", 500.0, 45e-9, spheres=[(*place, 5e-6)], temperature=723.0,
                       faces=dict.fromkeys(SIDES, "free") | {side: kind},
                       overrides=(f"particles.direction={direction}", *overrides))


def strained(setup) -> float:
    """Return the 90th percentile of PEEQ."""
    return measure.percentiles(*(setup.state.owned(name).reshape(-1) for name in ("peeq", "mass")), (0.9,))[0]


@pytest.mark.parametrize("kind", ["symmetry", "fixed", "absorbing"])
@pytest.mark.parametrize("side", SIDES)
def test_what_arrives_at_a_side_meets_its_mirror_image(side, kind):
    """The bits are those without active rows, and no energy is unexplained.

    Fails without ``boundary.activate`` in ``State.update_activity``: ghosts behind the side stay empty at first.
    """
    found = []
    for active in ("true", "false"):
        setup, substrate = scene_setup(scene_towards(side, kind, f"numerics.active_rows={active}"))
        setup.advance_to(45e-9)
        balance = measure.measure_balance(setup.state, setup.model, setup.ledger, substrate)
        # (what flies into an absorbing side is more than its waves were made for)
        least = 1e-4 if kind == "absorbing" else 1e-9
        assert abs(balance["energy"]["remainder"]) < least * balance["energy"]["brought_in"]
        found.append({name: setup.state.owned(name).copy() for name in setup.state.saved})
    for name, values in found[0].items():
        assert np.array_equal(values, found[1][name]), name
    assert kind == "absorbing" or strained(setup) > 0.1


def test_a_sphere_over_an_empty_box_is_put_down_before_the_wall():
    """Nothing is on the grid, so nothing limits the step. Fails when ``choose`` takes ``math.inf`` for ``model.sound``.
    """
    scene = write_scene(CELLS, DX, "copper-ge", 500.0, 40e-9, spheres=[(14e-6, 15e-6, 18e-6, 5e-6)], temperature=723.0,
                        faces={"z_low": "fixed"}, overrides=("particles.flight=ballistic",))
    setup, plan = prepare(scene)
    run_cycles(scene, plan, setup, setup.advance_to)
    assert setup.supply.flight.count == 0
    assert strained(setup) > 0.1


def test_the_first_look_reckons_with_steps_of_full_size():
    """A sphere that starts 3.04 cells over the substrate at 1200 m/s is met before the first step is over.

    Fails without ``or longest`` in ``Supply.land``: no remap was done yet, so none is looked ahead for.
    """
    scene = write_scene(CELLS, DX, "copper-ge", 1200.0, 10e-9, substrate=3, temperature=723.0,
                        spheres=[(14e-6, 15e-6, 12.6e-6, 5e-6)], overrides=("particles.flight=ballistic",))
    setup, plan = prepare(scene)
    supply = Supply(scene, plan, setup.state, setup.model, setup.clock, setup.ledger)
    supply.insert(0)
    assert supply.land() is not None


@pytest.mark.parametrize("direction", [(0.2, 0.0, -1.0), (-0.2, 0.0, -1.0), (0.0, 0.0, -1.0)])
def test_a_sphere_that_a_mirror_cuts_is_put_in_as_cut_wherever_it_flies(direction):
    """It weighs what the box holds of it at the start. Fails when ``_at_side`` looks only where spheres fly to.
    """
    sphere = (2e-6, 15e-6, 22e-6, 5e-6)
    scene = write_scene(CELLS, DX, "copper-ge", 500.0, 60e-9, spheres=[sphere], temperature=723.0,
                        faces=dict.fromkeys(SIDES, "symmetry"), overrides=(f"particles.direction={list(direction)}",))
    setup, substrate = scene_setup(scene)
    setup.advance_to(60e-9)
    painted = measure.measure_balance(setup.state, setup.model, setup.ledger, substrate)["painted_volume_m3"]
    cut = clipped_volume(Batch(*(np.array([value]) for value in sphere)), *(n * DX for n in CELLS))
    assert cut < 0.9 * 4.0 / 3.0 * np.pi * sphere[3] ** 3
    assert painted == pytest.approx(cut, rel=1e-3)
