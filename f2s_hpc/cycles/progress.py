"""What a running simulation says: plain lines every few seconds, one line kept fresh on a terminal."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

from f2s_hpc.units import count_text, pretty

ETA_SHARE = 0.02
"""Share of a session's work after which the rest can be foretold; the first steps say little about it."""


def clock_text(seconds: float) -> str:
    """Return a duration as h:mm:ss."""
    whole = int(round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def cycle_text(row: dict, cycles: int, density: float) -> str:
    """Return the line at the end of a cycle: ``row`` of the cycle table, one of ``cycles``; ``density`` in kg/m3."""
    unexplained = row["energy"]["remainder"] / max(row["energy"]["brought_in"], 1e-300)
    left = row["mass_left_kg"] / max(row["painted_volume_m3"] * density, 1e-300)
    # (none as long as nothing has landed)
    p50 = f" PEEQ {row['peeq_p50']:.2f}," if row["peeq_p50"] is not None else ""
    t50 = f" {row['temperature_p50_degC']:.0f} degC," if row["temperature_p50_degC"] is not None else ""
    return (f"cycle {row['cycle']}/{cycles} done: {count_text(row['particles'], 'particle')}, dense height "
            f"{1e6 * row['dense_height_m']:.1f} um, surface mean {1e6 * row['height_mean_m']:.1f} max "
            f"{1e6 * row['height_max_m']:.1f} um,{p50}{t50} loss {100 * row['numerical_loss_fraction']:.1f} %, "
            f"unexplained {100 * unexplained:.2f} %"
            + (f", {row['particles_in_flight']} still in flight" if row["particles_in_flight"] else "")
            + (f", left the box: {100 * left:.1f} % of the powder's mass" if left >= 5e-4 else ""))


def silence() -> None:
    """Let what is still to be printed go nowhere: nobody reads it any more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def tell(text: str, end: str = "\n") -> bool:
    """Print at once; return whether that was possible.

    A run goes on in silence whose reader has gone (a closed pipe or terminal) or whose log has no room left.
    """
    if sys.stdout is None:  # (closed before the start)
        return False
    try:
        sys.stdout.write(text + end)
        sys.stdout.flush()
    except OSError:
        silence()
        return False
    return True


class Progress:
    """Progress lines of rank 0; silent elsewhere.

    ``share``: which share of the work of the whole run is to be done at a simulated time (s); ``interval``: wall time
    between lines (s); ``under_launcher``: started by mpirun. The estimated end counts only this session, from its first
    step on (which may have compiled the kernels), and is left out until ``ETA_SHARE`` of its work is done.
    """

    def __init__(self, speaks: bool, share: Callable[[float], float], interval: float,
                 under_launcher: bool = False) -> None:
        self.speaks = speaks
        self.share, self.done_before = share, 0.0
        self.interval = interval
        self.last = time.monotonic()
        self.start: float | None = None  # end of the first step
        # mpirun gives rank 0 a terminal of its own, whatever its output goes to
        self.on_terminal = speaks and sys.stdout.isatty() and not under_launcher
        self._open_line = False

    def say(self, text: str) -> None:
        """Print a line of its own."""
        if not self.speaks:
            return
        self._write(("\n" if self._open_line else "") + text + "\n")
        self._open_line = False

    def _write(self, text: str) -> None:
        if not tell(text, ""):
            self.speaks = self.on_terminal = False

    def step(self, clock, cycle: int, cycles: int, duration: float,
             in_flight: Callable[[], float] = lambda: 0.0) -> None:
        """Report the present step when it is time to; ``in_flight``: the fastest particle not on the grid yet (m/s)."""
        if not self.speaks:
            return
        now = time.monotonic()
        if self.start is None:
            self.start, self.done_before = now, self.share(clock.time)
        if not self._due(now):
            return
        share = self.share(clock.time)
        fastest = max(clock.limits.heavy_speed, in_flight())
        text = (f"cycle {cycle + 1}/{cycles}  {1e9 * clock.in_cycle:7.1f} of {1e9 * duration:.0f} ns"
                f"  step {clock.steps}  dt {1e12 * clock.dt:.0f} ps ({clock.limit})"
                f"  fastest {fastest:.0f} m/s  {100.0 * share:5.1f} % of the work{self._eta(now, share)}")
        self._renew(text, share)

    def dwell(self, left: float, duration: float, cycle: int, cycles: int) -> None:
        """Report the dwell after ``cycle`` of ``cycles`` when it is time to; ``left`` of its ``duration`` (s)."""
        if self.speaks and self._due(time.monotonic()):
            share = 1.0 - left / duration
            self._renew(f"dwell after cycle {cycle}/{cycles}  {100.0 * share:5.1f} % of {pretty(duration, 'time')}",
                        share)

    def _due(self, now: float) -> bool:
        """Tell whether it is time for another line, and if so take it for said."""
        if now - self.last < (0.5 if self.on_terminal else self.interval):
            return False
        self.last = now
        return True

    def _renew(self, text: str, share: float) -> None:
        """Print a line of progress: on a terminal in the place of the one before, with a bar of the ``share`` done."""
        if self.on_terminal:
            bar = ("#" * int(20 * share)).ljust(20, ".")
            self._write(f"\r[{bar}] {text}\033[K")
            self._open_line = True
        else:
            self.say(text)

    def _eta(self, now: float, share: float) -> str:
        """Return the time that is left, as the line ends with it; nothing while it cannot be told."""
        passed, left = share - self.done_before, 1.0 - share
        if passed <= 0.0 or passed < ETA_SHARE * (passed + left):
            return ""
        return f"  ETA {clock_text((now - self.start) * left / passed)}"
