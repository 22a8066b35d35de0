"""Porosity of a deposit three ways: exact from volume fractions, as a microscope sees it, and open against closed.

All are taken in the bulk: above the substrate top, and deeper than a surface zone below the surface as seen from above
(:func:`bulk_top`), since a valley of a rough surface is no pore.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from f2s_hpc.analysis.surface import HALF_FULL
from f2s_hpc.errors import InputError

_NO_BULK = ("porosity: no bulk is left between the substrate and the surface zone; the deposit is too thin, or "
            "--surface-zone too thick")


@dataclass(frozen=True)
class SectionPorosity:
    """Porosity of thresholded sections: ``mean`` and ``scatter`` (standard deviation) over ``sections`` of them.

    ``values``: each section's; ``smallest``: pores of fewer pixels were left out, as image analysis does with noise.
    """

    mean: float
    scatter: float
    sections: int
    smallest: int
    values: np.ndarray


@dataclass(frozen=True)
class PoreSplit:
    """Exact porosity split into what is open to the surface, closed, and too thin to show as a void cell.

    ``open`` + ``closed`` + ``thin`` = the exact porosity; ``pores``: number of closed pores; ``largest``: volume of
    the largest closed one (m3).
    """

    open: float
    closed: float
    thin: float
    pores: int
    largest: float


def bulk_top(surface: np.ndarray, dx: float, zone: float, bottom: float = 0.0) -> np.ndarray:
    """Return up to which height (m) the bulk reaches in each column, (ny, nx): all of it is ``zone`` from the surface.

    The surface as seen from above, (ny, nx) (m), is eroded by a ball of radius ``zone`` (m), mirrored at the sides:
    a point of the bulk is at least that far below and beside all free space above the deposit. Raises ``InputError``
    where the deposit, which begins at the height ``bottom`` (m), is nowhere thicker than the zone.
    """
    if zone >= float(surface.max()) - bottom:
        raise InputError(_NO_BULK)
    reach = int(zone / dx)
    if reach < 1:
        return surface - zone
    # no farther than the other side, where it is right (a mirror image is never nearer than the column itself): scipy
    # goes wrong with balls several times as wide as the box
    y, x = (np.arange(-most, most + 1) * dx for most in (min(reach, n - 1) for n in surface.shape))
    square = zone**2 - y[:, None] ** 2 - x[None, :] ** 2
    footprint = square >= 0.0
    ball = np.sqrt(np.where(footprint, square, 0.0))
    # grey erosion takes min(surface - structure)
    return ndimage.grey_erosion(surface, footprint=footprint, structure=ball, mode="reflect")


def bulk_share(shape: tuple[int, int, int], dx: float, bottom: float, top: np.ndarray | float) -> np.ndarray:
    """Return how much of each cell is bulk, 0 to 1, float32 (nz, ny, nx): what lies between ``bottom`` and ``top``.

    ``bottom`` (m), ``top`` (m), (ny, nx) or one number; ``dx`` (m). Only whole cells above the bottom count: in the
    one that the substrate top crosses, substrate and deposit cannot be told apart.
    """
    level = np.broadcast_to(np.asarray(top, dtype=np.float32) / np.float32(dx), shape[1:])
    first = int(np.ceil(bottom / dx - 1e-6))
    share = np.zeros(shape, dtype=np.float32)
    for k in range(max(first, 0), shape[0]):
        np.clip(level - k, 0.0, 1.0, out=share[k])
    return share


def exact_porosity(fraction: np.ndarray, share: np.ndarray) -> float:
    """Return 1 - sum(VF w) / sum(w), exact below the cell size.

    ``fraction``: volume fractions VF, (nz, ny, nx); ``share``: weight w of each cell (:func:`bulk_share`).
    Raises ``InputError`` when there is no bulk.
    """
    solid, whole = 0.0, 0.0
    for layer, weight in zip(fraction, share):  # by layers: no copy of the box
        solid += float((np.minimum(layer, 1.0) * weight).sum(dtype=np.float64))
        whole += float(weight.sum(dtype=np.float64))
    if whole <= 0.0:
        raise InputError(_NO_BULK)
    return 1.0 - solid / whole


def image_porosity(fraction: np.ndarray, bulk: np.ndarray, smallest: int = 4) -> tuple[float, np.ndarray]:
    """Return the porosity of one section by image analysis, and the pore pixels (bool, shape of the section).

    A pixel with VF < 0.5 is pore (the paper thresholds the VF field in ImageJ); pores of fewer than ``smallest``
    pixels (edge neighbours) are dropped. ``fraction``: VF of the section; ``bulk``: which pixels count (bool).
    """
    pores = (fraction < HALF_FULL) & bulk
    labels, count = ndimage.label(pores)
    if count:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        pores = (sizes >= smallest)[labels]
    area = int(bulk.sum())
    return (float(pores.sum()) / area if area else 0.0), pores


def section_porosity(fraction: np.ndarray, share: np.ndarray, sections: int = 10, smallest: int = 4) -> SectionPorosity:
    """Return the porosity of vertical sections, as from ``sections`` micrographs along x and as many along y.

    The planes are evenly spaced. ``fraction``, ``share``: (nz, ny, nx); a pixel counts when at least half of it is
    bulk. Raises ``InputError`` when no plane holds bulk.
    """
    found = []
    for axis in (1, 2):
        n = fraction.shape[axis]
        for index in np.unique(((np.arange(sections) + 0.5) * n / sections).astype(int)):
            bulk = np.take(share, index, axis) >= HALF_FULL
            if bulk.any():
                found.append(image_porosity(np.take(fraction, index, axis), bulk, smallest)[0])
    if not found:
        raise InputError("porosity: no section holds bulk; the deposit is too thin, or --surface-zone too thick")
    values = np.array(found)
    return SectionPorosity(float(values.mean()), float(values.std()), values.size, smallest, values)


def split_pores(fraction: np.ndarray, share: np.ndarray, surface: np.ndarray, dx: float) -> PoreSplit:
    """Return how much of the porosity is open to the free space above the deposit, and how much is closed.

    Void cells (VF < 0.5) connected through faces are one pore; it is open when a part of it lies above the surface as
    seen from above. The sides of the box are no way out: they are mirrors. ``fraction``, ``share``: (nz, ny, nx);
    ``surface``: height of the surface (m), (ny, nx); ``dx`` (m). Raises ``InputError`` without bulk.
    """
    whole = float(share.sum(dtype=np.float64))
    if whole <= 0.0:
        raise InputError(_NO_BULK)
    labels, count = ndimage.label(fraction < HALF_FULL)
    top = np.ceil(surface / dx - 1e-6).astype(int)
    is_open = np.zeros(count + 1, dtype=bool)
    volumes, thin = np.zeros(count + 1), 0.0
    for k in range(fraction.shape[0]):
        is_open[np.unique(labels[k][k >= top])] = True
        void = (1.0 - np.minimum(fraction[k], 1.0)) * share[k]
        volumes += np.bincount(labels[k].ravel(), weights=void.ravel(), minlength=count + 1)
    thin = float(volumes[0])
    volumes[0], is_open[0] = 0.0, False
    closed = np.where(is_open, 0.0, volumes)
    return PoreSplit(float(volumes[is_open].sum()) / whole, float(closed.sum()) / whole, thin / whole,
                     int((closed > 0.0).sum()), float(closed.max(initial=0.0)) * dx**3)
