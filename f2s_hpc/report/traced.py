"""The real shape of every particle in a deposit, from the material points that moved with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from f2s_hpc.analysis.flattening import (
    LEAST_POINTS,
    Flattening,
    Regression,
    flattening_from_points,
    regression,
)
from f2s_hpc.io.tracers import ParticleTable
from f2s_hpc.report.deposit import Deposit

MEASURED, CUT, APART, FEW = "measured", "cut by a side", "not in the deposit", "too few points"
"""What became of a particle. One that flies, rebounded or left has less than half its points in the deposit."""

LEAST_SHARE = 0.5
EDGE = 1e-6  # cells: places are saved in single precision, so that one on a side may read as beyond it


@dataclass(frozen=True, eq=False)
class TracedParticles:
    """All particles with points, (p,), in the order in which they were put onto the grid.

    ``flattening``: NaN where one was left out; ``fates``: why; ``share``: of its points that are in the deposit;
    ``fits``: lines of ``equation_5`` over the width, ``equation_6`` over D, and ``exact_6`` over the diameter before
    impact. ``points``: how many there are, ``in_void`` in cells without material, ``outside`` of the box.
    ``waiting``: particles of the run that were not on the grid yet.
    """

    particles: ParticleTable
    flattening: Flattening
    fates: np.ndarray
    share: np.ndarray
    fits: dict[str, Regression | None]
    points: int
    in_void: int
    outside: int
    waiting: int

    def number(self, fate: str) -> int:
        """Return how many particles met ``fate``."""
        return int((self.fates == fate).sum())


def trace(deposit: Deposit) -> TracedParticles | None:
    """Return the shapes of the particles of a deposit; None where nothing was traced.

    A shape is that of the points in landed material, attached to the substrate: a splash far off would count with the
    square of its distance. Particles that a side of the box cuts are left out, as are those not in the deposit.
    """
    cloud = deposit.tracers
    if cloud is None:
        return None
    total = cloud.particles.diameter.size
    number = np.array(deposit.fraction.shape[::-1])
    slack = EDGE * deposit.dx * number
    inside = ((cloud.position >= -slack) & (cloud.position <= number * deposit.dx + slack)).all(axis=1)
    i, j, k = np.clip(np.floor(cloud.position / deposit.dx).astype(np.int64), 0, number - 1).T
    there = inside & deposit.landed[k, j, i] & (cloud.fraction > 0.0)
    held = np.bincount(cloud.particle, minlength=total)
    landed = np.bincount(cloud.particle[there], minlength=total)
    share = landed / np.maximum(held, 1)
    fates = np.where(landed < LEAST_POINTS, FEW, MEASURED)
    fates = np.where(cloud.particles.cut, CUT, np.where(share < LEAST_SHARE, APART, fates))
    chosen = there & (fates == MEASURED)[cloud.particle]
    flat = flattening_from_points(cloud.particle[chosen], cloud.position[chosen], cloud.particles.diameter)
    fits = {"equation_5": regression(flat.width, flat.equation_5),
            "equation_6": regression(flat.diameter, flat.equation_6),
            "exact_6": regression(flat.true_diameter, flat.exact_6)}
    return TracedParticles(cloud.particles, flat, fates, share, fits, cloud.particle.size,
                           int((inside & (cloud.fraction <= 0.0)).sum()), int((~inside).sum()),
                           max(0, deposit.diameters.size - total))


def columns(found: TracedParticles) -> dict[str, list]:
    """Return a table with a row for each particle, for a CSV file; lengths in um."""
    table, flat = found.particles, found.flattening

    def micro(values: np.ndarray) -> list:
        return [float(f"{1e6 * v:.7g}") if math.isfinite(v) else "" for v in values]

    def plain(values: np.ndarray) -> list:
        return [float(v) if math.isfinite(v) else "" for v in values]

    return {"particle": list(range(table.diameter.size)), "fate": found.fates.tolist(),
            "true_diameter_um": micro(table.diameter), "painted_us": micro(table.time),
            **{f"painted_{axis}_um": micro(table.centre[:, number]) for number, axis in enumerate("xyz")},
            "share_in_deposit": plain(found.share), "width_um": micro(flat.width), "height_um": micro(flat.height),
            "equation_5": plain(flat.equation_5), "diameter_um": micro(flat.diameter),
            "equation_6": plain(flat.equation_6), "width_over_true_diameter": plain(flat.exact_6)}
