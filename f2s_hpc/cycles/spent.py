"""What a run has spent: wall time, memory, and where the time went; of all its sessions together."""

from __future__ import annotations

import os
import pathlib
import time

import numpy as np

from f2s_hpc import mpi, phases

_IMPORTED = time.monotonic()


class Spent:
    """Sums up what the sessions of a run have spent."""

    def __init__(self) -> None:
        self.before = {"wall_s": 0.0, "peak_memory_bytes_per_rank": 0, "peak_memory_bytes": 0, "phases": {}}

    def restore(self, saved: dict) -> None:
        """Take up what :meth:`so_far` returned to an earlier session."""
        self.before |= saved
        if "phases" not in saved:  # (older checkpoints do not tell)
            wall = self.before["wall_s"]
            self.before["phases"] = {"other": {"mean_s": wall, "largest_s": wall}}

    def so_far(self, elapsed: float) -> dict:
        """Return wall time (s) and peak memory, and the mean and the largest seconds of the ranks in each phase.

        ``elapsed``: wall time (s) of this session, whose phases end up as much. Of several sessions the largest are
        added, whichever rank they were on. Collective.
        """
        before = self.before
        found = mpi.all_gather((elapsed, peak_memory(), phases.seconds()))
        memory, spent = [entry[1] for entry in found], np.array([entry[2] for entry in found])
        table = {name: {"mean_s": float(mean), "largest_s": float(largest)}
                 for name, mean, largest in zip(phases.PHASES, spent.mean(axis=0), spent.max(axis=0))}
        for name, earlier in before["phases"].items():
            for key, seconds in earlier.items():
                table[name if name in table else "other"][key] += seconds  # (another version may divide otherwise)
        return {"wall_s": before["wall_s"] + found[mpi.ROOT][0], "phases": table,
                "peak_memory_bytes_per_rank": max(before["peak_memory_bytes_per_rank"], *memory),
                "peak_memory_bytes": max(before["peak_memory_bytes"], sum(memory))}


def process_age() -> float:
    """Return how long this process has been running (s), imports included; without /proc, since this module's own."""
    try:
        fields = pathlib.Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")  # field 22 of proc(5), since boot
        return time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (OSError, AttributeError, ValueError, IndexError):
        return time.monotonic() - _IMPORTED


def peak_memory() -> int:
    """Return the largest resident memory of this rank so far (bytes).

    Linux says it of this program alone; the resource usage that others know includes what started it.
    """
    try:
        for line in pathlib.Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource  # (not on Windows, where runs are only measured)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
