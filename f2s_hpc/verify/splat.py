"""One sphere on a substrate of the same material, a symmetric quarter: the run, and what is measured on it.

What is particle is known from the carried field ``particle_fraction``, which is kept sharp; all lengths are moments or
column sums of it, so they are finer than a cell.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.fields import ORIGIN
from f2s_hpc.solver.model import Settings
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import Setup
from f2s_hpc.verify.case import Stopwatch
from f2s_hpc.verify.scenes import scene_setup, write_scene

LEAST_SHARE = 0.01
"""Cells with less of the particle do not count in percentiles over its volume, as in the published series."""

MEANS = ("height_start", "height", "width", "crater", "peeq_p95", "peeqvavg_p95", "peeq_mean", "temperature_p95")
"""Fields of :class:`Splat` that a mean over several runs is taken of; its balance is the first one's."""

_FACES = {"x_low": "symmetry", "y_low": "symmetry"}


@dataclass(frozen=True)
class Impact:
    """What is shot at what: material name, diameter (m), speed (m/s), temperatures (K), simulated time (s).

    ``half_width``, ``depth``: quarter's width and substrate's depth in diameters; depth 0: a mirror instead of a
    substrate. The sphere touches the surface.
    """

    material: str
    diameter: float
    speed: float
    temperature: float
    duration: float
    half_width: float = 2.0
    depth: float = 3.0


@dataclass(frozen=True)
class Splat:
    """What a particle became: lengths in m, PEEQ, temperature (K), energy balance, settings of the scheme, cost.

    ``height``, ``width``: axes 2 sqrt(5) sigma of the ellipsoid with the particle's second moments; ``height_start``:
    the same before impact; ``crater``: depth of the interface between particle and substrate below the surface, on
    the axis. ``peeq_p95``, ``temperature_p95``: 95th percentiles of the particle's material; ``peeqvavg_p95``: that of
    PEEQ averaged over the whole cell, where what is not particle counts as zero (Abaqus' PEEQVAVG of an Eulerian part
    that holds the particle alone).
    """

    dx: float
    height_start: float
    height: float
    width: float
    crater: float
    peeq_p95: float
    peeqvavg_p95: float
    peeq_mean: float
    temperature_p95: float
    balance: dict
    settings: Settings
    steps: int
    cell_steps: int
    wall_s: float

    @property
    def cost(self) -> dict:
        """Steps, cell-steps and wall time, as rows take them."""
        return {"steps": self.steps, "cell_steps": self.cell_steps, "wall_s": self.wall_s}

    def flattening(self, cells_per_diameter: float) -> float:
        """Return 1 - height / height_start as a code with ``cells_per_diameter`` cells would tell it from cell centres.

        Moments of cell centres exceed the true ones by dx^2 / 12 (Sheppard); ours are corrected for that.
        """
        rough = 20.0 / 12.0 * (self.height_start / cells_per_diameter) ** 2
        return 1.0 - math.sqrt((self.height**2 + rough) / (self.height_start**2 + rough))


def splat(impact: Impact, cells_per_diameter: float, overrides: Sequence[str] = (), place: float = 0.0) -> Splat:
    """Run an impact and return what it left; collective, the same on every rank.

    ``overrides``: "key.path=value" for the scene; ``place``: how far (in cells, below 1) the surface lies above a face
    of the cells. Raises ``InputError`` and ``UnstableStep``.
    """
    watch = Stopwatch()
    scene, surface = splat_scene(impact, cells_per_diameter, overrides, place)
    setup, substrate_quanta = scene_setup(scene)
    height_start, _ = _axes(setup)
    setup.advance_to(impact.duration)
    height, width = _axes(setup)
    balance = measure.measure_balance(setup.state, setup.model, setup.ledger, substrate_quanta)
    return Splat(setup.model.dx, height_start, height, width, surface - _interface(setup), peeq_p95(setup),
                 peeqvavg_p95(setup), _peeq_mean(setup), _temperature_p95(setup), balance, setup.model.settings,
                 setup.clock.steps, sample.cell_steps(setup.clock), watch.read())


def splat_scene(impact: Impact, cells_per_diameter: float, overrides: Sequence[str] = (),
                place: float = 0.0) -> tuple[Scene, float]:
    """Return the scene of :func:`splat`, and the height of the substrate's surface (m). Raises ``InputError``."""
    dx, radius = impact.diameter / cells_per_diameter, 0.5 * impact.diameter
    wide, deep = math.ceil(impact.half_width * cells_per_diameter), math.ceil(impact.depth * cells_per_diameter)
    above = math.ceil(1.5 * cells_per_diameter) + math.ceil(place)  # room for the rim, which rises beside the sphere
    faces = _FACES if deep else _FACES | {"z_low": "symmetry"}
    scene = write_scene((wide, wide, deep + above), dx, impact.material, impact.speed, impact.duration,
                        spheres=[(0.0, 0.0, radius, radius)], substrate=deep + place, temperature=impact.temperature,
                        faces=faces, overrides=("output.origin=true", *overrides))
    return scene, (deep + place) * dx


def splats(impact: Impact, cells_per_diameter: float, overrides: Sequence[str], places: int) -> list[Splat]:
    """Run an impact at ``places`` even places of its surface between two faces of the cells (a mirror lies on one).

    What comes of it hangs on that place, at six cells per diameter by some per cent; particles of a spray have any.
    """
    return [splat(impact, cells_per_diameter, overrides, n / places) for n in range(places if impact.depth else 1)]


def mean_splat(runs: Sequence[Splat]) -> Splat:
    """Return the mean of runs that differ in their place; steps, cell-steps and wall time are those of all together."""
    total = {name: sum(getattr(run, name) for run in runs) for name in (*MEANS, "steps", "cell_steps", "wall_s")}
    return dataclasses.replace(runs[0], **total | {name: total[name] / len(runs) for name in MEANS})


def _particle_mass(setup: Setup) -> np.ndarray:
    """Return the particle's mass in the owned cells (full cells)."""
    return setup.state.owned("mass") * setup.state.owned(ORIGIN)


def _axes(setup: Setup) -> tuple[float, float]:
    """Return height and width (m) of the ellipsoid with the particle's second moments, 2 sqrt(5) sigma each.

    A quarter lies around the axis x = y = 0, so the horizontal moments are about that axis, halved over x and y.
    """
    mass, part = _particle_mass(setup), setup.state.part
    x, y, z = (np.arange(n) + s + 0.5 for n, s in zip(part.count, part.start))
    across = y[:, None] ** 2 + x[None, :] ** 2
    layers = mass.sum(axis=(1, 2))
    local = np.array([layers.sum(), layers @ z, layers @ z**2, (mass.sum(axis=0) * across).sum()])
    whole, first, second, spread = sum(mpi.all_gather(local))
    grain = 1.0 / 12.0  # cell centres exaggerate each moment by this (Sheppard)
    along = second / whole - (first / whole) ** 2 - grain
    sideways = 0.5 * spread / whole - grain
    # a film within one layer of cells has no height that these could tell
    return tuple(math.sqrt(20.0 * max(float(moment), 0.0)) * setup.model.dx for moment in (along, sideways))


def _interface(setup: Setup) -> float:
    """Return the height (m) of the substrate's surface on the axis: its volume in the column there."""
    part = setup.state.part
    height = 0.0
    if part.start[0] == 0 and part.start[1] == 0:
        fraction, share = setup.state.owned("volume_fraction"), setup.state.owned(ORIGIN)
        height = float((fraction[:, 0, 0] * (1.0 - share[:, 0, 0])).sum())
    return sum(mpi.all_gather(height)) * setup.model.dx


def peeq_p95(setup: Setup) -> float:
    """Return the PEEQ below which 95 % of the particle's mass lies, over the cells that are mostly particle."""
    mass = _particle_mass(setup)
    mostly = setup.state.owned(ORIGIN) > 0.5
    return measure.percentiles(setup.state.owned("peeq")[mostly], mass[mostly], (0.95,))[0]


def particle_cells(setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return the particle's volume fraction in the cells that have ``LEAST_SHARE`` of it, and which cells these are."""
    fraction = setup.state.owned("volume_fraction") * setup.state.owned(ORIGIN)
    cells = fraction >= LEAST_SHARE
    return fraction[cells], cells


def peeqvavg_p95(setup: Setup) -> float:
    """Return the 95th percentile, by the particle's volume, of PEEQ times the particle's volume fraction."""
    fraction, cells = particle_cells(setup)
    return measure.percentiles(fraction * setup.state.owned("peeq")[cells], fraction, (0.95,))[0]


def _temperature_p95(setup: Setup) -> float:
    """Return the 95th percentile, by the particle's volume, of the temperature (K)."""
    fraction, cells = particle_cells(setup)
    return measure.percentiles(setup.state.owned("temperature")[cells], fraction, (0.95,))[0]


def _peeq_mean(setup: Setup) -> float:
    """Return the mean PEEQ of the particle's mass."""
    mass = _particle_mass(setup)
    strained, whole = sum(mpi.all_gather(np.array([(mass * setup.state.owned("peeq")).sum(), mass.sum()])))
    return float(strained / whole)
