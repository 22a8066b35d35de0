"""Particle sizes, packing, the batch files and the plan of batches over the cycles."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from f2s_hpc.config import load_scene
from f2s_hpc.config.particles import Particles
from f2s_hpc.errors import InputError
from f2s_hpc.particles.batch import Batch, clipped_volume, read_csv, smallest_gap, stack, write_csv
from f2s_hpc.particles.packing import DENSEST, LEAST_FAILURES, NEXT_SIZE, crowd, pack, smallest_gap_ratio
from f2s_hpc.particles.plan import cycle_order, make_batches
from f2s_hpc.particles.sizes import RosinRammler

UM, MM = 1e-6, 1e-3
POWDER = (19 * UM, 30 * UM, 52 * UM)
LAYER = (0.35 * MM, 0.35 * MM, 0.203 * MM)


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def powder() -> RosinRammler:
    return RosinRammler.fit(*POWDER, 10 * UM, 85 * UM)


def scene(**changes) -> SimpleNamespace:
    """A scene of two small generated batches over five cycles; ``changes`` override any attribute by name."""
    batches = {"count": changes.pop("batch_count", 2), "particles": 40, "files": [], "spheres": [], "seed": 7,
               "gap_factor": 1.02, "attempts": 2000, "shuffle": True, "diameter_d10": 19 * UM, "diameter_d50": 30 * UM,
               "diameter_d90": 52 * UM, "diameter_min": 10 * UM, "diameter_max": 85 * UM, "distribution": "uniform",
               "even_sides": False, "mirror_repeats": ()}
    domain = {"size": (0.15 * MM, 0.12 * MM, 0.4 * MM), "substrate_height": 0.1 * MM,
              "cell_size": 3 * UM, "particle_layer_height": 0.2 * MM}
    cycles, scheme = {"count": changes.pop("cycle_count", 5)}, changes.pop("scheme", "recurring")
    for name, value in changes.items():
        (domain if name in domain else batches)[name] = value
    particles = Particles(speed="600 m/s", temperature="450 degC")
    return SimpleNamespace(scheme=scheme, batches=SimpleNamespace(**batches), domain=SimpleNamespace(**domain),
                           cycles=SimpleNamespace(**cycles), particles=particles)


def paper_file(name: str) -> Path:
    """Return the path of one of the authors' batches, or skip."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data" / "free2spray"
    folder = Path(os.environ.get("F2S_PAPER_DATA", beside))
    if not (folder / name).is_file():
        pytest.skip(f"the authors' batch {name} is not in {folder}; set F2S_PAPER_DATA to its folder")
    return folder / name


# --- sizes -----------------------------------------------------------------------------------------------------------

def test_truncated_distribution_starts_at_minimum_ends_at_maximum_and_inverts():
    """Fails when ``start`` is dropped from ``volume_percentile``."""
    sizes = powder()
    assert sizes.volume_percentile([0.0, 1.0]) == pytest.approx([10 * UM, 85 * UM], rel=1e-12)

    def above(diameter: np.ndarray | float) -> np.ndarray:
        """Return the volume share above a diameter of the distribution that is not truncated."""
        return np.exp(-(diameter / sizes.scale) ** sizes.exponent)

    q = np.linspace(0, 1, 21)
    share = (above(10 * UM) - above(sizes.volume_percentile(q))) / (above(10 * UM) - above(85 * UM))
    assert share == pytest.approx(q, abs=1e-12)


def test_fit_recovers_a_distribution_from_its_own_percentiles():
    """Fails when the fit compares with the untruncated percentiles (``start`` = 0 in ``volume_percentile``)."""
    true = RosinRammler(33 * UM, 2.4, 12 * UM, 80 * UM)
    fitted = RosinRammler.fit(*true.volume_percentile([0.1, 0.5, 0.9]), 12 * UM, 80 * UM)
    assert (fitted.scale, fitted.exponent) == pytest.approx((true.scale, true.exponent), rel=1e-6)


def test_fit_to_the_papers_percentiles_is_a_least_squares_minimum_and_reports_its_misfit():
    """The three cannot all be met: within 10 %, and no neighbour in scale or exponent is closer."""
    sizes = powder()

    def squares(candidate: RosinRammler) -> float:
        return float(np.sum(np.log1p(candidate.misfit(*POWDER)) ** 2))

    assert max(map(abs, sizes.misfit(*POWDER))) < 0.10
    for scale, exponent in ((1.002, 1), (0.998, 1), (1, 1.005), (1, 0.995)):
        other = RosinRammler(sizes.scale * scale, sizes.exponent * exponent, sizes.minimum, sizes.maximum)
        assert squares(other) > squares(sizes)
    assert "19.0 / 30.0 / 52.0 um" in sizes.message(*POWDER)


def test_sizes_sampled_by_number_have_the_volume_percentiles():
    """20000 particles, volume-weighted, within 3 %; fails when ``/ d**3`` is dropped from ``sample_by_number``."""
    sizes = powder()
    d = np.sort(sizes.sample_by_number(20000, generator(1)))
    share = np.cumsum(d**3) / np.sum(d**3)
    q = [0.1, 0.5, 0.9]
    assert d[np.searchsorted(share, q)] == pytest.approx(sizes.volume_percentile(q), rel=0.03)
    assert d[0] >= 10 * UM
    assert d[-1] <= 85 * UM
    assert np.cbrt(np.mean(d**3)) == pytest.approx(24.1 * UM, rel=0.02)  # two-percentile fits give 21.9 to 24.6


@pytest.mark.parametrize("sizes", [(30, 19, 52, 10, 85), (9, 30, 52, 10, 85), (19, 30, 90, 10, 85),
                                   (19, 30, 52, 0, 85)])
def test_impossible_percentiles_are_refused(sizes):
    with pytest.raises(InputError, match="diameter_d10"):
        RosinRammler.fit(*(value * UM for value in sizes))


# --- packing ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("count", "box", "gap"), [(500, LAYER, 1.02), (2559, (3.55 * MM, 0.3 * MM, 0.304 * MM), 1.02),
                                             (300, LAYER, 1.5)])
def test_packed_spheres_keep_the_gap_and_the_layer(count, box, gap):
    """Fails when ``reach`` leaves out ``largest`` (neighbours missed), or the span of z lacks ``- 2.0 * radius``."""
    packed = pack(powder().sample_by_number(count, generator(2)), box, gap, generator(3), 5000)
    assert packed.placed == packed.requested == count == packed.r.size
    centres = np.stack([packed.x, packed.y, packed.z])
    distance = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=0) / (packed.r[:, None] + packed.r)
    np.fill_diagonal(distance, np.inf)
    assert distance.min() >= gap * (1 - 1e-12)
    assert packed.reached_gap == pytest.approx(distance.min(), rel=1e-12)
    assert np.all(packed.z >= packed.r)
    assert np.all(packed.z < box[2] - packed.r)
    assert packed.x.min() >= 0
    assert packed.x.max() <= box[0]
    assert packed.y.min() >= 0
    assert packed.y.max() <= box[1]
    crossing = (packed.x < packed.r) | (packed.x > box[0] - packed.r)
    assert crossing.any()
    assert np.all(np.diff(packed.r) <= 0)
    assert packed.x.mean() == pytest.approx(box[0] / 2, rel=0.1)


def test_packing_follows_its_seed():
    """Fails when the places come from any other source than the given generator."""
    d = powder().sample_by_number(100, generator(2))
    first, again, other = (pack(d, LAYER, 1.02, generator(seed), 1000) for seed in (5, 5, 6))
    assert np.array_equal(first.x, again.x)
    assert np.array_equal(first.z, again.z)
    assert not np.array_equal(first.x, other.x)


def test_packer_says_how_many_it_could_place():
    """More than fits: those placed keep the gap, and the sentence names both numbers."""
    packed = pack(np.full(200, 40 * UM), (0.1 * MM, 0.1 * MM, 0.1 * MM), 1.2, generator(1), 200)
    assert 3 < packed.placed < 200
    assert packed.requested == 200
    assert packed.reached_gap >= 1.2
    assert f"placed {packed.placed} of 200" in packed.message()
    assert "200 attempts" in packed.message()
    tall = pack(np.array([0.3 * MM, 20 * UM]), (0.1 * MM, 0.1 * MM, 0.1 * MM), 1.0, generator(1), 10)
    assert tall.placed == 1
    assert tall.r[0] == 10 * UM
    assert tall.reached_gap == math.inf
    assert "1 found no room" in tall.message()


def test_a_size_without_room_is_given_up_and_smaller_ones_still_find_some():
    """Fails (as none but the first size is tried) when ``given_up`` becomes 0, and when ``radius > given_up`` is left
    out, as then all thousand spheres are tried: they must cost no more than ``LEAST_FAILURES`` of them."""
    box = (0.1 * MM, 0.1 * MM, 0.1 * MM)

    class Counting:
        """A generator that counts what is drawn from it."""

        def __init__(self) -> None:
            self.own, self.rows = generator(1), 0

        def random(self, shape: tuple[int, int]) -> np.ndarray:
            self.rows += shape[0]
            return self.own.random(shape)

    few, many = Counting(), Counting()
    small = np.full(20, 10 * UM)
    first = pack(np.concatenate([np.full(40 + LEAST_FAILURES, 40 * UM), small]), box, 1.2, few, 2000)
    second = pack(np.concatenate([np.full(1000, 40 * UM), small]), box, 1.2, many, 2000)
    assert few.rows == many.rows < 2000 * (60 + LEAST_FAILURES)
    assert np.array_equal(first.x, second.x)
    assert (second.r < NEXT_SIZE * 20 * UM).sum() == 20
    assert 3 < (second.r == 20 * UM).sum() < 40


def test_a_crowd_is_told_before_it_is_placed():
    """Fails when ``crowd`` leaves out what the walls cut, or the gap; what can be placed is never above 1."""
    box = (1.0 * MM, 1.0 * MM, 1.0 * MM)
    radii = np.full(1000, 20 * UM)
    own = 1000 * 4 / 3 * math.pi * (20 * UM) ** 3 / DENSEST
    assert crowd(radii, box, 1.0) == pytest.approx(own / (1.04 * MM * 1.04 * MM * 1.0 * MM), rel=1e-9)
    assert crowd(radii, box, 1.5) == pytest.approx(1.5**3 * own / (1.06 * MM * 1.06 * MM * 1.02 * MM), rel=1e-9)
    assert crowd(radii[:0], box, 1.0) == 0.0
    for count, narrow, gap in ((2000, LAYER, 1.0), (60, (0.05 * MM, 0.05 * MM, 0.09 * MM), 1.0), (40, LAYER, 4.0)):
        packed = pack(powder().sample_by_number(count, generator(2)), narrow, gap, generator(3), 200)
        assert crowd(packed.r, narrow, gap) < 1.0


@pytest.mark.parametrize("particles", [3000, 20_000, 1_000_000])
def test_more_particles_than_any_packing_holds_are_refused_at_once(particles):
    """Fails when ``_refuse_crowd`` is not called: 20,000 particles in the small layer took many minutes of silence."""
    with pytest.raises(InputError, match=rf"batches.particles = {particles}: .* ask for fewer than (2|3)\d\d "):
        make_batches(load_scene("quickstart", [f"batches.particles={particles}"]))


@pytest.mark.parametrize(("diameters", "box", "gap", "attempts"), [
    ([10 * UM], LAYER, 0.9, 10), ([10 * UM], LAYER, 1.0, 0), ([10 * UM], (1.0, 0.0, 1.0), 1.0, 10),
    ([0.0], LAYER, 1.0, 10), ([math.nan], LAYER, 1.0, 10)])
def test_packing_refuses_what_makes_no_sense(diameters, box, gap, attempts):
    with pytest.raises(InputError, match="packing"):
        pack(np.array(diameters), box, gap, generator(1), attempts)


# --- files -----------------------------------------------------------------------------------------------------------

def random_batch(count: int) -> Batch:
    numbers = generator(9)
    return Batch(*(numbers.random(count) * MM for _ in range(3)), (0.005 + 0.04 * numbers.random(count)) * MM)


def test_csv_round_trip_is_exact(tmp_path):
    """Bit for bit; fails when ``_metres`` divides ``float(text)`` by 1000 instead of shifting the decimal point."""
    batch = random_batch(2000)
    batch.x[0], batch.y[0], batch.z[0] = 0.0, 1e-12, 3.55e-3
    write_csv(tmp_path / "b.csv", batch)
    again = read_csv(tmp_path / "b.csv")
    for name in "xyzr":
        assert np.array_equal(getattr(batch, name), getattr(again, name))
    lines = (tmp_path / "b.csv").read_text().splitlines()
    assert lines[0] == "x,y,z,r"
    assert len(lines) == 2001
    assert os.listdir(tmp_path) == ["b.csv"]
    assert float(lines[2].split(",")[3]) == pytest.approx(1e3 * batch.r[1], rel=1e-15, abs=0.0)


def test_csv_accepts_what_spreadsheets_write(tmp_path):
    """A byte order mark, Windows lines, large letters, any order, rows of commas alone, remarks.

    Fails when ``split_rows`` leaves out only what is blank.
    """
    text = b"\xef\xbb\xbf# mine\r\nR, z,Y,x\r\n0.01,3e-2,0.2,0.1\r\n\r\n,,,\r\n"
    (tmp_path / "b.csv").write_bytes(text)
    batch = read_csv(tmp_path / "b.csv")
    assert (batch.x[0], batch.y[0], batch.z[0], batch.r[0]) == (1e-4, 2e-4, 3e-5, 1e-5)
    assert batch.count == 1


@pytest.mark.parametrize(("text", "words"), [
    ("", "empty"), ("x,y,z,r\n", "no sphere"), ("x,y,z\n1,2,3\n", "column 'r' is missing"),
    ("0.1,0.1,0.1,0.01\n", "column 'x' is missing"), ("x,y,z,r,d\n1,1,1,1,1\n", "unexpected column 'd'"),
    ("x,y,z,r\n0.1,0.1,0.1,0.01\n0.1,abc,0.1,0.01\n", "row 2: y is 'abc'"),
    ("x,y,z,r\n0.1,0.1,nan,0.01\n", "row 1: z is 'nan'"), ("x,y,z,r\n0.1,inf,0.1,0.01\n", "row 1: y is 'inf'"),
    ("x,y,z,r\n0.1,0.1,0.1,0.01\n\n0.1,0.1,0.1,-0.01\n", "row 2: r is -0.01"),
    ("x,y,z,r\n0.1,0.1,0.1,0\n", "row 1: r is 0"), ("x,y,z,r\n0.1,0.1,0.1\n", "row 1: 3 values"),
    ("x,y,z,r\n0.1,0.1,,0.01\n", "row 1: z is ''"), ("x,y,z,r\n1e9999999,0.1,0.1,0.01\n", "row 1: x is '1e9999999'"),
    (f"x,y,z,r\n0.1,0.1,0.1,1e{10**20}\n", "row 1: r is '1e100"),
    ("x,y,z,r\n0.1,1e400,0.1,0.01\n", "row 1: y is '1e400'"), ("x,y,z,r\n0.1,0.1,snan,0.01\n", "row 1: z is 'snan'"),
    ("x;y;z;r\n1.000,1;0,1;0,1;0,01\n", "row 1: x is '1.000.1'"), ("x,y,z,r\n0,1,0,1,0,1,0,01\n", "they need a point"),
    ('x,y,z,r\n0.1,0.1,0.1,0.01\n"' + 9000 * "0.1,0.1,0.1,0.01\n", "row 2: cannot be split into values"),
    ('"x,y,z,r\n' + 9000 * "0.1,0.1,0.1,0.01\n", "the first line: cannot be split into values"),
    ('x,y,z,r\n0.1,0.1,0.1,"' + 1000 * "0.1,0.1,0.1,0.01\n", "row 1: r is '0.1,0.1"),
    ('"x,y,z,r\n' + 1000 * "0.1,0.1,0.1,0.01\n", "column 'x' is missing")])
def test_csv_errors_name_file_and_row(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_csv(path)
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < len(str(path)) + 200


@pytest.mark.parametrize("text", [
    "x;y;z;r\n0,1;0,2;0,3;0,04\n", "x;y;z;r\r\n0.1;0.2;0.3;0.04\r\n;;;\r\n", "x\ty\tz\tr\n0.1\t0,2\t0.3\t0,04\n"])
def test_csv_of_other_countries_is_read_as_it_is(tmp_path, text):
    """Fails when ``split_rows`` takes a comma for the mark between values, or leaves it in a number."""
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    batch = read_csv(tmp_path / "b.csv")
    assert (batch.x[0], batch.y[0], batch.z[0], batch.r[0]) == (1e-4, 2e-4, 3e-4, 4e-5)
    assert batch.count == 1


def test_csv_that_cannot_be_read_or_written(tmp_path):
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x81")
    for path in (tmp_path / "absent.csv", tmp_path, tmp_path / "binary.csv"):
        with pytest.raises(InputError, match="cannot be read"):
            read_csv(path)
    with pytest.raises(InputError, match="cannot be written"):
        write_csv(tmp_path / "absent" / "b.csv", random_batch(1))


def test_clipped_volume_and_gap():
    """Half, quarter and eighth spheres; fails when ``clipped_volume`` drops a side."""
    r, whole = 10 * UM, 4 / 3 * math.pi * (10 * UM) ** 3
    centres = {(50, 50, 50): 1.0, (0, 50, 50): 0.5, (50, 100, 50): 0.5, (100, 0, 50): 0.25, (0, 0, 0): 0.125,
               (50, 50, 100): 0.5, (120, 50, 50): 0.0}
    for centre, share in centres.items():
        batch = Batch(*(np.array([value * UM]) for value in centre), np.array([r]))
        assert clipped_volume(batch, 100 * UM, 100 * UM, 100 * UM) == pytest.approx(share * whole, rel=1e-12, abs=1e-30)
    pair = Batch(np.array([0, 30 * UM]), np.zeros(2), np.array([0, 40 * UM]), np.array([r, 3 * r]))
    assert smallest_gap(pair) == pytest.approx(50 / 40)
    assert smallest_gap_ratio(*(np.zeros(1),) * 4) == math.inf


@pytest.mark.parametrize(("name", "gap", "dense_um", "dense_grid_um"), [
    ("spheres_info-01.csv", 1.0215, 34.338, 34.4), ("spheres_info-02.csv", 1.0201, 32.554, 32.7)])
def test_authors_batches(name, gap, dense_um, dense_grid_um):
    """Gap and dense height over 0.35 x 0.35 mm; references from counting 0.9 million points per sphere.

    The rounded heights belong to the 117 cells of 3 um, 0.351 mm. Fails when ``clipped_volume`` leaves out the clip
    by the side walls (35.5 and 34.1 um).
    """
    batch = read_csv(paper_file(name))
    assert batch.count == 500
    assert smallest_gap(batch) == pytest.approx(gap, abs=1e-4)
    area = (0.35 * MM) ** 2
    assert clipped_volume(batch, *LAYER) / area == pytest.approx(dense_um * UM, abs=0.003 * UM)
    on_grid = clipped_volume(batch, 0.351 * MM, 0.351 * MM, LAYER[2]) / area
    assert on_grid == pytest.approx(dense_grid_um * UM, abs=0.05 * UM)


# --- plan ------------------------------------------------------------------------------------------------------------

def test_generated_plan_is_the_same_for_the_same_seed_and_repeats_one_permutation():
    """Fails when ``order`` is reshuffled each round, or all batches share one seed."""
    plan, again, other = make_batches(scene()), make_batches(scene()), make_batches(scene(seed=8))
    assert [batch.count for batch in plan.batches] == [40, 40]
    for first, second in zip(plan.batches, again.batches):
        assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in "xyzr")
    assert not np.array_equal(plan.batches[0].x, other.batches[0].x)
    assert not np.array_equal(plan.batches[0].r, plan.batches[1].r)
    assert plan.order == again.order
    assert sorted(plan.order[:2]) == [0, 1]
    assert plan.order[2:] == (plan.order * 2)[2:5]
    assert any("Rosin-Rammler" in line for line in plan.messages)
    more = make_batches(scene(batch_count=3))
    assert np.array_equal(more.batches[0].x, plan.batches[0].x)  # a batch does not depend on how many follow


def test_order_without_shuffle_and_with():
    assert cycle_order(7, 3, False, generator(1)) == [0, 1, 2, 0, 1, 2, 0]
    shuffled = cycle_order(12, 6, True, generator(1))
    assert sorted(shuffled[:6]) == list(range(6))
    assert shuffled[:6] == shuffled[6:] != list(range(6))


def test_a_packing_says_how_much_of_its_box_is_full():
    """Spheres stick out of a narrow box. Fails when ``message`` counts what lies outside."""
    packed = pack(np.full(60, 30 * UM), (36 * UM, 36 * UM, 300 * UM), 1.02, generator(1), 2000)
    assert packed.placed < 60
    share = float(re.search(r"([\d.]+) % of the volume", packed.message()).group(1))
    inside = sum(clipped_volume(Batch(*([value] for value in sphere)), 36 * UM, 36 * UM, 300 * UM)
                 for sphere in zip(packed.x, packed.y, packed.z, packed.r))
    assert share == pytest.approx(100.0 * inside / (36 * UM * 36 * UM * 300 * UM), abs=0.1)
    assert share < 75.0


def test_packing_shortfall_is_told():
    plan = make_batches(scene(particles=400, attempts=50))
    short = [line for line in plan.messages if "of 400 spheres" in line]
    assert len(short) == 2
    assert f"placed {plan.batches[0].count} of 400" in short[0]
    assert "batch 1 of 2" in short[0]


def test_standard_scheme_stacks_the_layers_into_one_batch():
    """Fails when a layer is raised by its own height instead of index times height."""
    small = {"diameter_d10": 12 * UM, "diameter_d50": 18 * UM, "diameter_d90": 25 * UM, "diameter_max": 40 * UM}
    plan = make_batches(scene(scheme="standard", cycle_count=1, batch_count=4, particles=20, shuffle=False, **small))
    (batch,) = plan.batches
    assert plan.order == [0]
    assert batch.count == 80
    layer = (np.arange(80) // 20) * 0.05 * MM
    assert np.all(batch.z - batch.r >= layer - 1e-18)
    assert np.all(batch.z + batch.r <= layer + 0.05 * MM + 1e-18)
    assert smallest_gap(batch) > 1.0
    with pytest.raises(InputError, match=r"cycles\.count"):
        make_batches(scene(scheme="standard"))


def test_standard_scheme_repeats_files_in_the_recurring_order(tmp_path):
    """Two files over four layers deposit in the same sequence as four recurring cycles of them."""
    files = []
    for number in range(2):
        files.append(str(tmp_path / f"{number}.csv"))
        write_csv(files[-1], Batch(*(np.array([value * UM]) for value in (50 + number, 50, 20, 10 + number))))
    standard = make_batches(scene(scheme="standard", cycle_count=1, batch_count=4, files=files))
    recurring = make_batches(scene(cycle_count=4, files=files))
    expected = stack([recurring.batches[index] for index in recurring.order], 0.05 * MM)
    assert all(np.array_equal(getattr(standard.batches[0], name), getattr(expected, name)) for name in "xyzr")
    assert standard.batches[0].count == 4


def test_standard_scheme_sprays_every_file(tmp_path):
    """Three files and no ``batches.count``; fails when ``layers`` is that count alone: one file would be left."""
    files = [str(tmp_path / f"{number}.csv") for number in range(3)]
    for number, name in enumerate(files):
        write_csv(name, Batch(*(np.array([value * UM]) for value in (50 + number, 50, 20, 10))))
    (batch,) = make_batches(scene(scheme="standard", cycle_count=1, batch_count=0, files=files)).batches
    assert sorted(batch.x) == pytest.approx([50 * UM, 51 * UM, 52 * UM])
    assert batch.z == pytest.approx([20 * UM, 20 * UM + 0.2 * MM / 3, 20 * UM + 0.4 * MM / 3])


def test_explicit_spheres_are_one_batch():
    plan = make_batches(scene(spheres=[[75 * UM, 60 * UM, 20 * UM, 15 * UM], [0.0, 0.0, 20 * UM, 20 * UM]]))
    assert plan.order == [0] * 5
    assert len(plan.batches) == 1
    assert plan.messages == []
    assert plan.batches[0].x[0] == 75 * UM
    assert plan.batches[0].r[1] == 20 * UM
    two = [[75 * UM, 60 * UM, 20 * UM, 15 * UM], [75 * UM, 60 * UM, 40 * UM, 15 * UM]]
    overlapping = make_batches(scene(spheres=two))
    assert "overlap" in overlapping.messages[0]


@pytest.mark.parametrize(("sphere", "words"), [
    ((75, 60, 190, 15), "row 2: the sphere spans z"), ((75, 60, 10, 15), "row 2: the sphere spans z"),
    ((-16, 60, 50, 15), "row 2: the sphere at x"), ((75, 136, 50, 15), "row 2: the sphere at y")])
def test_spheres_outside_the_layer_are_refused_with_file_and_row(tmp_path, sphere, words):
    """Spheres 1 um inside these limits are accepted; fails when ``check_inside`` skips a side."""
    first = np.array([[75, 60, 100, 20]]) * UM
    write_csv(tmp_path / "b.csv", Batch(*np.vstack([first, np.array(sphere) * UM]).T))
    with pytest.raises(InputError) as error:
        make_batches(scene(files=[str(tmp_path / "b.csv")]))
    assert str(error.value).startswith(f"{tmp_path / 'b.csv'}: {words}")
    with pytest.raises(InputError, match=r"batches\.spheres: row 1"):
        make_batches(scene(spheres=[[value * UM for value in sphere]]))
    towards = np.sign(np.array([75, 60, 100, 20]) - sphere) * [2, 2, 6, 0]
    make_batches(scene(spheres=[list((np.array(sphere) + towards) * UM)]))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "micrometres"), (1e-3, "metres")])
def test_a_file_in_other_units_is_told(tmp_path, factor, unit):
    """Fails when ``_refuse_other_units`` takes the largest radius for the smallest, or is not called."""
    path = tmp_path / "b.csv"
    write_csv(path, Batch(*(np.array([v, 1.1 * v]) * factor * UM for v in (30.0, 30.0, 50.0, 10.0))))
    with pytest.raises(InputError, match=rf"b.csv: a radius of .* are its numbers {unit}\? millimetres"):
        make_batches(load_scene("section4", [f"batches.files=['{path}']"]))


def test_spheres_that_touch_an_end_of_the_layer_are_inside():
    """Whatever (height - r) + r rounds to; fails when ``LAYER_TOLERANCE`` is 0."""
    height = 0.2 * MM
    rows = [[75 * UM, 60 * UM, height - r, r] for r in np.linspace(5 * UM, 45 * UM, 200)]
    assert any(z + r > height for _, _, z, r in rows)
    assert make_batches(scene(spheres=rows)).batches[0].count == 200


def test_nothing_to_spray_is_refused():
    with pytest.raises(InputError, match="nothing to spray"):
        make_batches(scene(particles=0))
    with pytest.raises(InputError, match=r"batches\.spheres: row 1"):
        make_batches(scene(spheres=[[75 * UM, 60 * UM, 20 * UM, -UM]]))
    with pytest.raises(InputError, match="no particle of batch 1 fits"):
        make_batches(scene(particle_layer_height=5 * UM))


def test_the_wide_scene_holds_a_hundred_thousand_particles():
    """All of them find room, as many per area and cycle as in section4, and of the same powder."""
    wide, narrow = load_scene("wide-100k"), load_scene("section4")
    plan = make_batches(wide)
    assert [batch.count for batch in plan.batches] == [20480] * 5
    assert sorted(plan.order) == [0, 1, 2, 3, 4]
    assert sum(plan.batches[b].count for b in plan.order) == 102_400
    areas = [scene.domain.size[0] * scene.domain.size[1] for scene in (wide, narrow)]
    assert 20480 / areas[0] == pytest.approx(narrow.batches.particles / areas[1], rel=0.001)
    mean = [np.concatenate([batch.r for batch in made.batches]).mean() for made in (plan, make_batches(narrow))]
    assert mean[0] == pytest.approx(mean[1], rel=0.02)
