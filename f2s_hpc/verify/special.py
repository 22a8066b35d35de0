"""Extreme cases that are more than a scene: a head-on collision, long rest, and the largest stable Courant numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles.insert import kinetic_quanta, paint_batch
from f2s_hpc.fields import VELOCITY
from f2s_hpc.verify.scenes import prepare, run_cycles
from f2s_hpc.verify.watch import FAILED, STABLE, Broken, Outcome, Watch, judge

NOISE = 0.1
"""Largest component of the random velocities (m/s) that must die out."""

_SHARED = 200
"""Steps after which random velocities have shared their energy with the stresses. An explicit step keeps the kinetic
energy less an eighth of dt^2 f^2 / m, f the force on a node: while forces arise, the energy of the fastest waves of the
mesh rises by that, here 5 % in four steps, 0.3 % with half the step, none with a quarter of it."""

_COURANT = {False: (0.7, 0.9), True: (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.6, 1.8, 2.0)}
_REMAP = {False: (0.25, 0.45), True: (0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95)}


def head_on(name: str, text: str, overrides: tuple[str, ...]) -> Outcome:
    """Run two spheres against each other: the first of the scene flies up, the second down, each at its speed."""
    scene = parse_scene(text, name, overrides)
    setup, plan = prepare(scene)
    batch, (u, v, w) = plan.batches[0], scene.particles.velocity
    for index, velocity in ((0, (-u, -v, -w)), (1, (u, v, w))):
        one = batch.chosen(slice(index, index + 1))
        paint_batch(setup.state, setup.model, one, scene.domain.layer_bottom, velocity, scene.particles.temperature,
                    setup.ledger, index)
    setup.clock.limits.put_in(scene.particles.speed, setup.model.dx)
    watch = Watch(setup, scene.particles.speed)

    return judge(name, watch, lambda: watch.run(scene.cycles.duration))


def rest(name: str, text: str, full: bool, numerics: tuple[str, ...]) -> Iterator[Outcome]:
    """Run a hot sphere that lies still on the substrate, then the substrate with random velocities, for long.

    At rest every bit of velocity, mass, stress and PEEQ must stay; the temperature only levels out. With random
    velocities the energy must not rise, from when stresses have their share of it (``_SHARED``), which a step that
    feeds on itself would show.
    """
    steps = 100_000 if full else 3000
    numerics = ("domain.cell_size=6 um", *numerics)
    yield _at_rest(f"{name}, {steps} steps", text, numerics, steps)
    yield _with_noise(f"{name} but for noise, {steps} steps", text, numerics, steps)


def _at_rest(name: str, text: str, numerics: tuple[str, ...], steps: int) -> Outcome:
    scene = parse_scene(text, name, numerics)
    setup, plan = prepare(scene)
    paint_batch(setup.state, setup.model, plan.batches[0], scene.domain.layer_bottom, (0.0, 0.0, 0.0),
                scene.particles.temperature, setup.ledger, 1)
    watch = Watch(setup, 0.0)
    kept = [n for n in setup.state.saved if n not in ("temperature", "internal_energy")]
    before = {n: setup.state.owned(n).copy() for n in kept}
    hottest = scene.particles.temperature * (1.0 + 1e-12)

    def unchanged() -> None:
        changed = [n for n in kept if not np.array_equal(before[n], setup.state.owned(n))]
        changed = sorted({n for names in mpi.all_gather(changed) for n in names})
        if changed or watch.temperature_max > hottest:
            raise Broken(f"something grew at rest, at step {setup.clock.steps}: "
                         f"{', '.join(changed) or f'temperature {watch.temperature_max:.2f} K'}")

    return judge(name, watch, lambda: _take_steps(watch, steps, unchanged))


def _with_noise(name: str, text: str, numerics: tuple[str, ...], steps: int) -> Outcome:
    scene = parse_scene(text, name, numerics)
    setup, _ = prepare(scene)
    state, part = setup.state, setup.state.part
    generator = np.random.Generator(np.random.PCG64(1))
    whole = tuple(n + 1 for n in part.box.cells[::-1])
    here = tuple(slice(s, s + n) for s, n in zip(part.start[::-1], part.node_count[::-1]))
    for component in VELOCITY:
        state.owned(component)[...] = generator.uniform(-NOISE, NOISE, whole)[here]
    state.boundary.hold([state.views[n] for n in VELOCITY])
    state.exchange(state.ghosted)
    setup.ledger.add("brought_in", kinetic_quanta(state, setup.model))
    while (left := _SHARED - setup.clock.steps) > 0:
        setup.step(1.0, left)
    watch = Watch(setup, NOISE, least_energy=math.inf)
    return judge(name, watch, lambda: _take_steps(watch, steps, lambda: None))


def _take_steps(watch: Watch, steps: int, check: Callable[[], None]) -> None:
    """Take ``steps`` steps with about fifty looks; ``check`` is called with each."""
    clock = watch.setup.clock
    watch.look()
    for look in range(1, 51):
        while (left := steps * look // 50 - clock.steps) > 0:
            watch.step(1.0, left)
        watch.look()
        check()


def courant(name: str, text: str, full: bool, numerics: tuple[str, ...]) -> Iterator[Outcome]:
    """Raise the Courant number of sound until the run breaks; stable if the default lies below the limit found."""
    yield _largest_stable(name, "courant", text, numerics, _COURANT[full])


def remap_courant(name: str, text: str, full: bool, numerics: tuple[str, ...]) -> Iterator[Outcome]:
    """The same for the share of a cell that material crosses in a step; so soft a metal that sound does not limit."""
    soft = ("material.young_modulus=2 GPa", "material.flow_stress.sigma_y0=1 MPa", "particles.speed=1500 m/s",
            "material.flow_stress.hardening_A=8 MPa", "material.flow_stress.high_rate_B=3 MPa",
            "numerics.strain_per_step=1.0")
    yield _largest_stable(name, "remap_courant", text, (*soft, *numerics), _REMAP[full])


def _largest_stable(name: str, setting: str, text: str, overrides: tuple[str, ...], values: Sequence[float]) -> Outcome:
    """Run with rising ``values`` of a setting, also beyond what a scene may ask for, up to the first that fails."""
    scene = parse_scene(text, name, overrides)
    default, good, last, why = getattr(scene.numerics, setting), None, None, ""
    for value in values:
        setup, plan = prepare(scene)
        setup.model = setup.model._replace(settings=setup.model.settings._replace(**{setting: value}))
        watch = Watch(setup, scene.particles.speed)
        outcome = judge(name, watch, partial(run_cycles, scene, plan, setup, watch.run))
        if outcome.verdict != STABLE:
            why = f"; {value:g} does not: {outcome.reason}"
            break
        good, last = value, outcome
    if good is None or good < default:
        return replace(outcome, verdict=FAILED, reason=f"the default {setting} {default:g} is too large{why}")
    return replace(last, reason=f"{setting} up to {good:g} holds (default {default:g}){why}")


TASKS: tuple[tuple[str, Callable[..., Iterator[Outcome]]], ...] = (
    ("at rest", rest), ("Courant number", courant), ("share of a cell crossed", remap_courant))
"""Name and function (name, TOML text of an impact, full, numerics) -> outcomes."""
