"""Where results come from: the commit of a repository or of a worktree of it, and who looks it up."""

from __future__ import annotations

import subprocess

import pytest
from test_damaged import SCENE

from f2s_hpc import mpi, origin
from f2s_hpc._cache import package_hash
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene
from f2s_hpc.cycles import output, simulation
from f2s_hpc.io import runs


def git(*words: str) -> str:
    return subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True, capture_output=True,
                          text=True).stdout.strip()


def test_commit_of_a_repository_and_of_its_worktrees(tmp_path):
    """Fails if ``gitdir:`` or ``commondir`` is not followed, or packed branches are not read."""
    main, tree = str(tmp_path / "main"), str(tmp_path / "tree")
    git("init", "-q", main)
    git("-C", main, "commit", "-q", "--allow-empty", "-m", "one")
    git("-C", main, "worktree", "add", "-q", "-b", "other", tree)
    git("-C", tree, "commit", "-q", "--allow-empty", "-m", "two")
    for folder in (main, tree):
        assert origin.commit_of(tmp_path / folder) == git("-C", folder, "rev-parse", "HEAD")
    assert origin.commit_of(tmp_path / "main") != origin.commit_of(tmp_path / "tree")
    git("-C", main, "pack-refs", "--all")
    for folder in (main, tree):
        assert origin.commit_of(tmp_path / folder) == git("-C", folder, "rev-parse", "HEAD")
    assert origin.commit_of(tmp_path) is None


@pytest.mark.mpi
def test_one_rank_reads_the_origin_for_all(shared_path, monkeypatch):
    """Fails if each rank of a large job reads git's files and the whole package."""
    asked = []
    monkeypatch.setattr(output, "versions", lambda: asked.append(0) or {"commit": "c", "sources": "s"})
    told = output.RunFolder(shared_path, load_scene("splat")).provenance()
    assert told["sources"] == "s"
    assert len(asked) == (1 if mpi.is_root() else 0)


def test_the_origin_is_that_of_the_start(tmp_path, monkeypatch):
    """Fails if the sources are read when the first file is written, maybe an hour and some edits later."""
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    advance = simulation.advance

    def edited(*arguments) -> None:
        monkeypatch.setattr(output, "versions", lambda: {"sources": "edited"})
        advance(*arguments)

    monkeypatch.setattr(simulation, "advance", edited)
    assert main(["run", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "run"), "--set",
                 "output.picture=false"]) == 0
    assert runs.read_summary(tmp_path / "run")["versions"]["sources"] == package_hash()
