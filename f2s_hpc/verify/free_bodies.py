"""Bodies in free space: what turns keeps its spin, and a collision is the same in every frame."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc.analysis.depth import weighted_percentiles
from f2s_hpc.cycles.insert import paint_batch
from f2s_hpc.fields import VELOCITY
from f2s_hpc.grid.box import SIDES
from f2s_hpc.particles.batch import Batch
from f2s_hpc.solver.model import Model
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import Setup, make_model, make_setup, never_yields, node_coordinates, warm_up
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.setting import Setting, material

OPEN = dict.fromkeys(SIDES, "free")
_MARGIN = 5
"""Cells between a body and the sides of its box."""

_OFF_GRID = np.array([0.31, 0.17, 0.43])
"""Part of a cell by which a body's centre is off the nodes, so that no face or node is special."""

_SPIN_BAR = 0.1
"""Largest share of its angular momentum that a sphere may lose in a turn, at any size."""

RESOLVED, _EXTENT_BAR, _MEAN_BAR = 12.0, 0.01, 0.02
"""Cells per diameter from which on a frame must not change extents and mean PEEQ by more than these shares."""


# --- spin -------------------------------------------------------------------------------------------------------


def _spinning_sphere(model: Model, level: float, rim_speed: float) -> tuple[Setup, np.ndarray]:
    """Return a sphere of ``level`` cells that turns about z, and its centre (cells)."""
    cells = math.ceil(level) + 2 * _MARGIN
    centre = 0.5 * cells + _OFF_GRID
    setup = make_setup((cells, cells, cells), model, [(*centre, 0.5 * level)], sides=OPEN)
    x, y, _ = node_coordinates(setup.state)
    rate = rim_speed / (0.5 * level)  # per cell of distance
    there = _nodal_mass(setup) > 0.0
    for name, velocity in (("velocity_x", -rate * (y - centre[1])), ("velocity_y", rate * (x - centre[0]))):
        setup.state.views[name][...] = np.where(there, velocity, 0.0)
    setup.clock.limits.put_in(rim_speed, model.dx)
    return setup, centre


def _nodal_mass(setup: Setup) -> np.ndarray:
    """Return the mass of the local nodes (in full ones): an eighth of each of their cells."""
    around = np.pad(setup.state.views["mass"], 1)
    a, b, c = setup.state.part.node_shape
    return 0.125 * sum(around[k:k + a, j:j + b, i:i + c] for k in (0, 1) for j in (0, 1) for i in (0, 1))


def _spin(setup: Setup, centre: np.ndarray) -> float:
    """Return the angular momentum about the axis along z through ``centre`` (full nodes times cells times m/s)."""
    state = setup.state
    x, y, _ = node_coordinates(state)
    u, v, _ = (state.views[name] for name in VELOCITY)
    moment = _nodal_mass(setup) * ((x - centre[0]) * v - (y - centre[1]) * u)
    return float(sample.sums([moment[state.part.owned_nodes].sum()])[0])


def _run_spin(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        model = never_yields(make_model(options["diameter"] / level, options["material"], options["speed"],
                                        options.overrides))
        warm_up(model)
        watch = Stopwatch()
        setup, centre = _spinning_sphere(model, level, options["speed"])
        before = _spin(setup, centre)
        setup.advance_to(options["turns"] * math.pi * options["diameter"] / options["speed"])
        lost = 1.0 - _spin(setup, centre) / before
        yield Measured("angular momentum lost", level, model.dx, lost, 0.0, abs(lost), _SPIN_BAR * options["turns"],
                       least_order=1.0 if number else None, **sample.cost(setup.clock, watch))


# --- frames -----------------------------------------------------------------------------------------------------


def _collision(model: Model, level: float, options: Options, frame: float) -> Setup:
    """Let two spheres collide along x, seen from a frame in which their centre moves at ``frame`` (m/s)."""
    half, way = 0.5 * options["speed"], frame * options["duration"] / model.dx
    width, room = math.ceil(2.5 * level) + 2 * _MARGIN, math.ceil(2.0 * level) + 2 * _MARGIN
    start = np.array([0.5 * width, 0.5 * room, 0.5 * room]) + _OFF_GRID
    x = np.array([start[0] - 0.5 * level, start[0] + 0.5 * level])
    setup = make_setup((width + math.ceil(way), room, room), model, sides=OPEN)
    y, z, r = (np.full(2, value) for value in (start[1], start[2], 0.5 * level))
    velocity = np.array([[frame + half, 0.0, 0.0], [frame - half, 0.0, 0.0]])
    batch = Batch(*(column * model.dx for column in (x, y, z, r)), velocity)
    paint_batch(setup.state, model, batch, 0.0, (0.0, 0.0, 0.0), options["temperature"], setup.ledger, 1)
    setup.activate()
    setup.clock.limits.put_in(frame + half, model.dx)
    setup.advance_to(options["duration"])
    return setup


def _shape(setup: Setup) -> dict[str, float]:
    """Return the extents (root mean square, cells) along x and y, and mean and 95th percentile of PEEQ, by mass."""
    state = setup.state
    mass, peeq = state.owned("mass"), state.owned("peeq")
    _, j, i = np.indices(mass.shape)
    x, y = i + state.part.start[0], j + state.part.start[1]
    whole, *moments = sample.sums([float((mass * value).sum()) for value in (1.0, x, x * x, y, y * y, peeq)])
    x1, x2, y1, y2, mean = np.array(moments) / whole
    there = mass > 0.0
    pieces = sample.gathered(np.stack([peeq[there], mass[there]], axis=1))
    p95 = float(weighted_percentiles(pieces[:, 0], pieces[:, 1], (0.95,))[0])
    return {"extent along": math.sqrt(x2 - x1 * x1), "extent across": math.sqrt(y2 - y1 * y1), "PEEQ mean": mean,
            "PEEQ p95": p95}


def _run_frames(options: Options) -> Iterator[Measured]:
    bars = {"extent along": _EXTENT_BAR, "extent across": _EXTENT_BAR, "PEEQ mean": _MEAN_BAR}
    for level in options.levels:
        model = make_model(options["diameter"] / level, options["material"], options["speed"], options.overrides)
        warm_up(model)
        watch = Stopwatch()
        moving, resting = (_collision(model, level, options, frame) for frame in (0.5 * options["speed"], 0.0))
        spent, reference = sample.cost(moving.clock, watch), _shape(resting)
        for name, value in _shape(moving).items():
            bar = bars.get(name) if level >= RESOLVED else None
            off = abs(value - reference[name])
            yield Measured(name, level, model.dx, value, reference[name], off / reference[name] if off else 0.0, bar,
                           **spent)


CASES = (
    Case("spinning-sphere", """Elastic sphere that turns in free space: angular momentum lost
A sphere that never yields, set off as a rigid body about z through its centre; what is left of its angular momentum
after a part of a turn. Nothing acts on it, so all must be left. The remap takes some; bars: 10 % in a turn, order 1.
(The exchange between light nodes takes none: what a pair shares lies along the line between them.)""",
         _run_spin, (8, 12, 16), (8, 12, 16, 24),
         {"diameter": Setting("25 um", "length"), "speed": Setting("50 m/s", "speed"),
          "turns": Setting("0.25", above=0.0), "material": material("copper-ge")}, 4),
    Case("moving-frame", """Two spheres collide, seen by one of them and from their centre: shape and PEEQ
In one frame one sphere is at rest and the other comes at the whole speed, in the other each comes at half of it; the
reference is the latter. What moves is remapped more, so what has steep gradients smears more. Extents: root mean square
of the distance of the material from its centre, along the line of impact and across, in cells; bars from 12 cells per
diameter on.""",
         _run_frames, (8, 12, 16), (8, 12, 16, 24),
         {"diameter": Setting("25 um", "length"), "speed": Setting("500 m/s", "speed"),
          "temperature": Setting("450 degC", "temperature"), "duration": Setting("60 ns", "time"),
          "material": material("copper-ge")}, 4),
)
