"""Batches that come again mirrored, and powder that is even up to the sides."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from f2s_hpc.config import load_scene
from f2s_hpc.errors import InputError
from f2s_hpc.kernels.sphere import sphere_box_volume
from f2s_hpc.particles.batch import Batch, clipped_volume
from f2s_hpc.particles.plan import make_batches, mirrored
from f2s_hpc.particles.sizes import RosinRammler

MM = 1e-3


def plan(*overrides: str, scene: str = "section4"):
    return make_batches(load_scene(scene, overrides))


def rows(batch: Batch) -> np.ndarray:
    return np.column_stack([batch.x, batch.y, batch.z, batch.r])


def test_a_batch_that_comes_again_is_mirrored():
    """Two batches in ten cycles: the first uses as generated, then in x, in y, in both, exchanged; all different.

    Fails when ``with_images`` counts the uses of all batches together.
    """
    as_paper = plan("batches.count=2", "batches.particles=60")
    asked = plan("batches.count=2", "batches.particles=60", 'batches.mirror_repeats=["x", "y", "xy"]')
    assert as_paper.order == [asked.order[0], asked.order[1]] * 5
    assert len(set(asked.order)) == 10
    size = 0.35 * MM
    for turn, index in enumerate(asked.order):
        first, image = rows(asked.batches[asked.order[turn % 2]]), rows(asked.batches[index])
        use = turn // 2
        expected = first.copy()
        if use & 1:
            expected[:, 0] = size - expected[:, 0]
        if use & 2:
            expected[:, 1] = size - expected[:, 1]
        if use & 4:
            expected[:, :2] = expected[:, 1::-1]
        assert np.array_equal(image, expected), turn


def test_images_are_used_in_turn_and_their_velocities_turn_with_them(tmp_path):
    """One file in nine cycles: eight images, then the first again. Fails when ``turn`` leaves the velocity as it is."""
    path = tmp_path / "one.csv"
    path.write_text("x,y,z,r,vx,vy,vz\n0.1,0.05,0.1,0.01,30,-20,-600\n")
    found = plan(f'batches.files=["{path}"]', "cycles.count=9", 'batches.mirror_repeats=["x", "y", "xy"]')
    assert found.order == [0, 1, 2, 3, 4, 5, 6, 7, 0]
    # towards the middle of x, away from that of y, whatever the image
    places = {(round(b.x[0] / MM, 6), round(b.y[0] / MM, 6)) for b in found.batches}
    assert places == {*itertools.product((0.1, 0.25), (0.05, 0.3)), *itertools.product((0.05, 0.3), (0.1, 0.25))}
    for batch in found.batches:
        inward = np.sign(0.175 * MM - np.array([batch.x[0], batch.y[0]])) * batch.velocity[0, :2]
        assert sorted(inward) == [-20.0, 30.0]
        assert batch.velocity[0, 2] == -600.0


def test_mirrored_twice_is_the_batch_again():
    batch = plan("batches.count=1", "batches.particles=50", "cycles.count=1").batches[0]
    for how in ("x", "y", "xy"):
        again = mirrored(mirrored(batch, [how], 0.35 * MM, 0.35 * MM), [how], 0.35 * MM, 0.35 * MM)
        assert np.allclose(rows(again), rows(batch), rtol=0.0, atol=1e-18)


@pytest.mark.parametrize(("overrides", "wrong"), [
    (['batches.mirror_repeats=["x", "x"]'], "twice"),
    (['batches.mirror_repeats=["z"]'], "mirror_repeats"),
    (['batches.mirror_repeats=["xy"]', 'domain.size=["0.35 mm", "0.3 mm", "0.6 mm"]'], "exchanges x and y"),
    (['batches.mirror_repeats=["y", "x"]', 'batches.distribution="sech"', 'batches.jet_width="1.4 mm"'], "the jet"),
    (['batches.spheres=[["0.1 mm", "0.1 mm", "0.1 mm", "0.02 mm"]]', "batches.even_sides=true"], "no effect"),
])
def test_what_cannot_be_is_refused(overrides, wrong):
    with pytest.raises(InputError, match=wrong):
        load_scene("section4", overrides)


def _powder_at_sides(batches, size: float, depth: float) -> float:
    """Return the powder in the outermost ``depth`` (m) of a square footprint over that of an even spread."""
    inner = [depth, size - depth] * 2
    everywhere = sum(clipped_volume(batch, size, size, 1.0) for batch in batches)
    within = sum(sphere_box_volume(x, y, z, r, *inner, 0.0, 1.0) for batch in batches
                 for x, y, z, r in rows(batch).tolist())
    return (1.0 - within / everywhere) / (1.0 - ((size - 2.0 * depth) / size) ** 2)


@pytest.mark.parametrize("jet", [(), ('batches.distribution="sech"', 'batches.jet_width="20 mm"',
                                      "batches.jet_centre=0.175 mm")])
def test_powder_is_even_up_to_the_sides(jet):
    """In the outermost 3 um lies two thirds of the powder if all centres are inside, all of it with ``even_sides``.

    And the batch holds the volume of its number of particles. Fails without the margin in ``_generate``, or when
    ``number`` does not grow with it.
    """
    size, wanted = 0.35 * MM, ["batches.count=24", "batches.particles=500", "cycles.count=24", *jet]
    cut, even = plan(*wanted).batches, plan(*wanted, "batches.even_sides=true").batches
    assert 0.5 < _powder_at_sides(cut, size, 3e-6) < 0.8
    assert 0.9 < _powder_at_sides(even, size, 3e-6) < 1.1
    mean = RosinRammler.fit(19e-6, 30e-6, 52e-6, 10e-6, 85e-6).mean_particle_volume()
    volume = sum(clipped_volume(batch, size, size, 1.0) for batch in even)
    assert volume == pytest.approx(24 * 500 * mean, rel=0.05)
    for batch in even:
        assert (np.hypot(np.maximum(np.maximum(-batch.x, batch.x - size), 0.0),
                         np.maximum(np.maximum(-batch.y, batch.y - size), 0.0)) < batch.r).all()


def test_even_sides_leave_no_batch_empty():
    """One particle a batch: some come down beside the box, and are drawn anew. Fails without ``DRAWS``."""
    for seed in range(12):
        found = plan("batches.count=3", "batches.particles=1", "cycles.count=3", "batches.even_sides=true",
                     f"batches.seed={seed}", scene="quickstart")
        assert all(batch.count >= 1 for batch in found.batches), seed
