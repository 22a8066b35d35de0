"""Scenes that verification cases write themselves, and the boxes they become."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from f2s_hpc import mpi
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.config.load import parse_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import paint_batch, paint_substrate
from f2s_hpc.cycles.supply import Supply
from f2s_hpc.particles.plan import BatchPlan, make_batches
from f2s_hpc.verify.box import Setup

_SCENE = """
title = "a verification case"
[domain]
size = [{size}]
cell_size = "{dx!r} m"
substrate_height = "{substrate!r} m"
particle_layer_height = "{layer!r} m"
[domain.faces]
{faces}
[material]
name = "{material}"
[particles]
speed = "{speed!r} m/s"
temperature = "{temperature!r} K"
[batches]
spheres = [{spheres}]
[cycles]
count = 1
duration = "{duration!r} s"
"""

Sphere = tuple[float, float, float, float]


def write_scene(cells: Sequence[int], dx: float, material: str, speed: float, duration: float, *,
                spheres: Sequence[Sphere], substrate: float = 0, temperature: float = 298.15,
                faces: dict[str, str] | None = None, overrides: Sequence[str] = ()) -> Scene:
    """Return the scene of a box of ``cells`` (nx, ny, nz) cells of ``dx`` (m) and one batch of ``spheres``.

    ``spheres``: (x, y, z, r) in metres, z from the top of the substrate, which is ``substrate`` cells high; ``speed``
    (m/s) and ``temperature`` (K) are the particles'; ``duration`` in s; ``faces`` replaces the standard sides.
    ``overrides``: "key.path=value", as ``f2s run --set`` takes them. Raises ``InputError`` like ``parse_scene``.
    """
    quoted = ("[" + ", ".join(f'"{float(a)!r} m"' for a in sphere) + "]" for sphere in spheres)
    sides = "\n".join(f'{side} = "{kind}"' for side, kind in (faces or {}).items())
    text = _SCENE.format(
        size=", ".join(f'"{n * dx!r} m"' for n in cells), dx=float(dx), substrate=substrate * dx,
        layer=(cells[2] - substrate) * dx, faces=sides, material=material, speed=float(speed),
        temperature=float(temperature), spheres=", ".join(quoted), duration=float(duration))
    return parse_scene(text, "verification case", overrides)


def empty_setup(scene: Scene) -> Setup:
    """Return the empty box of a scene (collective)."""
    model = build_model(scene)
    return Setup(build_state(scene), model, build_ledger(model))


def scene_setup(scene: Scene) -> tuple[Setup, int]:
    """Return the box of a scene with its substrate and its first batch, as a run begins; collective.

    The second value is the substrate's mass in quanta, as ``measure_balance`` wants it.
    """
    setup = empty_setup(scene)
    state, model = setup.state, setup.model
    paint_substrate(state, scene.domain.substrate_height, scene.substrate.temperature)
    substrate_quanta = measure.material_quanta(state, model)
    batch = mpi.run_together(make_batches, scene).batches[0]
    setup.report = paint_batch(state, model, batch, scene.domain.layer_bottom, scene.particles.velocity,
                               scene.particles.temperature, setup.ledger, scene.batches.seed)
    setup.clock.limits.put_in(scene.top_speed, model.dx)
    setup.activate()
    return setup, substrate_quanta


def prepare(scene: Scene) -> tuple[Setup, BatchPlan]:
    """Return the box of a scene with its substrate, and its batches. Collective; raises ``InputError``."""
    plan = mpi.run_together(make_batches, scene)
    setup = empty_setup(scene)
    paint_substrate(setup.state, scene.domain.substrate_height, scene.substrate.temperature)
    return setup, plan


def run_cycles(scene: Scene, plan: BatchPlan, setup: Setup, run: Callable[[float], None]) -> None:
    """Run all cycles of a scene as ``f2s run`` does, in memory only: the same batches, order, seeds and flight.

    ``run``: called with the duration of each cycle (s) after its batch was put in, or launched. Collective.
    """
    clock = setup.clock
    setup.supply = Supply(scene, plan, setup.state, setup.model, clock, setup.ledger)
    for cycle, duration in enumerate(scene.cycles.durations):
        setup.report, _ = setup.supply.insert(cycle)
        run(duration)
        clock.cycle_start, clock.in_cycle = clock.cycle_start + duration, 0.0
