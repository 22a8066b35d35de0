"""The tag that tells particles from substrate stays as sharp as it was, keeps its amount and stays between 0 and 1."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import cell_coordinates

from f2s_hpc import mpi
from f2s_hpc.fields import ORIGIN
from f2s_hpc.kernels import tag as tags
from f2s_hpc.verify.scenes import scene_setup, write_scene

DX, RADIUS, SPEED = 2e-6, 5.0, 500.0
CELLS = (44, 22, 22)
FLOWN = 22.0


def flying_halves(normal):
    """Return a sphere that flies along a diagonal, one half of it tagged: that in front of a plane through its centre.

    The plane's ``normal`` is a vector; cells are tagged whole, by where their centres are.
    """
    start = np.array([9.0, 9.0, 9.0])
    scene = write_scene(CELLS, DX, "copper-ge", SPEED, 1e-6, spheres=[(*(start * DX), RADIUS * DX)],
                        overrides=("output.origin=true",))
    setup, _ = scene_setup(scene)
    velocity = SPEED * np.array([0.98, 0.14, 0.14]) / np.linalg.norm([0.98, 0.14, 0.14])
    for name, value in zip(("velocity_x", "velocity_y", "velocity_z"), velocity):
        setup.state.views[name][...] = value
    state = setup.state
    ahead = sum(n * (q - s) for n, q, s in zip(normal, cell_coordinates(state), start))
    state.views[ORIGIN][...] = np.where((ahead > 0.0) & (state.views["mass"] > 0.0), 1.0, 0.0)
    return setup, start, velocity


def amounts(setup):
    """Return the tagged mass, and how much mass has a tag between 2 and 98 %, in full cells, over all ranks."""
    mass, tag = setup.state.owned("mass"), setup.state.owned(ORIGIN)
    between = mass * ((tag > 0.02) & (tag < 0.98))
    return sum(mpi.all_gather(np.array([(mass * tag).sum(), between.sum()])))


@pytest.mark.mpi
@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0), (1.0, -0.6, 0.3)])
def test_a_tag_stays_sharp(normal):
    """Flown over 22 cells: as much is tagged as before, within 0 and 1; the interface is a cell and a half thick.

    Fails when the tag is swept as other fields are (``State.swept_cells``): the interface is four cells thick.
    """
    setup, start, velocity = flying_halves(normal)
    tagged, _ = amounts(setup)
    setup.advance_to(FLOWN * DX / SPEED)
    found, between = amounts(setup)
    assert found == pytest.approx(tagged, rel=1e-12)
    tag, mass = setup.state.owned(ORIGIN), setup.state.owned("mass")
    assert tag.min() >= -1e-14
    assert tag.max() <= 1.0 + 1e-14
    assert between < 1.6 * np.pi * RADIUS**2
    # and it is where it should be: all that lies more than two cells from the plane is on its side
    centre = start + FLOWN * velocity / SPEED
    ahead = sum(n * (q - c) for n, q, c in zip(normal, cell_coordinates(setup.state), centre)) / np.linalg.norm(normal)
    ahead = ahead[setup.state.part.owned_cells]
    assert tag[(mass > 0.01) & (ahead > 2.0)].min(initial=1.0) > 0.98
    assert tag[(mass > 0.01) & (ahead < -2.0)].max(initial=0.0) < 0.02


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_tag_keeps_its_bounds_where_flows_part(axis, rng):
    """Cells of any mass and tag, any part of which leaves through both faces: tags stay in 0..1, their sum is kept.

    Fails when what has left through the low face is not taken off what may leave
    through the high one (``kept -= leaves``).
    """
    n = 12
    mass, tag = rng.uniform(0.2, 1.0, (n, n, n)), rng.random((n, n, n)) ** rng.choice([0.2, 1.0, 5.0], (n, n, n))
    low, high = 0.6 * rng.random((n, n, n)) * mass, 0.39 * rng.random((n, n, n)) * mass
    moved, flux = np.zeros((n + 1,) * 3), np.zeros((n + 1,) * 3)
    inner = slice(2, n - 2)
    before = [inner] * 3
    before[2 - axis] = slice(2, n - 3)
    after = [inner] * 3
    after[2 - axis] = slice(3, n - 2)
    up = rng.random(mass[tuple(after)].shape) < 0.5
    moved[tuple(after)] = np.where(up, high[tuple(before)], -low[tuple(after)])
    runs = np.array([[k, j, 2, n - 2] for k in range(2, n - 2) for j in range(2, n - 2)])
    window = (2, n - 2) * 3
    swept = tag.copy()
    rows = [a.reshape(-1) for a in (moved, flux, mass, swept)]
    tags.tag_fluxes(runs, len(runs), window, (n, n), axis, rows[0], rows[2], rows[3], rows[1])
    tags.sweep_tag(runs, len(runs), window, (n, n), axis, *rows)
    step = np.roll(moved, -1, axis=2 - axis)
    left = (mass + (moved - step)[:n, :n, :n])[inner, inner, inner]
    swept, tag, mass = (a[inner, inner, inner] for a in (swept, tag, mass))
    assert swept.min() >= 0.0
    assert swept.max() <= 1.0
    assert left.min() > 0.0
    assert (left * swept).sum() == pytest.approx((mass * tag).sum(), rel=1e-13)
