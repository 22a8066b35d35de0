"""Advection of the volume fraction by prescribed solenoidal fields: the solver's remap, nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from f2s_hpc.fields import SWEEP
from f2s_hpc.solver.remap import remap_all
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import ALL_SYMMETRY, Setup, cell_coordinates, make_model, make_setup, node_coordinates, warm_up
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import Setting

THIN = 3
_PI = math.pi
ROUND_OFF = 1e-12

LEVEQUE_BAR, LEVEQUE_PUBLISHED = {64: 3.7e-3}, {32: 7.743e-3, 64: 3.079e-3, 128: 6.967e-4}
"""E1 that must be reached, and that of plicRDF (TwoPhaseFlow, DLR, testsuite/advection)."""

DISC, DISC_RADIUS = (0.3, 0.263662), 0.2
REVERSED_PUBLISHED = {32: 0.0550883, 64: 0.0108781, 128: 0.00159635}
"""L1 error of Basilisk's split PLIC, src/test/reversed.ref."""

Sweeps = Callable[[float, tuple[np.ndarray, ...]], tuple[np.ndarray, ...]]


def leveque_sweeps(h: float, nodes: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the exact volume per time (in cells) through the low x, y, z faces of the field of LeVeque 1996.

    u = 2 sin^2(pi x) sin(2 pi y) sin(2 pi z), v = -sin(2 pi x) sin^2(pi y) sin(2 pi z), w = -sin(2 pi x) sin(2 pi y)
    sin^2(pi z). The circulation of A = (0, S(y) [C(x) s(z) + C(z)], -C(x) s(y) S(z)) / 2 pi, with S = sin 2 pi,
    C = cos 2 pi, s = sin^2 pi, along the edges of each face, so the sum over the faces of a cell is zero to round-off.
    ``nodes``: coordinates of the low nodes in the unit cube.
    """
    x, y, z = nodes
    edge_y = -(np.cos(2 * _PI * (y + h)) - np.cos(2 * _PI * y)) / (2 * _PI)  # integral of sin 2 pi y
    edge_z = -(np.cos(2 * _PI * (z + h)) - np.cos(2 * _PI * z)) / (2 * _PI)

    def along_y(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return edge_y * (np.cos(2 * _PI * x) * np.sin(_PI * z) ** 2 + np.cos(2 * _PI * z)) / (2 * _PI)

    def along_z(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -edge_z * np.cos(2 * _PI * x) * np.sin(_PI * y) ** 2 / (2 * _PI)

    volume = h**3
    return ((along_y(x, z) + along_z(x, y + h) - along_y(x, z + h) - along_z(x, y)) / volume,
            (along_z(x, y) - along_z(x + h, y)) / volume,
            (along_y(x + h, z) - along_y(x, z)) / volume)


def reversed_sweeps(h: float, nodes: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the exact volume per time (in cells) through the low faces, stream function of Basilisk's reversed.c.

    psi = 1.5 sin(pi x) sin(pi y) / pi on the unit square, u = d psi / dy, v = -d psi / dx.
    """
    x, y, z = nodes

    def stream(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 1.5 * np.sin(_PI * x) * np.sin(_PI * y) / _PI + 0.0 * z

    return (stream(x, y + h) - stream(x, y)) / h**2, -(stream(x + h, y) - stream(x, y)) / h**2, 0.0 * (x + y + z)


def disc_fractions(x: np.ndarray, y: np.ndarray, h: float, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Return the share of each square cell (low corner x, y) that a disc covers, to about 1e-6 (midpoint rule)."""
    samples = 400
    share = np.zeros(np.broadcast(x, y).shape)
    low = (y - centre[1]) / h
    for i in range(samples):
        across = x + (i + 0.5) / samples * h - centre[0]
        half = np.sqrt(np.maximum(radius**2 - across**2, 0.0)) / h
        share += np.clip(half - low, 0.0, 1.0) - np.clip(-half - low, 0.0, 1.0)
    return share / samples


def _advect(setup: Setup, sweeps: Sweeps, h: float, path: float, step: float) -> None:
    """Carry the material out and back; ``path``: integral of the field's time factor over the way out.

    Every step has the same Courant number, as a solver chooses them from the velocity of the moment: ``step`` is its
    share of the path. Where the factor is small the steps in time are long.
    """
    state = setup.state
    rates = sweeps(h, tuple(h * c for c in node_coordinates(state)))
    one_way = max(1, math.ceil(path / step))
    for number in range(2 * one_way):
        state.update_activity()
        setup.clock.active_cell_steps += state.active_cells()
        share = (path if number < one_way else -path) / one_way
        for name, rate in zip(SWEEP, rates):
            state.views[name][...] = share * rate
        remap_all(state, setup.model, number, setup.ledger)
    setup.clock.steps = 2 * one_way


def _rows(level: float, h: float, setup: Setup, before: np.ndarray, watch: Stopwatch, bar: float | None,
          published: float | None, thickness: float) -> Iterator[Measured]:
    state = setup.state
    after, mass = state.owned("volume_fraction"), state.owned("mass")
    change, start, end, carried = sample.sums([np.abs(after - before).sum(), before.sum(), after.sum(), mass.sum()])
    over = float(sample.largest(mass.max(initial=0.0))) - 1.0
    spent = sample.cost(setup.clock, watch)
    per_cell = h**3 / thickness
    dx = setup.model.dx
    yield Measured("E1", level, dx, change * per_cell, published, change * per_cell, bar, **spent)
    yield Measured("volume", level, dx, end * per_cell, start * per_cell, abs(end / start - 1.0), ROUND_OFF,
                   compares=False, **spent)
    off = float(np.maximum(abs(carried / start - 1.0), over))
    yield Measured("mass", level, dx, carried * per_cell, start * per_cell, off, ROUND_OFF, compares=False, **spent)


def _of(options: Options, number: float | None) -> float | None:
    """Return a published number or a bar on it; None where the options are of another problem."""
    return number if options.as_published() else None


def _leveque(options: Options) -> Iterator[Measured]:
    for level in options.levels:
        cells = round(level)
        h = 1.0 / cells
        model = make_model(h, overrides=options.overrides)
        warm_up(model)
        watch = Stopwatch()
        setup = make_setup((cells, cells, cells), model, [(0.35 * cells,) * 3 + (0.15 * cells,)], sides=ALL_SYMMETRY)
        before = setup.state.owned("volume_fraction").copy()
        _advect(setup, leveque_sweeps, h, options["period"] / _PI, options["courant"] * h / 2.0)
        bar, published = LEVEQUE_BAR.get(cells), LEVEQUE_PUBLISHED.get(cells)
        yield from _rows(level, h, setup, before, watch, *(_of(options, n) for n in (bar, published)), 1.0)


def _reversed(options: Options) -> Iterator[Measured]:
    for level in options.levels:
        cells = round(level)
        h = 1.0 / cells
        model = make_model(h, overrides=options.overrides)
        warm_up(model)
        watch = Stopwatch()
        setup = make_setup((cells, cells, THIN), model, sides=ALL_SYMMETRY)
        state = setup.state
        x, y = (h * (c - 0.5) for c in cell_coordinates(state)[:2])
        share = disc_fractions(x, y, h, DISC, DISC_RADIUS)
        for name in ("mass", "volume_fraction"):
            state.views[name][...] = share
        state.exchange(state.ghosted)
        setup.activate()
        before = state.owned("volume_fraction").copy()
        published = _of(options, REVERSED_PUBLISHED.get(cells))
        _advect(setup, reversed_sweeps, h, options["period"] / _PI, options["courant"] * h / 1.5)
        yield from _rows(level, h, setup, before, watch, 1.2 * published if published else None, published, THIN * h)


CASES = (
    Case("vof-leveque", """Sphere in the 3-D deformation field of LeVeque, the solver's PLIC remap
Sphere of radius 0.15 at (0.35, 0.35, 0.35) in the unit cube, stretched and brought back; exact face volumes from a
vector potential. Error of E1: the volume of the difference to the start, not normalised; the reference is plicRDF's
(TwoPhaseFlow, 2022). Volume and mass: relative change, and mass in any cell over that of a full one.""",
         _leveque, (16, 24, 32), (32, 64, 128), {"courant": Setting("0.5", most=1.0), "period": Setting("3")}, 4,
         whole=True),
    Case("vof-vortex", """Disc in a reversed 2-D vortex, the solver's PLIC remap
Disc of radius 0.2 in the unit square, stretched into a spiral and brought back (T = 15), as Basilisk's test reversed.c,
whose split PLIC gives the reference. Error of E1: the area of the difference to the start, not normalised;
at most 1.2 times the reference. Volume and mass as in vof-leveque.""",
         _reversed, (16, 32, 64), (32, 64, 128), {"courant": Setting("0.5", most=1.0), "period": Setting("15")}, 4,
         whole=True),
)
