"""Runs that are watched: what must hold in every run, looked at while it runs, and the verdict.

Looked at every few steps and at the end:

finite      every stored field is finite everywhere, and PEEQ is not negative beyond round-off
mass        what was put in is in the box, has left through an open side, or was counted as capped (dust)
energy      kinetic and elastic energy, plastic work, work of the shock viscosity, what losses gave back as heat or will
            in the next step, and the kinetic energy that left never rise: nothing but the painting of material brings
            energy in (with Mie-Grueneisen pressure, where heat does work too: kinetic and internal energy, and what
            left)
PEEQ        its sum over all material, weighted with mass, never falls by more than what left can have carried away
            (the largest single value may fall: the remap mixes)
ranks       all ranks end after the same step with the same outcome
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.analysis.table import aligned
from f2s_hpc.config.load import parse_scene
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.flight import NO_ROOM
from f2s_hpc.errors import InputError, TooManyRanks, UnstableStep
from f2s_hpc.fields import LENT
from f2s_hpc.kernels import momentum
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import Setup
from f2s_hpc.verify.case import Stopwatch
from f2s_hpc.verify.scenes import prepare, run_cycles

STABLE, STOPPED, REFUSED, FAILED, SMALL = "stable", "stopped", "refused", "failed", "too small"

MASS_BAR = 1e-10
"""Largest mass missing, over all that was put in."""

ENERGY_BAR = 1e-3
"""Largest rise of the energy, over the energy that was brought in."""

PEEQ_BAR = 1e-12
"""Largest fall of the sum of PEEQ from look to look, over its largest value: round-off."""

LEAST_PEEQ = -1e-12
"""The limited remap of a field that is zero next to one that is not rounds to either side of zero."""

MOST_STEPS = 200_000
"""A run that takes more steps than this has failed."""


class Broken(Exception):
    """Something that must hold does not; the text says what, and at which step."""


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    ``verdict``: stable, stopped (with a clear reason), refused (by the check of the scene), failed, or too small (a
    box that so many ranks can not share).
    ``speed_ratio``: largest speed of heavy nodes over the impact speed; ``temperature_max``: K; ``mass_drift``: mass
    missing over mass put in; ``energy_rise``: largest rise of the energy (see the module) over what was brought in.
    """

    scene: str
    verdict: str
    reason: str = ""
    steps: int = 0
    limit: str = ""
    speed_ratio: float = 0.0
    peeq_max: float = 0.0
    temperature_max: float = 0.0
    mass_drift: float = 0.0
    energy_rise: float = 0.0
    nodes_capped: int = 0
    cell_steps: int = 0
    wall_s: float = 0.0

    @property
    def passed(self) -> bool:
        """A run may end, stop with a clear reason, be refused or be too small for the ranks; else it has failed."""
        return self.verdict != FAILED


def _worst(so_far: float, now: float) -> float:
    """Return the larger one, and NaN once there was one: ``max`` would forget it."""
    return float(np.maximum(so_far, now))


@dataclass
class Watch:
    """Looks at a run; ``speed``: that of the particles (m/s).

    ``least_energy``: the least energy so far (J, over what was brought in), that at the start unless given.
    """

    setup: Setup
    speed: float
    limits: Counter = field(default_factory=Counter)
    substrate: int = 0
    mass_drift: float = 0.0
    energy_rise: float = 0.0
    peeq_max: float = 0.0
    temperature_max: float = 0.0
    least_energy: float = 0.0
    _peeq: float = 0.0  # sum over all material, at the last look
    _most_peeq: float = 0.0
    _left: int = 0
    _lent: float = 0.0  # full cells

    def __post_init__(self) -> None:
        s = self.setup
        painted = s.ledger.totals()["mass_painted"]
        self.substrate = measure.material_quanta(s.state, s.model) - painted

    def run(self, duration: float, interval: int = 20) -> None:
        """Step to ``duration`` (s, of this cycle), looking before, every ``interval`` steps and after the last.

        Raises ``Broken``, ``UnstableStep``. Collective.
        """
        self.look()
        clock, looked = self.setup.clock, self.setup.clock.steps
        end = duration * (1.0 - 1e-12)
        while clock.in_cycle < end:
            self.step(duration)
            if clock.steps - looked >= interval or clock.in_cycle >= end:
                looked = clock.steps
                self.look()
            if clock.steps > MOST_STEPS:
                raise Broken(f"not at the end after {MOST_STEPS} steps; the step is {clock.dt:.3g} s, limited by "
                             f"{clock.limit}")

    def step(self, duration: float, most: int | None = None) -> None:
        """Step towards ``duration`` (s, of this cycle) until the next remap, that is after ``most`` steps at most."""
        self.setup.step(duration, most)
        self.limits[self.setup.clock.limit] += 1

    def look(self) -> None:
        """Look at the present state. Collective; raises ``Broken``."""
        self._look_at_fields()
        self._look_at_energy(self._look_at_mass())
        self._look_at_peeq()

    def _at(self) -> str:
        clock = self.setup.clock
        return f"at step {clock.steps}, {clock.time * 1e9:.2f} ns"

    def _look_at_fields(self) -> None:
        state = self.setup.state
        wrong = [n for n in state.saved if not np.isfinite(state.owned(n)).all()]
        wrong += ["peeq below 0"] if (state.owned("peeq") < LEAST_PEEQ).any() else []
        wrong = sorted({name for names in mpi.all_gather(wrong) for name in names})
        if wrong:
            raise Broken(f"not finite or not possible {self._at()}: {', '.join(wrong)}")
        solid = state.owned("volume_fraction") > 0.0
        for name, attribute in (("peeq", "peeq_max"), ("temperature", "temperature_max")):
            here = state.owned(name)[solid].max() if solid.any() else 0.0
            setattr(self, attribute, _worst(getattr(self, attribute), float(sample.largest(here))))

    def _look_at_mass(self) -> dict:
        s = self.setup
        # (not the drift of the balance, which is over what was painted: at rest that is nothing)
        now = measure.material_quanta(s.state, s.model)
        missing, painted = measure.missing_quanta(s.ledger.totals(), now, self.substrate)
        self.mass_drift = _worst(self.mass_drift, abs(missing) / max(painted + self.substrate, 1))
        if not self.mass_drift <= MASS_BAR:
            raise Broken(f"mass: {self.mass_drift:.2e} of it is missing {self._at()}")
        return measure.measure_balance(s.state, s.model, s.ledger, self.substrate)

    def _look_at_energy(self, balance: dict) -> None:
        s, energy = self.setup, balance["energy"]
        held = energy["kinetic"] + energy["through_faces"] + self._not_yet_heat()
        if s.state.energy.size > 1:
            inner = float((s.state.owned("mass") * s.state.owned("internal_energy")).sum())
            held += sum(mpi.all_gather(inner)) * s.model.cell_mass
        else:
            # what came back from losses did so with the Taylor-Quinney share; the rest is stored, as of plastic work
            back = energy["returned_heat"] / max(s.model.bulk.taylor_quinney, 1e-300)
            held += energy["elastic"] + energy["plastic_work"] + energy["shock_viscosity"] + back
        over, scale = held - energy["brought_in"], energy["brought_in"] or 1.0
        self.energy_rise = _worst(self.energy_rise, (over - self.least_energy) / scale)
        self.least_energy = min(self.least_energy, over)
        if not self.energy_rise <= ENERGY_BAR:
            raise Broken(f"energy: it rose by {100 * self.energy_rise:.2f} % of what was brought in {self._at()}")

    def _not_yet_heat(self) -> float:
        """Return what the last remap and light nodes took, which the next step turns into heat (J)."""
        s = self.setup
        if s.state.lost.size == 1:
            return 0.0
        runs, count = s.state.runs
        quanta = momentum.sum_lost(runs, count, s.state.node_window(), s.state.part.cell_shape[1:],
                                   s.state.boundary.weights, s.state.lost, s.model.cell_mass, s.model.energy_quantum)
        return sum(mpi.all_gather(int(quanta))) * s.model.energy_quantum

    def _look_at_peeq(self) -> None:
        s = self.setup
        total = sum(mpi.all_gather(float((s.state.owned("mass") * s.state.owned("peeq")).sum())))
        totals = s.ledger.totals()
        left = totals["mass_left"] + totals["mass_capped"]
        # mass is counted in quanta: what left is known to the bar of the mass only
        known = max(left - self._left, 0) + MASS_BAR * (totals["mass_painted"] + self.substrate)
        # (what cells beside absorbing sides lend goes with their PEEQ, and comes back with that of later)
        lent = sum(mpi.all_gather(float(np.abs(s.state.owned(LENT)).sum()))) if LENT in s.state.saved else 0.0
        carried = (known * s.model.mass_quantum + lent + self._lent) * self.peeq_max
        self._most_peeq = _worst(self._most_peeq, total)
        if not total >= self._peeq - carried - PEEQ_BAR * self._most_peeq:
            raise Broken(f"PEEQ: its sum fell by {(self._peeq - total) / self._peeq:.2e} {self._at()}")
        self._peeq, self._left, self._lent = total, left, lent

    def outcome(self, scene: str, verdict: str, reason: str, wall: float) -> Outcome:
        """Return what became of the run so far. Collective, unless this rank is alone."""
        clock = self.setup.clock
        return Outcome(
            scene, verdict, reason, clock.steps, self.limits.most_common(1)[0][0] if self.limits else "",
            float(mpi.maximum(clock.fastest_heavy)) / self.speed if self.speed else 0.0, self.peeq_max,
            self.temperature_max, self.mass_drift, self.energy_rise,
            int(mpi.total(np.int64(self.setup.ledger.counts["nodes_capped"]))),
            sample.cell_steps(clock), float(mpi.broadcast(wall)))


def judge(name: str, watch: Watch, task: Callable[[], None]) -> Outcome:
    """Run ``task()`` under ``watch`` and return the outcome.

    On one rank any exception is an outcome, since a solver that raises it has failed. On several ranks only those that
    all ranks raise together are: a rank alone with an error ends the whole job through the abort hook.
    """
    stopwatch, verdict, reason = Stopwatch(), STABLE, ""
    try:
        task()
    except UnstableStep as error:
        # only a scene that asks for more room stops for a good reason; numbers that leave the finite world do not
        verdict, reason = STOPPED if str(error) == NO_ROOM else FAILED, str(error)
    except Broken as error:
        verdict, reason = FAILED, str(error)
    except (ArithmeticError, LookupError, ValueError, TypeError) as error:
        if mpi.size() > 1:
            raise
        verdict, reason = FAILED, f"{type(error).__name__}: {error}"
    ends = mpi.all_gather((verdict, reason, watch.setup.clock.steps, watch.setup.clock.dt))
    if len(set(ends)) > 1:
        verdict, reason = FAILED, f"the ranks ended differently: {ends}"
    return watch.outcome(name, verdict, reason, stopwatch.read())


def run_scene(name: str, text: str, overrides: Sequence[str] = ()) -> Outcome:
    """Run the scene written in ``text`` (TOML) with ``overrides`` ("key.path=value") to its end. Collective."""
    try:
        scene = parse_scene(text, name, overrides)
        setup, plan = prepare(scene)
    except TooManyRanks as error:
        return Outcome(name, SMALL, str(error))
    except InputError as error:
        return Outcome(name, REFUSED, str(error))
    watch = Watch(setup, scene.top_speed)
    return judge(name, watch, lambda: run_cycles(scene, plan, setup, watch.run))


COLUMNS = (
    ("scene", "scene", "{}"), ("verdict", "verdict", "{}"), ("steps", "steps", "{}"), ("limit", "dt limit", "{}"),
    ("speed_ratio", "v/v0", "{:.2f}"), ("peeq_max", "PEEQ", "{:.3g}"), ("temperature_max", "T max K", "{:.0f}"),
    ("mass_drift", "mass", "{:.1e}"), ("energy_rise", "E rise", "{:.1e}"), ("nodes_capped", "capped", "{}"),
    ("wall_s", "wall s", "{:.1f}"), ("reason", "reason", "{}"))


def table(outcomes: list[Outcome]) -> str:
    """Return the outcomes as a table, with the number of each verdict below."""
    lines = [[head for _, head, _ in COLUMNS]]
    lines += [[form.format(getattr(o, name)) for name, _, form in COLUMNS] for o in outcomes]
    counts = ", ".join(f"{n} {verdict}" for verdict, n in Counter(o.verdict for o in outcomes).items())
    return "\n".join([*aligned(lines, left=range(len(COLUMNS))), counts])
