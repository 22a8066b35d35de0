"""How a field is distributed over the height of a deposit: volume-weighted percentiles in layers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from f2s_hpc.errors import InputError

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Shares of the volume at which percentiles are given."""


@dataclass(frozen=True)
class DepthDistribution:
    """Percentiles of a field in layers, from the lowest up.

    ``low``, ``high``: bounds of each layer above the substrate top (m), (n,); ``volume``: material in it (m3), (n,);
    ``mean`` (n,); ``percentiles`` (n, len(SHARES)) at ``SHARES``. NaN in a layer without material.
    """

    low: np.ndarray
    high: np.ndarray
    volume: np.ndarray
    mean: np.ndarray
    percentiles: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Middle of each layer above the substrate top (m), (n,)."""
        return 0.5 * (self.low + self.high)

    @property
    def median(self) -> np.ndarray:
        """The median of each layer, (n,)."""
        return self.percentiles[:, SHARES.index(0.5)]


def weighted_percentiles(values: np.ndarray, weights: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Return the weighted percentiles of ``values`` at ``shares`` (0 to 1), (len(shares),); NaN without weight.

    The percentile of share p is read off the line through the points (cumulative weight less half the value's own
    weight, value), so that equal weights give the usual midpoint rule. ``values``, ``weights``: (n,).
    """
    keep = weights > 0.0
    values, weights = values[keep], weights[keep].astype(np.float64)
    if values.size == 0:
        return np.full(len(shares), np.nan)
    order = np.argsort(values, kind="stable")
    values, weights = values[order].astype(np.float64), weights[order]
    cumulative = np.cumsum(weights)
    return np.interp(np.asarray(shares) * cumulative[-1], cumulative - 0.5 * weights, values)


def layer_cells(layer: float, dx: float) -> int:
    """Return how many cells thick layers of about ``layer`` (m) are, at least one; ``dx``: cell size (m)."""
    return max(1, round(layer / dx))


def depth_distribution(field: np.ndarray, weight: np.ndarray, dx: float, substrate_height: float,
                       layer: float = 10e-6) -> DepthDistribution:
    """Return the distribution of ``field`` over the height above the substrate top, down into the substrate.

    ``field``: cells, (nz, ny, nx), any unit; ``weight``: volume of material in each cell over that of the cell (the
    volume fraction, 0 where it should not count), same shape; ``dx``, ``substrate_height`` in m; ``layer``: wanted
    thickness (m), rounded to whole cells, with a bound at the substrate top; a cell that it crosses is substrate.
    Raises ``InputError`` when the shapes differ or ``layer`` is not positive.
    """
    if field.ndim != 3 or field.shape != weight.shape:
        raise InputError(f"distribution by depth: field {field.shape} and weight {weight.shape} must both be "
                         "(nz, ny, nx)")
    if not layer > 0.0:
        raise InputError(f"distribution by depth: layers of {1e6 * layer:g} um; they must be thicker than nothing")
    nz, thick, ground = field.shape[0], layer_cells(layer, dx), math.ceil(substrate_height / dx - 1e-6)
    first = ground - thick * (ground // thick + (1 if ground % thick else 0))
    rows = []
    for start in range(first, nz, thick):
        inside = slice(max(start, 0), min(start + thick, nz))
        w = np.asarray(weight[inside]).ravel()
        v = np.asarray(field[inside]).ravel()
        total = float(w.sum(dtype=np.float64))
        mean = float((v * w).sum(dtype=np.float64)) / total if total > 0.0 else np.nan
        rows.append((inside.start, inside.stop, total, mean, weighted_percentiles(v, w, SHARES)))
    filled = [n for n, row in enumerate(rows) if row[2] > 0.0]
    rows = rows[:filled[-1] + 1] if filled else rows[:0]
    low, high = (np.array([row[n] for row in rows], dtype=float) * dx - substrate_height for n in (0, 1))
    return DepthDistribution(low, high, np.array([row[2] for row in rows]) * dx**3, np.array([row[3] for row in rows]),
                             np.array([row[4] for row in rows]).reshape(-1, len(SHARES)))
