"""Reasons to stop before the end: a signal, or the wall-time budget. Every rank may ask, all stop together."""

from __future__ import annotations

import signal
import time

from f2s_hpc import mpi

SIGNALS = (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopRequest:
    """Remembers that this rank was asked to stop.

    ``wall_time``: budget in seconds from the creation of this object, or None. SIGUSR1 and SIGTERM
    (what batch systems send before they kill) ask for a stop with a checkpoint, and so do SIGHUP (the terminal has
    gone; not under nohup) and the first Ctrl-C.
    """

    def __init__(self, wall_time: float | None) -> None:
        self.start = time.monotonic()
        self.wall_time = wall_time
        self.signalled: str | None = None
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._remember)

    def _remember(self, number: int, _frame) -> None:
        self.signalled = signal.Signals(number).name
        if number == signal.SIGINT:  # who asks twice does not want to wait
            signal.signal(number, signal.SIG_DFL)

    def elapsed(self) -> float:
        """Return the wall time since the start (s)."""
        return time.monotonic() - self.start

    def asked(self) -> bool:
        """Tell whether this rank wants the run to stop."""
        return self.signalled is not None or (self.wall_time is not None and self.elapsed() > self.wall_time)

    def reason(self) -> str:
        """Return why, for the log. Collective: a signal may have reached another rank only."""
        found = [name for name in mpi.all_gather(self.signalled) if name]
        return f"signal {found[0]}" if found else "the wall-time budget is spent"
