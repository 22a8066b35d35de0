"""Starting f2s in a process of its own, and what it left, for the scripts that measure whole runs."""

from __future__ import annotations

import os
import pathlib
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence

from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import F2SError
from f2s_hpc.io import layout, runs

RULE = re.compile(r"[-=*]{20,}")
LAUNCHER = re.compile(r"\[[^\]]+:\d+\]|srun: |slurmstepd: ")


def f2s(*words: str, settings: Sequence[str] = ()) -> list[str]:
    """Return the command of this Python's f2s, with ``settings`` as its ``--set``."""
    return [sys.executable, "-m", "f2s_hpc", *words, *(word for setting in settings for word in ("--set", setting))]


def on_ranks(launcher: str, ranks: int, command: Sequence[str]) -> list[str]:
    """Return ``command`` started by ``launcher`` ("mpirun -n") on so many ranks."""
    return [*shlex.split(launcher), str(ranks), *command]


def reason(said: str) -> str:
    """Return the line of ``said``, what a command has printed, that tells why it failed: its last one.

    What mpirun (blocks between rules, lines that begin with [host:process]) and srun add comes after it and only tells
    that a rank has failed; where nothing else was said, the first line of that.
    """
    lines, inside, added = [], False, []
    for line in filter(None, map(str.strip, said.splitlines())):
        if RULE.fullmatch(line):
            inside = not inside
        elif inside or LAUNCHER.match(line):
            added.append(line)
        else:
            lines.append(line)
    return (lines[-1:] or added or ["no word"])[0]


def run(command: Sequence[str], what: str, environment: Mapping[str, str] | None = None, quiet: bool = True) -> None:
    """Run a command, its output kept unless not ``quiet``; raises ``F2SError`` that names ``what`` if it fails."""
    try:
        done = subprocess.run(list(command), env=launch_environment(os.environ) | dict(environment or {}),
                              capture_output=quiet, text=True, check=False, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise F2SError(f"{command[0]}: cannot be started ({error.strerror})") from None
    if done.returncode:
        said = (done.stderr or "").strip() or done.stdout or ""
        raise F2SError(f"{what} ended with {done.returncode}" + (f": {reason(said)}" if quiet else ""))


def finished(folder: pathlib.Path, keys: Sequence[str]) -> dict:
    """Return the summary of the complete run in ``folder``.

    Raises ``F2SError`` if there is none, it is not complete, or its summary lacks one of ``keys``.
    """
    summary = runs.read_summary(folder)
    lacking = [key for key in ("status", *keys) if key not in summary]
    if lacking:
        raise F2SError(f"{folder / layout.SUMMARY_JSON}: lacks {', '.join(lacking)}; is {folder} the folder of a run?")
    if summary["status"] != "complete":
        raise F2SError(f"{folder}: the run is {summary['status']}, not complete")
    return summary
