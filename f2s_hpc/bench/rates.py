"""Rates of the step on this machine, for :mod:`f2s_hpc.workload.predict`: measured in under a minute, kept on disk."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import pathlib
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from f2s_hpc import places
from f2s_hpc._cache import cache_directory, source_hash
from f2s_hpc.bench import crowd, states
from f2s_hpc.bench.hook import EXCHANGE, hooked
from f2s_hpc.bench.trial import typical
from f2s_hpc.build import build_model
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.grid.box import GHOST
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.solver.model import Model
from f2s_hpc.verify.box import Setup, make_setup
from f2s_hpc.workload.predict import FLYING, SOLID, Rates

TILES = ((1, 1), (2, 2), (4, 4), (8, 8))
"""Sizes measured, from in cache to far out of it."""

NARROW = ((1, 16), (16, 1))
"""Boxes as large as one of those and as narrow as the smallest, along x and along y: by them the costs of cells and of
ghosts beyond the sides can be told apart."""

END_SHARES, GHOST_SHARES = np.linspace(0.1, 2.0, 39), np.linspace(0.1, 0.8, 15)
"""What a ghost may cost of an owned cell, at the ends of rows and elsewhere. Noise must not carry it out: kernels visit
one to three of the four ghost layers; at the ends, rows that are short for vectors come on top."""

AIR, LEAST_AIR = (80, 80, 72), (16, 16, 32)
"""Cells (x, y, z) of the box that flying particles are measured in: its largest and its smallest size."""

STRETCHES = 10
PAIRS = 3


def _step_seconds(setup: Setup) -> float:
    """Return the CPU time of a step, averaged as the trial runs are that the prediction is held against."""
    seconds = []
    for _ in range(STRETCHES):
        start = time.thread_time()
        steps = setup.advance_to_remap()
        seconds.append((time.thread_time() - start) / steps)
    return typical(seconds[2:])


def _active(setup: Setup) -> tuple[int, int, int]:
    """Return the active cells of the rank: owned, ghosts at the ends of its own rows, other ghosts."""
    runs, count = setup.state.runs
    k, j, first, end = runs[:count].astype(np.int64).T
    _, ny, nz = setup.state.part.count
    own = (k >= GHOST) & (k < GHOST + nz) & (j >= GHOST) & (j < GHOST + ny)
    owned, rows = setup.state.active_cells(), int((end - first)[own].sum())
    return owned, rows - owned, int((end - first).sum()) - rows


def _exchanges(setup: Setup) -> tuple[tuple[tuple[float, float], ...], int]:
    """Return how many cell and node fields each ghost exchange from remap to remap carries, and the steps in between.

    Asked of real steps. Fields of which only some layers go count by their share of all, those that go along one axis
    by a third.
    """
    found: list[tuple[float, float]] = []

    def wrap(name: str, function: Callable) -> Callable:
        if name != EXCHANGE:
            return function

        def noted(pool, names, layers=GHOST, axis=None):
            share = layers / GHOST * (1.0 if axis is None else 1.0 / 3.0)
            cells = sum(BY_NAME[n].location == CELL for n in names)
            found.append((share * cells, share * (len(names) - cells)))
            return function(pool, names, layers, axis)

        return noted

    with hooked(wrap):
        steps = setup.advance_to_remap()
    return tuple(found), steps


def _packing_rate(memory: np.ndarray) -> float:
    """Return at which rate (bytes/s) ghosts are gathered from the fields into a message and scattered out of one."""
    place = np.arange(0, memory.size, 5, dtype=np.int64)
    best = np.inf
    for _ in range(4):
        start = time.thread_time()
        memory[place] = memory[place]
        best = min(best, time.thread_time() - start)
    return 8.0 * place.size / best


def air_of(scene: Scene, plan: BatchPlan) -> tuple[tuple[int, ...], list[tuple[float, ...]] | None]:
    """Return the cells (x, y, z) of a box in the middle of the particle layer, and the spheres that fit it.

    At most as large as ``AIR``; spheres (x, y, z, r in cells) of the scene's first batch, None if none fits.
    """
    batch, dx = plan.batches[plan.order[0]], scene.domain.cell_size
    extents = (*scene.domain.extents[:2], scene.domain.particle_layer_height)
    size = tuple(min(max(round(extent / dx), least), most) for extent, least, most in zip(extents, LEAST_AIR, AIR))
    low = [max(0.0, 0.5 * (extent / dx - cells)) for extent, cells in zip(extents, size)]
    x, y, z, r = batch.x / dx - low[0], batch.y / dx - low[1], batch.z / dx - low[2], batch.r / dx
    inside = (x > 0.0) & (x < size[0]) & (y > 0.0) & (y < size[1]) & (z - r > 1.0) & (z + r < size[2] - 1.0)
    return size, list(zip(*(a[inside] for a in (x, y, z, r)))) or None


def _crowding(saved: dict[str, np.ndarray], model: Model, scene: Scene) -> float:
    """Return by which factor a step is slower while all other cores step as well; 1 where there is no other."""
    def step() -> float:
        # from the same state each time: it comes to rest
        return _step_seconds(states.tiled(saved, model, crowd.TILES))

    step()
    before, slower = step(), []
    # in turn: the machine's other users come and go
    for _ in range(PAIRS):
        with crowd.crowd(saved, scene):
            together = step()
        after = step()
        slower.append(2.0 * together / (before + after))
        before = after
    return max(float(np.median(slower)), 1.0)


def calibrate(scene: Scene, plan: BatchPlan, say: Callable[[str], None] = lambda text: None) -> Rates:
    """Measure the rates of the step with material, settings and particles of ``scene``; one rank."""
    say("measuring the rates of the step on this machine, under a minute")
    model = states.model_for(scene)
    rows, times = [], []

    def measure(setup: Setup) -> None:
        times.append(_step_seconds(setup))
        rows.append(_active(setup))

    saved = states.save(states.deposit(model))
    slower = _crowding(saved, model, scene)
    for tiles in (*TILES, *NARROW):
        measure(states.tiled(saved, model, tiles))
    # hardly any cells: what a step costs however few there are
    measure(make_setup((8, 8, 8), model, [(4.0, 4.0, 4.0, 1.5)], (0.0, 0.0, -1.0)))
    solid = _fitted(rows, times)
    # how many cells of a particle its surface cuts, and how they lie in memory, decides what it costs: the scene's own
    # particles and cells, as wide as they are
    size, spheres = air_of(scene, plan)
    setup = states.flying(model._replace(dx=scene.domain.cell_size), spheres, scene.particles.speed, size)
    measure(setup)
    exchanges, steps = _exchanges(setup)
    return replace(solid, per_cell=solid.per_cell | {FLYING: _cost(solid, rows[-1], times[-1])}, exchanges=exchanges,
                   steps=steps, packing=_packing_rate(setup.state.pool.memory), crowding=slower, cores=crowd.cores())


def _cost(rates: Rates, row: tuple[int, int, int], seconds: float) -> float:
    """Return the cost of an owned cell (s) by which the model with ``rates`` meets a measured step."""
    alone = seconds / rates.slower(sum(row)) - rates.per_step
    return max(alone, 0.0) / rates.worth(*row)


def _fitted(rows: Sequence[tuple[int, int, int]], times: Sequence[float]) -> Rates:
    """Fit the costs per step, per cell and per ghost to measured steps, all relative errors alike.

    ``rows``: cells as :func:`_active` counts them, first those of the sizes in ``TILES``.
    """
    owned, ends, ghosts = (np.array(column) for column in zip(*rows))
    seconds = np.array(times)
    best = None
    # linear for given shares of the ghosts; these are found by trying
    for end_share, share in itertools.product(END_SHARES, GHOST_SHARES):
        matrix = np.stack([np.ones(seconds.size), owned + end_share * ends + share * ghosts], axis=1) / seconds[:, None]
        found = np.linalg.lstsq(matrix, np.ones(seconds.size), rcond=None)[0]
        if found[0] < 0.0:
            found = np.array([0.0, np.linalg.lstsq(matrix[:, 1:], np.ones(seconds.size), rcond=None)[0][0]])
        fitted = matrix @ found
        error = float(((fitted - 1.0) ** 2).sum())
        if best is None or error < best[0]:
            best = (error, float(share), float(end_share), found, fitted)
    _, share, end_share, found, fitted = best
    # what the fit leaves is the caches: small boxes run in them, large ones do not
    sizes = tuple((int(sum(row)), float(1.0 / whole)) for row, whole in list(zip(rows, fitted))[:len(TILES)])
    return Rates(float(found[0]), {SOLID: float(found[1])}, share, end_share, 0.0, (),
                 where=f"{platform.node()}, {platform.machine()}", sizes=sizes)


def cache_file(scene: Scene) -> pathlib.Path:
    """Return where the rates for material, settings and particles of ``scene`` are kept: beside the kernels."""
    model = build_model(scene)
    s = model.settings
    parts = (type(model.flow).__name__, type(model.eos).__name__, "conduction" if s.conduction else "adiabatic",
             "2nd" if s.second_order else "1st")
    own = (scene.domain, scene.batches, scene.particles, scene.numerics)
    # (the folder follows the kernels; what they cost follows the steps that call them, too)
    parts = (*parts, hashlib.sha256(repr((own, source_hash("solver"))).encode()).hexdigest()[:8])
    return pathlib.Path(cache_directory()) / f"rates-{'-'.join(parts)}.json"


def write_rates(path: str | os.PathLike, rates: Rates) -> None:
    """Write rates as JSON; raises ``InputError`` if the place cannot be written."""
    places.make_folder(pathlib.Path(path).parent, "--rates")
    places.write_text(path, json.dumps(asdict(rates), indent=1) + "\n")


def read_rates(path: str | os.PathLike) -> Rates:
    """Read rates that :func:`write_rates` wrote; raises ``InputError`` for anything else."""
    try:
        record = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
        record["exchanges"] = tuple((float(c), float(n)) for c, n in record["exchanges"])
        record["sizes"] = tuple((int(n), float(factor)) for n, factor in record["sizes"])
        rates = Rates(**record)
        numbers = [rates.per_step, rates.ghost_share, rates.end_share, rates.packing, rates.crowding, rates.reductions,
                   *(rates.per_cell[kind] for kind in (SOLID, FLYING)), *itertools.chain(*rates.exchanges)]
        if not all(np.isfinite(float(n)) and n >= 0.0 for n in numbers) or rates.packing == 0.0:
            raise ValueError("a rate is not a positive number")
        counts = (rates.steps, rates.cores, *(cells for cells, _ in rates.sizes))
        if not all(type(n) is int and 0 < n < 2**63 for n in counts):
            raise ValueError("a number of steps, cores or cells is not a whole one above 0")
        if not all(0.0 < factor < np.inf for _, factor in rates.sizes) or set(rates.per_cell) != {SOLID, FLYING}:
            raise ValueError("a size without its factor, or another kind of cell")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: is no file of rates as f2s plan writes it ({error})") from None
    return rates


def rates_for(scene: Scene, plan: BatchPlan, path: str | None, say: Callable[[str], None] = lambda text: None) -> Rates:
    """Return the rates of the file ``path`` if it is there, else of the cache, else measured now and kept.

    What another version of the code kept is measured anew. Raises ``InputError`` if ``path`` is no file of rates, or
    cannot be written; a cache that cannot is told by ``say``.
    """
    place = pathlib.Path(path) if path else cache_file(scene)
    try:
        if places.kind(place) != places.NOTHING:
            return read_rates(place)
    except InputError:
        if path:
            raise
    if path:
        places.check_file(place, "--rates")
    rates = calibrate(scene, plan, say)
    try:
        write_rates(place, rates)
    except InputError as error:
        if path:
            raise
        say(f"note: the rates are not kept, and will be measured again ({error}); --rates FILE keeps them elsewhere")
    return rates
