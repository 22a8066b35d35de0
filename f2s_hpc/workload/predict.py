"""What a run will take on any number of ranks: a model of the step fed with measured rates and the expected load.

Time of a step on a rank (s), with N active cells owned, X active ghost cells at the ends of its rows and G others, of
which some hold flying particles:

    per_step + sum over kinds of per_cell[kind] (N[kind] + end_share X[kind] + ghost_share G[kind]) + messages

    messages = exchanges x neighbours x latency + bytes (1 / bandwidth + 1 / packing)
               + 2 log2(ranks) latency per reduction (Hockney's model; Thakur et al. 2005 for the reduction)

The step ends when the slowest rank ends. Rates are measured on this machine (:mod:`f2s_hpc.bench.rates`), also how much
cores that share caches and a memory bus slow each other; latency and bandwidth are given, and shared network links are
not modelled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.config.describe import quiet_time_step
from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import GHOST
from f2s_hpc.grid.decomposition import Ranges
from f2s_hpc.particles.plan import BatchPlan
from f2s_hpc.workload import memory
from f2s_hpc.workload.balance import balanced
from f2s_hpc.workload.expected import Moment, moments, part_cells, summed_load

SOLID, FLYING = "solid", "flying"

LATENCY, BANDWIDTH = 2e-6, 5e9
"""Network figures (s; bytes/s of each rank) taken where none are given: a message between two nodes of a common cluster
network takes 1 to 2 us, and a link of 25 GB/s is shared by the ranks of a node that send at once."""


@dataclass(frozen=True)
class Rates:
    """Measured costs of the step on one core (seconds, bytes/s).

    ``end_share``, ``ghost_share``: of a ghost cell beyond an x side, at which every row begins or ends anew, and of any
    other, in the cost of an owned one;
    ``exchanges``: how many cell and node fields each ghost exchange carries in ``steps`` steps, from remap to remap;
    ``reductions``: of a step;
    ``crowding``: by which factor a step is slower while all ``cores`` of the machine step;
    ``sizes``: by which factor a step on so many active cells, ghosts included, is slower than the model says (caches).
    """

    per_step: float
    per_cell: dict[str, float]
    ghost_share: float
    end_share: float
    packing: float
    exchanges: tuple[tuple[float, float], ...]
    reductions: int = 1
    steps: int = 1
    where: str = ""
    sizes: tuple[tuple[int, float], ...] = ()
    crowding: float = 1.0
    cores: int = 1

    def worth(self, owned, ends, ghosts):
        """Return as how many owned cells these count (numbers or arrays): owned, ghosts at ends of rows, others."""
        return owned + self.end_share * ends + self.ghost_share * ghosts

    def slower(self, cells):
        """Return by which factor a step on so many active cells (a number or an array) is slower than the model."""
        if not self.sizes:
            return 1.0
        known, factors = zip(*self.sizes)
        return np.interp(np.log(np.maximum(cells, 1)), np.log(known), factors)

    def crowd(self, ranks: int) -> float:
        """Return by which factor so many ranks slow each other, that fill one machine before the next."""
        return 1.0 + (self.crowding - 1.0) * min((ranks - 1) / max(self.cores - 1, 1), 1.0)


@dataclass(frozen=True)
class Network:
    """Latency of a message (s) and bandwidth (bytes/s) of a rank."""

    latency: float = LATENCY
    bandwidth: float = BANDWIDTH


@dataclass(frozen=True)
class Prediction:
    """A run on ``ranks`` ranks: times in s, memory in bytes of the fullest rank, efficiency against one rank."""

    ranks: int
    grid: tuple[int, int, int]
    cells_per_rank: int
    active_cells: float
    steps: int
    step_s: float
    total_s: float
    messages_s: float
    memory: int
    message_bytes: int
    imbalance: float
    efficiency: float


def _parts(scene: Scene, ranges: Ranges) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each rank [z, y, x], the ghost cells it gets from others and how many neighbours send them."""
    volumes, shares = 1, 1
    neighbours = 1
    for axis in (2, 1, 0):
        counts = np.array(ranges[axis])
        low, high = np.arange(counts.size) > 0, np.arange(counts.size) < counts.size - 1
        wide = counts + GHOST * (low.astype(int) + high)
        volumes = np.multiply.outer(volumes, wide)
        shares = np.multiply.outer(shares, counts)
        neighbours = np.multiply.outer(neighbours, 1 + low.astype(int) + high)
    return volumes - shares, neighbours - 1


def message_seconds(scene: Scene, ranges: Ranges, rates: Rates, network: Network) -> tuple[np.ndarray, np.ndarray]:
    """Return seconds and bytes that the messages of a step cost each rank, [z, y, x] of the process grid."""
    ghosts, neighbours = _parts(scene, ranges)
    fields = sum(cells + nodes for cells, nodes in rates.exchanges) / rates.steps
    sent = 8 * ghosts * fields
    reductions = rates.reductions * 2.0 * math.log2(max(neighbours.size, 1)) * network.latency
    seconds = (len(rates.exchanges) / rates.steps * neighbours * network.latency + reductions
               + sent * (1.0 / network.bandwidth + 1.0 / rates.packing))
    return seconds, sent


def busy_seconds(moment: Moment, cells: int, ranges: Ranges, rates: Rates) -> np.ndarray:
    """Return the seconds that each rank computes in a step at a moment, [z, y, x] of the process grid."""
    busy = np.full(tuple(len(r) for r in ranges[::-1]), rates.per_step)
    visited = 0
    for kind, blocks in ((SOLID, moment.solid), (FLYING, moment.blocks & ~moment.solid & 1)):
        owned, rows, local = (part_cells(blocks, cells, ranges, widths)
                              for widths in ((0, 0, 0), (GHOST, 0, 0), (GHOST, GHOST, GHOST)))
        busy = busy + rates.per_cell[kind] * rates.worth(owned, rows - owned, local - rows)
        visited = visited + local
    return busy * rates.slower(visited)


def predict(scene: Scene, plan: BatchPlan, ranks: Sequence[int], rates: Rates, network: Network) -> list[Prediction]:
    """Return a prediction for each number of ranks. Raises ``InputError`` if the box can not be cut for one of them."""
    history = list(moments(scene, plan))
    load = summed_load(history, scene.domain.cells[0])
    balances = {count: balanced(scene, plan, count, load) for count in dict.fromkeys((1, *ranks))}
    paces = np.array([moment.weight * moment.pace for moment in history])
    steps = math.ceil(scene.cycles.total_time / quiet_time_step(scene) * paces.sum())
    active = float(load.sum())  # over time; the steps of busy times are shorter
    found: dict[int, Prediction] = {}
    for count, balance in balances.items():
        seconds, sent = message_seconds(scene, balance.ranges, rates, network)
        crowd = rates.crowd(count)
        busy = [crowd * busy_seconds(moment, scene.domain.cells[0], balance.ranges, rates) for moment in history]
        weights = paces / paces.sum()
        step = float(sum(w * (b + seconds).max() for w, b in zip(weights, busy)))
        mean = sum(w * b for w, b in zip(weights, busy))
        largest = tuple(max(r) for r in balance.ranges)
        fullest = memory.of_fullest(scene, balance.ranges, plan)
        alone = found[1].total_s if found else step * steps
        found[count] = Prediction(
            count, tuple(map(len, balance.ranges)), math.prod(largest), active, steps, step, step * steps,
            float(seconds.max()) if count > 1 else 0.0,
            fullest.total + memory.on_root(scene, fullest, plan),
            int(sent.max()), float(mean.max() / mean.mean()), alone / (count * step * steps))
    return [found[count] for count in ranks]


def table(predictions: Sequence[Prediction]) -> str:
    """Return the predictions as a table."""
    lines = [(f"{'ranks':>6} {'grid':>10} {'cells/rank':>11} {'ms/step':>9} {'messages':>9} {'total':>10} "
              f"{'MiB/rank':>9} {'KiB/step':>9} {'imbalance':>10} {'efficiency':>11}")]
    lines += [(f"{p.ranks:6d} {' x '.join(map(str, p.grid)).replace(' ', ''):>10} {p.cells_per_rank:11,} "
               f"{1e3 * p.step_s:9.2f} {p.messages_s / p.step_s:9.1%} {duration_text(p.total_s):>10} "
               f"{p.memory / 2**20:9.0f} {p.message_bytes / 2**10:9.0f} {p.imbalance:10.2f} {p.efficiency:11.1%}")
              for p in predictions]
    return "\n".join(lines)


def duration_text(seconds: float) -> str:
    """Return a time (s) in the unit in which it reads well."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"
