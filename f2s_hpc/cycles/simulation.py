"""The recurring simulation: insert a batch, run a cycle, save everything, next batch."""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib

import numpy as np

from f2s_hpc import mpi, phases
from f2s_hpc.build import build_ledger, build_model, build_state
from f2s_hpc.config.dump import dump_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.finite import refuse_what_is_not_finite
from f2s_hpc.cycles.insert import InsertReport, paint_substrate
from f2s_hpc.cycles.output import BATCHES, RunFolder
from f2s_hpc.cycles.pause import Pause
from f2s_hpc.cycles.progress import Progress, cycle_text
from f2s_hpc.cycles.spent import Spent, peak_memory, process_age
from f2s_hpc.cycles.stop import StopRequest
from f2s_hpc.cycles.supply import Supply
from f2s_hpc.cycles.tracers import Tracers, check_same
from f2s_hpc.errors import CheckpointError, F2SError
from f2s_hpc.fields import BY_NAME, CELL
from f2s_hpc.grid import log
from f2s_hpc.grid.pages import trim_heap
from f2s_hpc.io import checkpoint
from f2s_hpc.io.layout import STOP_FILE
from f2s_hpc.particles.batch import flight_speed
from f2s_hpc.particles.plan import BatchPlan, plan_digest
from f2s_hpc.phases import phase
from f2s_hpc.solver.step import Clock, advance
from f2s_hpc.solver.timestep import SAVE, STOP
from f2s_hpc.workload.balance import balance_and_growth

REMAPS_PER_RELEASE = 64
"""How often the memory of what particles have flown past is given back: often enough that it does not add up, so rarely
that it costs nothing (some milliseconds)."""

RUNNING, COMPLETE, TIMEOUT, FAILED = "running", "complete", "timeout", "failed"


class Simulation:
    """A run of a scene, from its start or from a checkpoint.

    ``plan``: the batches, the same on every rank; None to take them from the run folder. ``started``: see
    ``StopRequest``. All methods are collective.
    """

    def __init__(self, scene: Scene, folder: str | os.PathLike, plan: BatchPlan | None = None,
                 started: float | None = None) -> None:
        self.scene = scene
        self.folder = RunFolder(folder, scene)
        self.versions = self.folder.versions  # (now: sources may be edited while the run goes on)
        phases.start()
        self.stop = StopRequest(scene.run.wall_time, self.folder.path / STOP_FILE, started)
        self.stages = log.stages()
        self.plan = plan or self.folder.read_plan()
        self.model = build_model(scene)
        self.balance, self.growth = balance_and_growth(scene, self.plan)
        self.state = build_state(scene, self.balance.ranges)
        self.ledger = build_ledger(self.model)
        self.clock = Clock()
        self.cycle = 0
        self.batch_is_in = False
        self.supply = Supply(scene, self.plan, self.state, self.model, self.clock, self.ledger)
        self.pause = Pause(scene, self.state, self.model, self.clock)
        self.tracers = Tracers(scene.output.tracers, self.state) if scene.output.tracers else None
        self.rows: list[dict] = []
        self.frame = 0
        self.intervals = 0  # frame intervals that have gone by
        self.view_frame, self.view_intervals = 0, 0  # the same of the view
        self.noted: set[str] = set()
        self.substrate_quanta = 0
        self.active_at_start_of_cycle = 0
        self.spent = Spent()
        self.progress = Progress(False, self.growth.at, 1.0)
        self.status = RUNNING
        self.picture: pathlib.Path | None = None  # made at the end
        self.saved_at = 0.0  # wall time of this session (s) at the newest checkpoint
        self.startup: tuple[float, int] | None = None  # age of the process (s) and its peak memory after the start

    # --- start and resume ---------------------------------------------------------------------------

    def begin(self) -> None:
        """Paint the substrate; write the resolved scene and the batches."""
        paint_substrate(self.state, self.scene.domain.substrate_height, self.scene.substrate.temperature)
        self.substrate_quanta = measure.material_quanta(self.state, self.model)
        self.folder.write_input(self.plan)

    def resume(self, path: pathlib.Path) -> None:
        """Continue from the checkpoint at ``path``; raises ``CheckpointError`` on all ranks if it does not verify."""
        state = self.state
        requests = {}
        for name in state.saved:
            count = state.part.count if BY_NAME[name].location == CELL else state.part.node_count
            requests[name] = (state.part.start[::-1], count[::-1])
        if self.tracers is not None:
            requests |= self.tracers.requests(checkpoint.saved_shapes(path))
        arrays, saved = checkpoint.read_checkpoint(path, requests)
        check_same(self.scene.output.tracers, saved.get("tracers"))
        if "batches" in saved and saved["batches"]["sha256"] != plan_digest(self.plan, saved["batches"]["cycles"]):
            raise CheckpointError(f"{path}: the batches in {self.folder.path / BATCHES} are not those of this run any "
                                  "more; put them back as they were")
        for name in state.saved:
            owned, values = state.owned(name), arrays.pop(name)
            # what is left unwritten takes no memory; -0 is something too
            for k in np.flatnonzero(values.view(np.uint64).any(axis=(1, 2))):
                owned[k] = values[k]
        state.settle()
        if self.tracers is not None:
            self.tracers.restore(saved["tracers"], arrays)
        self._restore(saved)
        del arrays, values
        trim_heap()

    def _restore(self, saved: dict) -> None:
        clock = self.clock
        for name, value in saved["clock"].items():
            setattr(clock, name, value)
        for name, value in saved["limits"].items():
            setattr(clock.limits, name, value)
        asleep = saved["sleep"]
        clock.sleep.since = asleep["since"]
        if asleep["floor"]:
            self.state.set_floor(asleep["floor"])
        self.ledger.restore({name: int(text) for name, text in saved["ledger"].items()})
        if not mpi.is_root():
            clock.active_cell_steps = 0
        self.active_at_start_of_cycle = clock.active_cell_steps
        self.cycle, self.batch_is_in = saved["cycle"], saved["batch_is_in"]
        self.supply.restore(saved)
        self.pause.restore(saved.get("pause"))
        self.rows, self.frame = saved["rows"], saved["frame"]
        self.spent.restore(saved.get("spent", {}))
        self.view_frame = saved.get("view_frame", 0)
        self.intervals, self.view_intervals = self._intervals(), self._intervals("view")
        self.substrate_quanta = int(saved["substrate_quanta"])

    def _attributes(self) -> dict:
        """Return all that a resumed run needs besides the fields, the same on any rank count, and whence it comes."""
        clock, rates = self.clock, self.clock.limits.over_ranks()
        return {
            "scene": dump_scene(self.scene), **self.folder.identity, "versions": self.versions,
            "step": clock.steps,
            "clock": {"cycle_start": clock.cycle_start, "in_cycle": clock.in_cycle, "steps": clock.steps,
                      "remaps": clock.remaps, "between_remaps": clock.between_remaps, "dt": clock.dt,
                      "limit": clock.limit,
                      "fastest_heavy": float(mpi.maximum(clock.fastest_heavy)),
                      "active_cell_steps": int(mpi.total(np.int64(clock.active_cell_steps)))},
            "sleep": {"floor": self.state.floor, "since": clock.sleep.since},
            "limits": {"light_speed": float(rates[1]), "heavy_speed": float(rates[2]), "gradient": float(rates[3])},
            "ledger": {name: str(value) for name, value in self.ledger.totals().items()},
            "batches": self._batches,
            "cycle": self.cycle, "batch_is_in": self.batch_is_in, **self.supply.attributes(),
            "tracers": None if self.tracers is None else self.tracers.attributes(),
            "pause": self.pause.attributes(),
            "rows": self.rows, "frame": self.frame, "view_frame": self.view_frame,
            "spent": self.spent.so_far(self.stop.elapsed()),
            "substrate_quanta": str(self.substrate_quanta),
        }

    @functools.cached_property
    def _batches(self) -> dict:
        """What a checkpoint tells of the batches, which stay the same in all of them."""
        cycles = self.scene.cycles.count
        return {"cycles": cycles, "sha256": plan_digest(self.plan, cycles)}

    # --- the run ------------------------------------------------------------------------------------

    def run(self) -> str:
        """Run all remaining cycles; return the status, complete or timeout. Raises ``F2SError``.

        Whatever happens, ``summary.json`` tells; after a failure the last checkpoint stands.
        """
        scene = self.scene
        self.progress = Progress(mpi.is_root(), self.growth.at, scene.output.progress_seconds,
                                 mpi.launched_by_mpirun())
        for message in self.plan.messages:
            self.progress.say(f"note: {message}")
        self.folder.write_tables(self.rows, self.summary())  # (who looks should find a run that goes on)
        try:
            while self.cycle < scene.cycles.count:
                if not self._run_cycle():
                    self.status = TIMEOUT
                    break
            else:
                self.status = COMPLETE
        except F2SError:
            self.status = FAILED
            self.folder.write_tables(self.rows, self.summary())
            with contextlib.suppress(F2SError):  # (what went wrong first is to be told)
                self._index_view()
            raise
        self.folder.write_tables(self.rows, self.summary())
        self.picture = self.folder.draw(self.rows, self.plan)
        return self.status

    def _run_cycle(self) -> bool:
        """Run one cycle to its end; False when a stop was asked for and a checkpoint was written."""
        duration = self.scene.cycles.durations[self.cycle]
        if not self.batch_is_in:
            if self.cycle and self.scene.cycles.dwell is not None and not self._dwell():
                return False
            self.insert()
        clock = self.clock
        follow = None if self.tracers is None else self._follow
        while clock.in_cycle < duration * (1.0 - 1e-12):
            clock.limits.request = self._request()
            landed = self.supply.land()
            if landed is not None and self.tracers is not None:
                self.tracers.seed(landed, clock.time)
            advance(self.state, self.model, clock, self.ledger, duration, None, follow)
            self._end_startup()
            if clock.remaps % REMAPS_PER_RELEASE == 0:
                self.state.release_empty()
            self.progress.step(clock, self.cycle, self.scene.cycles.count, duration, self._fastest_in_flight)
            goes_on = clock.in_cycle < duration * (1.0 - 1e-12)
            if self._intervals() > self.intervals:
                self.intervals = self._intervals()
                if goes_on or self.scene.output.frames != "cycle":
                    self._frame(ends_cycle=False)
            if self._intervals("view") > self.view_intervals:
                self.view_intervals = self._intervals("view")
                self.folder.write_view(self.state, self.model, self.view_frame, clock.time)
                self.view_frame += 1
            if (clock.stop or clock.save) and goes_on:
                self._save(clock.stop)
                if clock.stop:
                    self._index_view()
                    return False
        with self.stop.saving():
            self._finish_cycle(duration)
        if not clock.stop or self.cycle == self.scene.cycles.count:
            return True
        self.progress.say(f"stopped: {self.stop.reason()}")
        return False

    def _dwell(self) -> bool:
        """Let the deposit dwell before the next batch; False when a stop was asked for and a checkpoint was written."""
        self._end_startup()

        def asks(left: float) -> int:
            self.progress.dwell(left, self.scene.cycles.dwell, self.cycle, self.scene.cycles.count)
            return self._request()

        while asked := self.pause.take(asks):
            self._save(asked >= STOP)
            if asked >= STOP:
                return False
        self.progress.say(self.pause.told(flight_speed(self.plan.batches, self.scene.top_speed), self.rows[-1]))
        return True

    def _end_startup(self) -> None:
        """Note what the start took: up to the end of the first step, or to a dwell with which a resumed run begins."""
        if self.startup is None:
            self.startup = process_age(), peak_memory()
            phases.started(self.stages)

    def _save(self, stops: bool) -> None:
        """Write a checkpoint within a cycle or a dwell, and say so."""
        refuse_what_is_not_finite(self.state)
        with self.stop.saving():
            path = self._checkpoint()
        self.progress.say((f"stopped: {self.stop.reason()}; " if stops else "") + f"checkpoint {path}")

    def _request(self) -> int:
        """Return what this rank asks for: the end of the run, or on rank 0 a checkpoint now and then in long cycles."""
        if self.stop.asked():
            return STOP
        due = self.stop.elapsed() - self.saved_at > self.scene.run.checkpoint_interval
        return SAVE if due and self.scene.output.checkpoints and mpi.is_root() else 0

    def insert(self) -> InsertReport:
        """Paint or launch the batch of the present cycle and what waited from the one before; return what happened."""
        report, message = self.supply.insert(self.cycle)
        if self.tracers is not None:
            self.tracers.seed(report.positions, self.clock.time)
        self.batch_is_in = True
        if message:
            self.progress.say(f"cycle {self.cycle + 1}: {message}")
        return report

    def _fastest_in_flight(self) -> float:
        """Return the highest speed (m/s) of the spheres that are not on the grid yet; 0 without any."""
        flight = self.supply.flight
        return float(np.linalg.norm(flight.velocity, axis=1).max()) if flight is not None and flight.count else 0.0

    def _intervals(self, of: str = "frames") -> int:
        """Return how many intervals of the frames or the view have gone by; round-off does not put one off."""
        output = self.scene.output
        interval = output.view.interval if of == "view" else output.frame_interval
        return int(self.clock.time / interval + 1e-9) if interval else 0

    @phase("output")
    def _finish_cycle(self, duration: float) -> None:
        clock = self.clock
        clock.cycle_start += duration
        clock.in_cycle = 0.0
        self.state.release_work()
        refuse_what_is_not_finite(self.state)
        row = self._row()
        self.rows.append(row)
        self.cycle += 1
        self.batch_is_in = False
        self.active_at_start_of_cycle = clock.active_cell_steps
        output = self.scene.output
        failure = None
        try:
            if output.frames == "cycle":
                self._frame(ends_cycle=True)
            self._index_view()
            if self.tracers is not None:
                self.folder.write_tracers(self.tracers.cloud_at(self.state, clock.time), self.cycle)
        except F2SError as error:  # a picture of the state that can not be written must not cost the state
            failure = error
        self.folder.write_tables(self.rows, self.summary())
        if output.checkpoints or clock.stop or failure:
            self._checkpoint()
        if failure:
            raise failure
        if output.picture_each_cycle and self.cycle < self.scene.cycles.count:
            self.folder.draw(self.rows, self.plan)
        trim_heap()
        self.progress.say(cycle_text(row, self.scene.cycles.count, self.scene.material.density))

    def _follow(self, dt: float, displaced: bool) -> None:
        """Move the tracers with the nodes."""
        self.tracers.move(self.state, dt, displaced, self.clock.remaps)

    @phase("output")
    def _checkpoint(self) -> pathlib.Path:
        self.saved_at = self.stop.elapsed()
        more = [] if self.tracers is None else self.tracers.blocks()
        return self.folder.write_checkpoint(self.state, self.cycle, self._attributes(), more)

    @phase("output")
    def _frame(self, ends_cycle: bool) -> None:
        self._note(self.folder.write_frame(self.state, self.model, self.frame, self.clock.time, self.cycle, ends_cycle))
        self.frame += 1

    @phase("output")
    def _index_view(self) -> None:
        """Renew the index of the view's series: not with each picture, which would take longer each time."""
        if self.view_frame:
            self._note(self.folder.update_view(self.view_frame - 1))

    def _note(self, notes: list[str]) -> None:
        """Say what has not been said before: an index lacks the same frames each time."""
        for note in notes:
            if note not in self.noted:
                self.progress.say(f"note: {note}")
        self.noted.update(notes)

    # --- numbers ------------------------------------------------------------------------------------

    @phase("measuring")
    def _row(self) -> dict:
        clock, scene = self.clock, self.scene
        row = {
            "cycle": self.cycle + 1, "time_s": clock.time, "steps": clock.steps, "dt_s": clock.dt,
            "dt_limit": clock.limit, **self.supply.row(), **self.pause.row()}
        row |= measure.measure_material(self.state, self.model, scene.domain.substrate_height,
                                        flight_speed(self.plan.batches, scene.top_speed))
        row |= measure.measure_balance(self.state, self.model, self.ledger, self.substrate_quanta)
        if self.tracers is not None:
            row |= self.tracers.census(self.state)
        active = int(mpi.total(np.int64(clock.active_cell_steps)))
        spent = self.spent.so_far(self.stop.elapsed())
        loads = mpi.all_gather(clock.active_cell_steps - self.active_at_start_of_cycle)
        row |= {
            "speed_max_heavy_m_s": float(mpi.maximum(clock.fastest_heavy)),
            "active_cells": int(mpi.total(np.int64(self.state.active_cells()))), "active_cell_steps": active,
            "imbalance": max(loads) * len(loads) / max(sum(loads), 1),
            "active_cell_steps_per_s": active / max(spent["wall_s"], 1e-9), **spent}
        return row

    def summary(self) -> dict:
        """Return ``summary.json``: the last row of the cycle table, or the present state, and the run as a whole."""
        row = self.rows[-1] if self.rows and not self.batch_is_in else self._row()
        # (what was written after the last row took its time, and maybe most memory)
        row = row | self.spent.so_far(self.stop.elapsed())
        row["active_cell_steps_per_s"] = row["active_cell_steps"] / max(row["wall_s"], 1e-9)
        keep = {name: value for name, value in row.items() if name not in ("cycle", "dt_s", "dt_limit")}
        age, memory = self.startup or (process_age(), peak_memory())
        keep |= {"startup_s": float(mpi.maximum(age)), "startup_memory_bytes": int(mpi.total(np.int64(memory)))}
        return {"status": self.status, "scene": self.scene.title, "scheme": self.scene.scheme, **self.folder.identity,
                "cells": int(np.prod(self.scene.domain.cells)), "cycles": self.cycle, **keep,
                "versions": self.versions}
