"""Roughness of profiles and surfaces: the Gaussian filter of ISO 16610-21 and the arithmetic and quadratic means.

The weight function is s(x) = exp(-pi (x / (alpha lc))^2) / (alpha lc), alpha = sqrt(ln 2 / pi), so a sine whose
wavelength is the cutoff lc keeps half its amplitude in the mean line, and the other half in the roughness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import correlate1d

from f2s_hpc.errors import InputError

ALPHA = math.sqrt(math.log(2.0) / math.pi)
REACH = 1.0
"""The weights are cut off this many cutoffs from their centre, where 1e-6 of the largest one is left.

ISO 16610-21 allows half a cutoff (0.76 % of the area is then missing); twice that costs nothing here."""

MIRROR, RENORMALISED = "mirror", "renormalised"
LEAST_CELLS, MOST_CELLS = 4, 50_000
"""Lengths of the cutoff; far beyond the box nothing is left to filter, and the weights would fill the memory."""
STANDARD_LENGTHS = 5
"""An evaluation length by ISO 21920 is this many cutoffs."""


@dataclass(frozen=True)
class Roughness:
    """Roughness with all that it depends on, lengths in m.

    ``cutoff`` and ``length`` (evaluation length); ``Ra``, ``Rq``: mean over all profiles; ``Ra_scatter``,
    ``Rq_scatter``: standard deviation over them; ``Pa``, ``Pq``: the same without filter, about the mean height of each
    profile, so that a tilt counts; ``profiles``: their number; ``ends``: how the ends were treated; ``standard``: is
    the evaluation length at least five cutoffs, as ISO 21920 asks?
    """

    cutoff: float
    length: float
    Ra: float
    Rq: float
    Ra_scatter: float
    Rq_scatter: float
    Pa: float
    Pq: float
    profiles: int
    ends: str
    standard: bool


@dataclass(frozen=True)
class ArealRoughness:
    """Roughness of a surface (m): ``Sa``, ``Sq`` after the Gaussian filter of ``cutoff``; without it, about the mean
    level, ``Sa_unfiltered``, ``Sq_unfiltered``, the height between lowest and highest point ``Sz_unfiltered``, and
    skewness ``Ssk_unfiltered`` (above zero: peaks on a plain) and kurtosis ``Sku_unfiltered`` (3 for a normal
    distribution of heights), NaN where the surface is flat."""

    cutoff: float
    Sa: float
    Sq: float
    Sa_unfiltered: float
    Sq_unfiltered: float
    Sz_unfiltered: float
    Ssk_unfiltered: float
    Sku_unfiltered: float
    ends: str


def gaussian_weights(dx: float, cutoff: float) -> np.ndarray:
    """Return the weights of the filter at multiples of ``dx``, (2 n + 1,), their sum 1 (lengths in m).

    Raises ``InputError`` when the cutoff is shorter than ``LEAST_CELLS`` cells: sampled more coarsely than that, the
    weights no longer transmit half of a wave at the cutoff; or longer than ``MOST_CELLS``.
    """
    if not (math.isfinite(cutoff) and cutoff >= LEAST_CELLS * dx * (1.0 - 1e-9)):
        raise InputError(f"cutoff {1e6 * cutoff:g} um: it must be at least {LEAST_CELLS} cells "
                         f"({LEAST_CELLS * dx * 1e6:g} um)")
    if cutoff > MOST_CELLS * dx:
        raise InputError(f"cutoff {1e6 * cutoff:g} um: it must be at most {MOST_CELLS:,} cells "
                         f"({MOST_CELLS * dx * 1e6:g} um)")
    reach = math.ceil(REACH * cutoff / dx)
    weights = np.exp(-math.pi * (np.arange(-reach, reach + 1) * dx / (ALPHA * cutoff)) ** 2)
    return weights / weights.sum()


def mean_line(height: np.ndarray, dx: float, cutoff: float, ends: str = MIRROR, axis: int = -1) -> np.ndarray:
    """Return the mean line of profiles, the long waves of ``height`` along ``axis`` (ISO 16610-21).

    ``height`` (m), any shape; ``dx``, ``cutoff`` in m. ``ends``: "mirror" continues the profile as its mirror image,
    which is exact beside a symmetry side of the box; "renormalised" divides by the weights that lie inside, so that
    nothing beyond an end is invented (ISO 16610-28). No part of the profile is lost either way.
    Raises ``InputError`` for another treatment, or a cutoff that is too short.
    """
    if ends not in (MIRROR, RENORMALISED):
        raise InputError(f'roughness: ends can be "{MIRROR}" or "{RENORMALISED}", not {ends!r}')
    weights = gaussian_weights(dx, cutoff)
    height = np.asarray(height, dtype=np.float64)
    if ends == MIRROR:
        return correlate1d(height, weights, axis=axis, mode="reflect")
    inside = correlate1d(np.ones(height.shape[axis]), weights, mode="constant", cval=0.0)
    shape = [1] * height.ndim
    shape[axis] = -1
    return correlate1d(height, weights, axis=axis, mode="constant", cval=0.0) / inside.reshape(shape)


def profile_roughness(height: np.ndarray, dx: float, cutoff: float, ends: str = MIRROR) -> Roughness:
    """Return Ra and Rq of profiles along the last axis of ``height`` (m), (n,) or (profiles, n); spacing ``dx`` (m).

    Ra = mean |r|, Rq = sqrt(mean r^2), r = height - mean line (ISO 21920-2), over the whole length of each profile.
    Raises ``InputError`` for fewer than three points, or what :func:`mean_line` refuses.
    """
    height = np.atleast_2d(np.asarray(height, dtype=np.float64))
    if height.ndim != 2 or height.shape[1] < 3:
        raise InputError(f"roughness: profiles of shape {height.shape}; at least three points each are needed")
    residue = height - mean_line(height, dx, cutoff, ends)
    primary = height - height.mean(axis=1, keepdims=True)
    Ra, Rq = np.abs(residue).mean(axis=1), np.sqrt((residue**2).mean(axis=1))
    length = height.shape[1] * dx
    return Roughness(cutoff, length, float(Ra.mean()), float(Rq.mean()), float(Ra.std()), float(Rq.std()),
                     float(np.abs(primary).mean()), float(np.sqrt((primary**2).mean(axis=1)).mean()), height.shape[0],
                     ends, bool(length >= STANDARD_LENGTHS * cutoff * (1.0 - 1e-9)))


def areal_roughness(surface: np.ndarray, dx: float, cutoff: float,
                    ends: tuple[str, str] = (MIRROR, MIRROR)) -> ArealRoughness:
    """Return Sa, Sq, Sz, Ssk, Sku (ISO 25178-2) of ``surface`` (m), (ny, nx); areal Gaussian filter of ISO 16610-61.

    The areal weights are the product of those along x and y. ``ends``: treatment along x and along y.
    Raises ``InputError`` when the surface is not two-dimensional, or as :func:`mean_line` does.
    """
    surface = np.asarray(surface, dtype=np.float64)
    if surface.ndim != 2 or surface.size < 9:
        raise InputError(f"roughness: a surface of shape {surface.shape}; it must be (ny, nx)")
    along_x = mean_line(surface, dx, cutoff, ends[0], axis=1)
    residue = surface - mean_line(along_x, dx, cutoff, ends[1], axis=0)
    plain = surface - surface.mean()
    spread, height = float(np.sqrt((plain**2).mean())), float(np.ptp(plain))
    uneven = height > 1e-9 * dx
    skewness, kurtosis = (float((plain**n).mean()) / spread**n if uneven else math.nan for n in (3, 4))
    return ArealRoughness(cutoff, float(np.abs(residue).mean()), float(np.sqrt((residue**2).mean())),
                          float(np.abs(plain).mean()), spread, height, skewness, kurtosis,
                          ends[0] if ends[0] == ends[1] else f"{ends[0]} along x, {ends[1]} along y")
