"""Elastic standing waves between mirrors, along an axis and along a diagonal of the grid."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc.fields import STRESS, STRESS_PLACES, VELOCITY
from f2s_hpc.kernels.derived import cell_pressure
from f2s_hpc.solver.model import Model
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import (
    NO_SHOCK_VISCOSITY,
    Setup,
    cell_coordinates,
    make_block,
    make_model,
    never_yields,
    node_coordinates,
    warm_up,
)
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import Setting, material

THIN = 3
"""Cells across the directions in which nothing varies."""


class Mode:
    """The lowest longitudinal mode of a box between mirrors, velocity ~ grad(cos k x1 ... cos k xn).

    Superposition of plane waves along the diagonals of the first ``directions`` axes: n = 1 a wave along x, n = 2 waves
    along (1, +-1, 0), n = 3 along (1, +-1, +-1). With V the speed amplitude, e = V k / w and w = c_L k sqrt(n):
    velocity_a = V sin(k x_a) prod_b cos(k x_b) cos(w t), strain_aa = e prod_b cos(k x_b) sin(w t),
    strain_ab = -e sin(k x_a) sin(k x_b) prod_c cos(k x_c) sin(w t), products over the axes not named.
    """

    def __init__(self, setup: Setup, cells: int, directions: int, strain: float) -> None:
        bulk, dx = setup.model.bulk, setup.model.dx
        self.bulk, self.directions = bulk, directions
        self.sound = setup.model.sound
        self.frequency = self.sound * math.pi / (cells * dx) * math.sqrt(directions)
        self.strain = strain
        self.speed = strain * self.sound * math.sqrt(directions)
        wave = math.pi / cells
        nodes, centres = node_coordinates(setup.state), cell_coordinates(setup.state)
        self.node_waves = [(np.sin(wave * x), np.cos(wave * x)) for x in nodes[:directions]]
        self.cell_waves = [(np.sin(wave * x), np.cos(wave * x)) for x in centres[:directions]]

    def velocity(self, axis: int, time: float) -> np.ndarray:
        """Velocity component (m/s) on all local nodes, broadcastable."""
        if axis >= self.directions:
            return np.zeros((1, 1, 1))
        product = functools.reduce(np.multiply, [w[0] if b == axis else w[1] for b, w in enumerate(self.node_waves)])
        return self.speed * product * math.cos(self.frequency * time)

    def stress(self, time: float) -> tuple[np.ndarray, list[np.ndarray]]:
        """Pressure (Pa) and the six deviatoric stresses (Pa) on all local cells, broadcastable."""
        n, shear = self.directions, 2.0 * self.bulk.shear_modulus * self.strain * math.sin(self.frequency * time)
        all_cosines = functools.reduce(np.multiply, [w[1] for w in self.cell_waves])
        deviator = []
        for a, b in STRESS_PLACES:
            if a == b:
                deviator.append(shear * ((1.0 if a < n else 0.0) - n / 3.0) * all_cosines)
            elif max(a, b) >= n:
                deviator.append(np.zeros((1, 1, 1)))
            else:
                parts = [w[0] if c in (a, b) else w[1] for c, w in enumerate(self.cell_waves)]
                deviator.append(-shear * functools.reduce(np.multiply, parts))
        volume = n * self.strain * math.sin(self.frequency * time) * all_cosines
        return -self.bulk.bulk_modulus * volume, deviator


def _errors(setup: Setup, mode: Mode) -> tuple[float, float]:
    """L2 errors of stress and velocity, over the L2 norms of their largest values."""
    state, time = setup.state, setup.clock.in_cycle
    found = np.zeros(state.part.cell_shape)
    cell_pressure(setup.model.eos, state.flat["mass"], state.flat["volume_fraction"], state.energy, found.reshape(-1))
    cells, nodes = state.part.owned_cells, state.part.owned_nodes
    pressure, deviator = mode.stress(time)
    off = [(found - pressure)[cells]]
    off += [(state.views[name] - exact)[cells] for name, exact in zip(STRESS, deviator)]
    peak_time = 0.5 * math.pi / mode.frequency
    peak_pressure, peak_deviator = mode.stress(peak_time)
    all_of = [np.broadcast_to(f, state.part.cell_shape)[cells] for f in (peak_pressure, *peak_deviator)]
    wrong = [(state.views[name] - mode.velocity(a, time))[nodes] for a, name in enumerate(VELOCITY)]
    full = [np.broadcast_to(mode.velocity(a, 0.0), state.part.node_shape)[nodes] for a in range(3)]
    total = sample.sums([sum(float((f * f).sum()) for f in group) for group in (off, all_of, wrong, full)])
    return math.sqrt(total[0] / total[1]), math.sqrt(total[2] / total[3])


def _whole_steps(directions: int, cells: int, courant: float, options: Options) -> int:
    """Return how many steps of one size cover the wanted periods, at least: a period is 2 cells / sqrt(n) crossings."""
    return math.ceil(options["periods"] * 2.0 * cells / math.sqrt(directions) / courant * (1.0 - 1e-9))


def _model(directions: int, cells: int, dx: float, options: Options) -> Model:
    """Return the model, its steps shortened so that every resolution is compared at the same phase of the wave.

    The shared last steps of a cycle would add an error of their own, other phases another share of the amplitude.
    """
    overrides = [*NO_SHOCK_VISCOSITY, *options.overrides]
    model = make_model(dx, options["material"], overrides=overrides)
    steps = _whole_steps(directions, cells, model.settings.courant, options)
    courant = options["periods"] * 2.0 * cells / math.sqrt(directions) / steps
    return never_yields(make_model(dx, options["material"], overrides=[*overrides, f"numerics.courant={courant!r}"]))


def _run(directions: int, options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        cells = round(level)
        dx = options["length"] / cells
        model = _model(directions, cells, dx, options)
        warm_up(model)
        watch = Stopwatch()
        setup = make_block([cells if axis < directions else THIN for axis in range(3)], model)
        mode = Mode(setup, cells, directions, options["strain"])
        for axis, name in enumerate(VELOCITY):
            setup.state.views[name][...] = mode.velocity(axis, 0.0)
        setup.state.boundary.hold([setup.state.views[name] for name in VELOCITY])
        setup.state.exchange(VELOCITY)
        setup.advance(_whole_steps(directions, cells, model.settings.courant, options))
        errors = _errors(setup, mode)
        spent = sample.cost(setup.clock, watch)
        for quantity, error in zip(("stress, L2", "velocity, L2"), errors):
            yield Measured(quantity, level, dx, error, 0.0, error, least_order=1.8 if number else None, **spent)


_TEXT = """{first}
The lowest standing mode between mirrors, elastic, so weak (strain 1e-6) that the linear solution is exact to 1e-6;
error: L2 norm of the difference over the L2 norm of the amplitude.
Shock viscosity off, as it acts on any compression and is of first order in dx by design; hourglass control on."""
_SETTINGS = {"length": Setting("0.1 mm", "length"), "strain": Setting("1e-6"), "periods": Setting("1.125"),
             "material": material("copper-ge")}
_LEAST = 4

CASES = (
    Case("elastic-wave", _TEXT.format(first="Longitudinal elastic wave along x against the linear solution"),
         functools.partial(_run, 1), (12, 24, 48), (16, 32, 64, 128), _SETTINGS, _LEAST, whole=True),
    Case("elastic-wave-diagonal",
         _TEXT.format(first="Longitudinal elastic waves along the diagonals (1, +-1, 0) against the linear solution"),
         functools.partial(_run, 2), (12, 24, 48), (16, 32, 64, 128), _SETTINGS, _LEAST, whole=True),
)
