"""Points that stand for equal volumes of a sphere."""

from __future__ import annotations

import numpy as np

_PLASTIC = 1.3247179572447460
"""Root of p^3 = p + 1: its powers give the two-dimensional additive sequence of lowest discrepancy (Roberts 2018)."""


def unit_ball(count: int) -> np.ndarray:
    """Return ``count`` (at least 4) points that stand for equal volumes of the ball of radius 1, (count, 3).

    One in each of ``count`` shells of equal volume, in directions of a low-discrepancy sequence; then the cloud is
    moved and strained, by less than 4 % from 100 points on, so that its mean is zero and its second moments are those
    of the ball, 1/5 along each axis, to round-off. Under an affine deformation they so stay those of the ellipsoid.
    No point is more than 4 % of the radius outside, from 100 points on 0.1 %.
    """
    number = np.arange(count)
    radius = np.cbrt((number + 0.5) / count)
    cosine = 2.0 * np.mod(0.5 + number / _PLASTIC, 1.0) - 1.0
    angle = 2.0 * np.pi * np.mod(0.5 + number / _PLASTIC**2, 1.0)
    sine = np.sqrt(1.0 - cosine * cosine)
    points = radius[:, None] * np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    points -= points.mean(axis=0)
    factor = np.linalg.cholesky(points.T @ points / count)
    return np.linalg.solve(factor, points.T).T / np.sqrt(5.0)
