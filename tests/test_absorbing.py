"""Absorbing sides: waves go, a steady push does not last, mass and energy are kept, any ranks the same bits."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from conftest import f2s
from solver_setup import ALL_SYMMETRY, STANDARD_SIDES, make_block, make_model, make_setup, never_yields
from test_sleep import whole

from f2s_hpc import mpi
from f2s_hpc.cycles import measure
from f2s_hpc.fields import LENT, SWEEP
from f2s_hpc.io import layout, runs
from f2s_hpc.io.checkpoint import list_checkpoints
from f2s_hpc.solver.absorbing import lend_mass
from f2s_hpc.verify import absorbing

DX = 3e-6
GROUND = 6
MODEL = make_model(DX)
SIDES = STANDARD_SIDES | {"z_low": "absorbing", "x_high": "absorbing"}


def impact(sides, steps, grid=None):
    """Return a box after ``steps`` steps of a sphere's fall onto a thin substrate, and its balance."""
    setup = make_setup((16, 17, 20), MODEL, [(7.3, 6.4, GROUND + 3.2, 3.0)], (30.0, -20.0, -600.0), 700.0, GROUND,
                       sides=sides, grid=grid)
    substrate = measure.material_quanta(setup.state, setup.model) - setup.ledger.totals()["mass_painted"]
    setup.advance(steps)
    return setup, measure.measure_balance(setup.state, setup.model, setup.ledger, substrate)


@pytest.mark.mpi
def test_every_process_grid_gives_the_same_bits_and_the_balance_closes():
    """Cut along x, y or z, beside an absorbing side or not: the same fields, mass and energy ledger, which closes.

    Fails when ``lend_mass`` visits owned cells only, when ``apply_traction`` does not enter its work, or when
    ``_nodes_beside`` counts the nodes at the edge of two absorbing sides twice.
    """
    ranks = mpi.size()
    found = []
    for grid in ((1, 1, ranks), (1, ranks, 1), (ranks, 1, 1)):
        setup, balance = impact(SIDES, 120, grid)
        state = setup.state
        found.append((setup.clock.dt, balance, {name: whole(state, name) for name in state.saved}))
    for dt, balance, fields in found[1:]:
        assert (dt, balance) == found[0][:2]
        for name, bits in fields.items():
            assert (bits == found[0][2][name]).all(), name
    balance = found[0][1]
    energy, brought = balance["energy"], balance["energy"]["brought_in"]
    assert energy["through_faces"] > 1e-3 * brought
    assert abs(energy["remainder"]) < 1e-6 * brought
    assert abs(balance["mass_drift_relative"]) < 1e-11
    assert mpi.maximum(np.abs(setup.state.owned(LENT)).max()) > 1e-3


def test_waves_go_that_a_fixed_side_sends_back():
    """A longitudinal packet: under 2 % of its amplitude comes back, from a fixed side nearly all.

    Fails when ``remap_all`` leaves ``lend_mass`` out, or ``kick`` ``apply_traction``.
    """
    options = absorbing.CASES[0].options(False, [])
    share, theory, _ = absorbing.come_back("absorbing", "longitudinal", 0.0, 16.0, 2e-6, "1 m", options)
    assert share < 0.02
    assert theory < 1e-12
    share, _, _ = absorbing.come_back("fixed", "longitudinal", 0.0, 16.0, 2e-6, "1 m", options)
    assert 0.98 < share < 1.01


def test_reflection_of_plane_waves_on_dashpots():
    """Nothing comes back at normal incidence; of a sound wave in a fluid (1 - cos) / (1 + cos) of its angle.

    Fails when ``reflected`` takes the sine for the cosine, or the wrong speed in the impedance.
    """
    bulk = MODEL.bulk
    speeds = ((bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus) / bulk.density) ** 0.5, \
        (bulk.shear_modulus / bulk.density) ** 0.5
    assert absorbing.reflected(bulk, speeds, "longitudinal", 0.0) < 1e-12
    assert absorbing.reflected(bulk, speeds, "shear", 0.0) < 1e-12
    fluid = bulk._replace(shear_modulus=1e-12 * bulk.bulk_modulus)
    speeds = (fluid.bulk_modulus / fluid.density) ** 0.5, (fluid.shear_modulus / fluid.density) ** 0.5
    assert np.isclose(absorbing.reflected(fluid, speeds, "longitudinal", np.radians(60.0)), 1.0 / 3.0, rtol=1e-4)


def test_the_spring_brings_the_side_back():
    """A block that is set moving down: the side gives way, stops, and comes back in some H / c_p.

    Fails when ``outgoing_traction`` leaves ``push`` out: then the side stays where the impulse left it.
    """
    model = never_yields(make_model(DX, overrides=("numerics.absorbing_depth=60 um",)))
    setup = make_block((4, 4, 12), model, sides=ALL_SYMMETRY | {"z_low": "absorbing", "z_high": "free"})
    setup.state.views["velocity_z"][...] = -2.0
    setup.state.exchange(setup.state.ghosted)
    lent = []
    for _ in range(60):
        setup.advance_to_remap()
        lent.append(float(setup.state.owned(LENT).mean()))
    assert max(lent) > 1e-5
    assert abs(lent[-1]) < 0.1 * max(lent)


def test_sides_that_meet_give_way_together():
    """A nearly full cell between one side that gives way and one that comes in as much lends nothing.

    Fails when ``lend_mass`` takes one side after the other: the first fills the cell, and what was void is lent.
    """
    setup = make_block((6, 6, 6), MODEL, sides=STANDARD_SIDES | {"x_low": "absorbing", "y_low": "absorbing"})
    state = setup.state
    low = state.part.cell_shape[0] // 2 - 3  # ghosts come first
    corner = (slice(low, low + 6), low, low)
    state.views["mass"][corner] = state.views["volume_fraction"][corner] = 0.95
    for name in SWEEP:
        state.views[name][...] = 0.0
    state.views[SWEEP[0]][:, :, low], state.views[SWEEP[1]][:, low, :] = -0.1, 0.1
    lend_mass(state, MODEL, setup.ledger)
    assert state.views["volume_fraction"][corner] == pytest.approx(0.95, abs=1e-12)
    assert np.abs(state.views[LENT][corner]).max() < 1e-12
    assert np.abs(state.owned(LENT)).max() > 0.05  # beside one side alone full cells lend


def test_all_six_sides_give_way_alike():
    """A block that runs into a low or a high side along x, y or z lends the same and comes to the same rest.

    Fails when ``lend_mass`` takes the face on the other side of the cell along one axis (``gx[n + 1]`` for ``gx[n]``),
    or ``outgoing_traction`` the cells on the other side of the node.
    """
    model = never_yields(make_model(DX, overrides=("numerics.absorbing_depth=60 um",)))
    found = {}
    for axis, letter in enumerate("xyz"):
        for end, other, way in (("low", "high", -1.0), ("high", "low", 1.0)):
            cells = [4, 4, 4]
            cells[axis] = 12
            setup = make_block(cells, model, sides=ALL_SYMMETRY | {f"{letter}_{end}": "absorbing",
                                                                   f"{letter}_{other}": "free"})
            velocity = setup.state.views[f"velocity_{letter}"]
            velocity[...] = 2.0 * way
            setup.state.exchange(setup.state.ghosted)
            lent = []
            for _ in range(25):
                setup.advance_to_remap()
                lent.append(float(setup.state.owned(LENT).sum()))
            found[letter, end] = [*lent, way * float(setup.state.owned(f"velocity_{letter}").mean())]
    wanted = found.pop(("z", "low"))
    assert max(wanted) > 1e-3
    for side, numbers in found.items():
        assert numbers == pytest.approx(wanted, rel=1e-6, abs=1e-9), side


SCENE = """
title = "Impacts on a thin substrate with an absorbing bottom"
domain = { size = ["84 um", "66 um", "180 um"], cell_size = "6 um", substrate_height = "36 um", \
particle_layer_height = "144 um", faces = { z_low = "absorbing", y_high = "absorbing" } }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC", direction = [0.1, -0.05, -1.0] }
batches = { count = 2, particles = 8, seed = 3, diameter_min = "14 um", diameter_d10 = "20 um", \
diameter_d50 = "30 um", diameter_d90 = "42 um", diameter_max = "48 um" }
cycles = { count = 2, duration = "60 ns" }
output = { picture = false }
"""


def test_three_ranks_and_a_resumed_run_give_the_same_bits(tmp_path):
    """Fails when the field ``lent_mass`` is not saved, or not exchanged."""
    (tmp_path / "thin.toml").write_text(SCENE, encoding="utf-8")
    for ranks in (1, 3):
        f2s("run", "thin.toml", "--out", f"on-{ranks}", ranks=ranks, cwd=tmp_path)
    assert "identical in every saved bit" in f2s("compare", "on-1", "on-3", "--exact", cwd=tmp_path).stdout
    summary = runs.read_summary(tmp_path / "on-1")
    assert summary["energy"]["through_faces"] > 0.0
    assert abs(summary["mass_drift_relative"]) < 1e-12
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "on-1", copy)
    first, last = list_checkpoints(copy / layout.CHECKPOINTS)
    last.unlink()
    last.with_suffix(".json").unlink()
    assert f"resuming from {first}" in f2s("resume", copy, ranks=2, cwd=tmp_path).stdout
    assert "identical in every saved bit" in f2s("compare", "on-1", copy, "--exact", cwd=tmp_path).stdout
