"""Rates of the step on this machine, for :mod:`f2s_hpc.workload.predict`: measured in half a minute, kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import pathlib
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np

from f2s_hpc._jit import cache_directory
from f2s_hpc.bench import crowd, states
from f2s_hpc.bench.hook import EXCHANGE, hooked
from f2s_hpc.bench.trial import typical
from f2s_hpc.build import build_model
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.grid.box import GHOST
from f2s_hpc.particles.batch import BatchPlan
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

KINDS = {SOLID: "deposit", FLYING: "flying"}
STRETCHES = 10


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


def particles_in_patch(scene: Scene, plan: BatchPlan) -> list[tuple[float, float, float, float]] | None:
    """Return the spheres (cells) of the scene's first batch in the middle of its layer that fit the patch, if any."""
    batch, dx = plan.batches[plan.order[0]], scene.domain.cell_size
    width, depth, height = states.PATCH
    low = [max(0.0, 0.5 * (extent / dx - size)) for extent, size in zip(
        (*scene.domain.extents[:2], scene.domain.particle_layer_height), states.PATCH)]
    x, y, z, r = batch.x / dx - low[0], batch.y / dx - low[1], batch.z / dx - low[2], batch.r / dx
    inside = (x > 0.0) & (x < width) & (y > 0.0) & (y < depth) & (z - r > 1.0) & (z + r < height - 1.0)
    return list(zip(*(a[inside] for a in (x, y, z, r)))) or None


def _crowding(saved: dict[str, np.ndarray], scene: Scene) -> float:
    """Return by which factor a step is slower while all other cores step as well; 1 where there is no other."""
    setup = states.tiled(saved, crowd.model_of(scene), crowd.TILES)
    alone = _step_seconds(setup)
    with crowd.crowd(saved, scene):
        together = _step_seconds(setup)
    # (the machine's other users: before and after)
    return max(2.0 * together / (alone + _step_seconds(setup)), 1.0)


def calibrate(scene: Scene, plan: BatchPlan, say: Callable[[str], None] = lambda text: None) -> Rates:
    """Measure the rates of the step with material, settings and particles of ``scene``; one rank."""
    say("measuring the rates of the step on this machine, some half a minute")
    model = crowd.model_of(scene)
    rows, times, kinds = [], [], list(KINDS)
    exchanges, packing = ((), 1), 0.0
    for kind, state in KINDS.items():
        if kind == FLYING:
            # how many cells of a particle its surface cuts decides what it costs: the scene's own particles and cells
            model = model._replace(dx=scene.domain.cell_size)
            saved = states.save(states.flying(model, particles_in_patch(scene, plan), scene.particles.speed))
        else:
            saved = states.save(states.STATES[state](model))
            slower = _crowding(saved, scene)
        for tiles in (*TILES, *NARROW):
            setup = states.tiled(saved, model, tiles)
            seconds = _step_seconds(setup)
            rows.append((kinds.index(kind), *_active(setup)))
            times.append(seconds)
            exchanges, packing = _exchanges(setup), _packing_rate(setup.state.pool.memory)
    # hardly any cells: what a step costs however few there are
    setup = make_setup((8, 8, 8), crowd.model_of(scene), [(4.0, 4.0, 4.0, 1.5)], (0.0, 0.0, -1.0))
    rows.append((0, *_active(setup)))
    times.append(_step_seconds(setup))
    return replace(_fitted(rows, times, kinds, exchanges, packing), crowding=slower, cores=crowd.cores())


def _fitted(rows: list[tuple[int, int, int, int]], times: list[float], kinds: list[str],
            exchanges: tuple[tuple[tuple[float, float], ...], int], packing: float) -> Rates:
    """Fit the cost per step, per cell of each kind and of ghosts to measured steps, all relative errors alike.

    ``rows``: kind, and cells as :func:`_active` counts them; of each kind, one after the other, as many, first those of
    the sizes in ``TILES``; more may follow.
    """
    kind, owned, ends, ghosts = (np.array(column) for column in zip(*rows))
    seconds = np.array(times)
    best = None
    # linear for given shares of the ghosts; these are found by trying
    for end_share, share in itertools.product(END_SHARES, GHOST_SHARES):
        cells = owned + end_share * ends + share * ghosts
        columns = [np.ones(seconds.size), *((kind == n) * cells for n in range(len(kinds)))]
        matrix = np.stack(columns, axis=1) / seconds[:, None]
        found = np.linalg.lstsq(matrix, np.ones(seconds.size), rcond=None)[0]
        if found[0] < 0.0:
            found = np.concatenate([[0.0], np.linalg.lstsq(matrix[:, 1:], np.ones(seconds.size), rcond=None)[0]])
        error = float(((matrix @ found - 1.0) ** 2).sum())
        if best is None or error < best[0]:
            best = (error, float(share), float(end_share), found)
    _, share, end_share, found = best
    # what the fit leaves is the caches: small boxes run in them, large ones do not
    fitted = found[0] + found[1:][kind] * (owned + end_share * ends + share * ghosts)
    every = seconds.size // len(kinds)
    sizes = [(int((owned + ends + ghosts)[n:every * len(kinds):every].mean()),
              float((seconds / fitted)[n:every * len(kinds):every].mean())) for n in range(min(len(TILES), every))]
    return Rates(float(found[0]), {name: float(c) for name, c in zip(kinds, found[1:])}, share, end_share, packing,
                 exchanges[0], 1, exchanges[1], f"{platform.node()}, {platform.machine()}", tuple(sizes))


def cache_file(scene: Scene) -> pathlib.Path:
    """Return where the rates for material, settings and particles of ``scene`` are kept: beside the kernels."""
    model = build_model(scene)
    s = model.settings
    parts = (type(model.flow).__name__, type(model.eos).__name__, "conduction" if s.conduction else "adiabatic",
             "2nd" if s.second_order else "1st")
    own = (scene.domain.cell_size, scene.domain.particle_layer_height, scene.batches, scene.particles)
    parts = (*parts, hashlib.sha256(repr(own).encode()).hexdigest()[:8])
    return pathlib.Path(cache_directory()) / f"rates-{'-'.join(parts)}.json"


def write_rates(path: str | os.PathLike, rates: Rates) -> None:
    """Write rates as JSON; raises ``InputError`` if the place cannot be written."""
    path = pathlib.Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(rates), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def read_rates(path: str | os.PathLike) -> Rates:
    """Read rates that :func:`write_rates` wrote; raises ``InputError`` for anything else."""
    try:
        record = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
        record["exchanges"] = tuple((float(c), float(n)) for c, n in record["exchanges"])
        record["sizes"] = tuple((int(n), float(factor)) for n, factor in record["sizes"])
        rates = Rates(**record)
        numbers = [rates.per_step, rates.ghost_share, rates.end_share, rates.packing, rates.crowding,
                   *(rates.per_cell[kind] for kind in KINDS)]
        if not all(np.isfinite(float(n)) and n >= 0.0 for n in numbers) or rates.packing == 0.0:
            raise ValueError("a rate is not a positive number")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: is no file of rates as f2s plan writes it ({error})") from None
    return rates


def rates_for(scene: Scene, plan: BatchPlan, path: str | None, say: Callable[[str], None] = lambda text: None) -> Rates:
    """Return the rates of the file ``path`` if it is there, else of the cache, else measured now and kept.

    What another version of the code kept is measured anew. Raises ``InputError`` if ``path`` is no file of rates.
    """
    place = pathlib.Path(path) if path else cache_file(scene)
    with contextlib.ExitStack() as stack:
        if not path:
            stack.enter_context(contextlib.suppress(InputError))
        if place.exists():
            return read_rates(place)
    rates = calibrate(scene, plan, say)
    write_rates(place, rates)
    return rates
