"""Settings that would have no effect, or that undo each other, are refused; so is a box too low in whole cells.

Defaults that hang on the resolution leave alone what a scene says.
"""

from __future__ import annotations

import json
import pathlib

import pytest

from f2s_hpc.cli.main import main
from f2s_hpc.config import dump_scene, load_scene, parse_scene, scene_names, scene_text
from f2s_hpc.errors import InputError

SPHERE = '[["48 um", "48 um", "20 um", "12 um"]]'
GENERATED = "count = 3\nparticles = 36"


@pytest.fixture
def workplace(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """Make a folder with a batch file the current one."""
    (tmp_path / "a.csv").write_text("x,y,z,r\n0.04,0.04,0.04,0.01\n", encoding="ascii")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def message(name: str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(name, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- settings without a use -----------------------------------------------------------------------------


@pytest.mark.parametrize(("keys", "words"), [
    ('files = ["a.csv"]\ncount = 3', "batches.count = 3 has no effect where batches.files are given; leave it out"),
    ('files = ["a.csv"]\nparticles = 36', "batches.particles = 36 has no effect where batches.files are given"),
    (f"spheres = {SPHERE}\ncount = 2", "batches.count = 2 has no effect where batches.spheres are given"),
    (f"spheres = {SPHERE}\nparticles = 2", "batches.particles = 2 has no effect where batches.spheres are given"),
    ('files = ["a.csv"]\ndistribution = "sech"\njet_width = "1 mm"',
     'batches.distribution = "sech" has no effect where batches.files are given; leave it and jet_width out'),
    (f'spheres = {SPHERE}\ndistribution = "sech"\njet_width = "1 mm"', "where batches.spheres are given"),
    (f'{GENERATED}\njet_width = "1 mm"', "batches.jet_width has no effect on a uniform distribution; leave it out"),
])
def test_a_setting_without_a_use_is_refused(workplace, keys, words):
    """Fails if the key is read and nothing is made of it."""
    (workplace / "case.toml").write_text(scene_text("quickstart").replace(GENERATED, keys), encoding="utf-8")
    text = message("case.toml")
    assert text.startswith("case.toml: batches.")
    assert words in text


def test_a_setting_without_a_use_from_the_command_line_is_named(workplace):
    """Fails if the scene is blamed for what the command line asks."""
    text = message("section4", "batches.files=a.csv", "batches.count=2")
    assert text.startswith("--set batches.count: batches.count = 2 has no effect")
    assert message("section4", "batches.jet_width=1 mm").startswith("--set batches.jet_width: ")


def test_what_the_command_line_replaces_is_no_setting_without_a_use(workplace):
    """Files for a jet's scene, and an even distribution for it; fails if the scene's own sech is then refused."""
    scene = load_scene("track-120", ["batches.files=a.csv"])
    assert (scene.batches.distribution, scene.batches.jet_width) == ("uniform", None)
    scene = load_scene("track-120", ["batches.distribution=uniform"])
    assert (scene.batches.count, scene.batches.jet_width) == (4, None)


def test_standard_scenes_may_count_the_layers_of_their_files(workplace):
    """In the standard scheme count is the number of layers that the files fill; fails if it is refused there."""
    layers = 'files = ["a.csv"]\ncount = 10'
    (workplace / "case.toml").write_text(scene_text("section4-standard").replace("count = 10\nparticles = 500", layers),
                                         encoding="utf-8")
    assert load_scene("case.toml").batches.count == 10


def test_a_measured_stream_goes_with_files(workplace):
    """Its speed law holds for files too, its width does not; fails if the width it brings is then refused."""
    assert main(["stream", "synthetic", "--json", "fits.json"]) == 0
    width = json.loads((workplace / "fits.json").read_text())["number_over_lateral_position"]["width_m"]["value"]
    scene = load_scene("section4", ["particles.stream=fits.json", "batches.files=a.csv"])
    assert scene.particles.speed_curvature != 0.0
    assert (scene.batches.distribution, scene.batches.jet_width) == ("uniform", None)
    scene = load_scene("section4", ["particles.stream=fits.json", "batches.distribution=uniform"])
    assert scene.batches.jet_width is None
    assert load_scene("section4", ["particles.stream=fits.json"]).batches.jet_width == pytest.approx(width, rel=1e-12)


def test_scenes_of_older_checkpoints_are_still_read(workplace):
    """Fails if a run that was started before the check can neither be resumed nor measured."""
    text = dump_scene(load_scene("section4", ["batches.files=a.csv"]))
    text = text.replace('"uniform"', '"sech"\njet_width = "1 mm"')
    assert parse_scene(text, "old.h5").batches.distribution == "sech"


@pytest.mark.parametrize("second", ["batches={count=1}", "batches={count=1, particles=5}"])
def test_overrides_that_undo_each_other_are_refused(workplace, second):
    """Fails with a ``KeyError``, or loses the first of them without a word."""
    text = message("quickstart", 'batches.files=["a.csv"]', second)
    assert text == "--set batches: replaces the whole section, and --set batches.files with it; put it first"
    assert load_scene("quickstart", ["batches={count=1}", "batches.particles=5"]).batches.particles == 5


# --- the box in whole cells -----------------------------------------------------------------------------


def test_a_box_too_low_in_whole_cells_is_refused(workplace):
    """Fails if ``domain.size`` is checked, not what becomes of it: the layer then begins inside the substrate."""
    heights = {'"0.3 mm"]': '"0.1526 mm"]', '"0.048 mm"': '"0.0505 mm"'}
    text = scene_text("quickstart")
    for old, new in heights.items():
        assert old in text
        text = text.replace(old, new)
    (workplace / "case.toml").write_text(text, encoding="utf-8")
    said = message("case.toml")
    assert said == ("case.toml: domain.particle_layer_height does not fit: the box is 150 um high in whole cells, less "
                    "than substrate and layer together (152.5 um); domain.size[2] of 156 um makes room")
    domain = load_scene("case.toml", ['domain.size=["0.12 mm", "0.12 mm", "156 um"]']).domain
    assert domain.layer_bottom > domain.substrate_height
    assert message("splat", "domain.cell_size=8 um").startswith("--set domain.cell_size: domain.particle_layer_height")


@pytest.mark.parametrize("name", scene_names())
def test_the_layer_of_built_in_scenes_is_above_the_substrate(name):
    """Fails if a built-in scene leaves its layer no room in whole cells."""
    domain = load_scene(name).domain
    assert domain.layer_bottom >= domain.substrate_height * (1.0 - 1e-9)


@pytest.mark.parametrize(("cell", "overrides", "limits"), [
    (6.0, [], (1.2, 2.0)), (2.6, [], (1.2, 2.0)), (2.5, [], (3.0, 4.0)),
    (2.5, ["numerics.speed_limit_factor=1.5"], (1.5, 4.0)), (6.0, ["numerics.speed_cap_factor=5"], (1.2, 5.0))])
def test_jets_of_resolved_particles_are_not_braked(cell, overrides, limits):
    """Median particle of 30 um; fails if ``RESOLVED`` counts cells per radius, or a default replaces what is asked."""
    numerics = load_scene("section4", [f"domain.cell_size={cell} um", *overrides]).numerics
    assert (numerics.speed_limit_factor, numerics.speed_cap_factor) == limits
