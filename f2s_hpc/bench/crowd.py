"""Other cores at work: what a step takes while they step as well, since cores share caches and the memory bus.

    python -m f2s_hpc.bench.crowd PATCH.npz SCENE.toml

steps a saved patch, says so, and goes on until its standard input ends.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pathlib
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import numpy as np

from f2s_hpc.bench import states
from f2s_hpc.config.dump import dump_scene
from f2s_hpc.config.load import load_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.doctor import launch_environment
from f2s_hpc.errors import F2SError

TILES = (8, 8)
"""Size of the patch (tiles along x and y) that each core steps: 160 MB, far out of caches, so they share the bus."""

REMAPS = 10
"""After so many remaps a core begins again from the saved state."""

MOST = 16
"""Largest number of cores that are put to work; a memory bus is full long before."""


def cores() -> int:
    """Return how many cores this process may use, at most ``MOST``."""
    return min(len(os.sched_getaffinity(0)), MOST)


@contextlib.contextmanager
def crowd(saved: dict[str, np.ndarray], scene: Scene) -> Iterator[None]:
    """Keep all other cores busy with steps of a saved patch of the material of ``scene``.

    Raises ``F2SError`` if a process of the crowd ends before its time.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        patch, text = pathlib.Path(folder) / "patch.npz", pathlib.Path(folder) / "scene.toml"
        np.savez(patch, **saved)
        text.write_text(dump_scene(scene), encoding="utf-8")
        command = [sys.executable, "-m", "f2s_hpc.bench.crowd", str(patch), str(text)]
        others = [stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                                       env=launch_environment(os.environ))) for _ in range(cores() - 1)]
        try:
            if any(other.stdout.readline() != b"stepping\n" for other in others):
                raise F2SError("a process that should keep another core busy ended before its time")
            yield
        finally:
            for other in others:
                other.stdin.close()


def step_on(patch: str, scene: str) -> None:
    """Step the patch until standard input ends."""
    saved, model, setup = states.load(patch), states.model_for(load_scene(scene, [])), None
    for remap in itertools.count():
        if remap % REMAPS == 0:
            # it comes to rest, and steps at rest take less
            setup = states.tiled(saved, model, TILES)
        setup.advance_to_remap()
        if remap == 0:
            print("stepping", flush=True)
        if select.select([sys.stdin], [], [], 0.0)[0]:
            return


if __name__ == "__main__":
    step_on(*sys.argv[1:])
