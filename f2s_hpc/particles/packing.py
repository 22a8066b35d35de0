"""Random placement of spheres without overlap: each sphere goes to the first free of its random places.

Largest first, because a large sphere finds no room among many small ones. Neighbours are looked up in
a grid of bins, so thousands of spheres take a second. A size for which room has run out is not tried for long, and a
crowd that no packing can hold is told beforehand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.errors import InputError
from f2s_hpc.kernels.sphere import sphere_box_volume

FIRST_BLOCK, LARGEST_BLOCK = 64, 4096
DENSEST = 0.64
"""Volume share of the densest random packing of equal spheres. Spheres put down at random places, one after the other,
stay well below it, whatever their sizes."""
LEAST_FAILURES, LEAST_TRIES = 50, 100_000
"""Spheres in a row, and random places for them, that must have found no room before their size is given up."""
NEXT_SIZE = 0.95
"""A sphere this much smaller than one whose size was given up is tried again."""


def volume_inside(x: np.ndarray, y: np.ndarray, z: np.ndarray, r: np.ndarray, box: tuple[float, float, float]) -> float:
    """Return the volume (m3) of spheres inside the box from 0 to ``box`` (m).

    Closed form for spheres cut by any of the six sides; spheres are summed one by one (overlaps count twice).
    """
    size_x, size_y, size_z = map(float, box)
    return math.fsum(sphere_box_volume(*sphere, 0.0, size_x, 0.0, size_y, 0.0, size_z) for sphere in zip(x, y, z, r))


@dataclass(frozen=True, eq=False)
class PackingResult:
    """Placed spheres (m, largest first) and what the packing reached.

    ``x``, ``y``, ``z``, ``r`` have shape (placed,); ``reached_gap`` is the smallest centre distance over summed
    radii (infinite for fewer than two spheres).
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    r: np.ndarray
    placed: int
    requested: int
    reached_gap: float
    gap_factor: float
    attempts: int
    box: tuple[float, float, float]

    def message(self) -> str:
        """Return one sentence: how many spheres were placed, how densely, and what to change if not all."""
        lx, ly, lz = (f"{1e3 * length:g}" for length in self.box)
        share = volume_inside(self.x, self.y, self.z, self.r, self.box) / math.prod(self.box)
        text = (f"placed {self.placed} of {self.requested} spheres in {lx} x {ly} x {lz} mm at gap factor "
                f"{self.gap_factor:g} (reached {self.reached_gap:.4f}, {100 * share:.1f} % of the volume)")
        if self.placed < self.requested:
            text += (f"; {self.requested - self.placed} found no room (in {self.attempts} attempts, or as others of "
                     "their size had): ask for fewer particles, a smaller gap factor or a taller layer")
        return text


@kernel
def _first_free(places, radius, gap_factor, largest, x, y, z, r, head, following, bin_size):
    """Return the index of the first row of ``places`` (n, 3) where a sphere fits, -1 if none.

    ``head`` (bins per axis) holds the newest sphere of a bin, ``following`` the next one of the same bin, -1 ends.
    """
    reach = gap_factor * (radius + largest)
    bins_x, bins_y, bins_z = head.shape
    for n in range(places.shape[0]):
        px, py, pz = places[n, 0], places[n, 1], places[n, 2]
        free = True
        for bi in range(max(0, int((px - reach) / bin_size[0])), min(bins_x, int((px + reach) / bin_size[0]) + 1)):
            for bj in range(max(0, int((py - reach) / bin_size[1])), min(bins_y, int((py + reach) / bin_size[1]) + 1)):
                for bk in range(max(0, int((pz - reach) / bin_size[2])),
                                min(bins_z, int((pz + reach) / bin_size[2]) + 1)):
                    other = head[bi, bj, bk]
                    while other >= 0 and free:
                        wanted = gap_factor * (radius + r[other])
                        squared = (px - x[other]) ** 2 + (py - y[other]) ** 2 + (pz - z[other]) ** 2
                        free = squared >= wanted * wanted
                        other = following[other]
                    if not free:
                        break
                if not free:
                    break
            if not free:
                break
        if free:
            return n
    return -1


@kernel
def smallest_gap_ratio(x, y, z, r):
    """Return the smallest centre distance over summed radii among all pairs; infinite for fewer than two."""
    smallest = np.inf
    order = np.argsort(x)
    largest = r.max() if r.size else 0.0
    for n in range(x.size):
        first = order[n]
        widest = (r[first] + largest) * (r[first] + largest)
        for m in range(n + 1, x.size):
            second = order[m]
            if (x[second] - x[first]) ** 2 / widest >= smallest:  # (so are all that follow)
                break
            squared = (x[first] - x[second]) ** 2 + (y[first] - y[second]) ** 2 + (z[first] - z[second]) ** 2
            summed = r[first] + r[second]
            smallest = min(smallest, squared / (summed * summed))
    return np.sqrt(smallest)


@kernel
def shared_volume(distance, first, second):
    """Return the volume that two spheres of radii ``first`` and ``second`` share at this centre distance; one unit."""
    both, larger, smaller = first + second, max(first, second), min(first, second)
    if distance >= both:
        return 0.0
    if distance <= larger - smaller:
        return 4.0 / 3.0 * np.pi * smaller**3
    deep, difference = both - distance, first - second
    area = distance * (distance + 2.0 * both) - 3.0 * difference * difference
    return np.pi * deep * deep * area / (12.0 * distance)


@kernel
def _settle(x, y, z, r, allowed, settled, crowded, turns):
    """See :func:`settle_in_order`; here x rises, so that neighbours are near in memory, and ``turns`` is the order."""
    largest = r.max()
    for s in turns:
        if settled[s] or crowded[s]:
            continue
        shared = 0.0
        for way in (-1, 1):
            n = s + way
            while 0 <= n < x.size and abs(x[n] - x[s]) < r[s] + largest:
                if settled[n]:
                    a, b, c, both = x[n] - x[s], y[n] - y[s], z[n] - z[s], r[n] + r[s]
                    squared = a * a + b * b + c * c
                    if squared < both * both:
                        shared += shared_volume(np.sqrt(squared), r[n], r[s])
                n += way
        if shared > allowed:
            crowded[s] = True
        else:
            settled[s] = True


def settle_in_order(x: np.ndarray, y: np.ndarray, z: np.ndarray, r: np.ndarray, allowed: float, settled: np.ndarray,
                    crowded: np.ndarray) -> None:
    """Settle spheres one by one in their order; one that would share too much with the settled ones is crowded instead.

    ``x, y, z, r``: places and radii (m); ``allowed``: the most volume (m3) that a sphere may share with all settled
    ones. ``settled`` and ``crowded`` (bool, per sphere) are changed; a sphere that is either already keeps it.
    """
    if not r.size:
        return
    along = np.argsort(x, kind="stable")
    turns = np.empty_like(along)
    turns[along] = np.arange(x.size)
    done, refused = settled[along], crowded[along]
    _settle(x[along], y[along], z[along], r[along], allowed, done, refused, turns)
    settled[along], crowded[along] = done, refused


def _bins(box: tuple[float, float, float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the empty bins (-1) and their edge lengths: about one sphere per bin."""
    edge = (box[0] * box[1] * box[2] / max(count, 1)) ** (1.0 / 3.0)
    shape = [max(1, int(length / edge)) for length in box]
    return np.full(shape, -1, dtype=np.int64), np.array(box) / shape


def _find_place(radius: float, box: tuple[float, float, float], generator: np.random.Generator, attempts: int,
                search, x: float | None) -> np.ndarray | None:
    """Return the first free place (3,) among ``attempts`` random ones, ``None`` if all are taken.

    With ``x`` (m), all places are there.
    """
    low = np.array([0.0, 0.0, radius])
    span = np.array([box[0], box[1], box[2] - 2.0 * radius])
    if x is not None:
        low[0], span[0] = x, 0.0
    block, left = FIRST_BLOCK, attempts
    while left > 0:
        places = low + generator.random((min(block, left), 3)) * span
        places[:, 2] = np.clip(places[:, 2], radius, box[2] - radius)  # round-off must not leave the layer
        chosen = search(places, radius)
        if chosen >= 0:
            return places[chosen]
        left -= places.shape[0]
        block = min(2 * block, LARGEST_BLOCK)
    return None


def crowd(radii: np.ndarray, box: tuple[float, float, float], gap_factor: float) -> float:
    """Return the volume of spheres (radii in m), their gaps with them, over the most that any packing in ``box`` holds.

    Above 1 they cannot be placed. Side walls cut spheres, so the box counts as larger by a radius on each side.
    """
    if not radii.size:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        reach = gap_factor * float(radii.max())
        outside = (gap_factor - 1.0) * float(radii.max())  # layer ends cut no sphere, but its gap may stick out
        room = (box[0] + 2.0 * reach) * (box[1] + 2.0 * reach) * (box[2] + 2.0 * outside)
        return 4.0 / 3.0 * np.pi * float(np.sum((gap_factor * radii) ** 3)) / (DENSEST * room)


def pack(diameters: np.ndarray, box: tuple[float, float, float], gap_factor: float, generator: np.random.Generator,
         attempts: int, lateral: np.ndarray | None = None) -> PackingResult:
    """Place spheres of the given diameters (m, shape (n,)) at random in the box (lx, ly, lz) (m).

    Centre distances are at least ``gap_factor`` times the summed radii. Centres lie anywhere in 0..lx and
    0..ly (spheres may cross the side walls), and r <= z <= lz - r. Each sphere tries ``attempts`` places and is
    left out if none is free (``placed`` < ``requested``; see ``PackingResult.message``). Once ``LEAST_FAILURES`` in a
    row (and ``LEAST_TRIES`` places) found none, those of about the same size are left out untried.

    ``lateral`` (n,) gives each sphere its x (m) beforehand, and only y and z are tried: a crowded jet's axis then
    keeps its share, where new places for the spheres it has no room for would thin it out.
    Raises InputError for a gap factor below 1, no attempts, an empty box or a diameter that is not positive.
    """
    radii = 0.5 * np.asarray(diameters, dtype=np.float64)
    if lateral is not None:
        lateral = np.asarray(lateral, dtype=np.float64)[np.argsort(radii, kind="stable")[::-1]]
    radii = np.sort(radii)[::-1]
    if not (gap_factor >= 1.0 and attempts >= 1 and min(box) > 0.0):
        raise InputError(f"packing: gap_factor {gap_factor:g}, attempts {attempts}, box {box} m: "
                         "gap_factor >= 1, attempts >= 1 and positive edges are needed")
    if radii.size and not (np.isfinite(radii).all() and radii[-1] > 0.0):
        raise InputError("packing: every diameter must be a positive number")
    x, y, z, r = (np.empty(radii.size) for _ in range(4))
    head, bin_size = _bins(box, radii.size)
    following = np.empty(radii.size, dtype=np.int64)
    placed, failures, given_up = 0, 0, np.inf
    most_failures = max(LEAST_FAILURES, -(-LEAST_TRIES // attempts))

    def search(places: np.ndarray, radius: float) -> int:
        largest = r[0] if placed else 0.0
        return _first_free(places, radius, gap_factor, largest, x, y, z, r, head, following, bin_size)

    for index, radius in enumerate(radii):
        if 2.0 * radius > box[2] or radius > given_up:
            continue
        place = _find_place(radius, box, generator, attempts, search, None if lateral is None else lateral[index])
        if place is None:
            failures += 1
            if failures >= most_failures:
                failures, given_up = 0, NEXT_SIZE * radius
            continue
        failures = 0
        x[placed], y[placed], z[placed] = place
        r[placed] = radius
        here = tuple(np.minimum((place / bin_size).astype(np.int64), np.array(head.shape) - 1))
        following[placed], head[here] = head[here], placed
        placed += 1
    x, y, z, r = (values[:placed].copy() for values in (x, y, z, r))
    gap = float(smallest_gap_ratio(x, y, z, r))
    return PackingResult(x, y, z, r, placed, radii.size, gap, gap_factor, attempts, tuple(box))
