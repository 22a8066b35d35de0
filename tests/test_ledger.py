"""The energy and mass ledger: every joule and kilogram of a short impact; each test also runs under mpirun."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import paint_batch, paint_substrate
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver.ledger import ENERGY_TERMS, Ledger
from f2s_hpc.solver.step import Clock, advance

pytestmark = pytest.mark.mpi

# A sphere of 8 cells on 5 cells of substrate; it starts 0.1 cell above it.
IMPACT = """
title = "A short impact"
domain = { size = ["48 um", "45 um", "54 um"], cell_size = "3 um", substrate_height = "15 um", \
particle_layer_height = "39 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC" }
batches = { spheres = [["24 um", "21 um", "12.3 um", "12 um"]] }
cycles = { count = 1, duration = "20 ns" }
"""

# Larger cells, and mirrors at the middle of two spheres.
PRESSED = """
title = "Pressed"
domain = { size = ["40 um", "40 um", "60 um"], cell_size = "5 um", substrate_height = "20 um", \
particle_layer_height = "40 um" }
material = { name = "copper-ge" }
particles = { speed = "615 m/s", temperature = "450 degC" }
batches = { spheres = [["0 um", "0 um", "20 um", "19 um"], ["40 um", "40 um", "21 um", "19 um"]] }
cycles = { count = 1, duration = "70 ns" }
"""

# The same sphere flies out of an open side, a corner of it through an open edge.
DEPARTURE = """
title = "A departure"
domain = { size = ["48 um", "45 um", "54 um"], cell_size = "3 um", substrate_height = "0 um", \
particle_layer_height = "54 um", faces = { x_high = "%s", z_high = "%s" } }
material = { name = "copper-ge" }
particles = { speed = "600 m/s", temperature = "450 degC", direction = [1.0, 0.0, 0.5] }
batches = { spheres = [["30 um", "21 um", "30 um", "12 um"]] }
cycles = { count = 1, duration = "80 ns" }
"""


class Run:
    """A scene run to its end in this process, and its balance. Collective."""

    def __init__(self, text: str, *overrides: str) -> None:
        scene = parse_scene(text, "test", overrides)
        self.scene, self.model, self.state = scene, build_model(scene), build_state(scene)
        self.ledger, self.clock = build_ledger(self.model), Clock()
        paint_substrate(self.state, scene.domain.substrate_height, scene.substrate.temperature)
        self.substrate = measure.material_quanta(self.state, self.model)
        paint_batch(self.state, self.model, make_batches(scene).batches[0], scene.domain.layer_bottom,
                    scene.particles.velocity, scene.particles.temperature, self.ledger, 1)
        self.clock.limits.heavy_speed = scene.particles.speed
        self.heat_at_start = self.heat()
        while self.clock.in_cycle < scene.cycles.duration * (1.0 - 1e-12):
            advance(self.state, self.model, self.clock, self.ledger, scene.cycles.duration)
        self.heat_at_end = self.heat()
        self.balance = measure.measure_balance(self.state, self.model, self.ledger, self.substrate)
        self.energy = self.balance["energy"]

    def heat(self) -> float:
        """Return the heat of all material over 0 K, m c_p T (J)."""
        own = float((self.state.owned("mass") * self.state.owned("temperature")).sum())
        return sum(mpi.all_gather(own)) * self.model.cell_mass * self.model.bulk.specific_heat


@functools.cache
def impact(courant: float) -> Run:
    """Return the impact at a given Courant number; both other limits of the step follow it."""
    return Run(IMPACT, f"numerics.courant={courant}", f"numerics.remap_courant={0.5 * courant}",
               f"numerics.strain_per_step={0.2 * courant}")


def test_the_impact_is_one():
    run = impact(0.5)
    peak = mpi.maximum(np.array([run.state.owned("peeq").max()]))[0]
    assert peak > 0.3
    assert run.energy["plastic_work"] > 0.1 * run.energy["brought_in"]
    assert run.clock.steps > 30


def test_nothing_is_unexplained_and_the_error_of_the_step_falls():
    """What no term explains is round-off; the error of the step is under 0.5 % of the energy, and falls with the step.

    Fails if a term is wrong: in ``solver/lagrange.py:deform`` swap "plastic_work" and "heat"; in ``solver/step.py`` add
    the power of the shock viscosity twice.
    """
    coarse, fine = impact(0.5), impact(0.25)
    assert fine.clock.steps > 1.9 * coarse.clock.steps
    assert max(abs(run.energy["remainder"]) / run.energy["brought_in"] for run in (coarse, fine)) < 1e-10
    errors = [abs(run.energy["time_step"]) / run.energy["brought_in"] for run in (coarse, fine)]
    assert errors[0] < 0.005
    assert errors[1] < 0.75 * errors[0]


@pytest.mark.parametrize(("steps", "share"), [(1, 0.2), (8, 0.6)])
def test_half_kicks_and_closing_cells_explain_most_of_the_error_of_the_step(steps, share):
    """Each of both is larger than what is left of the error of the explicit step, and they have opposite signs.

    Fails when ``accelerate`` takes ``uneven`` as zero or with the other sign, ``_close_chunk`` leaves out CLOSING, or
    the viscous pressure works on the volume fraction before the step alone.
    """
    energy = Run(PRESSED, f"numerics.steps_per_remap={steps}").energy
    assert energy["closing"] > 0.004 * energy["brought_in"]
    assert energy["half_kicks"] < -0.004 * energy["brought_in"]
    assert abs(energy["time_step"]) < share * min(energy["closing"], -energy["half_kicks"])


@pytest.mark.parametrize("courant", [0.5, 0.25])
def test_mass_is_kept(courant):
    """Fails if a flux is counted on one side only: in ``remap.py`` skip ``_sweep_cells`` of one axis."""
    assert abs(impact(courant).balance["mass_drift_relative"]) < 1e-10
    assert impact(courant).balance["mass_left_kg"] == 0.0


@pytest.mark.parametrize("courant", [0.5, 0.25])
def test_the_heat_of_the_ledger_is_in_the_material(courant):
    """m c_p T of all material rises by exactly the heat entered, through remap and conduction.

    Fails if the remap of the temperature is not mass-weighted, if conduction loses heat at a void face, or if
    "heat" leaves out the work of the shock viscosity.
    """
    run = impact(courant)
    rise = run.heat_at_end - run.heat_at_start
    assert run.energy["heat"] > 0.0
    assert np.isclose(rise, run.energy["heat"], rtol=1e-7, atol=0.0)


def test_heat_is_that_of_its_three_sources():
    """Taylor-Quinney share of the plastic work, all work of the shock viscosity, and what came back from the losses.

    Fails if the Taylor-Quinney factor is used twice.
    """
    run = impact(0.5)
    energy = run.energy
    wanted = run.model.bulk.taylor_quinney * energy["plastic_work"] + energy["shock_viscosity"]
    assert energy["heat"] - energy["returned_heat"] == pytest.approx(wanted, rel=1e-6)
    # what the last step lost heats in the next; elastic energy lost, the mass floor's share and what nodes on the
    # surface and in fragments lost do not come back
    lost = sum(energy[name] for name in ("hourglass", "light_nodes", "remap_kinetic", "half_kicks", "closing"))
    returned = energy["returned_heat"] / run.model.bulk.taylor_quinney
    assert 0.6 < returned / lost < 1.0
    fractions = [run.balance[f"numerical_loss_{name}fraction"] for name in ("", "unheated_")]
    assert (fractions[0] - fractions[1]) * energy["brought_in"] == pytest.approx(returned, rel=1e-9, abs=0.0)


def test_losses_heat_only_if_asked():
    """Fails if ``heat_chunk`` leaves out ``losses *``."""
    run = Run(IMPACT, "numerics.loss_heating=false")
    assert run.energy["returned_heat"] == 0.0
    assert run.balance["numerical_loss_unheated_fraction"] == run.balance["numerical_loss_fraction"] > 0.0
    assert "lost_energy" not in run.state.views


def test_every_loss_is_a_loss():
    """Hourglass control, shock viscosity and the light nodes can only take energy; all terms are there.

    Fails if ``solver/lagrange.py:calm_light_nodes`` leaves out "exchanged".
    """
    energy = impact(0.5).energy
    assert set(energy) == set(ENERGY_TERMS)
    for name in ("kinetic", "elastic", "plastic_work", "shock_viscosity", "hourglass", "light_nodes", "remap_kinetic"):
        assert energy[name] >= 0.0, name


@pytest.mark.parametrize(("x_high", "z_high"), [("free", "outflow"), ("outflow", "free")])
def test_what_leaves_is_counted(x_high, z_high):
    """A sphere flies out of the box: all its mass and kinetic energy is entered as gone.

    Fails if ``Boundary.open_sides`` leaves one kind of side out, or inflow counts as outflow.
    """
    run = Run(DEPARTURE % (x_high, z_high))
    painted = run.balance["painted_volume_m3"] * run.model.bulk.density
    assert abs(run.balance["mass_drift_relative"]) < 1e-10
    assert np.isclose(run.balance["mass_left_kg"], painted, rtol=1e-10, atol=0.0)
    assert np.isclose(run.energy["through_faces"], run.energy["brought_in"], rtol=1e-9, atol=0.0)
    assert run.energy["heat"] == 0.0
    assert run.balance["dense_height_m"] == 0.0


@pytest.mark.mpi
def test_what_leaves_while_it_deforms_is_counted():
    """Open sides cut a sphere that strikes the ground, one side is a mirror: all but dust (1e-7) is accounted for.

    Fails if all that leaves is counted with the velocity before the sweep, or with the mean velocity of a face.
    """
    run = Run(IMPACT, "domain.faces.x_low=free", "domain.faces.y_high=outflow", "domain.faces.y_low=symmetry",
              "particles.direction=[-0.8, 0.4, -0.6]", 'batches.spheres=[["9 um", "36 um", "12.3 um", "12 um"]]')
    assert run.energy["through_faces"] > 0.01 * run.energy["brought_in"]
    assert abs(run.energy["remainder"]) < 1e-6 * run.energy["brought_in"]


def test_hot_material_under_mie_grueneisen_pressure_stays_whole():
    """An impact at 1000 m/s: few cells between void and full, and the work of the pressure is counted where it is done.

    Fails if ``close_cells`` or ``closure`` takes cold density for that of hot material at no pressure (more cells are
    partly filled than full), or if the ledger does not count compression.
    """
    run = Run(IMPACT, "material.pressure={model='mie_grueneisen',sound_speed='3940 m/s',slope_s=1.489,gamma=2.02}",
              "particles.speed=1000 m/s", "cycles.duration=40 ns")
    fraction = run.state.owned("volume_fraction")
    partly, full = sum(np.array(mpi.all_gather([((fraction > 0.9) & (fraction < 1.0)).sum(), (fraction >= 1.0).sum()])))
    assert partly < 0.2 * full
    # (0.5 %; 0.3 % at a quarter of the step)
    assert abs(run.energy["time_step"]) < 0.008 * run.energy["brought_in"]
    assert abs(run.energy["remainder"]) < 1e-10 * run.energy["brought_in"]


def test_what_fixed_walls_take_is_counted():
    """Material slides along two fixed sides and an edge of theirs: what they take from its nodes is a loss with a name.

    Fails if ``walls.hold`` enters nothing in the remap or in the exchange of light nodes, or an edge twice.
    """
    run = Run(IMPACT, "domain.faces.x_low=fixed", "domain.faces.y_low=fixed", "particles.direction=[-0.5, -0.4, -0.7]",
              'batches.spheres=[["9 um", "8 um", "12.3 um", "12 um"]]')
    assert run.energy["plastic_work"] > 0.1 * run.energy["brought_in"]
    assert abs(run.energy["remainder"]) < 1e-7 * run.energy["brought_in"]


def test_a_restored_ledger_continues_exactly():
    """Fails if every rank takes the totals of a checkpoint, or if they go through floating-point numbers."""
    first, second = 2**60 + 1, 3**37
    through, split = Ledger(1e-20), Ledger(1e-20)
    for ledger in (through, split):
        ledger.add("work", first + mpi.rank())
        ledger.add("mass_painted", 7 * mpi.rank())
        ledger.add_power("hourglass_power", 123456789 + mpi.rank(), 3.1e-10)
    totals = split.totals()
    assert totals["work"] == sum(first + rank for rank in range(mpi.size()))
    assert mpi.all_gather(totals) == [totals] * mpi.size()
    split = Ledger(1e-20)
    split.restore({name: int(str(value)) for name, value in totals.items()})
    assert split.totals() == totals
    for ledger in (through, split):
        ledger.add("work", second - mpi.rank())
        ledger.add_power("hourglass_power", 987654321, 2.9e-10)
    assert split.totals() == through.totals()
    assert split.energy(split.totals(), 5, 9) == through.energy(through.totals(), 5, 9)


def test_a_power_over_a_step_is_energy():
    """Fails if ``add_power`` and ``energy`` do not use the same unit: 2**39 in one of them."""
    ledger = Ledger(1e-20)
    ledger.add_power("hourglass_power", 4_000_000_000 if mpi.is_root() else 0, 0.5e-9)
    energy = ledger.energy(ledger.totals(), 0, 0)
    assert np.isclose(energy["hourglass"], 2e9 * 1e-20, rtol=1e-12, atol=0.0)
