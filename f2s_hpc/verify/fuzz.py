"""Random small scenes, each drawn from a seed, run to their end under :mod:`f2s_hpc.verify.watch`.

What a scene may ask for is drawn from its allowed range, hence also much that nobody would ask for; not drawn are
files, laws of speed, jets, what is written, and dwells. What the check of the scene refuses counts as refused; nothing
else may end otherwise than stable or with a clear reason.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import numpy as np

from f2s_hpc.config.sections import Numerics
from f2s_hpc.grid.box import SIDES
from f2s_hpc.materials import library
from f2s_hpc.verify.watch import Outcome, run_scene

MOST_CELL_STEPS = 1.5e6
"""Cells times sound crossings of a cell: what a scene may cost; longer ones are shortened."""


def _generator(*seeds: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seeds)))


def _cell_size(draw: np.random.Generator) -> float:
    """Return the cell size (m) of a scene: the first that is drawn for it."""
    return float(10.0 ** draw.uniform(-6.5, -5.0))


def scene_text(seed: int, index: int) -> str:
    """Return the TOML text of scene ``index`` of ``seed``: the same text for the same two numbers, on any machine."""
    draw = _generator(seed, index)
    cell = _cell_size(draw)
    cells = draw.integers(3, 17, size=3)
    cells[2] = draw.integers(8, 25)
    if draw.random() < 0.1:
        cells[draw.integers(0, 2)] = draw.integers(1, 3)
    size = cells * cell
    substrate = float(draw.choice([0.0, draw.uniform(0.0, 0.6)])) * size[2]
    layer = (size[2] - substrate) * float(draw.uniform(0.5, 1.0))
    speed = float(10.0 ** draw.uniform(1.5, 3.3))
    direction = draw.normal(size=3) if draw.random() < 0.4 else np.array([0.0, 0.0, -1.0])
    sound_steps = MOST_CELL_STEPS / float(cells.prod())
    duration = min(float(draw.uniform(0.5, 2.5)) * size[2] / speed, sound_steps * cell / 1e4)
    count = int(draw.integers(1, 3))
    lines = [
        f'title = "fuzz {seed}-{index}"', "[domain]", f"size = {_quantities(size, 'm')}", f'cell_size = "{cell!r} m"',
        f'substrate_height = "{substrate!r} m"', f'particle_layer_height = "{float(layer)!r} m"',
        f"faces = {_faces(draw)}", "[substrate]", f'temperature = "{draw.uniform(50.0, 1000.0):.3f} K"', "[particles]",
        f'flight = "{_flight(seed, index)}"', f'speed = "{speed!r} m/s"',
        f"direction = {[float(d) for d in direction]}",
        f'temperature = "{draw.uniform(77.0, 1340.0):.3f} K"', "[batches]", f"spheres = {_spheres(draw, size, layer)}",
        "[cycles]", f"count = {count}", f'duration = "{duration!r} s"', *_material(draw), *_numerics(draw)]
    return "\n".join(lines) + "\n"


def _flight(seed: int, index: int) -> str:
    """Return how the particles fly, drawn for itself: what else is drawn stays as it was before they could."""
    draw = _generator(seed, index, 1)
    return "ballistic" if draw.random() < 0.6 else "eulerian"


def options(seed: int, index: int) -> list[str]:
    """Return "key.path=value" of what few scenes ask for, for scene ``index`` of ``seed``.

    Drawn for itself, as :func:`_flight`, so that found failures stay the scenes that they were.
    """
    draw = _generator(seed, index, 2)
    chosen = []
    if draw.random() < 0.3:
        chosen += [f"domain.faces.{side}=absorbing" for side in SIDES if draw.random() < 0.4]
    if draw.random() < 0.2:
        chosen.append("numerics.loss_heating=false")
    if draw.random() < 0.3:
        depth = draw.uniform(8.0, 20.0) * _cell_size(_generator(seed, index))
        chosen.append(f"numerics.sleeping_depth={depth!r} m")
    if draw.random() < 0.2:
        chosen.append("output.origin=true")
    if draw.random() < 0.3:
        chosen += [f"particles.temperature_per_diameter={draw.uniform(-5.0, 5.0):.3f} K/um",
                   "particles.temperature_diameter=30 um"]
    return chosen


def _quantities(values: Sequence[float], unit: str) -> str:
    return json.dumps([f"{float(value)!r} {unit}" for value in values])


def _faces(draw: np.random.Generator) -> str:
    kinds = ["symmetry", "fixed", "free", "outflow"]
    drawn = {side: kinds[draw.integers(0, 4)] for side in SIDES if draw.random() < 0.3}
    return "{ " + ", ".join(f'{side} = "{kind}"' for side, kind in drawn.items()) + " }"


def _spheres(draw: np.random.Generator, size: np.ndarray, layer: float) -> str:
    """Return up to four spheres inside the layer that do not overlap; the side walls may cut them."""
    chosen: list[np.ndarray] = []
    for _ in range(int(draw.integers(1, 5))):
        radius = float(draw.uniform(0.08, 0.5)) * min(layer, float(size[:2].max()))
        place = np.array([draw.uniform(0.0, size[0]), draw.uniform(0.0, size[1]), draw.uniform(radius, layer - radius)])
        if all(np.linalg.norm(place - other[:3]) > radius + other[3] for other in chosen):
            chosen.append(np.array([*place, radius]))
    return "[" + ", ".join(_quantities(sphere, "m") for sphere in chosen) + "]"


def _material(draw: np.random.Generator) -> list[str]:
    lines = ["[material]", f'name = "{library.names()[draw.integers(0, len(library.names()))]}"']
    if draw.random() < 0.3:
        lines.append(f"poisson_ratio = {draw.uniform(0.0, 0.49):.4f}")
    if draw.random() < 0.3:
        lines.append(f'spall_pressure = "{10.0 ** draw.uniform(6.0, 11.0):.4g} Pa"')
    if draw.random() < 0.2:
        lines.append(f"taylor_quinney = {draw.uniform(0.0, 1.0):.3f}")
    if draw.random() < 0.2:
        lines.append(f'conductivity = "{10.0 ** draw.uniform(-1.0, 4.0):.4g} W/m/K"')
    return lines


_NUMERICS = {
    "courant": (0.05, 0.9), "remap_courant": (0.05, 0.45), "strain_per_step": (0.01, 1.0),
    "shock_viscosity_linear": (0.0, 0.5), "shock_viscosity_quadratic": (0.0, 3.0), "hourglass": (0.0, 1.0),
    "exchange_strength": (0.0, 0.5), "exchange_mass_limit": (0.0, 1.0), "light_mass_floor": (0.001, 0.9),
    "speed_limit_factor": (1.0, 3.0), "speed_cap_factor": (1.0, 5.0), "largest_strain": (0.05, 2.0),
}


def _bounds(name: str) -> tuple[float, float]:
    """Return the range of a setting: that of the table, cut by what the scene's check allows."""
    low, high = _NUMERICS[name]
    for bound in Numerics.model_fields[name].metadata:
        low = max(low, getattr(bound, "ge", low))
        high = min(high, getattr(bound, "le", high))
    return low, high


def _numerics(draw: np.random.Generator) -> list[str]:
    """Return settings of the scheme: half of the scenes keep the defaults, the rest change about a third of them.

    Half of all take several steps between two remaps, whatever their cells.
    """
    lines = ["[numerics]"]
    if draw.random() >= 0.5:
        lines += [f"{name} = {draw.uniform(*_bounds(name)):.4f}" for name in _NUMERICS if draw.random() < 0.3]
        switches = {"viscous_heating": "false", "conduction": "false", "remap_order": "1"}
        lines += [f"{name} = {value}" for name, value in switches.items() if draw.random() < 0.2]
    return lines + (["steps_per_remap = 8"] if draw.random() < 0.5 else [])


def run(count: int, seed: int = 1, numerics: Sequence[str] = (), first: int = 0,
        report: Callable[[Outcome], None] = lambda outcome: None, plain: bool = False) -> list[Outcome]:
    """Run scenes ``first`` to ``first + count - 1`` of ``seed`` and return the outcomes, the same on every rank.

    ``numerics``: "numerics.KEY=value" for every scene; ``report`` is called with every outcome as it comes; ``plain``:
    without :func:`options`. Collective.
    """
    outcomes = []
    for index in range(first, first + count):
        outcomes.append(run_scene(f"fuzz {seed}-{index}", scene_text(seed, index),
                                  (*([] if plain else options(seed, index)), *numerics)))
        report(outcomes[-1])
    return outcomes
