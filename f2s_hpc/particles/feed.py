"""How many particles hit a strip of substrate while the nozzle passes: feed rate, scanning speed, density, sizes.

Ge et al. 2026, section 5.2.1 and table 4: the strip is under the jet for t = path / V_s and takes ``share`` of what the
nozzle feeds, so it receives

    N = feed_rate share path / (V_s density V_mean),

V_mean the mean volume of a particle, each counting once: of the powder
(:meth:`f2s_hpc.particles.sizes.RosinRammler.mean_particle_volume`) or as measured
(:class:`f2s_hpc.particles.sizes.MeasuredSizes`).
Their 2.06 % and 7.3 mm agree with a mass balance: all powder lands, half of it on each side, so a half strip of width
W = 0.3 mm along the track takes feed_rate W / (2 V_s), and share path = 0.150 mm = W / 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from f2s_hpc.errors import InputError

TABLE_4 = {0.160: 10236, 0.120: 15354, 0.080: 20472}
"""Scanning speed (m/s): particles, table 4 of Ge et al. 2026."""

PARTICLES_PER_BATCH = 2559
MOST_PARTICLES = 10**15


@dataclass(frozen=True)
class Feed:
    """What leaves the nozzle and which part of it the strip takes.

    ``rate`` (kg/s), ``share`` (0..1) on the strip, ``path`` (m) over which the strip is under the jet, ``density``
    (kg/m3) of the powder, ``mean_volume`` (m3) of a particle. Raises InputError unless all are positive and share is at
    most 1.
    """

    rate: float
    share: float
    path: float
    density: float
    mean_volume: float

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise InputError(f"feed: a share of {100 * self.share:g} % on the strip; above 0 to 100 % is possible")
        for name, value in (("rate", self.rate), ("path", self.path), ("density", self.density),
                            ("mean volume of a particle", self.mean_volume)):
            if not value > 0.0:
                raise InputError(f"feed: the {name} must be positive")


@dataclass(frozen=True)
class FeedCount:
    """Particles on the strip at one scanning speed.

    ``scan_speed`` (m/s), ``time`` (s) under the jet, ``mass`` (kg) on the strip; ``particles`` by the law (a real
    number), ``batches`` = particles / particles per batch, ``whole_batches`` these rounded up, as table 4 has them,
    ``whole_particles`` in these; ``paper``: table 4 at this speed, ``paper_law``: table 4's 160 mm/s scaled by 1 / V_s.
    """

    scan_speed: float
    time: float
    mass: float
    particles: float
    batches: float
    whole_batches: int
    whole_particles: int
    paper: int | None
    paper_law: float


def count_particles(feed: Feed, scan_speed: float, per_batch: int = PARTICLES_PER_BATCH) -> FeedCount:
    """Return how many particles the strip receives at ``scan_speed`` (m/s), by the law and in whole batches.

    Raises InputError for a scanning speed or a batch that is not positive, and for more than ``MOST_PARTICLES``.
    """
    if per_batch > MOST_PARTICLES:
        raise InputError(f"feed: more than {MOST_PARTICLES:,} particles per batch")
    if not scan_speed > 0.0 or per_batch < 1:
        raise InputError(f"feed: {1e3 * scan_speed:g} mm/s and {per_batch} particles per batch; both must be positive")
    time = feed.path / scan_speed
    mass = feed.rate * feed.share * time
    each = feed.density * feed.mean_volume
    particles = mass / each if each > 0.0 else math.inf
    if not particles <= MOST_PARTICLES:
        raise InputError(f"feed: {particles:.3g} particles at {1e3 * scan_speed:g} mm/s, {MOST_PARTICLES:,} are "
                         "possible; are the units of feed rate, path, scanning speed, density and diameters right?")
    batches = particles / per_batch
    whole = max(1, math.ceil(batches * (1.0 - 1e-9)))
    paper = next((n for speed, n in TABLE_4.items() if math.isclose(speed, scan_speed, rel_tol=1e-9)), None)
    return FeedCount(scan_speed, time, mass, particles, batches, whole, whole * per_batch, paper,
                     TABLE_4[0.160] * 0.160 / scan_speed)
