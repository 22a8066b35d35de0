"""More cycles, or fewer, for a run that goes on."""

from __future__ import annotations

from f2s_hpc import mpi
from f2s_hpc.config.schema import Scene
from f2s_hpc.cycles.output import RunFolder
from f2s_hpc.errors import InputError
from f2s_hpc.particles.plan import make_batches, plan_digest
from f2s_hpc.units import count_text, pretty


def change_cycles(folder: RunFolder, saved: Scene, attributes: dict) -> list[str]:
    """Give the run in ``folder`` the cycles of its scene, where the checkpoint's (``saved``) has another number.

    ``attributes``: of the checkpoint. Further cycles get the batches that a run of so many would have had from the
    start. Returns notes. Collective; raises ``InputError`` for cycles that are done already, or batches that are no
    longer to be had.
    """
    scene, before = folder.scene, saved.cycles.count
    wanted, begun = scene.cycles.count, attributes["cycle"] + bool(attributes["batch_is_in"])
    if wanted == before:
        return []
    if wanted < begun:
        raise InputError(f"--set cycles.count={wanted}: of this run {count_text(begun, 'cycle')} came before; fewer "
                         "are not possible")
    if wanted > before:
        old, new = RunFolder(folder.path, saved).read_plan(), mpi.run_together(make_batches, scene)
        if plan_digest(new, before) != plan_digest(old, before):
            raise InputError(f"--set cycles.count={wanted}: the batches that the scene gives are not those of this "
                             "run; its CSV files must be as they were")
        folder.write_longer_input(new)
    first, last = saved.cycles.duration, saved.cycles.durations[-1]
    if attributes["cycle"] < before or wanted < before or first == last:
        return []
    return [(f"cycle {before} was the last and took {pretty(last, 'time')}; in a run of {wanted} from the start it "
             f"would have taken {pretty(first, 'time')}")]
