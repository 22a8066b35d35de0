"""Small boxes for verification cases and tests: state, model and ledger, built as a run builds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles.insert import InsertReport, paint_batch, paint_substrate
from f2s_hpc.cycles.supply import Supply
from f2s_hpc.fields import needed
from f2s_hpc.grid.box import GHOST, SIDES, Box
from f2s_hpc.grid.decomposition import Decomposition
from f2s_hpc.materials.params import Elastic, MieGrueneisen
from f2s_hpc.particles.batch import Batch
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.solver.step import Clock, advance
from f2s_hpc.state import State

ALL_SYMMETRY = dict.fromkeys(SIDES, "symmetry")
NO_SHOCK_VISCOSITY = ("numerics.shock_viscosity_linear=0", "numerics.shock_viscosity_quadratic=0")
STANDARD_SIDES = ALL_SYMMETRY | {"z_low": "fixed", "z_high": "fixed"}

_SCENE = """
title = "a small box"
[domain]
size = ["{side!r} m", "{side!r} m", "{side!r} m"]
cell_size = "{dx!r} m"
substrate_height = "0 m"
particle_layer_height = "{side!r} m"
[material]
name = "{material}"
[particles]
speed = "{speed!r} m/s"
temperature = "298.15 K"
[batches]
spheres = [["0 m", "0 m", "{radius!r} m", "{radius!r} m"]]
[cycles]
count = 1
duration = "1 us"
"""

_WARM: set[tuple[type, type]] = set()


@dataclass
class Setup:
    """A box that can be stepped; ``supply``: where its particles come from, if they fly."""

    state: State
    model: Model
    ledger: Ledger
    clock: Clock = field(default_factory=Clock)
    report: InsertReport | None = None
    supply: Supply | None = None

    def step(self, end: float, most: int | None = None) -> None:
        """Put in what arrives, then step towards ``end`` (s) until the next remap, after ``most`` steps at most."""
        if self.supply is not None:
            self.supply.land()
        advance(self.state, self.model, self.clock, self.ledger, end, most)

    def advance(self, steps: int) -> None:
        """Take ``steps`` time steps of the size that the solver chooses, and end with a remap."""
        end = self.clock.steps + steps
        while self.clock.steps < end:
            self.step(1.0, end - self.clock.steps)

    def advance_to_remap(self) -> int:
        """Step until the next remap is done; return how many steps that took."""
        before = self.clock.steps
        self.step(1.0)
        return self.clock.steps - before

    def advance_to(self, end: float) -> None:
        """Step to the time ``end`` (s) exactly."""
        while self.clock.in_cycle < end * (1.0 - 1e-12):
            self.step(end)

    def activate(self) -> None:
        """Find the active cells anew; call after cells were filled by hand."""
        self.state.everything_active()
        self.state.update_activity()


def make_model(dx: float, material: str = "copper-ge", speed: float = 600.0, overrides: Sequence[str] = (),
               **settings) -> Model:
    """Return the model of a library material with the default settings; ``settings`` replaces some of them.

    ``overrides``: "numerics.KEY=value" or "material.KEY=value", as ``f2s run --set`` takes them; later ones win.
    Raises ``InputError`` for a wrong one.
    """
    # the box of this scene only sets the quanta of the ledger; 1 mm, within the cells that a scene may have
    side = min(max(1e-3, 8.0 * dx), 1000.0 * dx)
    text = _SCENE.format(dx=dx, side=side, radius=0.1 * side, material=material, speed=speed)
    scene = parse_scene(text, "small box", overrides)
    model = build_model(scene)
    return model._replace(settings=model.settings._replace(**settings))


def never_yields(model: Model) -> Model:
    """Return ``model`` with a yield stress that nothing reaches: elastic, and compiled as the plastic one."""
    if isinstance(model.flow, Elastic):
        return model
    return model._replace(flow=model.flow._replace(yield_stress=1e30))


def make_setup(cells: Sequence[int], model: Model, spheres: Sequence[tuple[float, float, float, float]] = (),
               velocity: Sequence[float] = (0.0, 0.0, 0.0), temperature: float = 700.0, substrate: float = 0.0,
               sides: dict[str, str] | None = None, grid: tuple[int, int, int] | None = None) -> Setup:
    """Return a box of ``cells`` with ``spheres`` (x, y, z, r in cells) and a substrate ``substrate`` cells high.

    Spheres move at ``velocity`` (m/s) and have ``temperature`` (K); the substrate is at rest at 298.15 K.
    ``grid``: process grid, chosen by the code if not given. Collective.
    """
    box, sides = Box(tuple(cells), model.dx), sides or STANDARD_SIDES
    fields = needed(isinstance(model.eos, MieGrueneisen), displaced=model.settings.steps_per_remap > 1,
                    absorbing="absorbing" in sides.values())
    state = State(Decomposition(box, grid), sides, fields)
    setup = Setup(state, model, build_ledger(model))
    if substrate > 0.0:
        paint_substrate(state, substrate * model.dx, 298.15)
    if len(spheres):
        columns = np.array(spheres, dtype=float).T * model.dx
        batch = Batch(*(np.ascontiguousarray(column) for column in columns))
        setup.report = paint_batch(state, model, batch, 0.0, tuple(velocity), temperature, setup.ledger, 1)
    setup.activate()
    return setup


def warm_up(model: Model) -> None:
    """Compile, or load, the kernels of the material models of ``model``, so that no wall time holds it. Collective."""
    models = type(model.eos), type(model.flow)
    if models not in _WARM:
        _WARM.add(models)
        cells = (max(8, GHOST * mpi.size()), 8, 8)
        setup = make_setup(cells, model, [(4.0, 4.0, 4.0, 2.0)], (1.0, 1.0, 1.0), 298.15, 1.0)
        setup.advance(2)


def make_block(cells: Sequence[int], model: Model, temperature: float = 298.15,
               sides: dict[str, str] | None = None) -> Setup:
    """Return a box that is full of material at rest, between mirrors on all sides if not said otherwise."""
    setup = make_setup(cells, model, substrate=cells[2], sides=sides or ALL_SYMMETRY)
    setup.state.views["temperature"][...] = temperature
    return setup


def node_coordinates(state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y, z (in cells, global) of all local nodes, broadcastable to node arrays [k, j, i]."""
    x, y, z = (np.arange(n) + o for n, o in zip(state.part.node_shape[::-1], state.part.offset))
    return x[None, None, :].astype(float), y[None, :, None].astype(float), z[:, None, None].astype(float)


def cell_coordinates(state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y, z (in cells, global) of all local cell centres, broadcastable to cell arrays [k, j, i]."""
    x, y, z = (np.arange(n) + o + 0.5 for n, o in zip(state.part.cell_shape[::-1], state.part.offset))
    return x[None, None, :], y[None, :, None], z[:, None, None]
