"""All measurements of the paper on one deposit, in one place: what is measured, with which settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from f2s_hpc.analysis import boundaries, depth, flattening, porosity, profile, roughness
from f2s_hpc.analysis.picture import Section, choose_section, material_above
from f2s_hpc.analysis.surface import dense_height
from f2s_hpc.config import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.report.deposit import Deposit
from f2s_hpc.report.handover import Handover
from f2s_hpc.report.traced import TracedParticles, trace

PAPER_HEIGHT = {"recurring": 363e-6, "standard": 362e-6}
"""Height of the deposit of section 4 (m), both schemes: Ge et al. 2026, section 4 and Fig. 7."""

MOST_SECTIONS = 100_000
"""More than a box has cells along an axis: further ones would be the same again."""

WELL_COVERED = 0.9
"""A smaller share of a profile's width in common with the other is worth a note."""

_PAPER_PATCH, _PAPER_PARTICLES, _PAPER_SPEED, _PAPER_TEMPERATURE = 0.35e-3, 5000, 615.0, 723.15
_PAPER_MATERIAL, _PAPER_POWDER = "copper-ge", 334e-6
"""The powder of the paper's deposit as a dense layer (m): five times that of the authors' batches 01 and 02."""
SAME_POWDER = 0.05
"""A deposit with more or less powder than that of the paper, by a larger share, has another height to have."""


@dataclass(frozen=True)
class Settings:
    """How to measure; lengths in m.

    ``along``: direction of the track; ``cutoff``: of the Gaussian filter; ``surface_zone``: thickness that porosity
    leaves out below the surface, None for half the median particle diameter, at least two cells; ``sections``: planes
    each along x and y for image porosity; ``smallest_pore``: pixels; ``layer``: thickness of the layers of the
    distributions; ``prominence``: least rise of a PEEQ ridge (``analysis.boundaries``); ``symmetric``: half a track
    was simulated, and place 0 of the profile (x, or y with a track along x) is its middle, None where the scene shall
    tell (``half_track``); ``align``: move the profile onto the experimental one before they overlap.
    """

    along: str = "y"
    cutoff: float = 80e-6
    surface_zone: float | None = None
    sections: int = 10
    smallest_pore: int = 4
    layer: float = 10e-6
    prominence: float = boundaries.PROMINENCE
    symmetric: bool | None = None
    align: bool = False


@dataclass(frozen=True, eq=False)
class Porosity:
    """Porosity of the bulk; ``zone``: the surface zone left out (m); ``volume``: of the bulk (m3)."""

    zone: float
    volume: float
    exact: float
    image: porosity.SectionPorosity
    pores: porosity.PoreSplit


@dataclass(eq=False)
class Measurements:
    """What was measured on ``deposit``; ``notes`` tell what could not be, and why. All SI. ``settings`` are resolved:
    ``symmetric`` is no longer None.

    ``distributions``: in layers; ``overall``: in the whole substrate and in the whole deposit; ``rough_along``: of
    profiles along the track, ``rough_across`` of those across it; ``traced``: every particle, from its points.
    """

    deposit: Deposit
    settings: Settings
    heights: dict[str, float]
    paper_height: float | None
    profile: profile.Profile
    size: profile.ProfileSize
    rough_along: roughness.Roughness | None
    rough_across: roughness.Roughness | None
    areal: roughness.ArealRoughness | None
    porosity: Porosity | None
    distributions: dict[str, depth.DepthDistribution]
    overall: dict[str, depth.DepthDistribution]
    flattening: flattening.Flattening
    fits: dict[str, flattening.Regression | None]
    section: Section
    section_planes: int
    experiment: profile.Profile | None = None
    overlap: profile.Overlap | None = None
    handover: Handover | None = None
    traced: TracedParticles | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def layer(self) -> float:
        """Thickness (m) of the layers of the distributions: that of the settings in whole cells."""
        return depth.layer_cells(self.settings.layer, self.deposit.dx) * self.deposit.dx


def deposit_percentiles(found: Measurements, name: str) -> np.ndarray:
    """Return the percentiles (at ``depth.SHARES``) of a field in the whole deposit; NaN while nothing has landed."""
    whole = found.overall[name]
    above = whole.low > -1e-6 * found.deposit.dx
    return whole.percentiles[above][-1] if above.any() else np.full(len(depth.SHARES), np.nan)


def is_section4(deposit: Deposit) -> bool:
    """Tell whether a run is section 4 of the paper, whatever its cells: patch, material, particles."""
    domain = deposit.scene.domain
    particles = deposit.scene.particles
    return (all(abs(length - _PAPER_PATCH) < 0.5 * domain.cell_size for length in domain.size[:2])
            and abs(particles.speed - _PAPER_SPEED) < 1.0
            and abs(particles.temperature - _PAPER_TEMPERATURE) < 1.0
            and all(batch.velocity is None and batch.temperature is None for batch in deposit.batches)
            and deposit.scene.material.name == _PAPER_MATERIAL
            and deposit.diameters.size == _PAPER_PARTICLES)


def paper_height(deposit: Deposit, dense: float, notes: list[str]) -> float | None:
    """Return the paper's height (m) where it can be compared with; a note where only the powder is another.

    ``dense``: dense-equivalent height of the deposit (m).
    """
    if not is_section4(deposit):
        return None
    if abs(dense / _PAPER_POWDER - 1.0) > SAME_POWDER:
        notes.append(f"heights: not set beside the paper's, whose powder is {1e6 * _PAPER_POWDER:.0f} µm of dense "
                     f"height; here it is {1e6 * dense:.0f} µm (batches.files takes the authors' own batches)")
        return None
    return PAPER_HEIGHT[deposit.scene.scheme]


def half_track(scene: Scene, along: str = "y") -> bool:
    """Tell whether the scene sprays half of a track that runs along ``along``.

    So it is where the low side of the axis across is a mirror and the spray is centred in it: the jet's axis lies
    there, or all listed spheres do.
    """
    axis = profile.across(along)
    if getattr(scene.domain.faces, f"{axis}_low") != "symmetry":
        return False
    tolerance, batches = 1e-3 * scene.domain.cell_size, scene.batches
    if batches.spheres:
        return all(abs(sphere["xy".index(axis)]) <= tolerance for sphere in batches.spheres)
    # (a jet has an axis over x only; with batches from files its speed law tells of it)
    return axis == "x" and scene.has_axis and abs(batches.jet_centre) <= tolerance


def _mirror_notes(scene: Scene, settings: Settings, asked: bool | None) -> list[str]:
    """Return what to say about the mirror of the profile; ``settings`` have it resolved from what was ``asked``."""
    axis = profile.across(settings.along)
    side = f"domain.faces.{axis}_low"
    if asked is None and settings.symmetric:
        return [(f"profile: half a track was simulated ({side} is a mirror, and the spray is centred in it), so it is "
                 f"mirrored at {axis} = 0; width and area are those of the whole track (--no-symmetric: of the half)")]
    face = getattr(scene.domain.faces, f"{axis}_low")
    if asked and face != "symmetry":
        return [f'profile: mirrored at {axis} = 0 as asked (--symmetric), though {side} is "{face}", no mirror']
    return []


def _cover_notes(over: profile.Overlap) -> list[str]:
    """Return what to say where the two profiles know little of each other."""
    notes = []
    for share, text in ((over.covered, "the experiment covers {:.0f} % of the width of the simulated profile"),
                        (over.second_covered, "the simulated profile covers {:.0f} % of the width of the experiment")):
        if share < WELL_COVERED:
            notes.append(f"overlap: {text.format(100.0 * share)}; only what both cover counts, so the overlap says "
                         "nothing about the rest")
    return notes


def measure(deposit: Deposit, settings: Settings = Settings(),
            experiment: profile.Profile | None = None) -> Measurements:
    """Return all measurements of a deposit; what it does not allow is left out with a note.

    ``experiment``: a measured profile for the overlapping ratio. Raises ``InputError`` for settings that fit no
    deposit.
    """
    if not 1 <= settings.sections <= MOST_SECTIONS:
        raise InputError(f"--sections {settings.sections}: it must be at least 1 and at most {MOST_SECTIONS:,}")
    if settings.smallest_pore < 1:
        raise InputError(f"--smallest-pore {settings.smallest_pore}: it must be at least 1")
    asked, scene = settings.symmetric, deposit.scene
    settings = replace(settings, symmetric=half_track(scene, settings.along) if asked is None else asked)
    dense = dense_height(deposit.fraction, deposit.dx, deposit.ground)
    whole = profile.mean_profile(deposit.surface, deposit.dx, deposit.ground, settings.along)
    if settings.symmetric:
        whole = profile.mirrored(whole)
    section = choose_section(*material_above(deposit.fraction, deposit.dx, deposit.ground), deposit.surface, deposit.dx,
                             deposit.ground)
    notes = _mirror_notes(scene, settings, asked)
    if deposit.skipped:
        notes.append(f"skipped: {deposit.skipped}")
    if deposit.detached > deposit.dx**3:
        notes.append(f"heights: {1e18 * deposit.detached:.3g} µm³ of slow fragments hang in the air, not "
                     "attached to the deposit; they are no part of its surface")
    flat, planes = _flattening(deposit, settings, notes)
    found = Measurements(
        deposit, settings, profile.heights(deposit.surface, dense, deposit.ground),
        paper_height(deposit, dense, notes), whole, profile.profile_size(whole),
        None, None, None, _porosity(deposit, settings, notes), _distributions(deposit, settings.layer),
        _distributions(deposit, deposit.fraction.shape[0] * deposit.dx), flat,
        {"equation_5": flattening.regression(flat.width, flat.equation_5),
         "equation_6": flattening.regression(flat.diameter, flat.equation_6)}, section, planes,
        experiment=experiment, notes=notes, traced=trace(deposit))
    if scene.output.tracers and found.traced is None:
        notes.append(f"tracers: no points were saved at the end of cycle {deposit.cycle}")
    _roughness(found)
    if experiment is not None and found.size.maximum <= 0.0:
        notes.append("overlap: nothing has landed that could be laid over the experiment")
    elif experiment is not None and whole.x.size < 2:
        notes.append("overlap: the box is one cell wide across the track, which is no profile to lay over another")
    elif experiment is not None:
        found.overlap = profile.overlap(whole, experiment, settings.align)
        notes += _cover_notes(found.overlap)
    return found


def filter_ends(deposit: Deposit) -> tuple[str, str]:
    """Return how the filter treats the ends along x and along y: mirrored where both sides are symmetry sides."""
    faces = deposit.scene.domain.faces
    return tuple(roughness.MIRROR if getattr(faces, f"{axis}_low") == getattr(faces, f"{axis}_high") == "symmetry"
                 else roughness.RENORMALISED for axis in "xy")


def _roughness(found: Measurements) -> None:
    deposit, cutoff = found.deposit, found.settings.cutoff
    ends = filter_ends(deposit)
    by_axis = {"x": (deposit.surface, ends[0]), "y": (deposit.surface.T, ends[1])}
    along = found.settings.along
    across = profile.across(along)
    if min(deposit.surface.shape) < 3:
        found.notes.append("roughness: the box is narrower than three cells")
        return
    if cutoff == Settings.cutoff and cutoff < roughness.LEAST_CELLS * deposit.dx:
        found.notes.append(f"roughness: a cutoff of {1e6 * cutoff:g} µm needs cells of a quarter of it; --cutoff gives "
                           "a longer one")
        return
    found.rough_along = roughness.profile_roughness(by_axis[along][0], deposit.dx, cutoff, by_axis[along][1])
    found.rough_across = roughness.profile_roughness(by_axis[across][0], deposit.dx, cutoff, by_axis[across][1])
    found.areal = roughness.areal_roughness(deposit.surface, deposit.dx, cutoff, ends)
    if not (found.rough_along.standard and found.rough_across.standard):
        found.notes.append(f"roughness: profiles of {1e6 * found.rough_along.length:.4g} and "
                           f"{1e6 * found.rough_across.length:.4g} µm are shorter than the five cutoffs "
                           f"({5e6 * cutoff:.4g} µm) of ISO 21920; compare only with values of the same length "
                           "and cutoff")


def median_diameter(deposit: Deposit) -> float:
    """Return the diameter (m) below which half the painted volume lies; the scene's where no batch is at hand."""
    diameters = deposit.diameters
    if not diameters.size:
        return deposit.scene.batches.diameter_d50
    return float(depth.weighted_percentiles(diameters, diameters**3, (0.5,))[0])


def _porosity(deposit: Deposit, settings: Settings, notes: list[str]) -> Porosity | None:
    zone = settings.surface_zone
    if zone is None:
        zone = max(0.5 * median_diameter(deposit), 2.0 * deposit.dx)
    try:
        top = porosity.bulk_top(deposit.surface, deposit.dx, zone, deposit.ground)
        share = porosity.bulk_share(deposit.fraction.shape, deposit.dx, deposit.ground, top)
        exact = porosity.exact_porosity(deposit.fraction, share)
        image = porosity.section_porosity(deposit.fraction, share, settings.sections, settings.smallest_pore)
        pores = porosity.split_pores(deposit.fraction, share, deposit.surface, deposit.dx)
    except InputError as error:
        notes.append(f"{error} ({1e6 * zone:.3g} µm)")
        return None
    return Porosity(zone, float(share.sum(dtype=np.float64)) * deposit.dx**3, exact, image, pores)


def _distributions(deposit: Deposit, layer: float) -> dict[str, depth.DepthDistribution]:
    weight = np.where(deposit.landed, np.minimum(deposit.fraction, np.float32(1.0)), np.float32(0.0))
    return {name: depth.depth_distribution(getattr(deposit, name), weight, deposit.dx, deposit.ground, layer)
            for name in ("peeq", "temperature", "von_mises")}


def section_planes(deposit: Deposit) -> list[tuple[int, int]]:
    """Return the planes (axis of the array, index) for flattening: a median diameter apart, so none counts twice."""
    planes = []
    for axis in (1, 2):
        n = deposit.fraction.shape[axis]
        number = max(1, int(min(n, n * deposit.dx / median_diameter(deposit))))
        planes += [(axis, int((place + 0.5) * n / number)) for place in range(number)]
    return planes


def particles_of_plane(deposit: Deposit, axis: int, index: int, prominence: float) -> boundaries.SectionParticles:
    """Return the particles of one vertical section of a deposit."""
    fraction = np.where(np.take(deposit.landed, index, axis), np.take(deposit.fraction, index, axis), 0.0)
    return boundaries.section_particles(np.take(deposit.peeq, index, axis), fraction, deposit.dx,
                                        math.ceil(deposit.ground / deposit.dx - 1e-6), prominence)


def _flattening(deposit: Deposit, settings: Settings, notes: list[str]) -> tuple[flattening.Flattening, int]:
    planes = section_planes(deposit)
    found = [particles_of_plane(deposit, *plane, settings.prominence) for plane in planes]
    cells = median_diameter(deposit) / deposit.dx
    if cells < 10.0:
        notes.append(f"flattening: {cells:.1f} cells per median particle diameter are few for boundaries by PEEQ; "
                     "ratios from sections are then rough")
    return flattening.flattening_from_sizes(np.concatenate([f.width for f in found]),
                                            np.concatenate([f.height for f in found])), len(planes)
