"""What a cycle is judged by, against plain numpy on the whole box; each test also runs under mpirun."""

from __future__ import annotations

import numpy as np
import pytest

from f2s_hpc import mpi
from f2s_hpc.analysis.surface import attached_material
from f2s_hpc.build import build_ledger, build_model
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import paint_batch, paint_substrate
from f2s_hpc.fields import STRESS, VELOCITY, needed
from f2s_hpc.grid.box import SIDES, Box
from f2s_hpc.grid.decomposition import Decomposition
from f2s_hpc.particles.batch import Batch, clipped_volume
from f2s_hpc.state import State

pytestmark = pytest.mark.mpi

DX = 5e-6
CELLS = (13, 14, 24)
SCENE = """
title = "A box of columns"
domain = { size = ["65 um", "70 um", "120 um"], cell_size = "5 um", substrate_height = "17 um", \
particle_layer_height = "60 um" }
material = { name = "copper-ge" }
particles = { speed = "600 m/s", temperature = "450 degC" }
batches = { spheres = [["20 um", "20 um", "20 um", "10 um"]] }
cycles = { count = 1, duration = "1 ns" }
"""


@pytest.fixture(params=["columns", "layers"])
def state(request) -> State:
    """Return an empty state, cut across x and y as usual, or across z only."""
    scene = parse_scene(SCENE, "test")
    grid = None if request.param == "columns" else (1, 1, mpi.size())
    sides = {side: getattr(scene.domain.faces, side) for side in SIDES}
    return State(Decomposition(Box(CELLS, DX), grid), sides, needed(False))


def put(state: State, name: str, whole: np.ndarray) -> None:
    """Give a field the values of a global array [k, j, i]; ghosts are filled too."""
    own = state.owned(name)
    own[...] = whole[tuple(slice(s, s + n) for s, n in zip(state.part.start[::-1], own.shape))]
    state.exchange((name,))


def mine(state: State, whole: np.ndarray) -> np.ndarray:
    """Return this rank's part of a global cell array."""
    return whole[tuple(slice(s, s + n) for s, n in zip(state.part.start[::-1], state.part.count[::-1]))]


def agreed(value):
    """Return ``value`` after making sure that every rank has the same."""
    assert all(np.array_equal(value, other) for other in mpi.all_gather(value))
    return value


def columns(rng: np.random.Generator, lowest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return heights (cells) per column (ny, nx), and the volume fraction of solid columns of these heights."""
    height = rng.uniform(lowest, CELLS[2] - 1.5, CELLS[1::-1])
    height[0, 0], height[3, 4], height[5, 5], height[6, 7] = 12.0, 12.5, 11.0, 8.0
    return height, np.clip(height - np.arange(CELLS[2])[:, None, None], 0.0, 1.0)


@pytest.mark.parametrize("draw", ["normal", "skewed", "two heaps"])
def test_percentiles_are_those_of_numpy(rng, draw):
    """Fails if ``percentiles`` counts this rank's cells only: no ``mpi.total`` around ``np.bincount``, on 2 ranks."""
    values = {"normal": rng.normal(size=40000), "skewed": rng.exponential(size=40000),
              "two heaps": np.concatenate([rng.normal(size=10000), rng.normal(9.0, 0.1, size=30000)])}[draw]
    bounds = np.linspace(0.0, 1.0, mpi.size() + 1) ** 2 * values.size  # uneven shares
    share = slice(*bounds.astype(int)[mpi.rank():mpi.rank() + 2])
    shares = (0.01, 0.3, 0.5, 0.95, 0.999)
    found = agreed(measure.percentiles(values[share], np.ones(values.size)[share], shares))
    bin_width = np.ptp(values) / 8192
    # where data are sparse numpy's own answer lies anywhere between two neighbours
    gaps = [np.ptp(np.quantile(values, [s - 1e-4, s + 1e-4])) for s in shares]
    assert np.all(np.abs(np.array(found) - np.quantile(values, shares)) < bin_width + np.array(gaps))


def test_percentiles_weigh(rng):
    """Fails if the weights are left out: ``quanta = np.full(weights.shape, 2**20)``."""
    values, weights = rng.normal(size=20000), rng.integers(0, 5, 20000)
    share = slice(mpi.rank(), None, mpi.size())
    found = agreed(measure.percentiles(values[share], weights[share].astype(float), (0.05, 0.5, 0.95)))
    wanted = np.quantile(np.repeat(values, weights), (0.05, 0.5, 0.95))
    assert np.allclose(found, wanted, rtol=0.0, atol=2.0 * np.ptp(values) / 8192)


def test_percentiles_of_nothing_of_one_value_and_of_one_rank():
    empty = np.empty(0)
    assert measure.percentiles(empty, empty, (0.5, 0.9)) == [None, None]
    assert agreed(measure.percentiles(np.full(7, 3.25), np.ones(7), (0.5, 0.9))) == [3.25, 3.25]
    values = np.arange(101.0) if mpi.rank() == mpi.size() - 1 else empty
    assert np.isclose(agreed(measure.percentiles(values, np.ones(values.size), (0.5,)))[0], 50.0, atol=1.0)


def test_the_surface_of_columns_is_their_height(state, rng):
    """Fails if the cell above is not added: drop ``np.where(over < 0.5, over, 0.0)`` from ``surface_map``."""
    height, fraction = columns(rng, 0.6)
    put(state, "volume_fraction", fraction)
    landed = np.ones(state.part.cell_shape, dtype=bool)
    found = agreed(measure.surface_map(state, landed))
    assert found.shape == CELLS[1::-1]
    assert np.allclose(found, height * DX, rtol=0.0, atol=1e-12 * DX * CELLS[2])


def test_pores_count_and_flying_material_does_not(state, rng):
    """Fails if ``landed`` is ignored, or if the lowest cell of a column counts: ``np.argmax(solid, axis=0)``."""
    height, fraction = columns(rng, 6.0)
    height, fraction = np.minimum(height, 15.0), np.minimum(fraction, (np.arange(CELLS[2]) < 15)[:, None, None])
    fraction[3] = 0.0  # a pore under every column
    flying = np.zeros(fraction.shape, dtype=bool)
    flying[18:21] = True
    fraction[18:21, 2:9, 3:8] = 1.0
    fraction[:, 11, 11], height[11, 11] = 0.0, 0.0  # an empty column
    put(state, "volume_fraction", fraction)
    landed = np.ones(state.part.cell_shape, dtype=bool)
    landed[state.part.owned_cells] = ~mine(state, flying)
    found = agreed(measure.surface_map(state, landed))
    assert np.allclose(found, height * DX, rtol=0.0, atol=1e-12 * DX * CELLS[2])


def test_speed_is_the_norm_of_the_mean_nodal_velocity(state, rng):
    """Fails if one node of the cell is left out of ``derived.cell_speed``."""
    put(state, "mass", np.where(rng.random(CELLS[::-1]) < 0.7, 1.0, 0.0))
    nodes = {name: rng.normal(size=tuple(n + 1 for n in CELLS[::-1])) for name in VELOCITY}
    for name, whole in nodes.items():
        put(state, name, whole)
    mean = {name: sum(v[c:CELLS[2] + c, b:CELLS[1] + b, a:CELLS[0] + a] for a in (0, 1) for b in (0, 1) for c in (0, 1))
            / 8.0 for name, v in nodes.items()}
    wanted = mine(state, np.sqrt(sum(m**2 for m in mean.values())))
    wanted = np.where(state.owned("mass") > 0.0, wanted, 0.0)
    model = build_model(parse_scene(SCENE, "test"))
    assert np.allclose(measure.derived_field(state, model, "speed"), wanted, rtol=1e-13, atol=1e-15)


def test_von_mises_stress_is_that_of_the_whole_tensor(state, rng):
    """Random deviators, against sqrt(3/2 s:s) of their matrices; fails when shear counts once: ``1.0 * shear``."""
    xx, yy, xy, yz, xz = (rng.normal(size=CELLS[::-1]) for _ in range(5))
    parts = {(0, 0): xx, (1, 1): yy, (2, 2): -xx - yy, (0, 1): xy, (1, 2): yz, (0, 2): xz}
    tensor = np.zeros((*CELLS[::-1], 3, 3))
    for (a, b), values in parts.items():
        tensor[..., a, b] = tensor[..., b, a] = values
    for name, values in zip(STRESS, parts.values()):
        put(state, name, values)
    model = build_model(parse_scene(SCENE, "test"))
    wanted = mine(state, np.sqrt(1.5 * np.einsum("...ab,...ab", tensor, tensor)))
    assert np.allclose(measure.derived_field(state, model, "von_mises"), wanted, rtol=1e-13, atol=0.0)


def test_only_what_has_landed_above_the_substrate_counts(state, rng):
    """PEEQ and temperature of the deposit; heights above the substrate.

    Fails if flying material counts (``landed = fraction > 0``), or the substrate does (``centre > 0``).
    """
    model = build_model(parse_scene(SCENE, "test"))
    k = np.arange(CELLS[2])[:, None, None]
    fraction = np.broadcast_to(np.where(k < 10, 1.0, 0.0), CELLS[::-1]).copy()
    fraction[10] = 0.3
    fraction[18:21] = 1.0
    peeq = np.where(k < 4, 7.0, np.where(k < 11, rng.uniform(1.0, 2.0, CELLS[::-1]), 4.0)) * np.ones(CELLS[::-1])
    peeq[10] = 9.0  # less than half full: a splash that does not count
    put(state, "volume_fraction", fraction)
    put(state, "mass", fraction)
    put(state, "peeq", peeq)
    put(state, "temperature", 273.15 + 100.0 * peeq)
    falling = np.zeros(tuple(n + 1 for n in CELLS[::-1]))
    falling[16:] = -600.0
    put(state, "velocity_z", falling)
    found = agreed(measure.measure_material(state, model, 17e-6, 600.0))
    deposit = peeq[3:10]  # the substrate ends at 3.4 cells: the cell with its centre at 3.5 is deposit
    assert np.isclose(found["height_mean_m"], 10.3 * DX - 17e-6, rtol=1e-9, atol=0.0)
    assert np.isclose(found["height_max_m"], found["height_p95_m"], rtol=1e-9, atol=0.0)
    assert found["peeq_max"] == 7.0
    bin_width = (7.0 - 1.0) / 8192
    p50, p95 = np.quantile(deposit, (0.5, 0.95))
    assert abs(found["peeq_p50"] - p50) < 2.0 * bin_width + 1e-3
    assert abs(found["peeq_p95"] - p95) < 2.0 * bin_width + 1e-3
    assert abs(found["temperature_p50_degC"] - 100.0 * p50) < 0.3


def test_landed_is_what_is_attached_also_where_it_rings(state, rng):
    """An overhang, a slow fragment in the air, a surface that rings, a sphere that flies: as for the whole box at once.

    Fails when the ring around a rank's cells is left empty (in ``_grounded_rings``), the lowest layer does not ground,
    or ``LANDED`` is 0.1.
    """
    model = build_model(parse_scene(SCENE, "test"))
    assert not measure.landed_cells(state, model, 600.0).any()  # (an empty box)
    fraction = np.zeros(CELLS[::-1])
    fraction[:8], fraction[8] = 1.0, 0.3
    fraction[8:14, 3:5, 3:5], fraction[12:14, 3:11, 3:10] = 1.0, 1.0  # a mushroom over many ranks
    fraction[14, 2:12, 2:11] = 0.2
    fraction[17:19, 2:7, 2:9] = 1.0  # hangs in the air, slow
    fraction[21:23] = 1.0  # flies
    rings, flies = np.zeros(CELLS[::-1], dtype=bool), np.zeros(CELLS[::-1], dtype=bool)
    rings[7, :, 6:], flies[21:] = True, True
    speed = np.where(flies, 600.0, np.where(rings, 150.0, 0.0))
    put(state, "volume_fraction", fraction)
    put(state, "mass", fraction)
    nodes = np.zeros(tuple(n + 1 for n in CELLS[::-1]))
    nodes[:-1, :-1, :-1] = speed
    nodes[-1], nodes[:, -1], nodes[:, :, -1] = nodes[-2], nodes[:, -2], nodes[:, :, -2]
    put(state, "velocity_z", -nodes)
    slow = measure.derived_field(state, model, "speed") < 200.0
    whole = np.zeros(CELLS[::-1], dtype=bool)
    for start, own in mpi.all_gather((state.part.start, slow)):
        whole[tuple(slice(s, s + n) for s, n in zip(start[::-1], own.shape))] = own
    wanted = attached_material(fraction, whole)
    assert wanted[7].all()
    assert wanted[13, 9, 8]
    assert not wanted[17:].any()
    found = measure.landed_cells(state, model, 600.0)
    assert np.array_equal(found[state.part.owned_cells], mine(state, wanted))
    heights = agreed(measure.measure_material(state, model, 17e-6, 600.0))
    assert heights["height_max_m"] == pytest.approx(14.2 * DX - 17e-6, rel=1e-9)


def test_heights_and_temperatures_have_their_percentiles(state, rng):
    """Columns of any height, as hot as they are strained; fails when a percentile of one number is given another's."""
    model = build_model(parse_scene(SCENE, "test"))
    height, fraction = columns(rng, 6.0)
    peeq = rng.uniform(1.0, 2.0, CELLS[::-1])
    for name, whole in (("volume_fraction", fraction), ("mass", fraction), ("peeq", peeq),
                        ("temperature", 273.15 + 100.0 * peeq)):
        put(state, name, whole)
    found = agreed(measure.measure_material(state, model, 17e-6, 600.0))
    above = height * DX - 17e-6
    assert found["height_mean_m"] == pytest.approx(above.mean(), rel=1e-9)
    assert found["height_p95_m"] == pytest.approx(np.percentile(above, 95), rel=1e-9)
    assert found["height_max_m"] == pytest.approx(above.max(), rel=1e-9)
    assert found["temperature_p50_degC"] == pytest.approx(100.0 * found["peeq_p50"], abs=0.05)
    assert found["temperature_p95_degC"] == pytest.approx(100.0 * found["peeq_p95"], abs=0.05)
    assert found["peeq_p50"] < 1.6 < 1.9 < found["peeq_p95"]


@pytest.mark.parametrize("heats", [True, False])
def test_what_no_term_received_is_lost_and_mass_is_told_in_kilograms(state, heats):
    """An empty box and a ledger written by hand.

    Fails when a numerical term is left out of ``lost``, the shock viscosity stays a loss or is none, the heat that came
    back is not that of its plastic work, or a mass is in quanta or not that of its name.
    """
    model = build_model(parse_scene(SCENE, "test", [f"numerics.viscous_heating={str(heats).lower()}"]))
    ledger, substrate = build_ledger(model), 700
    terms = {"brought_in": 10**7, "plastic_work": 4 * 10**6, "shock_viscosity": 10**6, "through_faces": 5 * 10**5,
             "put_to_sleep": 3 * 10**5, "lost": 2 * 10**5, "capped": 10**5, "returned": 6 * 10**5, "mass_left": 2000,
             "mass_capped": 300, "mass_lent": 100, "mass_painted": 5000}
    if mpi.is_root():
        for name, quanta in terms.items():
            ledger.add(name, quanta)
    found = agreed(measure.measure_balance(state, model, ledger, substrate))
    lost = 1.0 - 0.4 - 0.05 - (0.1 if heats else 0.0)
    assert found["numerical_loss_fraction"] == pytest.approx(lost, rel=1e-12)
    back = 0.06 / model.bulk.taylor_quinney
    assert found["numerical_loss_unheated_fraction"] == pytest.approx(lost - back, rel=1e-12)
    kilogram = model.mass_quantum * model.bulk.density * DX**3
    assert found["mass_left_kg"] == pytest.approx(2000 * kilogram, rel=1e-12, abs=0.0)
    assert found["mass_capped_kg"] == pytest.approx(300 * kilogram, rel=1e-12, abs=0.0)
    assert found["mass_drift_relative"] == pytest.approx((5000 + 700 - 2000 - 300 - 100) / 5000)
    quantum = model.mass_quantum * DX**3
    assert found["dense_height_m"] == pytest.approx((100 - 700) * quantum / (65e-6 * 70e-6), rel=1e-12, abs=0.0)


def test_the_dense_height_is_the_painted_volume_over_the_area(state):
    """Fails if the substrate counts (drop ``- substrate_quanta``), or the area is that of one rank."""
    scene = parse_scene(SCENE, "test")
    model = build_model(scene)
    ledger = build_ledger(model)
    paint_substrate(state, 17e-6, 298.15)
    substrate = measure.material_quanta(state, model)
    spheres = np.array([[0.0, 30.0, 40.0, 12.0], [40.0, 70.0, 60.0, 14.0], [35.0, 22.0, 90.0, 11.0]]).T * 1e-6
    batch = Batch(*map(np.ascontiguousarray, spheres))
    paint_batch(state, model, batch, 0.0, (0.0, 0.0, -600.0), 700.0, ledger, 1)
    found = agreed(measure.measure_balance(state, model, ledger, substrate))
    volume = clipped_volume(batch, *(n * DX for n in CELLS))
    assert np.isclose(found["painted_volume_m3"], volume, rtol=1e-12, atol=0.0)
    assert np.isclose(found["dense_height_m"], volume / (65e-6 * 70e-6), rtol=1e-12, atol=0.0)
    assert abs(found["mass_drift_relative"]) < 1e-12
    energy = found["energy"]
    assert np.isclose(energy["kinetic"], 0.5 * model.bulk.density * volume * 600.0**2, rtol=1e-9, atol=0.0)
    assert np.isclose(energy["brought_in"], energy["kinetic"], rtol=1e-12, atol=0.0)
    assert found["numerical_loss_fraction"] == pytest.approx(0.0, abs=1e-12)
