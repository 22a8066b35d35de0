"""Spheres of different velocity that will touch in flight, and when they come within reach of each other."""

from __future__ import annotations

import numpy as np

from f2s_hpc.particles.batch import Batch

REACH = 3.0
"""Distance to material (in cells) at which a sphere is painted: two for its mixed cells and their nodes, one for the
wave that runs ahead of what it is to hit."""

LEAD = 18.0
"""Most cells that spheres which will touch each other in flight still fly after they are painted: those that close in
slowly would else be on the grid all the way down."""


ODD, MOST_ODD = 4.0, 64
"""A sphere whose drift against the others is so many times that of most is compared with each; so many at most."""


def _first_time(p: np.ndarray, w: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return when pairs at ``p`` + ``w`` t come as close as ``distance``: 0 if they are and close in, else infinity."""
    ww, pw, c = (w * w).sum(axis=1), (p * w).sum(axis=1), (p * p).sum(axis=1) - distance * distance
    root = pw * pw - ww * c
    first = np.where(c <= 0.0, 0.0, (-pw - np.sqrt(np.maximum(root, 0.0))) / np.maximum(ww, 1e-300))
    return np.where((pw < 0.0) & (root >= 0.0), first, np.inf)


def waits(spheres: Batch, dx: float) -> np.ndarray:
    """Return after which time (s) each sphere must be painted since it meets another in flight, infinite for most.

    ``spheres``: each with its own velocity, z from the bottom of the box (m). Pairs are within reach when
    |p + w t| = r_1 + r_2 + reach. What would touch only after it has landed, or passes by, does not count.
    """
    found, v = np.full(spheres.count, np.inf), spheres.velocity
    if spheres.count < 2 or (v == v[0]).all():
        return found
    from scipy.spatial import cKDTree  # (20 MB on every rank, for jets only)

    places = np.stack([spheres.x, spheres.y, spheres.z], axis=1)
    # down to the ground; what does not fly there is met on the way of the other
    landing = np.maximum(places[:, 2], 0.0) / np.maximum(-v[:, 2], 1e-3)
    spread, reach = np.linalg.norm(v - np.median(v, axis=0), axis=1), 2.0 * REACH * dx
    odd = _odd_ones(spread * landing)
    common = np.flatnonzero(~odd)
    width = (spread[common] * landing[common]).max(initial=0.0)
    near = cKDTree(places[common]).query_pairs(2.0 * (spheres.r.max() + width) + reach, output_type="ndarray")
    pairs = [common[near]]
    for one in np.flatnonzero(odd):
        others = np.flatnonzero(~odd | (np.arange(spheres.count) > one))
        pairs.append(np.sort(np.stack([np.full(others.size, one), others], axis=1), axis=1))
    for a, b in (pair.T for pair in pairs):
        p, w, radii = places[b] - places[a], v[b] - v[a], spheres.r[a] + spheres.r[b]
        touch, close = (_first_time(p, w, radii + gap) for gap in (dx, reach))
        speed = np.maximum(np.linalg.norm(v[a], axis=1), 1e-3)
        when = np.maximum(np.maximum(close, touch - LEAD * dx / speed), 0.0)
        meets = touch < np.minimum(landing[a], landing[b])
        for side in (a, b):
            np.minimum.at(found, side[meets], when[meets])
    return found


def _odd_ones(drift: np.ndarray) -> np.ndarray:
    """Return which spheres drift so far (m) against the others on their way that all could be in reach of them.

    A few, that are looked at one by one: a single one at rest would else pair each sphere with each.
    """
    odd = drift > ODD * np.median(drift)
    few = np.argsort(-drift, kind="stable")[:MOST_ODD]
    return odd & np.isin(np.arange(drift.size), few)
