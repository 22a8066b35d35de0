"""What the commands do, once their arguments are parsed. Collective unless said otherwise."""

from __future__ import annotations

import itertools
import os
import pathlib
import shlex

from f2s_hpc import mpi, places
from f2s_hpc._jit import is_compiled
from f2s_hpc.analysis.table import TABLE_KEY, format_table, where_the_time_went
from f2s_hpc.cli.notes import crowded_nodes, median_diameter, node_and_cores, scene_notes
from f2s_hpc.config import describe, dump_scene, load_scene
from f2s_hpc.config.load import parse_scene
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.lengthen import plan_of_cycles
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.cycles.progress import tell
from f2s_hpc.cycles.simulation import COMPLETE, RUNNING, TIMEOUT, Simulation
from f2s_hpc.cycles.tracers import bytes_saved
from f2s_hpc.errors import CheckpointError, InputError
from f2s_hpc.grid.box import Box
from f2s_hpc.grid.decomposition import process_grid
from f2s_hpc.io import checkpoint, layout, runs
from f2s_hpc.io.manifest import text_digest
from f2s_hpc.kernels import strain
from f2s_hpc.particles.batch import clipped_volume, write_csv
from f2s_hpc.particles.plan import BatchPlan, make_batches
from f2s_hpc.units import count_text, pretty, pretty_bytes
from f2s_hpc.workload import memory
from f2s_hpc.workload.balance import Balance, balance_of_run

EXIT_REQUEUE = 75
"""Exit code of a run that stopped early with a good checkpoint: run ``f2s resume`` to go on."""

BATCH_PICTURE = "batches.png"


def load(name: str, overrides: list[str]) -> Scene:
    """Read a scene on rank 0 and give it to all; a wrong one ends all ranks with the same line."""
    return mpi.run_together(load_scene, name, overrides)


def _painted(scene: Scene, plan) -> tuple[int, float]:
    """Return the number of particles of the whole run and their volume inside the box (m3)."""
    x, y, z = scene.domain.extents
    volumes = [clipped_volume(batch, x, y, z) for batch in plan.batches]
    return (sum(plan.batches[b].count for b in plan.order), sum(volumes[b] for b in plan.order))


def check(scene: Scene) -> str:
    """Return what running the scene will take; nothing is computed but the batches and the load they will make."""
    plan = mpi.run_together(make_batches, scene)
    balance = balance_of_run(scene, plan)
    parts = list(itertools.product(*balance.ranges))
    particles, volume = _painted(scene, plan)
    text = describe(scene, mpi.size(), parts, painted_volume=volume, particles=particles,
                    more=[("resolution", _resolution_line(scene, plan)),
                          ("memory", _memory_line(scene, balance, plan)), *_tracer_line(scene, particles),
                          ("imbalance", _balance_line(balance)),
                          ("run time", "'f2s plan SCENE' foretells it, on any number of ranks")])
    return "\n".join([text, *(f"# note: {message}" for message in [*scene_notes(scene, plan), *plan.messages])])


def _resolution_line(scene: Scene, plan: BatchPlan) -> str:
    """Return how many cells lie across the median particle, on which the error of a run depends."""
    median = median_diameter(scene, plan)
    return (f"{median / scene.domain.cell_size:.3g} cells across the median particle of {pretty(median, 'length', 3)}; "
            "how accurate that is: README, 'Which cells to choose'")


def _memory_line(scene: Scene, balance: Balance, plan: BatchPlan) -> str:
    """Return what the rank that needs most memory will need of it."""
    need = memory.of_fullest(scene, balance.ranges, plan)
    more = memory.on_root(scene, need, plan)
    root = f"; {pretty_bytes(more)} more on rank 0 to measure and draw the deposit" if more else ""
    return (f"{pretty_bytes(need.total)} on the largest rank: {pretty_bytes(need.baseline)} for the process and its "
            f"libraries, and {need.per_cell:.0f} bytes per cell{root}")


def _tracer_line(scene: Scene, particles: int) -> list[tuple[str, str]]:
    """Return what the points of the particles take; nothing in a scene without."""
    each = scene.output.tracers
    if not each:
        return []
    saved, file = bytes_saved(each, particles)
    text = (f"{each} points per particle, {each * particles:,} at the end: {pretty_bytes(saved)} more in a checkpoint, "
            f"{pretty_bytes(file)} in the file of the last cycle")
    return [("tracers", text)]


def _balance_line(balance: Balance) -> str:
    """Return how the expected load is shared among the ranks."""
    text = f"{balance.imbalance:.2f} expected (largest over mean active cell-steps of the ranks)"
    if balance.weighted:
        return text + f", with ranges weighted by the expected deposit; {balance.even:.2f} with even ones"
    return text + ", with even ranges"


def run(scene: Scene, out: str, started: float | None = None) -> int:
    """Run a scene into the new folder ``out``; return the exit code. ``started``: see ``StopRequest``."""
    place = runs.check_new_folder(out)
    plan = mpi.run_together(make_batches, scene)
    decomposition_fits(scene)
    _announce_compiling()  # (bad input is one line)
    # a run that cannot be set up leaves no folder that would pass for one that holds a run
    simulation = Simulation(scene, place, plan, started)
    folder = runs.prepare_run_folder(out)
    _say(f"{scene.title}: {scene.domain.cells[0]} x {scene.domain.cells[1]} x {scene.domain.cells[2]} cells of "
         f"{1e6 * scene.domain.cell_size:g} um on {count_text(mpi.size(), 'rank')}, into {folder}")
    for note in scene_notes(scene, plan):
        _say(f"note: {note}")
    simulation.begin()
    with runs.hold(folder):
        return _finish(simulation, folder)


def _announce_compiling() -> None:
    # (one of the last in a first step: f2s check has compiled others)
    if mpi.is_root() and not is_compiled(strain.lagrangian_step):
        _say("note: the kernels are compiled now, once: until the first step that takes a minute or so")


def decomposition_fits(scene: Scene) -> None:
    """Raise ``InputError`` on all ranks, before anything is written, if the box can not be cut for this rank count."""
    process_grid(Box(scene.domain.cells, scene.domain.cell_size), mpi.size())


def resume(folder: str, overrides: list[str], started: float | None = None) -> int:
    """Continue the run in ``folder`` from its newest valid checkpoint; return the exit code.

    ``started``: see ``StopRequest``.
    Raises ``InputError`` where there is no such folder, or for a setting that can not change on the way;
    ``CheckpointError`` where no checkpoint is valid.
    """
    for text in overrides:
        key = _key(text)
        if key.split(".")[0].strip() not in ("run", "output") and key != "cycles.count":
            raise InputError(f'--set {text}: a resumed run may change only its "run" and "output" sections and '
                             "cycles.count")
    mpi.run_together(_refuse_other_folders, folder)
    _announce_compiling()
    with runs.hold(folder):
        return _resume(folder, overrides, started)


def _resume(folder: str, overrides: list[str], started: float | None) -> int:
    mpi.run_together(_may_go_on, pathlib.Path(folder))
    path, skipped = checkpoint.newest_valid_checkpoint(pathlib.Path(folder) / layout.CHECKPOINTS)
    for message in skipped:
        _say(message)
    attributes = mpi.run_together(_checkpoint_attributes, path)
    (saved, scene, notes), kept = mpi.run_together(_scenes_of, attributes, path, pathlib.Path(folder), overrides)
    decomposition_fits(scene)
    own = RunFolder(folder, scene)
    plan, more = plan_of_cycles(own, saved, attributes)
    simulation = Simulation(scene, folder, plan, started)
    simulation.resume(path)
    if plan is not None or kept not in (None, scene.cycles.count):
        own.write_other_cycles(plan)
    notes += more
    for name in checkpoint.set_aside_after(path):
        _say(f"note: {name} is damaged, and is called that now")
    for note in notes:
        _say(f"note: {note}")
    clock = simulation.clock
    if simulation.cycle == scene.cycles.count:
        _say(f"{path}: all {scene.cycles.count} cycles are done, nothing is left to run")
    else:
        _say(f"resuming from {path}: cycle {simulation.cycle + 1} of {scene.cycles.count}, step {clock.steps}, "
             f"{1e6 * clock.time:.4f} us, on {count_text(mpi.size(), 'rank')}")
    return _finish(simulation, folder)


def _refuse_other_folders(folder: str) -> None:
    """Raise ``InputError`` for what is no run's folder, before a lock is left there."""
    place = places.run_folder(folder) / layout.CHECKPOINTS
    if places.kind(place) != places.FOLDER:
        raise InputError(f"{place}: no such folder; is {folder} the folder of a run?")


def _checkpoint_attributes(path: os.PathLike) -> dict:
    return runs.open_checkpoint_serial(path, names=[])[1]


def _saved_scene(attributes: dict, source: str, overrides: list[str]) -> tuple[Scene, Scene, list[str]]:
    """Return the scene that a checkpoint holds, the same with ``overrides``, and notes on what is new in it."""
    text = attributes.get("scene")
    if not isinstance(text, str):
        raise CheckpointError(f"{source}: holds no scene, so it is not the checkpoint of a run")
    # of the text itself: an older version wrote fewer settings than this one would
    if text_digest(text) != attributes.get("scene_hash"):
        raise CheckpointError(f"{source}: its scene does not match its own hash")
    scene = parse_scene(text, source)
    saved = text.splitlines()
    new = [line for line in dump_scene(scene).splitlines() if line not in saved]
    notes = [f"{source}: saved by another version; its scene as read now differs in {', '.join(new)}"] if new else []
    if not overrides:
        return scene, scene, notes
    changed = parse_scene(text, source, overrides)
    if changed.output.origin and not scene.output.origin:
        raise InputError("--set output.origin: the particles' share must be followed from the start, and this run "
                         "began without; leave it out")
    return scene, changed, notes


def _may_go_on(folder: pathlib.Path) -> None:
    """Raise ``InputError`` if the run was told to stop, or now, not a cycle later, if it will not be able to write."""
    stop = folder / layout.STOP_FILE
    if places.kind(stop) != places.NOTHING:
        raise InputError(f"{stop}: tells this run to stop; remove that file to go on")
    for place in (folder, folder / layout.CHECKPOINTS, folder / layout.FRAMES):
        if places.kind(place) == places.FOLDER and not os.access(place, os.W_OK | os.X_OK):
            raise InputError(f"{place}: cannot be written (Permission denied); a run goes on in its own folder")


def _scenes_of(attributes: dict, path: pathlib.Path, folder: pathlib.Path,
               overrides: list[str]) -> tuple[tuple[Scene, Scene, list[str]], int | None]:
    """Return what :func:`_saved_scene` does, and the number of cycles that the scene in the folder tells of.

    The run has that many, if ``overrides`` do not say otherwise: it may continue from a checkpoint of before that was
    changed. Raises ``CheckpointError`` if the checkpoint at ``path`` is of another scene than the one in the folder.
    """
    found = _saved_scene(attributes, str(path), overrides)
    place = folder / layout.SCENE_FILE
    if places.kind(place) != places.FILE:
        return found, None
    try:
        own = parse_scene(place.read_text(encoding="utf-8-sig"), str(place))
    except (InputError, UnicodeDecodeError) as error:
        raise InputError(f"{place}: is not the scene of this run any more ({error}); put that back, or remove the "
                         "file: the checkpoint is enough to go on") from None
    _same_run(found[0], own, path, place)
    if own.cycles.count != found[0].cycles.count and not any(_key(text) == "cycles.count" for text in overrides):
        found = _saved_scene(attributes, str(path), [*overrides, f"cycles.count={own.cycles.count}"])
    return found, own.cycles.count


def _key(override: str) -> str:
    return override.partition("=")[0].strip()


def _same_run(scene: Scene, own: Scene, path: pathlib.Path, place: pathlib.Path) -> None:
    for section in type(scene).model_fields:
        if section in ("title", "run", "output", "batches", "cycles"):
            continue
        if getattr(own, section) != getattr(scene, section):
            raise CheckpointError(f"{path}: is of another scene than {place}: their {section} differ; put back the one "
                                  "that belongs to this run")


def _finish(simulation: Simulation, folder: str | os.PathLike) -> int:
    for note in crowded_nodes(mpi.all_gather(node_and_cores())):
        _say(f"note: {note}")
    status = simulation.run()
    folder = pathlib.Path(folder)
    found = [(text, folder / name) for text, name in (
        ("numbers", layout.SUMMARY_JSON), ("cycle table", layout.SUMMARY_CSV), ("ParaView", layout.INDEX),
        ("view", layout.SERIES[layout.VIEW][0]))]
    found += [("picture", simulation.picture)] if simulation.picture else []
    _say(f"{status}: " + ", ".join(f"{text} {path}" for text, path in found if path.exists()))
    return 0 if status == COMPLETE else EXIT_REQUEUE


def write_particles(scene: Scene, out: str) -> int:
    """Write every batch of a scene as ``batch-NN.csv`` into the folder ``out``, and a picture of them; rank 0 only.

    Columns x,y,z,r in mm and, where the speed depends on the place, vx,vy,vz in m/s. The picture shows number and
    speed over x (figure 10 of Ge et al. 2026).
    """
    plan = mpi.run_together(make_batches, scene)
    folder = pathlib.Path(out)

    def write() -> list[str]:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a new folder with --out")
        if folder.is_dir() and any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty; name a new folder with --out")
        places.check_folder(folder, "--out")
        new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            return _written_batches(scene, plan, folder)
        except Exception:
            for path in folder.iterdir():  # all of it is ours: the folder was empty
                path.unlink(missing_ok=True)
            if new:
                folder.rmdir()
            raise

    lines = layout.attempt_on_root(write, f"{folder}: cannot be written", InputError)
    for line in [*lines, *(f"note: {m}" for m in plan.messages),
                 "order of batches over the cycles: " + " ".join(str(b + 1) for b in plan.order)]:
        _say(line)
    return 0


def _written_batches(scene: Scene, plan: BatchPlan, folder: pathlib.Path) -> list[str]:
    """Write the batches and their picture into ``folder``; return a line on each file."""
    lines = []
    x, y, z = scene.domain.extents
    for number, batch in enumerate(plan.batches, start=1):
        path = folder / f"batch-{number:02d}.csv"
        write_csv(path, batch)
        volume = clipped_volume(batch, x, y, z)
        lines.append(f"{path}: {count_text(batch.count, 'sphere')}, {1e6 * volume / (x * y):.2f} um of dense height")
    from f2s_hpc.analysis.stream import draw_batches  # (scipy.stats: 30 MB that a run has no use for)

    draw_batches(plan.batches, scene.domain.size[0], scene.particles.speed, folder / BATCH_PICTURE)
    return [*lines, f"picture {folder / BATCH_PICTURE}"]


def _counted(number: object, noun: str) -> str:
    """Return a number of a summary, which may be damaged, with its noun."""
    return count_text(number, noun) if isinstance(number, int) else f"{number} {noun}s"


def _standing(folder: str, status: object) -> tuple[object, list[str]]:
    """Return how the run in ``folder`` stands, and what to do then; ``status``: what it said last."""
    if status not in (RUNNING, TIMEOUT) or (busy := runs.at_work(folder)):
        return status, []
    go_on = (f"go on with: f2s resume {shlex.quote(str(folder))}" if runs.has_checkpoint(pathlib.Path(folder)) else
             "it has no checkpoint to go on from; remove it and run it anew")
    if status == TIMEOUT:
        return "stopped early", [go_on]
    if busy is None:
        return "running, or interrupted", [f"whether it is still at work cannot be told from here; if not, {go_on}"]
    return "interrupted", [f"nothing is at work in it any more; {go_on}"]


def inspect(folder: str) -> int:
    """Print the cycle table and the status of a run; rank 0 only. Raises ``InputError`` where there is no run."""
    def read() -> str:
        summary = runs.read_summary(folder)
        lacking = [key for key in ("scene", "status", "particles", "ranks") if key not in summary]
        if lacking:
            raise InputError(f"{pathlib.Path(folder) / layout.SUMMARY_JSON}: lacks {', '.join(lacking)}; "
                             f"is {folder} the folder of a run?")
        try:
            # (older runs do not tell)
            spent = [where_the_time_went(summary["phases"])] if "phases" in summary else []
        except InputError as error:
            raise InputError(f"{pathlib.Path(folder) / layout.SUMMARY_JSON}: {error}") from None
        rows = runs.read_cycle_table(folder)
        try:
            table = format_table(rows)
        except InputError as error:
            raise InputError(f"{pathlib.Path(folder) / layout.SUMMARY_CSV}: {error}") from None
        status, hints = _standing(folder, summary["status"])
        head = (f"{summary['scene']}: {status}, {_counted(summary['particles'], 'particle')}, "
                f"{_counted(summary['ranks'], 'rank')}")
        return "\n".join([head, *hints, *spent, table, TABLE_KEY])

    _say(mpi.run_together(read))
    return 0


def _say(text: str) -> None:
    if mpi.is_root():
        tell(text)
