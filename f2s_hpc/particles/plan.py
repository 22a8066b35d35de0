"""The plan of a run's batches: read, listed or generated, with velocities and temperatures, and which enters when."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc.errors import InputError
from f2s_hpc.kernels.sphere import sphere_box_volume
from f2s_hpc.particles.batch import Batch, check_inside, read_csv, smallest_gap, stack
from f2s_hpc.particles.lateral import SechProfile
from f2s_hpc.particles.packing import crowd, pack
from f2s_hpc.particles.sizes import RosinRammler
from f2s_hpc.units import ZERO_CELSIUS, pretty

MISFIT_WORTH_A_LINE = 0.01
SPEED_TOLERANCE = 1e-9  # of the highest speed: a velocity with its own round-off does not exceed it
SIZE_TOLERANCE = 1e-9
DRAWS = 100
"""Tries for a batch of which some particle reaches into the box."""
LEAST_SHARE = 1e-3
"""A sphere with its centre beyond the sides is left out where a smaller share of it than this lies inside."""


@dataclass(frozen=True, eq=False)
class BatchPlan:
    """All batches of a run, the batch index of each cycle, and what the user should be told."""

    batches: list[Batch]
    order: list[int]
    messages: list[str] = field(default_factory=list)


def cycle_order(cycles: int, batches: int, shuffle: bool, generator: np.random.Generator) -> list[int]:
    """Return the batch index of each cycle: one permutation (shuffled or not), repeated cyclically."""
    permutation = generator.permutation(batches) if shuffle else np.arange(batches)
    return [int(permutation[cycle % batches]) for cycle in range(cycles)]


def plan_digest(plan: BatchPlan, cycles: int) -> str:
    """Return what tells the batches of the first ``cycles`` cycles from all others: SHA-256 of their bits."""
    digest = hashlib.sha256()
    for index in plan.order[:cycles]:
        for array in plan.batches[index].columns.values():
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _read_files(scene, height: float, messages: list[str]) -> list[Batch]:
    size_x, size_y = scene.domain.size[0], scene.domain.size[1]
    batches = []
    for path in scene.batches.files:
        batch = read_csv(path)
        _refuse_other_units(batch, path, scene.domain)
        check_inside(batch, str(path), size_x, size_y, height)
        _warn_of_overlap(batch, str(path), messages)
        batches.append(batch)
    return batches


def _refuse_other_units(batch: Batch, path: str, domain) -> None:
    """Raise InputError for spheres of which all are larger than the box, or none is a hundredth of a cell."""
    for radius, wrong, unit in ((batch.r.min(), batch.r.min() > max(domain.size), "micrometres"),
                                (batch.r.max(), batch.r.max() < 0.005 * domain.cell_size, "metres")):
        if wrong:
            raise InputError(f"{path}: a radius of {1e3 * radius:g} mm, in a box of {1e3 * max(domain.size):g} mm with "
                             f"cells of {1e3 * domain.cell_size:g} mm; are its numbers {unit}? millimetres are needed")


def _given_spheres(scene, messages: list[str]) -> Batch:
    spheres = np.array(scene.batches.spheres, dtype=np.float64).reshape(-1, 4)
    batch = Batch(*(np.ascontiguousarray(column) for column in spheres.T))
    bad = np.flatnonzero(~(np.isfinite(spheres).all(axis=1) & (batch.r > 0.0)))
    if bad.size:
        raise InputError(f"batches.spheres: row {bad[0] + 1}: needs four numbers [x, y, z, r] with a positive radius")
    domain = scene.domain
    check_inside(batch, "batches.spheres", domain.size[0], domain.size[1], domain.particle_layer_height)
    _warn_of_overlap(batch, "batches.spheres", messages)
    return batch


def _warn_of_overlap(batch: Batch, label: str, messages: list[str]) -> None:
    gap = smallest_gap(batch)
    if gap < 1.0:
        messages.append(f"{label}: spheres overlap (smallest centre distance over summed radii {gap:.4f}); "
                        "where a cell that they share cannot hold both, the later one is moved")


def _refuse_crowd(wanted, diameters: np.ndarray, box: tuple[float, float, float], number: int) -> None:
    """Raise InputError where no packing can hold the particles of a batch, before any is placed."""
    share = crowd(0.5 * diameters[diameters <= box[2]], box, wanted.gap_factor)
    if not share <= 1.0:
        lx, ly, lz = (f"{1e3 * length:g}" for length in box)
        volume = np.pi / 6.0 * float(np.sum(diameters**3))
        raise InputError(f"batches.particles = {wanted.particles}: those of batch {number} have {1e9 * volume:.3g} mm3,"
                         f" {share:.3g} times what the densest packing at gap factor {wanted.gap_factor:g} holds in "
                         f"the layer of {lx} x {ly} x {lz} mm; ask for fewer than {int(wanted.particles / share)} (at "
                         "random places about half of that fit), or a taller domain.particle_layer_height")


def _generate(scene, height: float, seeds: list[np.random.SeedSequence], messages: list[str]) -> list[Batch]:
    """Return scene.batches.count packed batches, one seed each, for a layer of the given height (m)."""
    wanted = scene.batches
    if wanted.count < 1 or wanted.particles < 1:
        raise InputError(f"batches: count {wanted.count} of {wanted.particles} particles is nothing to spray; "
                         "set batches.count and batches.particles, batches.files, or batches.spheres")
    percentiles = (wanted.diameter_d10, wanted.diameter_d50, wanted.diameter_d90)
    sizes = RosinRammler.fit(*percentiles, wanted.diameter_min, wanted.diameter_max)
    if max(map(abs, sizes.misfit(*percentiles))) > MISFIT_WORTH_A_LINE:
        messages.append(sizes.message(*percentiles))
    size_x, size_y = float(scene.domain.size[0]), float(scene.domain.size[1])
    # a packing is crowded at its rim, where spheres have fewer neighbours: so that has to lie out of reach
    margin = wanted.diameter_max if wanted.even_sides else 0.0
    box = (size_x + 2.0 * margin, size_y + 2.0 * margin, height)
    jet = SechProfile(wanted.jet_centre, wanted.jet_width) if wanted.distribution == "sech" else None
    number = wanted.particles
    if jet:
        share, wide = (float(jet.share(-beyond, size_x + beyond)) for beyond in (0.0, margin))
        messages.append(f"particles over x: sech of width {1e3 * jet.width:g} mm about {1e3 * jet.centre:g} mm; the "
                        f"box holds {100 * share:.1f} % of such a jet")
        number *= wide / max(share, 1e-300) * size_x / box[0]
    number = round(number * box[0] * box[1] / (size_x * size_y))
    batches = []
    for index, seed in enumerate(seeds, start=1):
        generator = np.random.Generator(np.random.PCG64(seed))
        for _ in range(DRAWS):
            diameters = sizes.sample_by_number(number, generator)
            _refuse_crowd(wanted, diameters, box, index)
            lateral = margin + jet.sample(number, 0.0 - margin, size_x + margin, generator) if jet else None
            packed = pack(diameters, box, wanted.gap_factor, generator, wanted.attempts, lateral)
            if packed.placed == 0:
                raise InputError(f"batches: no particle of batch {index} fits the layer; {packed.message()}")
            batch = Batch(packed.x, packed.y, packed.z, packed.r)
            if wanted.even_sides:
                batch = _reaching_in(batch, margin, size_x, size_y)
            if batch.count:  # (of very few, all may have come down beside the box)
                break
        else:
            raise InputError(f"batches: no particle of batch {index} reaches into the box; ask for more with "
                             "batches.particles, or leave batches.even_sides out")
        if packed.placed < packed.requested:
            messages.append(f"batch {index} of {wanted.count}: {packed.message()}")
        batches.append(batch)
    return batches


def _reaching_in(batch: Batch, margin: float, size_x: float, size_y: float) -> Batch:
    """Return the spheres of a footprint wider by ``margin`` (m) on each side that reach into the box, placed in it."""
    moved = dataclasses.replace(batch, x=batch.x - margin, y=batch.y - margin)
    inside = np.array([sphere_box_volume(x, y, z, r, 0.0, size_x, 0.0, size_y, z - r, z + r)
                       for x, y, z, r in zip(moved.x, moved.y, moved.z, moved.r)])
    return moved.chosen(inside > LEAST_SHARE * 4.0 / 3.0 * np.pi * moved.r**3)


# --- batches that come again ------------------------------------------------------------------------------------


def mirrored(batch: Batch, how: Sequence[str], size_x: float, size_y: float) -> Batch:
    """Return the batch with places and own velocities mirrored in the box of ``size_x``, ``size_y`` (m).

    ``how``: "x" mirrors in the middle of x, "y" in that of y, "xy" exchanges x and y; one after the other.
    """
    x, y, velocity = batch.x, batch.y, batch.velocity
    for step in how:
        if step == "xy":
            x, y = y, x
            turn = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        else:
            x, y = (size_x - x, y) if step == "x" else (x, size_y - y)
            turn = np.diag([-1.0 if step == axis else 1.0 for axis in "xyz"])
        velocity = None if velocity is None else velocity @ np.array(turn)
    return dataclasses.replace(batch, x=x, y=y, velocity=velocity)


def with_images(batches: list[Batch], order: list[int], how: Sequence[str], size_x: float, size_y: float,
                ) -> tuple[list[Batch], list[int]]:
    """Return batches and order where a batch that comes again comes as another of its mirror images.

    ``how``: as :func:`mirrored`; n of them make 2**n images, which a batch takes in turn, itself first.
    """
    batches, order = list(batches), list(order)
    uses, known = {}, {}
    for cycle, index in enumerate(order):
        image = uses.get(index, 0) % 2 ** len(how)
        uses[index] = uses.get(index, 0) + 1
        if image and (index, image) not in known:
            known[index, image] = len(batches)
            steps = [step for bit, step in enumerate(how) if image >> bit & 1]
            batches.append(mirrored(batches[index], steps, size_x, size_y))
        order[cycle] = known.get((index, image), index)
    return batches, order


# --- velocities -------------------------------------------------------------------------------------------------


def _by_laws(scene, batch: Batch) -> Batch:
    """Return the batch with each sphere's velocity: its own, or that of the scene's laws at its x and diameter.

    Figures 8b to d and 10c of Ge et al. 2026. What a mirror over x cuts stands for a particle in that plane, whose
    other half is the image: by symmetry it has no velocity across.
    """
    if batch.velocity is not None:
        return batch
    particles, width = scene.particles, float(scene.domain.size[0])
    distance = np.clip(batch.x, 0.0, width) - scene.batches.jet_centre  # a centre outside the box flies like its wall
    velocity = particles.speed_at(distance, 2.0 * batch.r)[:, None] * np.array(particles.direction)
    if particles.lateral:
        faces = scene.domain.faces
        cut = (batch.x < batch.r) & (faces.x_low == "symmetry")
        cut |= (batch.x > width - batch.r) & (faces.x_high == "symmetry")
        velocity[:, 0] = np.where(cut, 0.0, particles.lateral_at(distance))  # (direction has no x then)
    return dataclasses.replace(batch, velocity=velocity)


def _check_laws(scene, batches: list[Batch]) -> None:
    """Raise where no sphere flies by the laws, or a file's is of a size that these were not checked for."""
    if all(batch.velocity is not None for batch in batches):
        key = "speed_per_diameter" if scene.particles.speed_per_diameter else scene.particles.lateral[0]
        raise InputError(f"particles.{key} has no effect where all batches.files give velocities; leave it out")
    if not scene.particles.speed_per_diameter:
        return
    for name, batch in zip(scene.batches.files, batches):
        if batch.velocity is None:
            _check_sizes(scene, name, batch, "speed_per_diameter")


def _check_sizes(scene, name: str, batch: Batch, law: str) -> None:
    """Raise where the file ``name`` has a sphere of a size that the ``law`` was not checked for."""
    low, high = scene.batches.diameter_range
    wrong = (2.0 * batch.r < low * (1.0 - SIZE_TOLERANCE)) | (2.0 * batch.r > high * (1.0 + SIZE_TOLERANCE))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{name}: row {row + 1}: a diameter of {2e3 * batch.r[row]:g} mm, for which "
                         f"particles.{law} was not checked; let batches.diameter_min and diameter_max "
                         f"({1e3 * low:g} and {1e3 * high:g} mm) hold it")


def _with_velocities(scene, batches: list[Batch], messages: list[str], kept: bool) -> list[Batch]:
    """Give all spheres velocities of their own if any has one, or the laws differ by place or size; check the highest.
    """
    own = [batch.velocity is not None for batch in batches]
    if not any(own) and not scene.particles.by_place and not scene.particles.speed_per_diameter:
        _warn_of_departure(scene, np.array(scene.particles.velocity[2:]), messages)
        return batches
    if (scene.particles.speed_per_diameter or scene.particles.lateral) and not kept:
        _check_laws(scene, batches)
    limit = scene.top_speed
    for name, batch in zip(scene.batches.files, batches):  # (their mirror images are as fast)
        if batch.velocity is not None:
            with np.errstate(over="ignore"):
                speeds = batch.speed
            row = int(np.argmax(speeds))
            if speeds[row] > limit * (1.0 + SPEED_TOLERANCE):
                raise InputError(f"{name}: row {row + 1}: {speeds[row]:.6g} m/s is above the highest speed of "
                                 f"the scene, {limit:.6g} m/s; raise particles.speed, to which the limits of the "
                                 "numerics refer")
    batches = [_by_laws(scene, batch) for batch in batches]
    _warn_of_departure(scene, np.concatenate([batch.velocity[:, 2] for batch in batches]), messages)
    speeds = np.concatenate([batch.speed for batch in batches])
    across = np.concatenate([batch.velocity[:, 0] for batch in batches])
    messages.append(f"particles fly at {speeds.min():.1f} to {speeds.max():.1f} m/s, {speeds.mean():.1f} in the mean"
                    + (f"; {across.min():.1f} to {across.max():.1f} m/s along x" if scene.particles.lateral else ""))
    return batches


def _warn_of_departure(scene, down: np.ndarray, messages: list[str]) -> None:
    """Tell when particles (``down``: their velocity along z, m/s) will never come to the substrate."""
    leaving = int((down >= 0.0).sum())
    if leaving and scene.domain.substrate_height > 0.0:
        who = "no particle flies" if leaving == down.size else f"{leaving} of {down.size} particles do not fly"
        messages.append(f"{who} towards the substrate; it is at the low side of z, so directions and velocities with a "
                        "negative z lead there")


# --- temperatures -----------------------------------------------------------------------------------------------


def _with_temperatures(scene, batches: list[Batch], messages: list[str], kept: bool) -> list[Batch]:
    """Give all spheres temperatures of their own if any has one, or they differ by size; check those of files."""
    law = bool(scene.particles.temperature_per_diameter)
    own = [batch.temperature is not None for batch in batches]
    if not any(own) and not law:
        return batches
    if all(own) and law and not kept:
        raise InputError("particles.temperature_per_diameter has no effect where all batches.files give temperatures; "
                         "leave it out")
    for name, batch in zip(scene.batches.files, batches):  # (their mirror images are as hot)
        if batch.temperature is None and law:
            _check_sizes(scene, name, batch, "temperature_per_diameter")
        for row, value in enumerate(() if batch.temperature is None else batch.temperature.tolist(), start=1):
            problem = scene.temperature_problem(value)
            if problem:
                raise InputError(f"{name}: row {row}: temperature {pretty(value, 'temperature')} {problem}")
    batches = [batch if batch.temperature is not None else dataclasses.replace(
        batch, temperature=np.full(batch.count, scene.particles.temperature_at(2.0 * batch.r))) for batch in batches]
    values = np.concatenate([batch.temperature for batch in batches]) - ZERO_CELSIUS
    messages.append(f"particles are at {values.min():.1f} to {values.max():.1f} degC, {values.mean():.1f} in the mean")
    return batches


def make_batches(scene, kept: bool = False) -> BatchPlan:
    """Read or generate the batches of a scene and order them over the cycles. For rank 0; same seed, same bits.

    Recurring scheme: each batch fills the particle layer; ``order[c]`` is the batch of cycle c, one permutation
    (shuffled from the seed if asked) repeated cyclically. Standard scheme: the layer is cut into
    ``batches.count`` equal layers (at least one per file), filled from the bottom in the order in which the recurring
    scheme would spray (so fewer files than layers repeat), and becomes one batch for the one cycle. Explicit
    spheres are one batch. Batches are generated for the footprint as written in the scene, so they do not
    depend on the cell size. With ``batches.mirror_repeats`` a batch that comes again is mirrored (:func:`with_images`).
    Where files give velocities, or the velocity depends on place or diameter, every sphere has its own; likewise
    temperatures; ``kept``: the files are the copies that a run keeps, which the laws have been applied to already.
    Raises InputError for unreadable files, spheres outside the layer, too fast or molten, or nothing to
    place.
    """
    wanted, height = scene.batches, float(scene.domain.particle_layer_height)
    cycles = scene.cycles.count
    standard = scene.scheme == "standard"
    if standard and cycles != 1:
        raise InputError(f"cycles.count: the standard scheme paints everything at once, so 1 is needed, not {cycles}")
    messages: list[str] = []
    shuffle_seed, *batch_seeds = np.random.SeedSequence(wanted.seed).spawn(max(wanted.count, 0) + 1)
    shuffler = np.random.Generator(np.random.PCG64(shuffle_seed))
    layers = max(wanted.count, len(wanted.files), 1) if standard else 1
    layer_height = height / layers
    if len(wanted.spheres):
        batches = [_given_spheres(scene, messages)]
    elif len(wanted.files):
        batches = _read_files(scene, layer_height, messages)
    else:
        batches = _generate(scene, layer_height, batch_seeds, messages)
    order = cycle_order(layers if standard else cycles, len(batches), wanted.shuffle, shuffler)
    batches, order = with_images(batches, order, wanted.mirror_repeats, *map(float, scene.domain.size[:2]))
    batches = _with_velocities(scene, batches, messages, kept)
    batches = _with_temperatures(scene, batches, messages, kept)
    if not standard:
        return BatchPlan(batches, order, messages)
    return BatchPlan([stack([batches[index] for index in order], layer_height)], [0], messages)
