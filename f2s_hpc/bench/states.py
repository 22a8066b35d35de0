"""Three states to measure the step on, at any size: a filled box, a sprayed deposit, particles in flight.

A patch of section4's spray, 16 x 16 cells wide, is computed once; wider boxes are its mirror images side by side, which
is what its symmetric sides mean. So all sizes hold the same mix of full cells, surfaces and void.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.build import build_model
from f2s_hpc.config.load import parse_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.insert import paint_batch
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.particles.batch import Batch
from f2s_hpc.particles.plan import make_batches
from f2s_hpc.solver.model import Model
from f2s_hpc.verify.box import STANDARD_SIDES, Setup, make_model, make_setup, node_coordinates

PATCH = (16, 16, 32)
CELL_SIZE = 6e-6
SPEED = 615.0
SUBSTRATE = 8
LANDED = 0.14e-6
"""Time (s) after which the first batch, painted just above the substrate, has landed but for its last particles."""

_SPRAY = """
title = "the benchmark's patch"
[domain]
size = ["96 um", "96 um", "192 um"]
cell_size = "6 um"
substrate_height = "48 um"
particle_layer_height = "144 um"
[material]
name = "copper-ge"
[particles]
speed = "615 m/s"
temperature = "450 degC"
[batches]
count = 2
particles = {particles}
seed = 7
diameter_d10 = "17 um"
diameter_d50 = "27 um"
diameter_d90 = "39 um"
diameter_max = "45 um"
shuffle = false
[cycles]
count = 2
duration = "0.14 us"
"""


def _batches() -> list[Batch]:
    """Return two batches with as many particles per area and height as section4's."""
    count = round(500 * (96.0 / 350.0) ** 2 * 144.0 / 203.0)
    return make_batches(parse_scene(_SPRAY.format(particles=count), "benchmark")).batches


def _spheres(batch: Batch, bottom: float) -> list[tuple[float, float, float, float]]:
    scale = 1.0 / CELL_SIZE
    return [(x * scale, y * scale, z * scale + bottom, r * scale)
            for x, y, z, r in zip(batch.x, batch.y, batch.z, batch.r)]


def filled(model: Model) -> Setup:
    """Return the patch full of material that swings and yields: no surface, no void."""
    setup = make_setup(PATCH, model, substrate=PATCH[2], sides=STANDARD_SIDES)
    x, y, z = node_coordinates(setup.state)
    shape = np.sin(np.pi * z / PATCH[2])
    for name, wave, along in (("velocity_x", np.sin, (x, 0)), ("velocity_y", np.sin, (y, 1)),
                              ("velocity_z", np.cos, (x, 0))):
        setup.state.views[name][...] = 60.0 * shape * wave(2.0 * np.pi * along[0] / PATCH[along[1]])
    setup.state.exchange(setup.state.ghosted)
    setup.activate()
    setup.advance(20)
    return setup


def deposit(model: Model) -> Setup:
    """Return the patch after a batch has landed and while the next one hits it."""
    first, second = _batches()
    setup = make_setup(PATCH, model, _spheres(first, SUBSTRATE), (0.0, 0.0, -SPEED), 723.15, SUBSTRATE)
    setup.advance_to(LANDED)
    paint_batch(setup.state, model, second, SUBSTRATE * CELL_SIZE, (0.0, 0.0, -SPEED), 723.15, setup.ledger, 1)
    setup.activate()
    setup.clock.in_cycle, setup.clock.limits.heavy_speed = 0.0, SPEED
    setup.advance_to(0.4 * LANDED)
    return setup


def flying(model: Model, spheres: Sequence[tuple[float, float, float, float]] | None = None,
           speed: float = SPEED, cells: tuple[int, int, int] = PATCH) -> Setup:
    """Return the patch, or a box of ``cells``, with ``spheres`` (x, y, z, r in cells; those of the patch if None) in
    free flight, nothing else."""
    spheres = _spheres(_batches()[0], SUBSTRATE) if spheres is None else spheres
    setup = make_setup(cells, model, spheres, (0.0, 0.0, -speed), 723.15)
    setup.advance(20)
    return setup


STATES: dict[str, Callable[[Model], Setup]] = {"filled": filled, "deposit": deposit, "flying": flying}


def default_model() -> Model:
    """Return cold-sprayed copper and the default settings at the patch's cell size."""
    return make_model(CELL_SIZE, "copper-ge", SPEED)


def model_for(scene: Scene) -> Model:
    """Return the material and settings of ``scene`` at the patch's cell size and speed."""
    model, own = build_model(scene), default_model()
    settings = model.settings._replace(speed_cap=own.settings.speed_cap, speed_limit=own.settings.speed_limit)
    return model._replace(dx=CELL_SIZE, settings=settings, energy_quantum=own.energy_quantum)


def save(setup: Setup) -> dict[str, np.ndarray]:
    """Return, on every rank, all fields that the step carries on, whole, and the clock. Collective."""
    clock, state, part = setup.clock, setup.state, setup.state.part
    numbers = np.array([clock.dt or 0.0, clock.limits.heavy_speed, clock.limits.light_speed, clock.limits.gradient])
    saved = {"clock": numbers}
    for name in state.saved:
        whole = np.zeros(part.box.node_shape if BY_NAME[name].location != CELL else part.box.shape)
        for (x, y, z), block in mpi.all_gather((part.start, state.owned(name))):
            whole[z:z + block.shape[0], y:y + block.shape[1], x:x + block.shape[2]] = block
        saved[name] = whole
    return saved


def load(path: str) -> dict[str, np.ndarray]:
    """Return what :func:`save` returned, from the file ``path`` (npz)."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def _mirrored(patch: np.ndarray, part_slices: tuple[tuple[int, int], ...], signs: tuple[int, int, int],
              on_nodes: bool) -> np.ndarray:
    """Return the block ``part_slices`` ((start, count) per k, j, i) of the patch continued by mirrors along x and y."""
    index, sign = [], []
    for axis, (start, count) in enumerate(part_slices):
        period = PATCH[2 - axis]
        place = np.arange(start, start + count)
        turn, inside = np.divmod(place, period)
        odd = (turn % 2).astype(bool)
        index.append(np.where(odd, period - inside - (0 if on_nodes else 1), inside) if axis else place)
        sign.append(np.where(odd, float(signs[2 - axis]), 1.0) if axis else np.ones(count))
    block = patch[np.ix_(*index)]
    return block * sign[1][None, :, None] * sign[2][None, None, :]


def tiled(saved: dict[str, np.ndarray], model: Model, tiles: tuple[int, int]) -> Setup:
    """Return the saved patch, mirrored ``tiles`` (x, y) times side by side, ready to step. Collective."""
    cells = (PATCH[0] * tiles[0], PATCH[1] * tiles[1], PATCH[2])
    setup = make_setup(cells, model)
    state, part = setup.state, setup.state.part
    for name in state.saved:
        field = BY_NAME[name]
        on_nodes = field.location != CELL
        counts = part.node_count if on_nodes else part.count
        slices = tuple(zip(part.start[::-1], counts[::-1]))
        state.owned(name)[...] = _mirrored(saved[name], slices, field.mirror_sign, on_nodes)
    state.everything_active()
    state.exchange(state.ghosted)
    clock = setup.clock
    clock.dt, clock.limits.heavy_speed, clock.limits.light_speed, clock.limits.gradient = map(float, saved["clock"])
    setup.activate()
    return setup
