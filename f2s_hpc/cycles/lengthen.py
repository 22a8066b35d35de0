"""More cycles, or fewer, for a run that goes on."""

from __future__ import annotations

from f2s_hpc import mpi
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.output import BATCHES, RunFolder, batch_name
from f2s_hpc.errors import InputError
from f2s_hpc.particles.plan import BatchPlan, make_batches, plan_digest
from f2s_hpc.units import count_text, pretty


def _with_own_files(scene: Scene, folder: RunFolder) -> Scene:
    """Return a scene whose batches come from files with the run folder's copies of them: others may be gone, or new."""
    files = scene.batches.files
    if not files:
        return scene
    own = tuple(str(folder.path / BATCHES / batch_name(number)) for number in range(1, len(files) + 1))
    return scene.model_copy(update={"batches": scene.batches.model_copy(update={"files": own})})


def plan_of_cycles(folder: RunFolder, saved: Scene, attributes: dict) -> tuple[BatchPlan | None, list[str]]:
    """Return the batches of a run that gets more cycles than its checkpoint's scene (``saved``) has, and notes.

    ``folder``: of the run, with the scene that it shall have; ``attributes``: of the checkpoint. Further cycles get the
    batches that a run of so many would have had from the start; None where the folder's are enough. Nothing is written.
    Collective; raises ``InputError`` for cycles that are done already or have gone on for longer than they would take,
    and for batches that are no longer to be had.
    """
    scene, before, done = folder.scene, saved.cycles.count, attributes["cycle"]
    wanted, begun = scene.cycles.count, done + bool(attributes["batch_is_in"])
    asked = f"cycles.count = {wanted}"
    if wanted == before:
        return None, []
    if wanted < begun:
        raise InputError(f"{asked}: of this run {count_text(begun, 'cycle')} came before; fewer are not possible")
    passed = attributes["clock"]["in_cycle"]
    if begun > done and passed > scene.cycles.durations[done] * (1.0 + 1e-9):
        raise InputError(f"{asked}: cycle {begun} has gone on for {pretty(passed, 'time')} already, longer than it "
                         f"takes in a run of {wanted} ({pretty(scene.cycles.durations[done], 'time')}); let it end "
                         "first")
    plan = None
    if wanted > before:
        old = RunFolder(folder.path, saved).read_plan()
        plan = mpi.run_together(make_batches, _with_own_files(scene, folder), bool(scene.batches.files))
        if plan_digest(plan, before) != plan_digest(old, before):
            raise InputError(f"{asked}: the batches that the scene gives are not those of this run; those in "
                             f"{folder.path / BATCHES} must be as they were, and generated ones come of the same "
                             "version of the code")
    first, last = saved.cycles.duration, saved.cycles.durations[-1]
    if done < before or wanted < before or first == last:
        return plan, []
    return plan, [(f"cycle {before} was the last and took {pretty(last, 'time')}; in a run of {wanted} from the start "
                   f"it would have taken {pretty(first, 'time')}")]
