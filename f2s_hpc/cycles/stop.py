"""Reasons to stop before the end: a signal, the wall-time budget, a file. Every rank may ask, all stop together."""

from __future__ import annotations

import contextlib
import os
import pathlib
import signal
import time
from collections.abc import Iterator

from f2s_hpc import mpi

# (Windows, where runs are only measured, has neither the first nor the last)
SIGNALS = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name))

LOOK_FOR_FILE = 2.0
"""Seconds of wall time between two looks for the stop file: shared file systems are slow to answer."""


class StopRequest:
    """Remembers that this rank was asked to stop.

    ``wall_time``: budget in seconds, or None; from ``started`` on, what ``time.monotonic`` gave at the start of the
    command (None: from now on), and with as much left at the end as saving has taken at most so far in this session.
    ``file``: rank 0 looks now and then whether it exists, None for no such file. SIGUSR1 and SIGTERM (what batch
    systems send before they kill) ask for a stop with a checkpoint, and so do SIGHUP (the terminal has gone; not under
    nohup) and the first Ctrl-C.
    """

    def __init__(self, wall_time: float | None, file: pathlib.Path | None = None,
                 started: float | None = None) -> None:
        self.start = time.monotonic()
        self.started = self.start if started is None else started
        self.reserve = 0.0
        self.wall_time = wall_time
        self.file = file if mpi.is_root() else None
        self.next_look = self.start
        self.found_file = False
        self.signalled: str | None = None
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._remember)

    def _remember(self, number: int, _frame) -> None:
        self.signalled = signal.Signals(number).name
        if number == signal.SIGINT:  # who asks twice does not want to wait
            signal.signal(number, signal.SIG_DFL)

    def elapsed(self) -> float:
        """Return the wall time of this session (s): since the creation of this object."""
        return time.monotonic() - self.start

    @contextlib.contextmanager
    def saving(self) -> Iterator[None]:
        """Measure how long what is done meanwhile takes: the budget must leave that much for the last time."""
        began = time.monotonic()
        yield
        self.reserve = max(self.reserve, time.monotonic() - began)

    def _is_spent(self) -> bool:
        return self.wall_time is not None and time.monotonic() - self.started + self.reserve > self.wall_time

    def asked(self) -> bool:
        """Tell whether this rank wants the run to stop."""
        return self.signalled is not None or self._is_spent() or self._file_is_there()

    def _file_is_there(self) -> bool:
        if self.file is not None and not self.found_file and (now := time.monotonic()) >= self.next_look:
            self.next_look = now + LOOK_FOR_FILE
            self.found_file = os.path.exists(self.file)  # (false where the file system does not answer)
        return self.found_file

    def reason(self) -> str:
        """Return why, for the log. Collective: a signal may have reached another rank only."""
        own = f"signal {self.signalled}" if self.signalled else f"{self.file} is there" if self.found_file else None
        found = [reason for reason in mpi.all_gather(own) if reason]
        return found[0] if found else "the wall-time budget is spent"
