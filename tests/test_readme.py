"""What README shows is run as it stands there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections import Counter

from conftest import ROOT, f2s

from f2s_hpc.cli.notes import scene_notes
from f2s_hpc.config import load_scene, scene_text
from f2s_hpc.particles.plan import make_batches

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
    assert len(lines) == 5
    assert 0.0 < float(lines[0]) < 1e-4
    lowest, stress = map(float, lines[2].split())
    assert -42e-6 < lowest < -30e-6
    assert -5e9 < stress < -1e7
    assert lines[4] == "(58, 58, 100) 650.0"


def test_each_command_of_readme_is_one(tmp_path):
    """Every ``f2s COMMAND`` in a block of commands, and every script. Fails when one is renamed."""
    blocks = "\n".join(line for line in README.splitlines() if line.startswith("    "))
    commands = set(re.findall(r"(?:^|[ ;])f2s ([a-z]+)", blocks))
    assert len(commands) > 10
    listed = f2s("--help", cwd=tmp_path).stdout
    assert all(re.search(rf"^ +{command}\b", listed, re.MULTILINE) for command in commands), commands
    for script in set(re.findall(r"(?:scripts|jobs)/[a-z0-9_.-]+[a-z0-9]", README)):
        assert (ROOT / script).exists(), script


def anchors() -> list[str]:
    """Return the anchors of all headings, as GitHub makes them: small letters, hyphens for blanks, no other marks."""
    text = re.sub(r"```.*?```", "", README, flags=re.DOTALL)
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads]


def test_each_link_leads_somewhere():
    """Fails when a heading is renamed and a link to it is not, two have one name, or a section is in no list."""
    found = anchors()
    assert [name for name, times in Counter(found).items() if times > 1] == []
    targets = re.findall(r"\]\(([^)\s]+)\)", README)
    assert len(targets) > 30
    for target in targets:
        if target.startswith("#"):
            assert target[1:] in found, target
        elif "://" not in target:
            assert (ROOT / target).exists(), target
    contents, *sections = README.split("\n## Contents\n")[1].split("\n## ")
    assert {*re.findall(r"\[([^\]]+)\]\(#", contents), "Licence"} == {text.split("\n")[0] for text in sections}


def test_lines_are_short_and_what_is_opened_is_closed():
    """Tables and pictures need one line each. Fails for any other line above 120 characters."""
    assert [line for line in README.splitlines() if len(line) > 120 and not line.startswith(("|", "!"))] == []
    for mark in ("details", "summary"):
        assert README.count(f"<{mark}>") == README.count(f"</{mark}>")


def test_the_lines_for_an_own_scene_make_one(tmp_path):
    """They replace those of ``section4``, as README says, and nothing is left to be noted.

    Fails when a key of theirs is renamed, a material is, or the cycles are shorter than the flight through the layer.
    """
    (lines,) = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    text = scene_text("section4")
    for section, keys in tomllib.loads(lines).items():
        for key, value in keys.items():
            text, count = re.subn(rf"(\[{section}\]\n(?:[^\[\n].*\n)*?){key} = .*", rf'\g<1>{key} = "{value}"', text)
            assert count == 1, key
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    scene = load_scene(tmp_path / "mine.toml")
    assert (scene.particles.speed, scene.batches.diameter_d50, scene.material.name) == (
        700.0, 28e-6, "aluminium-6061-t6")
    assert scene_notes(scene, make_batches(scene)) == []
