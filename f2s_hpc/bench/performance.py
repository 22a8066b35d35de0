"""What whole runs cost: one sphere as other codes ran it, start-up, empty height, cost per particle."""

from __future__ import annotations

import pathlib
import resource
import statistics
import tomllib
from collections.abc import Sequence

from f2s_hpc.bench import launch
from f2s_hpc.errors import F2SError
from f2s_hpc.io import layout, runs
from f2s_hpc.units import count_text

QUIET = ("output.frames=none", "output.checkpoints=false", "output.picture=false")

PEERS_SPLAT = (
    'domain.size=["150 um", "150 um", "120 um"]', "domain.cell_size=3 um", "domain.substrate_height=75 um",
    "domain.particle_layer_height=45 um", "material.name=copper-johnson-cook", "particles.temperature=25 degC",
    'batches.spheres=[["75 um", "75 um", "18 um", "15 um"]]', "cycles.duration=100 ns",
    *(f"domain.faces.{side}=free" for side in ("x_low", "x_high", "y_low", "y_high")))
"""30 um copper sphere, 615 m/s, Johnson-Cook, block of 150 x 150 x 75 um, 3 um, 100 ns; bottom fixed, sides free."""


def read_scene_text(folder: pathlib.Path) -> dict:
    """Return the scene of a run folder as it is written there; raises ``F2SError`` if there is none."""
    try:
        return tomllib.loads((folder / layout.SCENE_FILE).read_text(encoding="utf-8"))
    except OSError as error:
        raise F2SError(f"{folder}: no run to read ({error.strerror})") from None


def run_once(scene: str, settings: Sequence[str], folder: pathlib.Path, **environment: str) -> dict:
    """Run a scene on one core; return its summary and ``cpu_s``, user and system time of the whole process.

    Raises ``F2SError`` if it fails.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    launch.run(launch.f2s("run", scene, "--out", str(folder), settings=(*QUIET, *settings)), f"the run of {scene}",
               environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return runs.read_summary(folder) | {"cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def splat(out: pathlib.Path) -> str:
    """Return the cost of the sphere that other codes ran."""
    run_once("splat", [*PEERS_SPLAT, "cycles.duration=1 ns"], out / "splat-warm")  # kernels in the cache
    found = run_once("splat", PEERS_SPLAT, out / "splat")
    return (f"one sphere of 30 um, 150 x 150 x 75 um, 3 um, Johnson-Cook, 100 ns: {found['cpu_s']:.1f} s of CPU on one "
            f"core, start and all, {found['steps']} steps, {found['active_cell_steps'] / 1e6:.0f} M cell-steps, "
            f"{found['peak_memory_bytes'] / 1e6:.0f} MB")


def startup(out: pathlib.Path) -> str:
    """Return how long section4 takes to its first step, with a warm and with a cold cache of kernels."""
    first = ("cycles.count=1", "cycles.duration=1 ns", "cycles.last_duration=1 ns")
    run_once("section4", first, out / "start-first")
    warm = min(run_once("section4", first, out / f"start-warm-{n}")["startup_s"] for n in range(3))
    cache = str((out / "cache").resolve())
    cold = run_once("section4", first, out / "start-cold", F2S_CACHE_DIR=cache)["startup_s"]
    return (f"section4 at 3 um, from the start of the process to the end of the first step: {warm:.1f} s, "
            f"{cold:.0f} s where all kernels have to be compiled")


def empty_height(out: pathlib.Path, pairs: int = 5) -> str:
    """Return what twice the height of the box of quickstart costs, the same particles starting at the same place."""
    launch.run(launch.f2s("particles", "quickstart", "--out", str(out / "batches")), "making the batches of quickstart")
    files = sorted(str(path) for path in (out / "batches").glob("*.csv"))
    low_box = [f"batches.files=[{', '.join(map(repr, files))}]"]
    high_box = [*low_box, 'domain.size=["0.12 mm", "0.12 mm", "0.6 mm"]', "domain.particle_layer_height=0.402 mm"]
    run_once("quickstart", low_box, out / "warm")  # kernels in the cache: compiling takes memory too
    low, high = [], []
    for n in range(pairs):  # in turn, so that what else the machine does meets both
        low.append(run_once("quickstart", low_box, out / f"low-{n}"))
        high.append(run_once("quickstart", high_box, out / f"high-{n}"))

    def more(key: str) -> float:
        return statistics.median(b[key] / a[key] for a, b in zip(low, high)) - 1.0

    return (f"quickstart in a box twice as high, medians of {pairs} pairs of runs: CPU time {more('cpu_s'):+.1%}, "
            f"cell-steps {more('active_cell_steps'):+.1%}, peak memory {more('peak_memory_bytes'):+.1%}")


PATCH = ('domain.size=["0.32 mm", "0.32 mm", "{height}"]', "batches.particles=418")
"""A patch of wide-100k with a 49th of its area and of its particles."""


def _on_ranks(scene: str, settings: Sequence[str], folder: pathlib.Path, ranks: int, launcher: str) -> dict:
    command = launch.f2s("run", scene, "--out", str(folder), settings=settings)
    launch.run(launch.on_ranks(launcher, ranks, command), f"the run of {scene}")
    return runs.read_summary(folder)


COMPARED = ("particles", "painted_volume_m3", "active_cell_steps", "wall_s", "peak_memory_bytes", "ranks")


def per_particle(wide: pathlib.Path, out: pathlib.Path, launcher: str) -> str:
    """Return the cost per particle of a finished run of wide-100k against section4, and against a patch of itself.

    Both with its cells and cycles, on as many ranks as it had; the patch with all its settings. By cell-steps, which do
    not depend on what else the machine does, and by the clock. Powder and number of cycles are the same, so their
    deposits are as high. Raises ``F2SError`` for a folder without such a run, or a run that fails.
    """
    many, scene = launch.finished(wide, COMPARED), read_scene_text(wide)
    ranks, domain, cycles = many["ranks"], scene["domain"], scene["cycles"]
    patch = [s.format(height=domain["size"][2]) for s in PATCH]
    alike = [f"domain.cell_size={domain['cell_size']}", f"cycles.count={cycles['count']}",
             f"cycles.last_duration={cycles['last_duration']}"]
    few = {"section4": _on_ranks("section4", alike, out / "section4", ranks, launcher),
           "a patch of itself": _on_ranks(str(wide / layout.SCENE_FILE), patch, out / "patch", ranks, launcher)}
    lines = [(f"cells of {domain['cell_size']}, {count_text(ranks, 'rank')}: wide-100k {many['particles']:,} "
              f"particles, {many['wall_s']:.0f} s, {many['peak_memory_bytes'] / 1e9:.2f} GB")]
    for name, small in few.items():
        lines.append(f"  against {name} ({small['particles']:,} particles, {small['wall_s']:.0f} s):")
        for key, what in (("active_cell_steps", "cell-steps"), ("wall_s", "wall time")):
            each, volume = (many[key] / many[by] / (small[key] / small[by]) - 1.0
                            for by in ("particles", "painted_volume_m3"))
            lines.append(f"    {what} per particle {each:+.1%}, per volume deposited {volume:+.1%}")
    return "\n".join(lines)
