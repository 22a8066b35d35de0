"""Where results come from: the commit of a repository or of a worktree of it, and who looks it up."""

from __future__ import annotations

import platform
import subprocess

import pytest
from test_damaged import SCENE

from f2s_hpc import mpi, origin
from f2s_hpc._cache import package_hash
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene
from f2s_hpc.config.dump import scene_hash
from f2s_hpc.cycles import output, simulation
from f2s_hpc.io import checkpoint, layout, runs


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


@pytest.mark.mpi
def test_every_file_says_which_run_it_is_of_and_where_that_ran(shared_path):
    """Fails if ``identity`` is left out of the checkpoint's attributes, of the summary, or of the frames."""
    if mpi.is_root():
        (shared_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    mpi.barrier()
    folder = shared_path / "run"
    assert main(["run", str(shared_path / "scene.toml"), "--out", str(folder), "--set", "output.picture=false", "--set",
                 "cycles.count=1", "--set", "cycles.last_duration=1 ns", "--set", "batches.seed=7"]) == 0
    scene = load_scene(str(folder / layout.SCENE_FILE))
    wanted = {"scene_hash": scene_hash(scene), "seed": 7, "host": platform.node(), "ranks": mpi.size()}
    (newest,) = checkpoint.list_checkpoints(folder / layout.CHECKPOINTS)
    for told in (runs.open_checkpoint_serial(newest, [])[1], runs.read_summary(folder),
                 runs.read_frame_meta(folder / layout.FRAMES / layout.frame_name(0)).provenance):
        assert {key: told.get(key) for key in wanted} == wanted
