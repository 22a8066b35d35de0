"""A plane cutting the unit cube: volume below it, and the plane that leaves a given volume.

Formulae of Scardovelli and Zaleski (2000), J. Comput. Phys. 164, 228, for a normal whose components
are non-negative and add up to one; the general case follows by reflection and scaling.
"""

from __future__ import annotations

import math

from f2s_hpc._jit import kernel

_SMALLEST = 1e-7
"""Least component of a normal: thinner wedges lose more digits than the wedge is worth."""


@kernel
def _sorted(a, b, c):
    low, high = min(a, b), max(a, b)
    if c < low:
        return c, low, high
    if c > high:
        return low, high, c
    return low, c, high


@kernel
def _shares(a, b, c):
    """Return the three components in rising order, none below the least one, adding up to one."""
    a, b, c = max(a, _SMALLEST), max(b, _SMALLEST), max(c, _SMALLEST)
    total = a + b + c
    return _sorted(a / total, b / total, c / total)


@kernel
def volume_below(a, b, c, distance):
    """Return the volume of the unit cube where a x + b y + c z < distance; a, b, c >= 0, not all zero."""
    total = a + b + c
    if distance <= 0.0:
        return 0.0
    if distance >= total:
        return 1.0
    m1, m2, m3 = _shares(a / total, b / total, c / total)
    alpha = distance / total
    mirrored = alpha > 0.5
    if mirrored:
        alpha = 1.0 - alpha
    m12 = m1 + m2
    if alpha < m1:
        volume = alpha * alpha * alpha / (6.0 * m1 * m2 * m3)
    elif alpha < m2:
        volume = 0.5 * alpha * (alpha - m1) / (m2 * m3) + m1 * m1 / (6.0 * m2 * m3)
    elif alpha < min(m12, m3):
        volume = (alpha * alpha * (3.0 * m12 - alpha) + m1 * m1 * (m1 - 3.0 * alpha)
                  + m2 * m2 * (m2 - 3.0 * alpha)) / (6.0 * m1 * m2 * m3)
    elif m12 <= m3:
        volume = (alpha - 0.5 * m12) / m3
    else:
        volume = (alpha * alpha * (3.0 - 2.0 * alpha) + m1 * m1 * (m1 - 3.0 * alpha) + m2 * m2 * (m2 - 3.0 * alpha)
                  + m3 * m3 * (m3 - 3.0 * alpha)) / (6.0 * m1 * m2 * m3)
    volume = min(max(volume, 0.0), 0.5)
    return 1.0 - volume if mirrored else volume


@kernel
def plane_distance(a, b, c, volume):
    """Return the distance d with volume_below(a, b, c, d) = volume; a, b, c >= 0 and a + b + c = 1."""
    m1, m2, m3 = _shares(a, b, c)
    m12 = m1 + m2
    v = min(volume, 1.0 - volume)
    six = 6.0 * m1 * m2 * m3
    v1 = m1 * m1 / (6.0 * m2 * m3)
    v2 = v1 + 0.5 * (m2 - m1) / m3
    if m3 < m12:
        v3 = (m3 * m3 * (3.0 * m12 - m3) + m1 * m1 * (m1 - 3.0 * m3) + m2 * m2 * (m2 - 3.0 * m3)) / six
    else:
        v3 = 0.5 * m12 / m3
    if v < v1:
        alpha = (six * v) ** (1.0 / 3.0)
    elif v < v2:
        alpha = 0.5 * (m1 + math.sqrt(m1 * m1 + 8.0 * m2 * m3 * (v - v1)))
    elif v < v3:
        p = 2.0 * m1 * m2
        q = 1.5 * m1 * m2 * (m12 - 2.0 * m3 * v)
        root = math.sqrt(p)
        cosine = math.cos(math.acos(min(max(q / (p * root), -1.0), 1.0)) / 3.0)
        alpha = root * (math.sqrt(max(3.0 * (1.0 - cosine * cosine), 0.0)) - cosine) + m12
    elif m12 <= m3:
        alpha = m3 * v + 0.5 * m12
    else:
        p = m1 * (m2 + m3) + m2 * m3 - 0.25
        q = 1.5 * m1 * m2 * m3 * (0.5 - v)
        root = math.sqrt(p)
        cosine = math.cos(math.acos(min(max(q / (p * root), -1.0), 1.0)) / 3.0)
        alpha = root * (math.sqrt(max(3.0 * (1.0 - cosine * cosine), 0.0)) - cosine) + 0.5
    return 1.0 - alpha if volume > 0.5 else alpha


@kernel
def slab_volume(nx, ny, nz, distance, share, high):
    """Return the material volume in a slab of the unit cube at the low or high x side.

    The material fills n . x < distance, with |nx| + |ny| + |nz| = 1 and ``distance`` measured from the corner that
    the normal points away from; ``share`` is the slab's thickness; ``high`` picks x in
    [1 - share, 1], else [0, share].
    """
    a = abs(nx)
    near = (nx >= 0.0) != high
    start = 0.0 if near else 1.0 - share
    return share * volume_below(a * share, abs(ny), abs(nz), distance - a * start)


@kernel
def interface_normal(f, n, sx, sy, sz):
    """Return the unit-sum interface normal of cell ``n``, pointing out of the material.

    Mixed Youngs-centred choice (Aulisa, Manservisi, Scardovelli, Zaleski 2007, J. Comput. Phys.
    225, 2301): of three column-height normals the one most aligned with its axis, replaced by
    Youngs' 27-cell gradient where that is less aligned. ``f`` flat volume fractions; ``sx``, ``sy``,
    ``sz`` strides of the three axes.
    """
    yx, yy, yz = 0.0, 0.0, 0.0
    for c in range(-1, 2):
        for b in range(-1, 2):
            wx = (2 - abs(b)) * (2 - abs(c))
            m = n + b * sy + c * sz
            yx += wx * (f[m - sx] - f[m + sx])
            m = n + b * sx + c * sz
            yy += wx * (f[m - sy] - f[m + sy])
            m = n + b * sx + c * sy
            yz += wx * (f[m - sz] - f[m + sz])
    size = abs(yx) + abs(yy) + abs(yz)
    if size < 1e-30:
        return 0.0, 0.0, 1.0
    yx, yy, yz = yx / size, yy / size, yz / size
    best, cx, cy, cz = -1.0, yx, yy, yz
    for axis in range(3):
        if axis == 0:
            s, p, q = sx, sy, sz
        elif axis == 1:
            s, p, q = sy, sz, sx
        else:
            s, p, q = sz, sx, sy
        tp = 0.5 * (((f[n - p - s] + f[n - p]) + f[n - p + s]) - ((f[n + p - s] + f[n + p]) + f[n + p + s]))
        tq = 0.5 * (((f[n - q - s] + f[n - q]) + f[n - q + s]) - ((f[n + q - s] + f[n + q]) + f[n + q + s]))
        scale = 1.0 + abs(tp) + abs(tq)
        if 1.0 / scale > best:
            best = 1.0 / scale
            along = yx if axis == 0 else (yy if axis == 1 else yz)
            sign = (1.0 if along >= 0.0 else -1.0) / scale
            if axis == 0:
                cx, cy, cz = sign, tp / scale, tq / scale
            elif axis == 1:
                cx, cy, cz = tq / scale, sign, tp / scale
            else:
                cx, cy, cz = tp / scale, tq / scale, sign
    if best > max(abs(yx), abs(yy), abs(yz)):
        return yx, yy, yz
    return cx, cy, cz
