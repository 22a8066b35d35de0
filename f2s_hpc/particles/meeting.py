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
    slowest = max(np.abs(v[:, 2]).min(), 1e-3)
    flight_time = max(places[:, 2].max() / slowest, 0.0)
    spread = np.linalg.norm(v - v.mean(axis=0), axis=1).max()
    reach = 2.0 * REACH * dx
    pairs = cKDTree(places).query_pairs(2.0 * (spheres.r.max() + spread * flight_time) + reach, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    p, w, radii = places[b] - places[a], v[b] - v[a], spheres.r[a] + spheres.r[b]
    touch, near = (_first_time(p, w, radii + gap) for gap in (dx, reach))
    when = np.maximum(near, touch - LEAD * dx / np.linalg.norm(v[a], axis=1))
    meets = touch < flight_time
    for side in (a, b):
        np.minimum.at(found, side[meets], np.maximum(when[meets], 0.0))
    return found
