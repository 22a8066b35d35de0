"""A made-up in-flight sample: the program that wrote ``f2s_hpc/data/synthetic-in-flight.csv``, and can write it again.

Ge et al. 2026 show their measurement as a figure (8) and state ranges only, so this is no measurement, theirs or
anyone's. It has what they state: diameters 10 to 85 um of the powder with D10 / D50 / D90 = 19 / 30 / 52 um, a mean
velocity that falls from 625 m/s at 10 um to 580 m/s at 85 um, most velocities between 550 and 750 m/s, a speed that is
quadratic and a number that is sech in the lateral position, and a lateral velocity, larger at the edge, whose mean
stays below 10 m/s. What they do not state was chosen: the constants below, with the reason for each.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad

from f2s_hpc.particles.lateral import SechProfile
from f2s_hpc.particles.sizes import RosinRammler

SEED = 2026
COUNT = 3000
HALF_WIDTH = 3.5e-3
"""m; the radius of the spot (section 5.2.1): nothing was measured outside."""
PROFILE = SechProfile(0.0, 1.4e-3)
"""Width chosen: a narrower jet would pile the 80 mm/s track up into the layer where the paper paints particles."""
CURVATURE = -6.0e6
"""1/(m s), -6 m/s per mm2, chosen: 74 m/s slower at the edge of the spot than on its axis."""
SPREAD = 32.0
"""m/s, standard deviation of the velocity about its mean, chosen: 96 of 100 within the stated 550 to 750 m/s."""
SLOWEST_DIAMETER, FASTEST_DIAMETER = (85e-6, 580.0), (10e-6, 625.0)
"""Mean velocity (m/s) at the largest and the smallest diameter (m): section 5.1."""
LATERAL_AXIS, LATERAL_CURVATURE = 3.0, 0.4e6
"""Mean lateral velocity on the axis (m/s) and its growth (1/(m s)), chosen: 7.9 m/s at the edge (stated: below 10)."""
LATERAL_SHAPE = 4.0
"""Shape of the gamma distribution of lateral velocities, chosen: a spread of half the mean, never negative."""


def velocity_slope() -> float:
    """Return the change of the mean velocity with the diameter, 1/s: -0.6 m/s per um."""
    (large, slow), (small, fast) = SLOWEST_DIAMETER, FASTEST_DIAMETER
    return (slow - fast) / (large - small)


def mean_square_position() -> float:
    """Return the mean of the squared lateral position over the spot, m2."""
    def density(u: float) -> float:
        return 1.0 / np.cosh(u)

    end = HALF_WIDTH / PROFILE.width
    return PROFILE.width**2 * quad(lambda u: u * u * density(u), 0.0, end)[0] / quad(density, 0.0, end)[0]


def sample() -> np.ndarray:
    """Return the sample, shape (COUNT, 4): diameter (m), velocity (m/s), lateral position (m), lateral velocity (m/s).

    Drawn from SEED alone. Diameters follow the powder's number distribution and no place prefers a size, so the mean
    velocity over the diameters is the stated line.
    """
    generator = np.random.Generator(np.random.PCG64(SEED))
    sizes = RosinRammler.fit(19e-6, 30e-6, 52e-6, FASTEST_DIAMETER[0], SLOWEST_DIAMETER[0])
    diameter = sizes.sample_by_number(COUNT, generator)
    position = PROFILE.sample(COUNT, -HALF_WIDTH, HALF_WIDTH, generator)
    mean = (FASTEST_DIAMETER[1] + velocity_slope() * (diameter - FASTEST_DIAMETER[0])
            + CURVATURE * (position**2 - mean_square_position()))
    velocity = mean + SPREAD * generator.standard_normal(COUNT)
    lateral = LATERAL_AXIS + LATERAL_CURVATURE * position**2
    drift = generator.gamma(LATERAL_SHAPE, lateral / LATERAL_SHAPE)
    return np.column_stack([diameter, velocity, position, drift])


def csv_text() -> str:
    """Return the sample as the text of the packaged file; digits as a device gives them, so it is the same anywhere."""
    lines = [
        "# SYNTHETIC sample, not a measurement: drawn by f2s_hpc/particles/synthetic.py from the seed below, with the",
        "# properties that Ge et al. 2026, section 5.1, state as ranges. Made again, bit for bit, by",
        "# python -m f2s_hpc.particles.synthetic",
        f"# seed {SEED}, {COUNT} particles; the lateral velocity is its size, without a sign",
        "diameter [um],velocity [m/s],lateral position [mm],lateral velocity [m/s]"]
    lines += [f"{1e6 * d:.2f},{v:.2f},{1e3 * x:.4f},{w:.3f}" for d, v, x, w in sample()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(csv_text(), end="")
