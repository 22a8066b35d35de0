"""What the tests of the scripts and of the job templates share."""

from __future__ import annotations

import os
import pathlib
import subprocess
import textwrap

from f2s_hpc.doctor import launch_environment

FAKE_MPIRUN = 'shift 2\nexec "$@"'


def write_command(path: pathlib.Path, body: str) -> None:
    """Write a shell script that can be run, a stand-in of a command."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/usr/bin/env bash\n" + textwrap.dedent(body) + "\n")
    path.chmod(0o755)


def plain_environment() -> dict[str, str]:
    """What the tests were started with, without what would lead the scripts elsewhere."""
    return {name: value for name, value in launch_environment(os.environ).items()
            if not name.startswith(("SLURM_", "F2S_", "PYTEST_"))}


def bash(command: list[str], cwd: pathlib.Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run bash in ``cwd`` with more ``variables``; the exit code is not checked."""
    return subprocess.run(["bash", *command], cwd=cwd, env=plain_environment() | variables, stdin=subprocess.DEVNULL,
                          timeout=120, capture_output=True, text=True, check=False)
