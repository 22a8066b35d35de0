"""Particles in a section, found by the ridges of PEEQ between them, as the paper finds them.

Plastic strain localises where particles meet, so on a map of PEEQ each particle is a basin and its boundary a ridge.
Each cell belongs to the minimum it drains to (watershed); neighbouring basins between which the ridge rises too little
are one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from f2s_hpc.errors import InputError

PROMINENCE = 0.15
"""A ridge counts when it rises above the shallower of its two basins by this share of the ridge's own PEEQ."""

SMOOTHING = 0.7
"""Standard deviation (cells) of the Gaussian that takes the noise of single cells out of the map."""

LEAST_PIXELS = 12
"""A particle of fewer cells is left out."""

MOST_FREE = 0.25
"""A particle is left out when more of its outline than this is free surface: nothing there tells where it ends."""


@dataclass(frozen=True)
class SectionParticles:
    """The particles of a section that can be measured, lengths in m.

    ``labels``: (up, along), 0 where there is no measured particle, else 1 to p; ``width``, ``height``: their
    horizontal and vertical extent, (p,); ``boundaries``: bool, (up, along), ridges between any two basins of the
    deposit.
    """

    labels: np.ndarray
    width: np.ndarray
    height: np.ndarray
    boundaries: np.ndarray


def basins(peeq: np.ndarray, material: np.ndarray, prominence: float = PROMINENCE,
           smoothing: float = SMOOTHING) -> np.ndarray:
    """Return the basins of a section of PEEQ, int (up, along): 0 in void, else 1, 2, ...

    ``peeq``, ``material`` (bool): (up, along); ``prominence``: least rise of a ridge over the shallower of its two
    basins, over the ridge's PEEQ; ``smoothing``: standard deviation (cells). Void is the highest ridge of all.
    Raises ``InputError`` when the shapes differ.
    """
    if peeq.ndim != 2 or peeq.shape != material.shape:
        raise InputError(f"particle boundaries: PEEQ {peeq.shape} and material {material.shape} must both be sections")
    if not material.any():
        return np.zeros(peeq.shape, dtype=int)
    smooth = _smoothed(peeq, material, smoothing)
    flooded, count = _drained(smooth, material)
    return _merge(flooded, smooth, count, prominence)[flooded]


def _drained(height: np.ndarray, material: np.ndarray) -> tuple[np.ndarray, int]:
    """Return to which minimum each cell drains, 1 to the number of minima, 0 in void, and that number.

    Every cell passes on to the lowest of its eight neighbours (watershed by steepest descent). Equal heights are told
    apart by their place, so there are no plateaus; a minimum that this splits is one again after the merge.
    ``scipy.ndimage.watershed_ift`` will not do: it weighs differences of height, so its borders are slopes, not ridges.
    """
    order = np.argsort(np.where(material, height, np.inf), axis=None, kind="stable")
    rank = np.empty(order.size, dtype=np.int64)
    rank[order] = np.arange(order.size)
    lowest = ndimage.minimum_filter(rank.reshape(height.shape), size=3, mode="nearest").ravel()
    target = order[lowest]
    while not np.array_equal(further := target[target], target):
        target = further
    inside = material.ravel()
    labels = np.zeros(order.size, dtype=np.int64)
    minima, labels[inside] = np.unique(target[inside], return_inverse=True)
    labels[inside] += 1
    return labels.reshape(height.shape), minima.size


def _smoothed(peeq: np.ndarray, material: np.ndarray, smoothing: float) -> np.ndarray:
    """Return PEEQ smoothed inside the material only: void neither dilutes nor adds."""
    if smoothing <= 0.0:
        return np.where(material, peeq, 0.0).astype(float)
    weight = ndimage.gaussian_filter(material.astype(float), smoothing, mode="nearest")
    total = ndimage.gaussian_filter(np.where(material, peeq, 0.0).astype(float), smoothing, mode="nearest")
    return np.where(material, total / np.where(material, weight, 1.0), 0.0)


def _merge(flooded: np.ndarray, height: np.ndarray, count: int, prominence: float) -> np.ndarray:
    """Return for each label the one it belongs to once all low ridges are gone, consecutive from 1; 0 stays 0.

    Passes are taken in ascending height, so a basin meets its lowest pass first and the result does not depend on the
    order of the labels.
    """
    floor = np.full(count + 1, np.inf)
    inside = flooded > 0
    np.minimum.at(floor, flooded[inside], height[inside])
    passes: dict[tuple[int, int], float] = {}
    for axis in (0, 1):
        low = [slice(None), slice(None)]
        high = [slice(None), slice(None)]
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        one, two = flooded[tuple(low)], flooded[tuple(high)]
        meet = (one != two) & (one > 0) & (two > 0)
        ridge = np.maximum(height[tuple(low)][meet], height[tuple(high)][meet])
        for a, b, h in zip(one[meet].tolist(), two[meet].tolist(), ridge.tolist()):
            pair = (min(a, b), max(a, b))
            passes[pair] = min(h, passes.get(pair, np.inf))
    parent = list(range(count + 1))

    def root(label: int) -> int:
        while parent[label] != label:
            parent[label] = parent[parent[label]]
            label = parent[label]
        return label

    for (a, b), h in sorted(passes.items(), key=lambda item: item[1]):
        a, b = root(a), root(b)
        # (an equal sign for the minima that a plateau was split into, also one of no PEEQ)
        if a != b and h - max(floor[a], floor[b]) <= prominence * h:
            deeper, other = (a, b) if floor[a] <= floor[b] else (b, a)
            parent[other] = deeper
    found = np.array([root(label) for label in range(count + 1)])
    return np.concatenate([[0], np.unique(found[1:], return_inverse=True)[1] + 1]) if count else found


def _free_share(found: np.ndarray) -> np.ndarray:
    """Return for each basin (index: label) the share of its outline, in cell faces, that borders on void."""
    outline, free = np.zeros(found.max() + 1), np.zeros(found.max() + 1)
    for one, two in ((found[:-1], found[1:]), (found[1:], found[:-1]), (found[:, :-1], found[:, 1:]),
                     (found[:, 1:], found[:, :-1])):
        border = one != two
        outline += np.bincount(one[border], minlength=outline.size)
        free += np.bincount(one[border & (two == 0)], minlength=outline.size)
    return free / np.maximum(outline, 1.0)


def section_particles(peeq: np.ndarray, fraction: np.ndarray, dx: float, ground: int, prominence: float = PROMINENCE,
                      smoothing: float = SMOOTHING, least_pixels: int = LEAST_PIXELS) -> SectionParticles:
    """Return the particles of a section whose boundary is whole, with their widths and heights.

    ``peeq``, ``fraction`` (VF): (up, along), rows from the bottom up; ``dx`` (m); ``ground``: first row above the
    substrate top. Left out, as in the paper, which took "particles with clearer boundaries": basins that touch an edge
    of the section, whose centre lies in the substrate, of which more than ``MOST_FREE`` of the outline is free surface,
    or of fewer than ``least_pixels`` cells. Width and height are the extents of the basin. Raises ``InputError`` as
    :func:`basins` does.
    """
    material = fraction >= 0.5
    found = basins(peeq, material, prominence, smoothing)
    boundaries = np.zeros(found.shape, dtype=bool)
    boundaries[:-1] |= (found[:-1] != found[1:]) & material[:-1] & material[1:]
    boundaries[:, :-1] |= (found[:, :-1] != found[:, 1:]) & material[:, :-1] & material[:, 1:]
    boundaries[:ground] = False
    edge = np.unique(np.concatenate([found[0], found[-1], found[:, 0], found[:, -1]]))
    labels = np.zeros(found.shape, dtype=int)
    widths, tall, free = [], [], _free_share(found)
    for label, place in enumerate(ndimage.find_objects(found), start=1):
        if place is None or label in edge:
            continue
        own = found[place] == label
        rows = np.nonzero(own)[0] + place[0].start
        if own.sum() < least_pixels or rows.mean() + 0.5 < ground or free[label] > MOST_FREE:
            continue
        tall.append((place[0].stop - place[0].start) * dx)
        widths.append((place[1].stop - place[1].start) * dx)
        labels[place][own] = len(widths)
    return SectionParticles(labels, np.array(widths), np.array(tall), boundaries)
