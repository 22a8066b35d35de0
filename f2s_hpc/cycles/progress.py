"""What a running simulation says: plain lines every few seconds, one line kept fresh on a terminal."""

from __future__ import annotations

import os
import sys
import time


def clock_text(seconds: float) -> str:
    """Return a duration as h:mm:ss."""
    whole = int(round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def silence() -> None:
    """Let what is still to be printed go nowhere: nobody reads it any more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Progress:
    """Progress lines of rank 0; silent elsewhere.

    ``total_time``, ``done_time``: simulated time of the whole run and at the start of this session (s); ``interval``:
    wall time between lines (s); ``under_launcher``: started by mpirun. The estimated end counts only this session.
    """

    def __init__(self, speaks: bool, total_time: float, done_time: float, interval: float,
                 under_launcher: bool = False) -> None:
        self.speaks = speaks
        self.total_time, self.done_time = total_time, done_time
        self.interval = interval
        self.start = self.last = time.monotonic()
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
        """Write at once; a run whose reader has gone (a closed pipe) goes on in silence."""
        try:
            sys.stdout.write(text)
            sys.stdout.flush()
        except BrokenPipeError:
            self.speaks = self.on_terminal = False
            silence()

    def step(self, clock, cycle: int, cycles: int, duration: float) -> None:
        """Report the present step when it is time to."""
        if not self.speaks:
            return
        now = time.monotonic()
        if now - self.last < (0.5 if self.on_terminal else self.interval):
            return
        self.last = now
        share = clock.time / self.total_time
        passed = clock.time - self.done_time
        left = (now - self.start) * (self.total_time - clock.time) / passed if passed > 0.0 else 0.0
        text = (f"cycle {cycle + 1}/{cycles}  {1e9 * clock.in_cycle:7.1f} of {1e9 * duration:.0f} ns"
                f"  step {clock.steps}  dt {1e12 * clock.dt:.0f} ps ({clock.limit})"
                f"  fastest {clock.limits.heavy_speed:.0f} m/s  {100.0 * share:5.1f} %  ETA {clock_text(left)}")
        if self.on_terminal:
            bar = ("#" * int(20 * share)).ljust(20, ".")
            self._write(f"\r[{bar}] {text}\033[K")
            self._open_line = True
        else:
            self.say(text)
