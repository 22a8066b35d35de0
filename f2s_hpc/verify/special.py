"""Extreme cases that are more than a scene: a head-on collision, long rest, and the largest stable Courant numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import paint_batch
from f2s_hpc.fields import VELOCITY
from f2s_hpc.particles.batch import Batch
from f2s_hpc.verify.watch import FAILED, STABLE, Broken, Outcome, Watch, judge, prepare, run_cycles

GROWTH_BAR = 1e-9
"""At rest the energy may grow by this much of what was there: round-off."""


def head_on(name: str, text: str, overrides: tuple[str, ...] = ()) -> Outcome:
    """Run two spheres against each other: the first of the scene flies up, the second down, each at its speed."""
    scene = parse_scene(text, name, overrides)
    setup, plan = prepare(scene)
    batch, (u, v, w) = plan.batches[0], scene.particles.velocity
    for index, velocity in ((0, (-u, -v, -w)), (1, (u, v, w))):
        one = Batch(*(a[index:index + 1] for a in (batch.x, batch.y, batch.z, batch.r)))
        paint_batch(setup.state, setup.model, one, scene.domain.layer_bottom, velocity, scene.particles.temperature,
                    setup.ledger, index)
    setup.clock.limits.heavy_speed = scene.particles.speed
    watch = Watch(setup, scene.particles.speed)

    def task() -> None:
        watch.look()
        watch.run(scene.cycles.duration, 20)
        watch.look()

    return judge(name, watch, task)
