"""The hand-over from one cycle to the next, Fig. 6 of Ge et al. 2026: away from the new particles nothing may change.

The paper looks at the last increment of the second iteration and the first of the third. Here the checkpoint at the
end of a cycle is loaded, the next batch is put onto the grid, and every saved field is compared with the file, bit by
bit, in all cells that no new sphere touches and at all nodes that belong to no such cell.

With Eulerian flight the batch is painted exactly as the run paints it. With ballistic flight a run paints each sphere
only when it is about to meet something, between two steps, where nothing could be told from what the steps change. So
the batch is launched as the run does, and all spheres in flight that lie inside the box, of this batch and of those
before, are painted at once, at the time of the checkpoint and where they are then, by the function that the run uses.
Spheres above the top of the box are not. Where no new sphere touches a cell nothing is checked.
"""

from __future__ import annotations

import contextlib
import math
import os
import pathlib
import signal
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from f2s_hpc import fields
from f2s_hpc.config import Scene, parse_scene
from f2s_hpc.cycles.simulation import Simulation
from f2s_hpc.cycles.stop import SIGNALS
from f2s_hpc.io import runs
from f2s_hpc.kernels import derived, paint
from f2s_hpc.particles.batch import Batch, join
from f2s_hpc.report.deposit import checkpoints_by_cycle
from f2s_hpc.state import State

_LAYERS_AT_ONCE = 16


@dataclass(frozen=True)
class Handover:
    """What the insertion of a batch changed where it should change nothing.

    ``cycle``: at whose end; ``particles``: put onto the grid; ``cells``, ``new_cells``: of the box, and touched by new
    spheres; ``differences``: largest absolute difference of each saved field, and of the von Mises stress, outside of
    those, SI; ``different``: number of values that differ in any bit.
    """

    cycle: int
    particles: int
    cells: int
    new_cells: int
    differences: dict[str, float]
    different: int

    @property
    def exact(self) -> bool:
        """Tell whether every bit was carried over while something new came in."""
        return self.checked and self.different == 0

    @property
    def checked(self) -> bool:
        """Tell whether anything new came in: else the state was compared with its own file, which shows nothing."""
        return self.new_cells > 0


def memory_needed(scene: Scene) -> float:
    """Return the memory (bytes) that the check takes: the whole state of the solver."""
    allocated = scene.needed_fields
    return 8.0 * math.prod(scene.domain.cells) * len(allocated)


def check_handover(folder: str | os.PathLike, cycle: int | None = None) -> Handover | None:
    """Check the hand-over at the end of ``cycle`` of the run in ``folder``, or else the newest that still can be.

    It needs a checkpoint at the end of a cycle that another cycle follows; None when there is no such one. Nothing is
    written. Raises ``CheckpointError`` for a damaged checkpoint.
    """
    there = checkpoints_by_cycle(folder)
    for number in sorted(there, key=lambda n: (n == cycle, n), reverse=True):
        path = there[number]
        attributes = runs.open_checkpoint_serial(path, [])[1]
        scene = parse_scene(attributes["scene"], str(path))
        if attributes["cycle"] < scene.cycles.count:
            with _signals_as_before():
                simulation = Simulation(scene, folder)
            simulation.resume(path)
            return _compare(simulation, _put_in(simulation), path)
    return None


def _put_in(simulation: Simulation) -> Batch:
    """Put the next batch onto the grid; return its spheres there, as the module's text says."""
    report = simulation.insert()
    if simulation.supply.flight is None:
        return report.positions
    return simulation.supply.land_all() or join([])


@contextlib.contextmanager
def _signals_as_before() -> Iterator[None]:
    """Undo that a simulation takes the stop signals for itself: nothing here listens to it."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _compare(simulation: Simulation, spheres: Batch, path: pathlib.Path) -> Handover:
    state = simulation.state
    added = np.zeros(state.part.cell_shape)
    # found from the spheres, not from what changed: a change elsewhere must not hide itself
    paint.add_spheres(spheres.x, spheres.y, spheres.z, spheres.r, state.part.offset, state.part.box.dx, added)
    new = added[state.part.owned_cells] > 0.0
    near = _touched_nodes(new)
    differences, different = {}, 0
    with runs.CheckpointLayers(path) as file:
        for name in state.saved:
            old = ~(new if fields.BY_NAME[name].location == fields.CELL else near)
            largest, count = 0.0, 0
            owned = state.owned(name)
            for first in range(0, owned.shape[0], _LAYERS_AT_ONCE):
                layers = slice(first, min(first + _LAYERS_AT_ONCE, owned.shape[0]))
                before = file.layers(name, layers.start, layers.stop)[old[layers]]
                after = owned[layers][old[layers]]
                count += int((before.view(np.uint64) != after.view(np.uint64)).sum())
                largest = max(largest, float(np.abs(after - before).max(initial=0.0)))
            differences[name] = largest
            different += count
        differences["von_mises"] = _von_mises_difference(state, file, ~new)
    return Handover(simulation.cycle, spheres.count, new.size, int(new.sum()), differences, different)


def _touched_nodes(new: np.ndarray) -> np.ndarray:
    """Return the nodes (bool, one more per axis) of which any cell is new."""
    near = np.zeros([n + 1 for n in new.shape], dtype=bool)
    nz, ny, nx = new.shape
    for k in range(2):
        for j in range(2):
            for i in range(2):
                near[k:k + nz, j:j + ny, i:i + nx] |= new
    return near


def _von_mises_difference(state: State, file: runs.CheckpointLayers, old: np.ndarray) -> float:
    largest = 0.0
    for first in range(0, old.shape[0], _LAYERS_AT_ONCE):
        layers = slice(first, min(first + _LAYERS_AT_ONCE, old.shape[0]))
        both = []
        for parts in ([file.layers(n, layers.start, layers.stop) for n in fields.STRESS],
                      [state.owned(n)[layers] for n in fields.STRESS]):
            out = np.zeros(parts[0].shape)
            derived.cell_von_mises(tuple(np.ascontiguousarray(p).reshape(-1) for p in parts), out.reshape(-1))
            both.append(out)
        largest = max(largest, float(np.abs(both[0] - both[1])[old[layers]].max(initial=0.0)))
    return largest
