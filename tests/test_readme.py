"""What README shows is run as it stands there."""

from __future__ import annotations

import os
import re
import subprocess
import sys

from conftest import ROOT, f2s

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_example_runs_as_it_is_printed(tmp_path):
    """On a small run in the place of ``runs/s4``. Fails when a name that it uses is moved or takes other arguments."""
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    f2s("run", "splat-quarter", "--out", "runs/s4", "--set", "cycles.duration=40 ns", "--set",
        "domain.cell_size=4 um", cwd=tmp_path)
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, env=variables, capture_output=True, text=True,
                          timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert 0.0 < float(lines[0]) < 1e-4
    assert lines[3] == "(58, 58, 100) 650.0"


def test_each_command_of_readme_is_one(tmp_path):
    """Every ``f2s COMMAND`` in a block of commands, and every script. Fails when one is renamed."""
    blocks = "\n".join(line for line in README.splitlines() if line.startswith("    "))
    commands = set(re.findall(r"(?:^|[ ;])f2s ([a-z]+)", blocks))
    assert len(commands) > 10
    listed = f2s("--help", cwd=tmp_path).stdout
    assert all(re.search(rf"^ +{command}\b", listed, re.MULTILINE) for command in commands), commands
    for script in set(re.findall(r"(?:scripts|jobs)/[a-z0-9_.-]+[a-z0-9]", README)):
        assert (ROOT / script).exists(), script
