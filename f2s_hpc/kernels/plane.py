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


TAPER = 0.66
"""Share of the bulge of a section of even width that sections of a cube have, which taper towards their ends.

Measured: 0.65 to 0.67 on exact spheres of 5, 8 and 12 cells to a diameter, cut by faces in two ways.
"""

MOST_CURVED = 0.5
"""Largest curvature (1/cell) that is believed: that of a sphere of four cells."""

LEAST_GRADIENT = 1e-2
"""Gradient of the volume fraction (1/cell) below which a cell is crossed by no surface that could be curved."""


@kernel
def section_area(a, b, c, distance):
    """Return the area of the plane's section with the unit cube; a, b, c >= 0 and a + b + c = 1.

    The derivative of :func:`volume_below` by the distance along the normal.
    """
    m1, m2, m3 = _shares(a, b, c)
    alpha, m12 = min(distance, 1.0 - distance), m1 + m2
    if alpha <= 0.0:
        return 0.0
    if alpha < m1:
        slope = alpha * alpha / (2.0 * m1 * m2 * m3)
    elif alpha < m2:
        slope = (2.0 * alpha - m1) / (2.0 * m2 * m3)
    elif alpha < min(m12, m3):
        slope = (2.0 * alpha * m12 - alpha * alpha - m1 * m1 - m2 * m2) / (2.0 * m1 * m2 * m3)
    elif m12 <= m3:
        slope = 1.0 / m3
    else:
        slope = (2.0 * alpha - 2.0 * alpha * alpha - m1 * m1 - m2 * m2 - m3 * m3) / (2.0 * m1 * m2 * m3)
    return slope * math.sqrt(a * a + b * b + c * c)


@kernel
def interface_curvature(f, n, sx, sy, sz):
    """Return the curvature (1/cell) of the interface in cell ``n`` along x, above zero where material is convex.

    That of its section with the plane of normal and x axis: the second derivative of the volume fraction along the
    interface in that plane, over the gradient, both smoothed over 27 cells. Arguments as :func:`interface_normal`.
    """
    gx, gy, gz, hxx, hyy, hzz, hxy, hyz, hxz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(-1, 2):
        for b in range(-1, 2):
            for a in range(-1, 2):
                v = f[n + a * sx + b * sy + c * sz]
                wa, wb, wc = 0.5 - 0.25 * abs(a), 0.5 - 0.25 * abs(b), 0.5 - 0.25 * abs(c)
                da, db, dc = 0.5 * a, 0.5 * b, 0.5 * c
                qa, qb, qc = 3.0 * abs(a) - 2.0, 3.0 * abs(b) - 2.0, 3.0 * abs(c) - 2.0
                gx += v * (da * wb * wc)
                gy += v * (wa * db * wc)
                gz += v * (wa * wb * dc)
                hxx += v * (qa * wb * wc)
                hyy += v * (wa * qb * wc)
                hzz += v * (wa * wb * qc)
                hxy += v * (da * db * wc)
                hyz += v * (wa * db * dc)
                hxz += v * (da * wb * dc)
    size = math.sqrt(gx * gx + gy * gy + gz * gz)
    if size < LEAST_GRADIENT:
        return 0.0
    x, y, z = gx / size, gy / size, gz / size
    across = 1.0 - x * x
    if across < 1e-6:
        return 0.0
    p, q = -x * y, -x * z
    bent = across * across * hxx + p * p * hyy + q * q * hzz + 2.0 * (across * p * hxy + p * q * hyz + across * q * hxz)
    return -bent / (across * size)


@kernel
def slab_bulge(nx, ny, nz, distance, share, high, curvature):
    """Return the volume below a curved interface less that below the plane, in the slab of :func:`slab_volume`.

    An interface of ``curvature`` k along x that cuts off the same volume as the plane lies -k (s^2 - <s^2>) / 2 above
    it, s from the middle of the section along x: high in the middle, low at the ends, and a face sees an end. So a
    slab of a plane takes too much out of every donor, leading or trailing, and bodies ran ahead of their velocity. For
    a section of area A and even width that reaches s = +-h, the part from s = e h on holds -k A h^2 (e - e^3) / 12.
    """
    a, b, c = abs(nx), abs(ny), abs(nz)
    slope = (b * b + c * c) / (a * a + b * b + c * c)
    if slope < 1e-6:
        return 0.0
    low, top = 0.0, 1.0
    if a > 1e-9:
        low, top = max(0.0, (distance - b - c) / a), min(1.0, distance / a)
    half = 0.5 * (top - low)
    if half < 1e-9:
        return 0.0
    middle = 0.5 * (low + top)
    near = (nx >= 0.0) != high
    edge = (middle - share if near else 1.0 - share - middle) / half
    edge = min(max(edge, -1.0), 1.0)
    curved = TAPER * min(max(curvature, -MOST_CURVED), MOST_CURVED)
    return -curved / 12.0 * section_area(a, b, c, distance) * (half * half / slope) * (edge - edge * edge * edge)
