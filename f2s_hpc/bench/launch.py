"""Starting f2s in a process of its own, for the scripts that measure whole runs."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence

from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import F2SError


def f2s(*words: str, settings: Sequence[str] = ()) -> list[str]:
    """Return the command of this Python's f2s, with ``settings`` as its ``--set``."""
    return [sys.executable, "-m", "f2s_hpc", *words, *(word for setting in settings for word in ("--set", setting))]


def on_ranks(launcher: str, ranks: int, command: Sequence[str]) -> list[str]:
    """Return ``command`` started by ``launcher`` ("mpirun -n") on so many ranks."""
    return [*shlex.split(launcher), str(ranks), *command]


def run(command: Sequence[str], what: str, environment: Mapping[str, str] | None = None, quiet: bool = True) -> None:
    """Run a command, its output kept unless not ``quiet``; raises ``F2SError`` that names ``what`` if it fails."""
    done = subprocess.run(list(command), env=launch_environment(os.environ) | dict(environment or {}),
                          capture_output=quiet, text=True, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        said = ((done.stderr or "").strip() or (done.stdout or "").strip() or "no word").splitlines()[-1]
        raise F2SError(f"{what} ended with {done.returncode}" + (f": {said}" if quiet else ""))
