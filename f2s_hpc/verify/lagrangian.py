"""An independent solution of an impact to compare with: axisymmetric, Lagrangian, on a mesh that moves with the metal.

A sphere hits a mirror, or a block of its own material to which it bonds where it touches. Nothing of the Eulerian
scheme is in it but the laws of the material: quadrilaterals with one integration point, hourglass viscosity (Flanagan
and Belytschko 1981), central differences, Jaumann rate, radial return by bisection, adiabatic. It has no remap and
keeps its energy, part by part; but where jets fold its mesh it ends, so it is for moderate speeds.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from f2s_hpc._jit import kernel
from f2s_hpc.errors import UnstableStep
from f2s_hpc.materials.flow_stress import flow_stress
from f2s_hpc.materials.params import Bulk

LINEAR, QUADRATIC, HOURGLASS, COURANT = 0.06, 1.2, 0.01, 0.5  # bulk and hourglass viscosity; step over its limit
BISECTIONS = 50
WIDTH, DEPTH, FINE = 4.0, 4.0, (1.2, 0.9)  # of the block in diameters, and up to where its cells are square
GROWTH = 1.12
FOLDED = 0.03
PARTS = ("plastic_work", "shock_viscosity", "hourglass", "contact")
PLASTIC, VISCOUS, HOURGLASS_WORK, CONTACT = range(4)


class Mesh(NamedTuple):
    """Nodes (m) and quadrilaterals (element, 4), counter-clockwise; ``sphere``: how many of each are the sphere's.

    ``skin``: the sphere's surface; ``top``: the block's surface from the axis outwards (empty: there is a mirror at
    z = 0 instead); ``held_r``, ``held_z``: nodes that may not move that way.
    """

    r: np.ndarray
    z: np.ndarray
    quads: np.ndarray
    sphere: tuple[int, int]
    skin: np.ndarray
    top: np.ndarray
    held_r: np.ndarray
    held_z: np.ndarray


@dataclass(frozen=True)
class Solution:
    """What became of the sphere: ``height``, ``width`` (m, axes of the ellipsoid with its second moments), ``crater``
    (m, depth of the interface on the axis; 0 at a mirror), PEEQ over its mass; ``energy``: shares of the impact energy,
    ``unexplained`` among them; ``steps`` taken.
    """

    height: float
    width: float
    crater: float
    peeq_mean: float
    peeq_p50: float
    peeq_p95: float
    energy: dict[str, float]
    steps: int


# --- meshes -----------------------------------------------------------------------------------------------------


def _sphere(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, quadrilaterals and surface of a half disc of radius 1 around z = 1: a square block in a ring.

    ``n`` cells from the axis to the side of the block, and ``n`` from there to the surface: 4 n to the diameter.
    """
    def rounded(i: int, j: int) -> tuple[float, float]:
        u, v = i / n, j / n
        return 0.462 * u * (1.0 - 0.175 * v * v), 0.462 * v * (1.0 - 0.175 * u * u)

    wide = n + 1
    points = [rounded(i, j) for j in range(-n, n + 1) for i in range(wide)]
    quads = [(b + i, b + i + 1, b + wide + i + 1, b + wide + i) for b in range(0, 2 * n * wide, wide) for i in range(n)]
    edge = [(i, -n) for i in range(wide)] + [(n, j) for j in range(1 - n, n)] + [(i, n) for i in range(n, -1, -1)]
    rings = [[(j + n) * wide + i for i, j in edge]]
    for layer in range(1, n + 1):
        ring = []
        for turn, (i, j) in enumerate(edge):
            angle, share, (x, y) = math.pi * (turn / (4 * n) - 0.5), layer / n, rounded(i, j)
            ring.append(len(points))
            points.append((x + share * (math.cos(angle) - x), y + share * (math.sin(angle) - y)))
        rings.append(ring)
    quads += [(a[t], b[t], b[t + 1], a[t + 1]) for a, b in itertools.pairwise(rings) for t in range(4 * n)]
    places = np.array(points)
    for ring in rings:
        places[[ring[0], ring[-1]], 0] = 0.0  # cos(pi/2) is not quite
    return places + (0.0, 1.0), np.array(quads), np.array(rings[-1])


def _graded(spacing: float, fine: float, end: float) -> np.ndarray:
    """Return places from 0 to ``end``, ``spacing`` apart up to ``fine`` and then ever wider."""
    places, step = [0.0], spacing
    while places[-1] < end * (1.0 - 1e-9):
        step *= GROWTH if places[-1] >= fine else 1.0
        places.append(min(places[-1] + step, end))
    return np.array(places)


def make_mesh(cells_per_diameter: float, diameter: float, on_block: bool) -> Mesh:
    """Return the mesh of a sphere that touches z = 0, with a block below it or none."""
    n = max(2, round(cells_per_diameter / 4.0))
    points, quads, skin = _sphere(n)
    points = 0.5 * diameter * points
    whole = (len(points), len(quads))
    if not on_block:
        free = np.zeros(whole[0], dtype=np.bool_)
        return Mesh(*points.T.copy(), quads, whole, skin, np.empty(0, dtype=np.int64), free, free.copy())
    spacing = math.pi * diameter / (8 * n)
    across = _graded(spacing, FINE[0] * diameter, WIDTH * diameter)
    down = -_graded(spacing, FINE[1] * diameter, DEPTH * diameter)[::-1]
    grid = np.array([(r, z) for z in down for r in across])
    wide, high = across.size, down.size
    first = whole[0] + wide * np.arange(high - 1)[:, None] + np.arange(wide - 1)[None, :]
    block = np.stack([first, first + 1, first + wide + 1, first + wide], axis=-1).reshape(-1, 4)
    r, z = np.concatenate([points, grid]).T.copy()
    at_end = np.arange(r.size) >= whole[0]
    return Mesh(r, z, np.concatenate([quads, block]), whole, skin, whole[0] + wide * (high - 1) + np.arange(wide),
                at_end & (r >= across[-1]), at_end & (z <= down[0]))


# --- kernels ----------------------------------------------------------------------------------------------------


@kernel
def _volume(r, z, quad):
    """Return the volume (m3) of a quadrilateral turned around the axis: area times the path of the mean radius.

    That is what the forces of one integration point do work on; with the exact volume jets gained energy.
    """
    a, b, c, d = quad
    area = 0.5 * ((r[c] - r[a]) * (z[d] - z[b]) - (r[d] - r[b]) * (z[c] - z[a]))
    return 0.5 * math.pi * (r[a] + r[b] + r[c] + r[d]) * area


@kernel
def _shape(r, z, quad, u, v, back):
    """Return area, mean radius, the derivatives that two nodes have (the others: their negatives) and the gradient.

    On the mesh ``back`` (s) ago. Gradient: du/dr, du/dz, dv/dr, dv/dz, u/r (1/s).
    """
    a, b, c, d = quad
    r02, z02 = r[a] - r[c] - back * (u[a] - u[c]), z[a] - z[c] - back * (v[a] - v[c])
    r13, z13 = r[b] - r[d] - back * (u[b] - u[d]), z[b] - z[d] - back * (v[b] - v[d])
    area = 0.5 * (r02 * z13 - r13 * z02)
    mean = 0.25 * (u[a] + u[b] + u[c] + u[d])
    radius = 0.25 * (r[a] + r[b] + r[c] + r[d]) - back * mean
    ar, br, az, bz = 0.5 * z13, -0.5 * z02, -0.5 * r13, 0.5 * r02
    u02, u13, v02, v13 = u[a] - u[c], u[b] - u[d], v[a] - v[c], v[b] - v[d]
    over = 1.0 / area
    return (area, radius, ar, br, az, bz, (ar * u02 + br * u13) * over, (az * u02 + bz * u13) * over,
            (ar * v02 + br * v13) * over, (az * v02 + bz * v13) * over, mean / radius)


@kernel
def _forces(r, z, quads, u, v, volume, stress, bulk, dt, fr, fz, spent):
    """Nodal forces (N) of all elements; return the largest step (s), or -1 where one has turned inside out.

    ``spent`` (J): work of the bulk viscosity and of hourglass control over the last step ``dt``.
    """
    sound, limit = math.sqrt((bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus) / bulk.density), math.inf
    fr[:] = 0.0
    fz[:] = 0.0
    for e in range(quads.shape[0]):
        a, b, c, d = quads[e]
        area, radius, ar, br, az, bz, ur, _, _, vz, hoop = _shape(r, z, quads[e], u, v, 0.0)
        jacobian = _volume(r, z, quads[e]) / volume[e]
        if area <= 0.0 or jacobian <= 0.0:
            return -1.0
        closing = max(0.0, -(ur + vz + hoop))
        long = max(math.hypot(r[a] - r[c], z[a] - z[c]), math.hypot(r[b] - r[d], z[b] - z[d]))
        size, density = min(math.sqrt(area), area / long), bulk.density / jacobian
        viscous = density * size * closing * (LINEAR * sound + QUADRATIC * size * closing)
        pressure = viscous - bulk.bulk_modulus * math.log(jacobian)
        rr, zz, rz, tt = stress[e, 0] - pressure, stress[e, 1] - pressure, stress[e, 2], stress[e, 3] - pressure
        ring = 2.0 * math.pi * radius
        ring_force = 0.5 * math.pi * area * tt
        fra, fza = ring * (ar * rr + az * rz), ring * (az * zz + ar * rz)
        frb, fzb = ring * (br * rr + bz * rz), ring * (bz * zz + br * rz)
        # the hourglass mode 1, -1, 1, -1, less its linear part
        twist_r, twist_z = (r[a] - r[b] + r[c] - r[d]) / area, (z[a] - z[b] + z[c] - z[d]) / area
        first, second = ar * twist_r + az * twist_z, br * twist_r + bz * twist_z
        ga, gb, gc, gd = 1.0 - first, -1.0 - second, 1.0 + first, -1.0 + second
        strength = HOURGLASS * density * sound * math.sqrt(area) * 0.25 * ring
        qu, qv = ga * u[a] + gb * u[b] + gc * u[c] + gd * u[d], ga * v[a] + gb * v[b] + gc * v[c] + gd * v[d]
        hr, hz = strength * qu, strength * qv
        spent[VISCOUS] += viscous * closing * ring * area * dt
        spent[HOURGLASS_WORK] += (hr * qu + hz * qv) * dt
        fr[a] -= fra + ring_force + hr * ga
        fr[b] -= frb + ring_force + hr * gb
        fr[c] -= ring_force - fra + hr * gc
        fr[d] -= ring_force - frb + hr * gd
        fz[a] -= fza + hz * ga
        fz[b] -= fzb + hz * gb
        fz[c] -= hz * gc - fza
        fz[d] -= hz * gd - fzb
        limit = min(limit, COURANT * size / (sound * (1.0 + 2.0 * LINEAR) + 2.0 * QUADRATIC * size * closing))
    return limit


@kernel
def _stresses(r, z, quads, u, v, volume, stress, peeq, temperature, bulk, flow, dt, spent):
    """Deviatoric stress (element, rr zz rz tt), PEEQ and temperature after a step ``dt`` (s) that ends at r, z."""
    shear = bulk.shear_modulus
    for e in range(quads.shape[0]):
        _, _, _, _, _, _, ur, uz, vr, vz, hoop = _shape(r, z, quads[e], u, v, 0.5 * dt)
        mean, turn = (ur + vz + hoop) / 3.0, 0.25 * (uz - vr) * dt
        c, s = (1.0 - turn * turn) / (1.0 + turn * turn), 2.0 * turn / (1.0 + turn * turn)
        rr, zz, rz = stress[e, 0], stress[e, 1], stress[e, 2]
        new = (c * c * rr + 2.0 * c * s * rz + s * s * zz + 2.0 * shear * dt * (ur - mean),
               s * s * rr - 2.0 * c * s * rz + c * c * zz + 2.0 * shear * dt * (vz - mean),
               c * s * (zz - rr) + (c * c - s * s) * rz + shear * dt * (uz + vr),
               stress[e, 3] + 2.0 * shear * dt * (hoop - mean))
        mises = math.sqrt(1.5 * (new[0] ** 2 + new[1] ** 2 + 2.0 * new[2] ** 2 + new[3] ** 2))
        share = 1.0
        if mises > flow_stress(flow, peeq[e], 0.0, temperature[e])[0]:
            low, high, more = 0.0, mises / (3.0 * shear), 0.0
            for _ in range(BISECTIONS):
                more = 0.5 * (low + high)
                rest = mises - 3.0 * shear * more
                if rest > flow_stress(flow, peeq[e] + more, more / dt, temperature[e])[0]:
                    low = more
                else:
                    high = more
            share = (mises - 3.0 * shear * more) / mises
            work = share * mises * more
            spent[PLASTIC] += work * volume[e]
            temperature[e] += bulk.taylor_quinney * work / (bulk.density * bulk.specific_heat)
            peeq[e] += more
        for component in range(4):
            stress[e, component] = share * new[component]


@kernel
def _behind(r, z, node, top):
    """Return the segment of the block's surface that ``node`` is just behind (-1: none) and how far along it."""
    nearest, along, found = math.inf, 0.0, -1
    for k in range(top.size - 1):
        dr, dz = r[top[k + 1]] - r[top[k]], z[top[k + 1]] - z[top[k]]
        x, y, square = r[node] - r[top[k]], z[node] - z[top[k]], dr * dr + dz * dz
        share, behind = (x * dr + y * dz) / square, (x * dz - y * dr) / math.sqrt(square)
        if -1e-9 <= share <= 1.0 + 1e-9 and 0.0 <= behind < min(nearest, 0.7 * math.sqrt(square)):
            nearest, along, found = behind, min(max(share, 0.0), 1.0), k
    return found, along


@kernel
def _bond(r, z, u, v, mass, skin, top, tied, along, spent):
    """Bond the nodes of the skin that have got behind the block's surface to it, for good, keeping momentum."""
    for n in skin:
        if tied[n] >= 0:
            continue
        k, share = _behind(r, z, n, top)
        if k < 0:
            continue
        tied[n], along[n] = k, share
        before, after = mass[n] * (u[n] ** 2 + v[n] ** 2), 0.0
        for end, part in ((top[k], (1.0 - share) * mass[n]), (top[k + 1], share * mass[n])):
            before += mass[end] * (u[end] ** 2 + v[end] ** 2)
            whole = mass[end] + part
            u[end] = (mass[end] * u[end] + part * u[n]) / whole if r[end] > 0.0 else 0.0
            v[end] = (mass[end] * v[end] + part * v[n]) / whole
            mass[end] = whole
            after += whole * (u[end] ** 2 + v[end] ** 2)
        spent[CONTACT] += 0.5 * (before - after)
        mass[n] = 0.0


@kernel
def _march(r, z, quads, u, v, mass, volume, skin, top, held_r, held_z, stress, peeq, temperature, bulk, flow, end,
           spent):
    """Step to the time ``end`` (s); return the steps, and the time at which an element turned inside out or -1."""
    fr, fz, tied, along = np.zeros(r.size), np.zeros(r.size), np.full(r.size, -1), np.zeros(r.size)
    time, dt, steps = 0.0, 0.0, 0
    while time < end:
        limit = _forces(r, z, quads, u, v, volume, stress, bulk, dt, fr, fz, spent)
        if limit < 0.0:
            return steps, time
        before, dt = dt, min(limit, 1.05 * dt) if steps else 0.1 * limit
        dt = min(dt, end - time)
        kick = 0.5 * (before + dt)
        for n in skin:
            if tied[n] >= 0:
                for e, share in ((top[tied[n]], 1.0 - along[n]), (top[tied[n] + 1], along[n])):
                    fr[e] += share * fr[n]
                    fz[e] += share * fz[n]
        for n in range(r.size):
            if tied[n] >= 0:
                continue
            if held_z[n]:
                spent[CONTACT] += 0.5 * mass[n] * v[n] ** 2  # of a node that has just met the mirror
            u[n] = 0.0 if held_r[n] or r[n] <= 0.0 else u[n] + fr[n] / mass[n] * kick
            v[n] = 0.0 if held_z[n] else v[n] + fz[n] / mass[n] * kick
        for n in skin:
            if tied[n] >= 0:
                a, b, share = top[tied[n]], top[tied[n] + 1], along[n]
                u[n], v[n] = (1.0 - share) * u[a] + share * u[b], (1.0 - share) * v[a] + share * v[b]
        for n in range(r.size):
            if top.size == 0 and not held_z[n] and z[n] + v[n] * dt <= 0.0:
                held_z[n] = True
                lands = -z[n] / dt
                spent[CONTACT] += 0.5 * mass[n] * (v[n] ** 2 - lands**2)
                v[n] = lands
            r[n] += u[n] * dt
            z[n] += v[n] * dt
        _stresses(r, z, quads, u, v, volume, stress, peeq, temperature, bulk, flow, dt, spent)
        if top.size:
            _bond(r, z, u, v, mass, skin, top, tied, along, spent)
        time, steps = time + dt, steps + 1
    return steps, -1.0


# --- a solution -------------------------------------------------------------------------------------------------


def _volumes(r: np.ndarray, z: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Return the volumes (m3) of all elements."""
    return np.array([_volume(r, z, quad) for quad in quads])


def _moments(r: np.ndarray, z: np.ndarray, quads: np.ndarray, mass: np.ndarray) -> tuple[float, float]:
    """Return height and width (m), 2 sqrt(5) sigma each, from 2 x 2 points in each element.

    NaN where more than ``FOLDED`` of the mass lies in elements that have folded: in jets some do, and nothing hangs on
    them.
    """
    weights, radii, heights = [], [], []
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    for point in signs / math.sqrt(3.0):
        sides = 1.0 + signs * point
        shape = 0.25 * sides[:, 0] * sides[:, 1]
        along, across = 0.25 * signs[:, 0] * sides[:, 1], 0.25 * signs[:, 1] * sides[:, 0]
        area = (r[quads] @ along) * (z[quads] @ across) - (r[quads] @ across) * (z[quads] @ along)
        radii.append(r[quads] @ shape)
        heights.append(z[quads] @ shape)
        weights.append(area * radii[-1])
    if mass[np.min(weights, axis=0) <= 0.0].sum() > FOLDED * mass.sum():
        return math.nan, math.nan
    share = np.array(weights) / np.sum(weights, axis=0) * mass / mass.sum()
    mean = (share * heights).sum()
    return (math.sqrt(20.0 * (share * (np.array(heights) - mean) ** 2).sum()),
            math.sqrt(10.0 * (share * np.array(radii) ** 2).sum()))


def _elastic(bulk: Bulk, volume: np.ndarray, stress: np.ndarray, jacobian: np.ndarray) -> float:
    """Return the elastic energy (J), of shape and of volume (p = -K ln J)."""
    squares = stress[:, 0] ** 2 + stress[:, 1] ** 2 + 2.0 * stress[:, 2] ** 2 + stress[:, 3] ** 2
    dense = bulk.bulk_modulus * (1.0 - jacobian + jacobian * np.log(jacobian))
    return float((volume * (jacobian * squares / (4.0 * bulk.shear_modulus) + dense)).sum())


def solve(bulk: Bulk, flow: tuple, diameter: float, speed: float, temperature: float, duration: float,
          cells_per_diameter: float, on_block: bool) -> Solution:
    """Return the solution of an impact: diameter (m), speed (m/s), temperature (K) of all, simulated time (s).

    Pressure is K ln(rho / rho_0). Raises ``UnstableStep`` where an element of the mesh turns inside out.
    """
    r, z, quads, (nodes, elements), skin, top, held_r, held_z = make_mesh(cells_per_diameter, diameter, on_block)
    volume = _volumes(r, z, quads)
    mass = np.zeros(r.size)
    np.add.at(mass, quads, 0.25 * bulk.density * volume[:, None])
    u, v = np.zeros(r.size), np.where(np.arange(r.size) < nodes, -speed, 0.0)
    brought = 0.5 * float((mass * v * v).sum())
    stress, peeq, heated = np.zeros((len(quads), 4)), np.zeros(len(quads)), np.full(len(quads), temperature)
    spent = np.zeros(len(PARTS))
    steps, folded = _march(r, z, quads, u, v, mass, volume, skin, top, held_r, held_z, stress, peeq, heated, bulk, flow,
                           duration, spent)
    height, width = _moments(r, z, quads[:elements], volume[:elements])
    if folded >= 0.0 or math.isnan(height):
        when = f" at {1e9 * folded:.3g} ns" if folded >= 0.0 else ""
        raise UnstableStep(f"the Lagrangian mesh folds{when}; lower the speed or the time")
    jacobian = _volumes(r, z, quads) / volume
    energy = dict(zip(PARTS, spent / brought))
    energy |= {"kinetic": float(0.5 * (mass * (u * u + v * v)).sum()) / brought,
               "elastic": _elastic(bulk, volume, stress, jacobian) / brought}
    energy["unexplained"] = 1.0 - sum(energy.values())
    own, found = volume[:elements] / volume[:elements].sum(), peeq[:elements]
    order = np.argsort(found)
    p50, p95 = (float(found[order][np.searchsorted(np.cumsum(own[order]), share)]) for share in (0.5, 0.95))
    crater = -float(z[top[0]]) if on_block else 0.0
    return Solution(height, width, crater, float(own @ found), p50, p95, energy, steps)
