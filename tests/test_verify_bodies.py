"""What verification cases put into their boxes, and where material came from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.cycles import measure
from f2s_hpc.fields import ORIGIN
from f2s_hpc.verify import shapes, splat
from f2s_hpc.verify.box import ALL_SYMMETRY
from f2s_hpc.verify.scenes import empty_setup, scene_setup, write_scene

# --- where material came from -----------------------------------------------------------------------------------


def splat_scene(*overrides: str):
    """Return a sphere of 6 cells, 2 cells inside mirrors, that flies at its substrate."""
    return write_scene((8, 8, 20), 5e-6, "copper-ge", 600.0, 40e-9, spheres=[(10e-6, 15e-6, 16e-6, 15e-6)], substrate=8,
                       temperature=700.0, overrides=overrides)


def test_origin_costs_nothing_unless_asked_for():
    """Fails if ``fields.needed`` always returns the field."""
    setup, _ = scene_setup(splat_scene())
    assert ORIGIN not in setup.state.views
    setup, _ = scene_setup(splat_scene("output.origin=true"))
    assert ORIGIN in setup.state.saved


@pytest.mark.mpi
def test_particle_mass_is_carried_exactly():
    """The particles' mass through an impact, sum of mass times share, is what was painted; the share stays in 0..1.

    Fails if ``insert.add_material`` does not set the share, or ``State.carried_cells`` leaves it out of the remap.
    """
    setup, _ = scene_setup(splat_scene("output.origin=true"))
    state = setup.state

    def particle_mass() -> float:
        return sum(mpi.all_gather(float((state.owned("mass") * state.owned(ORIGIN)).sum())))

    painted = setup.report.volume / setup.model.dx**3
    assert particle_mass() == pytest.approx(painted, rel=1e-9)
    setup.advance_to(40e-9)
    assert particle_mass() == pytest.approx(painted, rel=1e-9)
    share = state.owned(ORIGIN)
    assert share.min() >= 0.0
    assert share.max() <= 1.0 + 1e-12
    # the splat has mixed with nothing but what it touches: cells deep in the substrate hold none of it
    if state.part.start[2] == 0:
        assert share[:2].max() < 1e-12


def test_origin_changes_nothing_else():
    """Fails if the kernels' answer depends on how many fields ride along."""
    runs = []
    for overrides in ((), ("output.origin=true",)):
        setup, _ = scene_setup(splat_scene(*overrides))
        setup.advance_to(10e-9)
        runs.append(setup.state)
    for name in runs[0].saved:
        np.testing.assert_array_equal(runs[0].owned(name), runs[1].owned(name))


# --- painted bodies ---------------------------------------------------------------------------------------------


def test_disc_area_is_exact():
    """Fails if a corner of ``quarter_disc_area`` misses the part beyond the arc: without ``under_arc``."""
    edges = np.arange(-4.0, 12.0)
    for radius in (0.4, 3.3, 8.0):
        share = shapes.disc_fractions(edges, edges, radius)
        inside = edges[:-1] >= 0.0
        assert share[np.ix_(inside, inside)].sum() == pytest.approx(0.25 * math.pi * radius**2, rel=1e-13)
        assert share.min() >= -1e-13
        assert share.max() <= 1.0 + 1e-13
        np.testing.assert_allclose(share, share.T, atol=1e-13)
    # by counting points: cells that the arc cuts
    fine = (np.arange(400) + 0.5) / 400.0
    share = shapes.disc_fractions(np.arange(5.0), np.arange(5.0), 3.3)
    for j, i in ((0, 3), (1, 3), (2, 2), (3, 0), (3, 3)):
        counted = ((i + fine[None, :]) ** 2 + (j + fine[:, None]) ** 2 <= 3.3**2).mean()
        assert share[j, i] == pytest.approx(counted, abs=3e-4)


@pytest.mark.mpi
def test_cylinder_brings_its_mass_and_energy():
    """Fails if ``_layers`` fills the cut cells of the ends, or nodes get the velocity of half their mass."""
    scene = write_scene((10, 9, 12), 1e-3, "copper-taylor", 100.0, 1e-6, spheres=[(0.0, 0.0, 1e-3, 1e-3)],
                        faces=ALL_SYMMETRY)
    setup = empty_setup(scene)
    shapes.paint_cylinder(setup, 6.3, 2.25, 8.5, (0.0, 0.0, -100.0), 300.0)
    volume = 0.25 * math.pi * 6.3**2 * 6.25
    balance = measure.measure_balance(setup.state, setup.model, setup.ledger, 0)
    assert balance["painted_volume_m3"] == pytest.approx(volume * 1e-9, rel=1e-9, abs=0.0)
    kinetic = 0.5 * 8930.0 * volume * 1e-9 * 100.0**2
    assert balance["energy"]["brought_in"] == pytest.approx(kinetic, rel=1e-9)
    assert balance["energy"]["kinetic"] == pytest.approx(kinetic, rel=1e-9)


def test_peeq_is_averaged_over_cells_as_the_published_series_has_it():
    """A sphere of even PEEQ 2, and of 4 in cells less than 0.9 full: averaged over those it is less than 3.6.

    Cells with less than a hundredth of it do not count. Fails when the average is not taken over the whole cell
    (``fraction * peeq``).
    """
    setup, _ = scene_setup(splat_scene("output.origin=true"))
    setup.state.views["peeq"][...] = np.where(setup.state.views["mass"] > 0.0, 2.0, 0.0)
    assert splat.peeq_p95(setup) == pytest.approx(2.0)
    assert splat.peeqvavg_p95(setup) == pytest.approx(2.0, rel=1e-3)
    fraction, cells = splat.particle_cells(setup)
    assert 0.01 <= fraction.min() < 0.1
    cut = (setup.state.owned("volume_fraction") < 0.9) & cells
    setup.state.owned("peeq")[cut] = 4.0
    assert splat.peeq_p95(setup) == pytest.approx(4.0, rel=1e-3)
    assert 2.5 < splat.peeqvavg_p95(setup) < 3.6
