"""Traces of void inside material: which cells stay full, and that what spreads does not tear along them."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import ALL_SYMMETRY, make_block, make_model, make_setup

from f2s_hpc.fields import SWEEP
from f2s_hpc.kernels.seal import INSIDE, TRACE, seal_cells
from f2s_hpc.materials.pressure import unloaded
from f2s_hpc.solver.remap import remap_all
from f2s_hpc.verify import taylor
from f2s_hpc.verify.vof import CASES as VOF_CASES

MODEL = make_model(3e-6)
CENTRE = (5, 4, 3)
BESIDE = [(5, 4, 2), (5, 4, 4), (5, 3, 3), (5, 5, 3), (4, 4, 3), (6, 4, 3)]


def remapped(mass: float, *, yielded: float = 0.1, beside: tuple[int, int, int] | None = None,
             beside_mass: float = 1.0, model=MODEL) -> float:
    """Return the volume fraction of the cell ``CENTRE`` (k, j, i) of a block at rest after a remap.

    ``mass``: its fill; ``yielded``: its PEEQ; ``beside``: a neighbour that holds ``beside_mass``.
    """
    setup = make_block((8, 9, 10), model)
    state = setup.state
    for place, fill in ((CENTRE, mass), (beside, beside_mass)):
        if place is not None:
            for name in ("mass", "volume_fraction"):
                state.owned(name)[place] = fill
    state.owned("peeq")[CENTRE] = yielded
    for name in SWEEP:
        state.views[name][...] = 0.0
    state.exchange(state.ghosted)
    remap_all(state, model, 0, setup.ledger)
    assert state.owned("mass")[CENTRE] == mass
    return state.owned("volume_fraction")[CENTRE]


def test_a_trace_of_void_is_sealed():
    """Fails if ``fraction[c] = 1.0`` of ``seal_cells`` goes, or the trace is a tenth as large."""
    assert remapped(1.0 - 0.99 * TRACE) == 1.0


def test_more_than_a_trace_stays():
    """A pore is a pore. Fails if the trace is twice as large."""
    assert remapped(1.0 - 1.01 * TRACE) == 1.0 - 1.01 * TRACE


def test_what_has_not_yielded_keeps_its_void():
    """Motion that is only carried along, as of a particle in flight. Fails without ``peeq[c] <= 0.0``."""
    assert remapped(1.0 - 0.5 * TRACE, yielded=0.0) == 1.0 - 0.5 * TRACE


@pytest.mark.parametrize("beside", BESIDE)
def test_a_cell_beside_the_surface_is_open(beside):
    """Fails if one of the six ``mass[c + ...]`` of ``seal_cells`` is left out."""
    fill = 1.0 - 0.5 * TRACE
    assert remapped(fill, beside=beside, beside_mass=INSIDE - 0.01) == fill
    assert remapped(fill, beside=beside, beside_mass=INSIDE + 0.01) == 1.0


def test_tension_beyond_the_spall_strength_opens():
    """Fails if ``least`` leaves the spall strength out."""
    weak = make_model(3e-6, overrides=["material.spall_pressure=50 MPa"])
    strain = 50e6 / weak.bulk.bulk_modulus
    assert remapped(1.0 - 1.1 * strain, model=weak) == 1.0 - 1.1 * strain
    assert remapped(1.0 - 0.9 * strain, model=weak) == 1.0


def test_hot_material_that_has_expanded_is_sealed():
    """Mie-Grueneisen: at no pressure a cell of hot metal is full with less mass, and so are its neighbours.

    Fails when ``seal_cells`` takes the mass for the share of the cell that is filled.
    """
    hot = make_model(3e-6, "copper-piston")
    energy = hot.bulk.specific_heat * 300.0
    free = unloaded(hot.eos, energy)
    assert free < 0.99
    for trace, sealed in ((0.5 * TRACE, True), (2.0 * TRACE, False)):
        setup = make_block((8, 9, 10), hot)
        state = setup.state
        state.owned("internal_energy")[...], state.owned("peeq")[...] = energy, 0.1
        state.owned("mass")[...], state.owned("volume_fraction")[...] = free, 1.0
        state.owned("mass")[CENTRE] *= 1.0 - trace
        state.owned("volume_fraction")[CENTRE] = 1.0 - trace
        for name in SWEEP:
            state.views[name][...] = 0.0
        state.exchange(state.ghosted)
        remap_all(state, hot, 0, setup.ledger)
        assert (state.owned("volume_fraction")[CENTRE] == 1.0) == sealed


def test_a_sphere_has_no_cell_inside_its_surface():
    """A painted sphere has traces of void only where the surface cuts a corner; none of its cells is sealed.

    Fails if ``INSIDE`` is 0: cells whose corner the surface cuts would be.
    """
    setup = make_setup((16, 16, 16), MODEL, [(8.1, 7.9, 8.2, 6.3)], sides=ALL_SYMMETRY)
    state = setup.state
    before = state.views["volume_fraction"].copy()
    runs, count = state.runs
    seal_cells(runs, count, state.cell_window(), state.part.cell_shape[1:], 2e9, MODEL.eos, state.energy,
               state.flat["mass"], np.ones_like(state.flat["mass"]), state.flat["volume_fraction"])
    assert np.array_equal(state.views["volume_fraction"], before)


def test_geometry_alone_seals_nothing():
    """LeVeque's field neither yields nor gains volume. Fails if what has not yielded is sealed."""
    case = next(case for case in VOF_CASES if case.name == "vof-leveque")
    for row in case.run(case.options(False, ["resolutions=16"])):
        if "volume" in row.quantity:
            assert abs(row.error) < 1e-10


def test_the_foot_of_a_taylor_bar_does_not_tear():
    """No void inside the two lowest layers after 14 us, at 16 cells per radius. Fails without ``_seal``."""
    options = next(case for case in taylor.CASES if case.name == "taylor-bar").options(False, [])
    setup = taylor.make_bar(options, 16.0)
    setup.advance_to(14e-6)
    foot = setup.state.owned("volume_fraction")[:2]
    reach = (np.arange(foot.shape[2])[None, :] + 1) ** 2 + (np.arange(foot.shape[1])[:, None] + 1) ** 2
    inside = reach < 0.8 ** 2 * 4.0 / np.pi * foot.sum(axis=(1, 2)).min()
    assert foot[:, inside].min() == 1.0
