"""Bodies other than spheres, painted by exact volume fractions."""

from __future__ import annotations

import numpy as np

from f2s_hpc.cycles.insert import kinetic_quanta, mass_quanta
from f2s_hpc.fields import VELOCITY
from f2s_hpc.grid.box import GHOST
from f2s_hpc.verify.box import Setup


def quarter_disc_area(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Return the area of {0 <= u <= x, 0 <= v <= y, u^2 + v^2 <= radius^2} for x, y >= 0 (closed form).

    The arc meets v = y at u = a = sqrt(R^2 - y^2); beyond it the height is sqrt(R^2 - u^2), whose antiderivative is
    (u sqrt(R^2 - u^2) + R^2 asin(u / R)) / 2.
    """
    def under_arc(u: np.ndarray) -> np.ndarray:
        return 0.5 * (u * np.sqrt(np.maximum(radius**2 - u**2, 0.0)) + radius**2 * np.arcsin(u / radius))

    x, y = np.minimum(x, radius), np.minimum(y, radius)
    a = np.minimum(np.sqrt(radius**2 - y**2), x)
    return a * y + under_arc(x) - under_arc(a)


def disc_fractions(x_edges: np.ndarray, y_edges: np.ndarray, radius: float) -> np.ndarray:
    """Return the share [j, i] of each cell inside the disc around the origin; edges in cells, any sign, spacing 1."""
    # odd continuation: the area between the axes and a corner with negative coordinates counts negative once per sign
    x, y = x_edges[None, :], y_edges[:, None]
    corner = np.sign(x) * np.sign(y) * quarter_disc_area(np.abs(x), np.abs(y), radius)
    return corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]


def paint_cylinder(setup: Setup, radius: float, bottom: float, top: float, velocity: tuple[float, float, float],
                   temperature: float) -> None:
    """Put a cylinder around the axis x = y = 0 into an empty box; collective.

    ``radius``, ``bottom``, ``top`` in cells; ``velocity`` (m/s) on every node that it touches; ``temperature`` in K.
    Its mass and kinetic energy (after the walls hold their nodes) are entered into the ledger as brought in.
    """
    state, part = setup.state, setup.state.part
    x, y, z = (np.arange(n + 1) - GHOST + s for n, s in zip(part.cell_shape[::-1], part.start))
    column = np.clip(np.minimum(z[1:], top) - np.maximum(z[:-1], bottom), 0.0, 1.0)
    share = column[:, None, None] * disc_fractions(x.astype(float), y.astype(float), radius)
    share[share < 1e-12] = 0.0
    for name, value in (("mass", share), ("volume_fraction", share), ("temperature", temperature * (share > 0.0))):
        state.views[name][...] = value
    touched = np.zeros(part.node_shape, dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        touched[tuple(slice(c, c + n) for c, n in zip(corner, part.cell_shape))] |= share > 0.0
    for name, component in zip(VELOCITY, velocity):
        state.views[name][touched] = component
    state.boundary.hold([state.views[n] for n in VELOCITY])
    state.exchange(state.ghosted)
    setup.activate()
    setup.ledger.add("brought_in", kinetic_quanta(state, setup.model))
    setup.ledger.add("mass_painted", mass_quanta(state.owned("mass"), setup.model.mass_quantum))
    setup.clock.limits.heavy_speed = float(np.linalg.norm(velocity))
