"""Bodies other than spheres, painted by exact volume fractions."""

from __future__ import annotations

import numpy as np

from f2s_hpc.cycles.insert import add_material
from f2s_hpc.verify.box import Setup

LEAST = 1e-9
"""A share of a cell that is no more than this is round-off of the coordinates, not material."""


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
    """Add a cylinder around the axis x = y = 0; collective.

    ``radius``, ``bottom``, ``top`` in cells, the latter two along z; ``velocity`` in m/s; ``temperature`` in K.
    """
    x, y, z = _edges(setup)
    share = _layers(z, bottom, top)[:, None, None] * disc_fractions(x, y, radius)
    share[share < LEAST] = 0.0
    _add(setup, share, velocity, temperature)


def paint_slab(setup: Setup, bottom: float, top: float, velocity: tuple[float, float, float],
               temperature: float) -> None:
    """Add a slab that fills the box from ``bottom`` to ``top`` (cells along z); collective. Units as above."""
    x, y, z = _edges(setup)
    share = np.zeros((z.size - 1, y.size - 1, x.size - 1))
    share[...] = _layers(z, bottom, top)[:, None, None]
    _add(setup, share, velocity, temperature)


def _edges(setup: Setup) -> list[np.ndarray]:
    """Return the x, y, z edges (cells, global) of the local cells."""
    part = setup.state.part
    return [np.arange(n + 1.0) + o for n, o in zip(part.cell_shape[::-1], part.offset)]


def _layers(z: np.ndarray, bottom: float, top: float) -> np.ndarray:
    """Return the share of each layer of cells between ``bottom`` and ``top``."""
    share = np.clip(np.minimum(z[1:], top) - np.maximum(z[:-1], bottom), 0.0, 1.0)
    share[share < LEAST] = 0.0
    share[share > 1.0 - LEAST] = 1.0
    return share


def _add(setup: Setup, share: np.ndarray, velocity: tuple[float, float, float], temperature: float) -> None:
    add_material(setup.state, setup.model, share, velocity, temperature, setup.ledger)
    setup.clock.limits.heavy_speed = max(setup.clock.limits.heavy_speed, float(np.linalg.norm(velocity)))
    setup.activate()
