"""Heights of a deposit, its profile across the track, and how well two profiles overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from f2s_hpc.errors import InputError

EDGE_SHARE = 0.05
"""The track is as wide as its profile stands above this share of its maximum height."""

CREST_SHARE = 0.25
"""Two profiles are aligned by what stands above this share of the maximum of each: where a scan shows more of the bare
substrate on one side, noise there, or a zero that is 1 % of the height off, moves its whole centroid by 0.1 mm."""


@dataclass(frozen=True)
class Profile:
    """Height above the substrate top (m), ``height`` (n,), at the places ``x`` (m), ascending, (n,).

    ``spacing``: of the places (m), needed where there is one only, as in a box one cell wide.
    """

    x: np.ndarray
    height: np.ndarray
    spacing: float = 0.0

    @property
    def stretch(self) -> np.ndarray:
        """What length each point stands for (m): halfway to its neighbours, an end point as much outside as inside."""
        return np.gradient(self.x) if self.x.size > 1 else np.full(self.x.size, self.spacing)


@dataclass(frozen=True)
class ProfileSize:
    """Maximum height, width (both m) and area (m2) of a profile."""

    maximum: float
    width: float
    area: float


@dataclass(frozen=True)
class Overlap:
    """How well two profiles overlap, each area taken above the substrate top and where both are known.

    ``over_union``: common area over the area under either, 1 only for equal profiles; ``over_second``: common area
    over the area of the second; ``shift``: how far the first was moved along x (m) before; ``covered``: share of the
    first's width that the second reaches over, ``second_covered``: share of the second's that the first does.
    """

    over_union: float
    over_second: float
    shift: float
    covered: float
    second_covered: float


def heights(surface: np.ndarray, dense: float, substrate_height: float) -> dict[str, float]:
    """Return every usual height of a deposit (m, above the substrate top).

    ``surface``: heights from the bottom of the box (m), (ny, nx), as ``surface.landed_surface`` returns; ``dense``:
    the dense-equivalent height (``surface.dense_height``); ``substrate_height`` (m).
    Keys: dense, mean, median, p95, maximum. Raises ``InputError`` when ``surface`` is not two-dimensional.
    """
    if surface.ndim != 2 or surface.size == 0:
        raise InputError(f"heights: the surface has shape {surface.shape}; it must be (ny, nx)")
    above = surface - substrate_height
    return {"dense": dense, "mean": float(above.mean()), "median": float(np.median(above)),
            "p95": float(np.percentile(above, 95.0)), "maximum": float(above.max())}


def across(along: str) -> str:
    """Return the axis of the profile across a track along x or y."""
    return "x" if along == "y" else "y"


def mean_profile(surface: np.ndarray, dx: float, substrate_height: float, along: str = "y") -> Profile:
    """Return the profile across a track that runs along ``along`` ("x" or "y"): the mean height along it.

    ``surface``: heights from the bottom of the box (m), (ny, nx); ``dx``, ``substrate_height`` in m. The places are
    the centres of the cells. Raises ``InputError`` for another direction.
    """
    if along not in ("x", "y"):
        raise InputError(f'profile: the track can run along "x" or "y", not {along!r}')
    height = surface.mean(axis=0 if along == "y" else 1) - substrate_height
    return Profile((np.arange(height.size) + 0.5) * dx, height, dx)


def mirrored(profile: Profile) -> Profile:
    """Return the whole of a track of which the half beside the symmetry side at place 0 was simulated."""
    return Profile(np.concatenate([-profile.x[::-1], profile.x]),
                   np.concatenate([profile.height[::-1], profile.height]), profile.spacing)


def _edges(profile: Profile) -> tuple[float, float]:
    """Return where a profile with any height begins and ends (m): see ``profile_size``."""
    x, height, stretch = profile.x, np.maximum(profile.height, 0.0), profile.stretch
    level = EDGE_SHARE * float(height.max())
    inside = np.flatnonzero(height >= level)
    low, high = int(inside[0]), int(inside[-1])
    left = x[0] - 0.5 * stretch[0] if low == 0 else np.interp(level, height[[low - 1, low]], x[[low - 1, low]])
    right = (x[-1] + 0.5 * stretch[-1] if high == x.size - 1
             else np.interp(level, height[[high + 1, high]], x[[high + 1, high]]))
    return float(left), float(right)


def _covered(profile: Profile, by: Profile) -> float:
    """Return the share of the width of ``profile`` over which ``by`` is known."""
    left, right = _edges(profile)
    low, high = by.x[0] - 0.5 * by.stretch[0], by.x[-1] + 0.5 * by.stretch[-1]
    return float(np.clip((min(right, high) - max(left, low)) / (right - left), 0.0, 1.0))


def profile_size(profile: Profile) -> ProfileSize:
    """Return maximum height, width and area of a profile.

    Each point stands for its ``stretch``, so a profile of cell centres reaches to the sides of the box. Width: distance
    of the outermost crossings of ``EDGE_SHARE`` of the maximum, linear between points, or to the end where it does not
    come down to that. Area: sum of height times stretch; what is below the substrate top counts as zero.
    """
    maximum = float(profile.height.max())
    if maximum <= 0.0:
        return ProfileSize(maximum, 0.0, 0.0)
    left, right = _edges(profile)
    return ProfileSize(maximum, right - left, float((np.maximum(profile.height, 0.0) * profile.stretch).sum()))


def overlap(first: Profile, second: Profile, align: bool = False) -> Overlap:
    """Return the overlapping ratio of two profiles, as in Fig. 13 (b) of Ge et al. 2026.

    The paper gives the ratio (above 80 %) but not its formula; here it is the common area over the area of the union,
    integral of min(h1, h2) over integral of max(h1, h2), the strictest of the usual ones, and beside it the common
    area over that of the second profile. Integrals run over the x that both cover (``Overlap.covered`` tells how much
    of either that is), heights below zero count as zero.
    ``align``: move the first so that the centroids of what stands above ``CREST_SHARE`` of each maximum agree (the zero
    of a scan is arbitrary).
    Raises ``InputError`` when the two have no x in common, or no area, or the first is one point only.
    """
    if first.x.size < 2:
        raise InputError("overlap: the box is one cell wide across the track, which is no profile to lay over another")
    shift = _centroid(second) - _centroid(first) if align else 0.0
    x1 = first.x + shift
    low, high = max(x1[0], second.x[0]), min(x1[-1], second.x[-1])
    if not high > low:
        raise InputError(f"overlap: the profiles cover {_span(x1)} and {_span(second.x)}, nothing in common; "
                         "are both in the same unit and zero?")
    # fine enough that neither the corners nor the crossings of the two broken lines matter
    x = np.linspace(low, high, 20 * max(x1.size, second.x.size) + 1)
    one = np.maximum(np.interp(x, x1, first.height), 0.0)
    two = np.maximum(np.interp(x, second.x, second.height), 0.0)
    union, own = float(np.maximum(one, two).sum()), float(two.sum())
    if union <= 0.0 or own <= 0.0:
        raise InputError("overlap: a profile without any height above the substrate has no overlap")
    common = float(np.minimum(one, two).sum())
    moved = Profile(x1, first.height, first.spacing)
    return Overlap(common / union, common / own, shift, _covered(moved, second), _covered(second, moved))


def _centroid(profile: Profile) -> float:
    """Return the place (m) of the centroid of what stands above ``CREST_SHARE`` of the maximum."""
    maximum = float(profile.height.max())
    if maximum <= 0.0:
        raise InputError("overlap: a profile without any height above the substrate has no overlap")
    weight = np.maximum(profile.height - CREST_SHARE * maximum, 0.0) * profile.stretch
    return float((profile.x * weight).sum() / weight.sum())


def _span(x: np.ndarray) -> str:
    return f"{1e6 * x[0]:.4g} to {1e6 * x[-1]:.4g} um"
