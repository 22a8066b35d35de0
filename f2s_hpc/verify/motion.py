"""Rigid motion and rotation of stress: free flight, a rotating pre-stressed block, simple shear."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.errors import InputError
from f2s_hpc.fields import STRESS, STRESS_PLACES, VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.materials.flow_stress import flow_stress
from f2s_hpc.solver import lagrange
from f2s_hpc.solver.model import Model
from f2s_hpc.solver.remap import remap_all
from f2s_hpc.state import State
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import (
    ALL_SYMMETRY,
    Setup,
    cell_coordinates,
    make_block,
    make_model,
    make_setup,
    never_yields,
    node_coordinates,
    warm_up,
)
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import TEXT, Setting, material

THIN = 3
DIRECTIONS = ((0.0, 0.0, -1.0), (1.0, 1.0, -1.0), (1.0, 0.0, 0.0), (1.0, 2.0, 3.0))
_STRESS_TENSOR = np.array([[1.0, 0.5, 0.0], [0.5, -0.4, 0.0], [0.0, 0.0, -0.6]])
_FLIGHT = {"velocity": 1e-9, "stress": 1e-9, "temperature": 1e-9, "PEEQ": 0.0, "mass": 1e-12}
"""What a flight must not change, and the bars."""

_CENTROID = "centroid (cells)"
_EIGHTH = "components after an eighth of a turn, L1"
_MARGIN = 4.0
"""Cells between a flying sphere and the sides of its box."""


# --- free flight -------------------------------------------------------------------------------------


def _directions(text: float | str, number: int, full: bool) -> list[np.ndarray]:
    """Return unit vectors: all standard directions (quick: the one of this resolution), or that written as "1,2,-3"."""
    if text == "all":
        chosen = [np.array(d) for d in (DIRECTIONS if full else DIRECTIONS[number % 3:number % 3 + 1])]
    else:
        try:
            chosen = [np.array([float(part) for part in str(text).split(",")])]
        except ValueError:
            chosen = []
        if not chosen or chosen[0].size != 3 or not 0.0 < np.linalg.norm(chosen[0]) < math.inf:
            raise InputError(f'--set direction={text}: write "all", or three numbers as in "1,2,-3"')
    return [d / np.linalg.norm(d) for d in chosen]


def _check_direction(options: Options) -> None:
    _directions(options["direction"], 0, options.full)


def _fly(model: Model, direction: np.ndarray, diameter: float, options: Options) -> tuple[Setup, np.ndarray]:
    """Fly a sphere of ``diameter`` cells; return the setup and what changed, in the order of ``_FLIGHT``.

    And last, how far the centroid is from where the flight leads (cells).
    """
    path = options["distance"] * direction
    low = np.minimum(path, 0.0) - 0.5 * diameter - _MARGIN
    high = np.maximum(path, 0.0) + 0.5 * diameter + _MARGIN
    # off the grid, so that no cell face or node is special
    start = -low + np.array([0.31, 0.17, 0.43])
    cells = [math.ceil(n) + 1 for n in high - low]
    temperature, velocity = options["temperature"], options["speed"] * direction
    setup = make_setup(cells, model, [(*start, 0.5 * diameter)], velocity, temperature)
    state = setup.state
    before, came_from = sample.sums([state.owned("mass").sum()])[0], _centroid(setup)
    setup.advance_to(options["distance"] * model.dx / options["speed"])
    matter = state.owned("mass") > 0.0
    heavy = state.owned("nodal_mass") > 1e-9
    limit = flow_stress(model.flow, 0.0, 0.0, temperature)[0]
    after = sample.sums([state.owned("mass").sum()])[0]
    changes = [
        np.max([np.abs(state.owned(n)[heavy] - v).max(initial=0.0) for n, v in zip(VELOCITY, velocity)])
        / options["speed"],
        np.max([np.abs(state.owned(n)).max(initial=0.0) for n in STRESS]) / limit,
        np.abs(state.owned("temperature")[matter] - temperature).max(initial=0.0) / temperature,
        np.abs(state.owned("peeq")).max(initial=0.0),
        abs(after / before - 1.0),
        np.abs(_centroid(setup) - came_from - path).max(),
    ]
    return setup, sample.largest(changes)


def _owned_centres(state: State) -> list[np.ndarray]:
    """Return x, y, z (in cells) of the centres of this rank's own cells, each [k, j, i]."""
    return [np.broadcast_to(c, state.part.cell_shape)[state.part.owned_cells] for c in cell_coordinates(state)]


def _centroid(setup: Setup) -> np.ndarray:
    """Return the centre of mass of all material (x, y, z in cells)."""
    state = setup.state
    mass = state.owned("mass")
    total, *moments = sample.sums([mass.sum(), *((mass * place).sum() for place in _owned_centres(state))])
    return np.array(moments) / total


def _free_flight(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        model = make_model(options["diameter"] / level, options["material"], options["speed"], options.overrides)
        warm_up(model)
        watch, worst, steps, cell_steps = Stopwatch(), np.zeros(len(_FLIGHT) + 1), 0, 0
        for direction in _directions(options["direction"], number, options.full):
            setup, changes = _fly(model, direction, level, options)
            worst = np.maximum(worst, changes)
            steps, cell_steps = steps + setup.clock.steps, cell_steps + sample.cell_steps(setup.clock)
        spent = {"steps": steps, "cell_steps": cell_steps, "wall_s": watch.read()}
        for (name, bar), change in zip(_FLIGHT.items(), worst):
            yield Measured(name, level, model.dx, float(change), 0.0, float(change), bar, compares=False, **spent)
        # the reconstruction of the surface moves it, but less and less; other directions at each size do not compare
        compares = options.full or options["direction"] != "all"
        yield Measured(_CENTROID, level, model.dx, float(worst[-1]), 0.0, float(worst[-1]), compares=compares,
                       least_order=1.0 if compares and number else None, **spent)


# --- rotating block ----------------------------------------------------------------------------------


def _pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the factor of the pre-stress at x, y in block widths from its centre."""
    return 1.0 + 0.5 * np.cos(2.0 * math.pi * x) * np.cos(2.0 * math.pi * y)


def _rotating_block(model: Model, width: int, amplitude: float) -> tuple[Setup, list[np.ndarray]]:
    """Return a square block ``width`` cells wide in a wide enough box, and where its nodes and cells are."""
    box = math.ceil(math.sqrt(2.0) * width) + 8
    box += (box - width) % 2
    setup = make_setup((box, box, THIN), model, sides=ALL_SYMMETRY)
    state = setup.state
    x, y, _ = (np.broadcast_to(c - 0.5 * box, state.part.cell_shape) for c in cell_coordinates(state))
    inside = (np.abs(x) < 0.5 * width) & (np.abs(y) < 0.5 * width)
    for name, value in (("mass", 1.0), ("volume_fraction", 1.0), ("temperature", 298.15)):
        state.views[name][inside] = value
    factor = amplitude * _pattern(x / width, y / width)
    for name, place in zip(STRESS, STRESS_PLACES):
        state.views[name][...] = np.where(inside, factor * _STRESS_TENSOR[place], 0.0)
    state.exchange(state.ghosted)
    setup.activate()
    nodes = [np.broadcast_to(c - 0.5 * box, state.part.node_shape) for c in node_coordinates(state)[:2]]
    return setup, nodes


def _turn(setup: Setup, nodes: list[np.ndarray], angle: float, steps: range) -> None:
    """Turn the block by ``angle`` in each of the ``steps``, numbered from the start.

    The velocity is prescribed before every step, the solver strains the cells and remaps them.
    It leads each node along the chord to where the turn takes it, as the velocity of mid-step does in a turning body.
    """
    state, model = setup.state, setup.model
    dt = 1e-9
    less, sine = math.cos(angle) - 1.0, math.sin(angle)
    speed = model.dx / dt
    rotation = [speed * (less * nodes[0] - sine * nodes[1]), speed * (sine * nodes[0] + less * nodes[1])]
    for number in steps:
        state.update_activity()
        setup.clock.active_cell_steps += state.active_cells()
        for name, component in zip(VELOCITY, rotation):
            state.views[name][...] = component
        lagrange.deform(state, model, dt, setup.ledger)
        remap_all(state, model, number, setup.ledger)
    setup.clock.steps = steps.stop


def _invariants(stress: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return von Mises stress and the cube root of the third invariant (determinant) of a deviator."""
    xx, yy, zz, xy, yz, xz = stress
    mises = np.sqrt(1.5 * (xx**2 + yy**2 + zz**2 + 2.0 * (xy**2 + yz**2 + xz**2)))
    third = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return mises, np.cbrt(third)


def _off_turned(setup: Setup, width: int, amplitude: float, angle: float) -> np.ndarray:
    """Return the L1 norm of the stress less the pre-stress turned by ``angle``, R S R^T, and that of the latter.

    Over all components, in cells at least half full whose material was inside the block.
    """
    state = setup.state
    box = state.part.box.cells[0]
    x, y, _ = (c - 0.5 * box for c in _owned_centres(state))
    cosine, sine = math.cos(angle), math.sin(angle)
    # where this material was
    x, y = cosine * x + sine * y, cosine * y - sine * x
    inside = (np.maximum(np.abs(x), np.abs(y)) < 0.5 * width) & (state.owned("mass") >= 0.5)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    turned, factor = turn @ _STRESS_TENSOR @ turn.T, amplitude * _pattern(x / width, y / width)
    off, whole = 0.0, 0.0
    for name, place in zip(STRESS, STRESS_PLACES):
        exact, twice = factor * turned[place], 1.0 if place[0] == place[1] else 2.0
        off += twice * np.abs(state.owned(name) - exact)[inside].sum()
        whole += twice * np.abs(exact)[inside].sum()
    return sample.sums([off, whole])


def _rotation(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        width = round(level)
        model = make_model(options["width"] / width, options["material"], overrides=options.overrides)
        model = never_yields(model)
        warm_up(model)
        watch = Stopwatch()
        setup, nodes = _rotating_block(model, width, model.bulk.shear_modulus)
        state = setup.state
        start = [state.owned(name).copy() for name in (*STRESS, "mass")]
        steps = math.ceil(2.0 * math.pi * (width / math.sqrt(2.0)) / options["courant"])
        angle, eighth = 2.0 * math.pi / steps, round(steps / 8)
        _turn(setup, nodes, angle, range(eighth))
        # after a whole turn stress that was not turned would be right too
        off, whole = _off_turned(setup, width, model.bulk.shear_modulus, eighth * angle)
        _turn(setup, nodes, angle, range(eighth, steps))
        end = [state.owned(name) for name in (*STRESS, "mass")]
        body = start[6] > 0.0
        before, after = _invariants(start[:6]), _invariants(end[:6])
        # where the block is and was: shape errors of its edge are another matter, shown by themselves
        both = body & (end[6] >= 0.5)
        shares = [np.abs(a - b)[both].sum() for a, b in zip(after, before)]
        shares += [np.abs(b)[both].sum() for b in before]
        shares += [np.abs(end[6] - start[6]).sum(), start[6].sum(), end[6].sum()]
        total = sample.sums(shares)
        setup.clock.steps = steps
        spent = sample.cost(setup.clock, watch)
        errors = (*(total[:2] / total[2:4]), off / whole)
        for quantity, error in zip(("von Mises stress, L1", "third invariant, L1", _EIGHTH), errors):
            yield Measured(quantity, level, model.dx, float(error), 0.0, float(error),
                           least_order=1.0 if number else None, **spent)
        yield Measured("shape, L1", level, model.dx, float(total[4] / total[5]), 0.0, float(total[4] / total[5]),
                       **spent)
        yield Measured("mass", level, model.dx, total[6], total[5], abs(total[6] / total[5] - 1.0), 1e-12,
                       compares=False, **spent)


# --- simple shear ------------------------------------------------------------------------------------


def few_cells(model: Model, temperature: float = 298.15) -> Setup:
    """Return a full block of three cells each way for every rank."""
    return make_block((GHOST * mpi.size(), THIN, THIN), model, temperature)


def shear_step(setup: Setup, rate: float, dt: float) -> None:
    """Shear all cells by ``rate`` (1/s, u = rate y) for one Lagrangian step of ``dt`` (s); nothing is remapped."""
    state, model = setup.state, setup.model
    _, y, _ = node_coordinates(state)
    state.views["velocity_x"][...] = rate * model.dx * y
    lagrange.deform(state, model, dt, setup.ledger)
    setup.clock.active_cell_steps += state.active_cells()
    setup.clock.steps += 1


def _simple_shear(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        model = never_yields(make_model(1e-6, options["material"], overrides=options.overrides))
        warm_up(model)
        watch = Stopwatch()
        setup = few_cells(model)
        state, shear = setup.state, model.bulk.shear_modulus
        step, worst = 1.0 / level, np.zeros(3)
        for n in range(1, math.ceil(options["shear"] / step) + 1):
            shear_step(setup, 1e9, step * 1e-9)
            exact = (1.0 - math.cos(n * step), math.cos(n * step) - 1.0, math.sin(n * step))
            off = [np.abs(state.owned(name) / shear - value).max(initial=0.0)
                   for name, value in zip(("stress_xx", "stress_yy", "stress_xy"), exact)]
            worst = np.maximum(worst, off)
        worst = sample.largest(worst)
        spent = sample.cost(setup.clock, watch)
        finest = number == len(options.levels) - 1
        for quantity, error in zip(("stress xx", "stress yy", "stress xy"), worst):
            yield Measured(quantity, level, step, float(error), 0.0, float(error), 1e-6 if finest else None, **spent)


CASES = (
    Case("free-flight", """Sphere flying 100 cells in any direction: nothing may change
Largest change of any node or cell after the flight: velocity over the speed, stress over the yield stress, temperature
and mass relative, PEEQ; and how far the centroid is from where the flight leads, in cells. The full solver; bars are
round-off, and for the centroid, where all resolutions fly alike, that it falls with order 1 or better: each
reconstruction of the surface moves it. Full size: the worst of four directions; quick: -z, (1, 1, -1), x, one at each
resolution.""",
         _free_flight, (4, 5, 7), (5, 8, 12),
         {"speed": Setting("2000 m/s", "speed"), "temperature": Setting("450 degC", "temperature"),
          "distance": Setting("100"), "diameter": Setting("25 um", "length"), "direction": Setting("all", kind=TEXT),
          "material": material("copper-ge")}, 1, check=_check_direction),
    Case("rotating-block", """Pre-stressed block after one turn: the invariants of its stress; its components on the way
A square block with a smooth pre-stress (factor 1 to 1.5 of a constant deviator) is turned once about z; velocity
prescribed along the chords of the turn, the solver's strain, stress update and remap do the rest. L1 error of the
invariants over their L1 norm in cells that hold material before and after; and after an eighth of the turn (to a whole
step) of all components against the turned pre-stress R S R^T, over its L1 norm. The pre-stress is as large as the shear
modulus: the update is linear in it, and so what is left of strain in a step stays a small part.""",
         _rotation, (12, 24, 36), (16, 32, 64, 128),
         {"width": Setting("0.1 mm", "length"), "courant": Setting("0.2", most=0.5), "material": material("copper-ge")},
         4, whole=True),
    Case("simple-shear", """Elastic simple shear with the Jaumann rate against the closed form
s_xy = G sin(gamma), s_xx = -s_yy = G (1 - cos(gamma)), the largest difference over G on the way; one Lagrangian
step after another, no remap. "cells" and "dx" stand for steps per unit shear and shear per step; bar at the finest.""",
         _simple_shear, (100, 300, 1000), (100, 300, 1000, 3000), {"shear": Setting("3.5"),
         "material": material("copper-ge")}, whole=True),
)
