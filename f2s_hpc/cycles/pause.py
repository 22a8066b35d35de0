"""The pause between two cycles in which nothing moves and heat flows (``cycles.dwell``), and what is told of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.solver import sleep
from f2s_hpc.solver.dwell import Course, dwell
from f2s_hpc.solver.model import Model
from f2s_hpc.solver.step import Clock
from f2s_hpc.state import State
from f2s_hpc.units import pretty


class Pause:
    """Lets the deposit of a scene dwell between its cycles, and remembers what that did. All methods are collective.

    ``count``: dwells so far; ``heat_left``: what left through the bottom, in quanta of mass times kelvin;
    ``temperature``: median of the deposit after the last one (degC); ``course``: of the one under way, None between
    them. A scene without a dwell pauses nothing.
    """

    def __init__(self, scene: Scene, state: State, model: Model, clock: Clock) -> None:
        self.scene, self.state, self.model, self.clock = scene, state, model, clock
        self.count, self.heat_left, self.temperature = 0, 0, None
        self.course: Course | None = None

    def take(self, asks: Callable[[float], int]) -> int:
        """Dwell, or go on with a dwell that was left; return what any rank asks for meanwhile, 0 when it has ended.

        ``asks``: as :func:`f2s_hpc.solver.dwell.dwell` takes it.
        """
        scene, state, model = self.scene, self.state, self.model
        if self.course is None:
            sleep.catch_up(state, model, self.clock.sleep, self.clock.time)
            self.course = Course(scene.cycles.dwell)
        before = measure.heat_quanta(state, model)
        asked = dwell(state, model, self.course, scene.substrate.backing, scene.substrate.temperature, asks)
        self.heat_left += before - measure.heat_quanta(state, model)
        if not asked:
            self.count, self.course = self.count + 1, None
        return asked

    def told(self, particle_speed: float, last: dict) -> str:
        """Measure what it did; return a sentence. ``last``: the row of the cycle before; ``particle_speed`` in m/s."""
        scene = self.scene
        found = measure.measure_material(self.state, self.model, scene.domain.substrate_height, particle_speed)
        self.temperature = found["temperature_p50_degC"]
        text = f"dwell of {pretty(scene.cycles.dwell, 'time')}"
        if None in (self.temperature, last["temperature_p50_degC"]):
            return f"{text}: no deposit yet"
        return (f"{text}: the deposit's median temperature goes from {last['temperature_p50_degC']:.0f} to "
                f"{self.temperature:.0f} degC")

    def row(self) -> dict:
        """Return its numbers for the cycle table; none in a scene without a dwell."""
        if self.scene.cycles.dwell is None:
            return {}
        joule = self.model.mass_quantum * self.model.cell_mass * self.model.bulk.specific_heat
        return {"dwell_s": self.count * self.scene.cycles.dwell, "dwell_heat_left_J": self.heat_left * joule,
                "temperature_p50_after_dwell_degC": self.temperature}

    def attributes(self) -> dict:
        """Return what a checkpoint keeps of it."""
        return {"count": self.count, "heat_left": str(self.heat_left), "temperature": self.temperature,
                "course": None if self.course is None else asdict(self.course)}

    def restore(self, saved: dict | None) -> None:
        """Take up what :meth:`attributes` returned; None of a checkpoint that is older than the dwell."""
        if saved:
            self.count, self.heat_left, self.temperature = saved["count"], int(saved["heat_left"]), saved["temperature"]
            course = saved.get("course")  # (older ones do not tell)
            self.course = Course(**course) if course else None
