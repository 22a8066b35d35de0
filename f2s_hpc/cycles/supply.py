"""The supply of particles: each cycle's batch is painted into the particle layer at once, or flies and lands.

Used by a run with its files and by the verification cases, which run cycles in memory: both put particles in alike.
"""

from __future__ import annotations

from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.flight import Flight
from f2s_hpc.cycles.insert import InsertReport, paint_arrivals, paint_batch
from f2s_hpc.particles.batch import Batch, from_lists, join, to_lists
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.phases import phase
from f2s_hpc.solver import sleep
from f2s_hpc.solver.ledger import Ledger
from f2s_hpc.solver.model import Model
from f2s_hpc.solver.step import Clock
from f2s_hpc.state import State


class Supply:
    """Puts the batches of a scene into its box, and knows what still waits or flies. All methods are collective.

    ``particles``: put in or launched so far; ``moved``: those whose place was taken; ``waiting``: those that found no
    place (z from the bottom of the particle layer); ``flight``: None where batches are painted at once.
    """

    def __init__(self, scene: Scene, plan: BatchPlan, state: State, model: Model, clock: Clock,
                 ledger: Ledger) -> None:
        self.scene, self.plan = scene, plan
        self.state, self.model, self.clock, self.ledger = state, model, clock, ledger
        self.particles = 0
        self.moved = 0
        self.waiting = join([])
        self.flight = Flight(model.dx, state.part.box.extents) if scene.ballistic else None

    @phase("particles")
    def insert(self, cycle: int) -> tuple[InsertReport, str]:
        """Paint or launch the batch of ``cycle`` and what waited; return what happened, and as a sentence or ""."""
        # spheres that waited come last
        batch = join([self.plan.batches[self.plan.order[cycle]], self.waiting])
        report, message = self._launch(batch) if self.flight is not None else self._paint(batch, cycle)
        self.waiting = report.deferred or join([])
        self.particles += report.spheres
        self.moved += report.moved
        return report, message

    def _paint(self, batch: Batch, cycle: int) -> tuple[InsertReport, str]:
        scene, bottom = self.scene, self.scene.domain.layer_bottom
        sleep.wake_for(self.state, self.model, self.clock.sleep, self.clock.time, bottom)
        report = paint_batch(self.state, self.model, batch, bottom, scene.particles.velocity,
                             scene.particles.temperature, self.ledger, scene.batches.seed * 1000003 + cycle)
        self.clock.limits.put_in(scene.top_speed, scene.domain.cell_size)
        return report, report.message(last=cycle + 1 == scene.cycles.count)

    def _launch(self, batch: Batch) -> tuple[InsertReport, str]:
        """Let a batch fly towards the deposit; nothing is painted yet."""
        raised = self.flight.launch(self.state, batch.raised(self.scene.domain.layer_bottom),
                                    self.scene.particles.velocity, self.clock.time)
        report = InsertReport(spheres=batch.count, moved=raised, positions=join([]))
        return report, (f"{raised} {'sphere starts' if raised == 1 else 'spheres start'} higher to clear what is in "
                        f"{'its' if raised == 1 else 'their'} place") if raised else ""

    @phase("particles")
    def land(self) -> Batch | None:
        """Put the spheres that are about to meet something onto the grid; return them, None if there are none."""
        if self.flight is None:
            return None
        settings = self.model.settings
        longest = settings.steps_per_remap * settings.courant * self.model.dx / self.model.sound
        return self._put_down(self.flight.arrivals(self.state, self.clock.time, self.clock.between_remaps or longest))

    def land_all(self) -> Batch | None:
        """Put down all spheres in flight that lie inside the box, where they are, as :meth:`land` does; for checks."""
        return self._put_down(self.flight.take_inside(self.clock.time))

    def _put_down(self, arrived: tuple[Batch, tuple[float, float, float]] | None) -> Batch | None:
        if arrived is None:
            return None
        spheres, clock = arrived[0], self.clock
        sleep.wake_for(self.state, self.model, clock.sleep, clock.time, float((spheres.z - spheres.r).min()))
        paint_arrivals(self.state, self.model, arrived, self.scene.particles.temperature, self.ledger)
        clock.limits.heavy_speed = max(clock.limits.heavy_speed, self.scene.top_speed)
        return spheres

    def attributes(self) -> dict:
        """Return what a checkpoint keeps of it."""
        return {"particles": self.particles, "moved": self.moved, "waiting": to_lists(self.waiting),
                "flight": None if self.flight is None else self.flight.attributes()}

    def restore(self, saved: dict) -> None:
        """Take up what :meth:`attributes` returned."""
        self.particles, self.moved = saved["particles"], saved["moved"]
        self.waiting = from_lists(saved["waiting"])
        if self.flight is not None:
            self.flight.restore(saved["flight"])

    def row(self) -> dict:
        """Return its numbers for the cycle table."""
        flight = self.flight
        return {
            "particles": self.particles, "particles_moved": self.moved + (0 if flight is None else flight.raised),
            "particles_waiting": self.waiting.count, "particles_in_flight": 0 if flight is None else flight.count,
            "volume_in_flight_m3": 0.0 if flight is None else flight.volume(self.clock.time)}
