"""Scenes: every error names file, key and remedy; what is dumped loads back equal."""

import math
import pickle
import tomllib

import pytest

from f2s_hpc.config import describe, dump_scene, load_scene, parse_scene, scene_hash, scene_names, scene_text
from f2s_hpc.config.describe import checkpoint_bytes, frame_bytes, frame_count, particle_count
from f2s_hpc.config.material import Material
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

TEXT = scene_text("quickstart")


@pytest.fixture
def scene_file(tmp_path):
    """Return a function that writes the quickstart scene with one line replaced and returns its path."""
    def write(old="", new=""):
        assert old in TEXT
        path = tmp_path / "case.toml"
        path.write_text(TEXT.replace(old, new, 1) if old else TEXT + new, encoding="utf-8")
        return str(path)
    return write


def message(name, *overrides):
    with pytest.raises(InputError) as caught:
        load_scene(name, overrides)
    text = str(caught.value)
    assert "\n" not in text
    assert caught.value.exit_code == 2
    return text


def material(name):
    return Material.model_validate({"name": name, **library.entry(name)})


# Built-in scenes and library


@pytest.mark.parametrize("name", ["quickstart", "section4", "section4-standard", "splat", "splat-quarter",
                                  "wide-100k"])
def test_built_in_scenes_load_and_start_with_comments(name):
    assert name in scene_names()
    assert scene_text(name).startswith("# ")
    assert "# Worth changing:" in scene_text(name)
    scene = load_scene(name)
    assert scene.material.name == "copper-ge"
    assert scene.particles.speed == 615.0
    assert scene.particles.temperature == 723.15
    assert scene.substrate.temperature == 298.15


def test_section4_is_the_papers():
    scene = load_scene("section4")
    assert scene.domain.cells == (117, 117, 200)
    assert math.prod(scene.domain.cells) == 2_737_800
    assert scene.domain.extents[0] == 117 * 3e-6
    assert scene.domain.layer_bottom == 200 * 3e-6 - 0.203e-3
    assert (scene.batches.count, scene.batches.particles, scene.cycles.count) == (5, 500, 10)
    assert scene.cycles.durations == (0.325e-6,) * 9 + (0.6e-6,)
    assert scene.cycles.total_time == pytest.approx(3.525e-6, rel=1e-14)
    assert scene.particles.velocity == (0.0, 0.0, -615.0)
    standard = load_scene("section4-standard")
    assert standard.scheme == "standard"
    assert standard.domain.cells[2] == 688
    assert standard.cycles.durations == (3.25e-6,)
    assert particle_count(standard) == particle_count(scene) == 5000


@pytest.mark.parametrize("name", library.names())
def test_every_metal_of_the_library_melts(name):
    """Fails when an entry loses its melting temperature: any start would then be taken up to ``HOTTEST``."""
    scene = load_scene("splat", [f"material.name={name}"])
    assert 900.0 < scene.melting_temperature < 3500.0
    with pytest.raises(InputError, match="below the melting temperature"):
        load_scene("splat", [f"material.name={name}", f"particles.temperature={scene.melting_temperature} K"])


@pytest.mark.parametrize("name", library.names())
def test_library_entries_are_complete_and_sourced(name):
    entry = material(name)
    assert 2000 < entry.density < 20000
    assert 3000 < entry.longitudinal_sound_speed < 8000
    assert len(library.source(name)) > 20


def test_library_copper_matches_the_published_wave_speeds():
    """Fails if a library constant or a modulus formula changes, for example 4/3 to 3/4 in the wave speed."""
    ge, taylor = material("copper-ge"), material("copper-taylor")
    assert ge.bulk_modulus == pytest.approx(133.333e9, rel=1e-5)
    assert ge.shear_modulus == pytest.approx(47.761e9, rel=1e-5)
    assert ge.longitudinal_sound_speed == pytest.approx(4689.17, abs=0.01)
    assert taylor.longitudinal_sound_speed == pytest.approx(4585.60, abs=0.01)
    assert material("copper-johnson-cook").longitudinal_sound_speed == pytest.approx(4615.32, abs=0.01)
    flow = ge.flow_stress
    assert (flow.sigma_y0, flow.hardening_A, flow.alpha, flow.beta) == (39e6, 320e6, 7.5e6, 1e4)
    assert (flow.rate_s, flow.rate_u, flow.high_rate_B, flow.hardening_n) == (1e-3, 1e4, 110e6, 0.41)
    assert (flow.room_temperature, flow.reference_temperature, flow.eta) == (298.15, 623.15, 0.0043)


def test_piston_copper_has_the_moduli_of_the_problem():
    """Fails if nu in the library is rounded to fewer digits."""
    piston = material("copper-piston")
    assert piston.shear_modulus == pytest.approx(45e9, rel=1e-15)
    assert piston.bulk_modulus == 8930.0 * 3940.0**2
    assert piston.young_modulus / (3 * (1 - 2 * piston.poisson_ratio)) == pytest.approx(piston.bulk_modulus, rel=1e-9)
    assert (piston.flow_stress.yield_stress, piston.flow_stress.hardening_modulus) == (90e6, 0.0)


# Round trip


OVERRIDES = {
    "quickstart": ["run.wall_time=90 min", "output.frame_interval=7.123456789 ns", "particles.direction=[1, 1, -2]"],
    "splat": ["material.name=copper-piston", 'title="quotes \\" and µ \\\\ \\t"', "domain.faces.x_low=outflow"],
    "section4": ["material.name=steel-316l", "material.conductivity=1.23456789012345678 W/m/K", "batches.seed=77",
                 "particles.temperature=0.1 K", "numerics.dust=1e-9"],
    "splat-quarter": ["material.flow_stress.model=elastic", "output.checkpoints=false"],
    "section4-standard": ["material.name=copper-taylor", "domain.cell_size=7.3 um"],
}


@pytest.mark.parametrize("name", OVERRIDES)
def test_dumped_scene_loads_back_equal(name, tmp_path):
    """Fails if ``dump_scene`` drops a key or rounds a number, for example ``units.pretty`` for ``units.show``."""
    for overrides in ([], OVERRIDES[name]):
        scene = load_scene(name, overrides)
        text = dump_scene(scene)
        path = tmp_path / "dumped.toml"
        path.write_text(text, encoding="utf-8")
        again = load_scene(str(path))
        assert again == scene
        assert dump_scene(again) == text
        assert parse_scene(text, "checkpoint") == scene
        assert scene_hash(again) == scene_hash(scene)
        assert len(scene_hash(scene)) == 64
        assert pickle.loads(pickle.dumps(scene)) == scene


@pytest.mark.parametrize(("name", "overrides", "steps"), [
    ("section4", [], 8), ("section4", ["domain.cell_size=5.5 um"], 8), ("section4", ["domain.cell_size=6 um"], 1),
    ("section4", ["domain.cell_size=6 um", "numerics.steps_per_remap=4"], 4), ("quickstart", [], 1),
    ("quickstart", ["domain.cell_size=5 um"], 8), ("splat", [], 8), ("splat", ["domain.cell_size=6 um"], 1)])
def test_fewer_remaps_only_where_the_cells_are_fine(name, overrides, steps):
    """Breaks if the rule looks at anything but the median particle, or if a number that is given does not win."""
    assert load_scene(name, overrides).numerics.steps_per_remap == steps


def test_hash_tells_scenes_apart():
    assert scene_hash(load_scene("splat")) != scene_hash(load_scene("splat", ["batches.seed=2"]))


def test_scene_cannot_be_changed():
    with pytest.raises(Exception, match="frozen"):
        load_scene("splat").domain.cell_size = 1.0


def test_dump_names_every_key_with_units():
    tables = tomllib.loads(dump_scene(load_scene("splat")))
    assert tables["domain"]["cell_size"] == "3 um"
    assert tables["particles"]["temperature"] == "450 degC"
    assert tables["batches"]["spheres"] == [["48 um", "48 um", "16.5 um", "15 um"]]
    assert tables["domain"]["faces"]["z_high"] == "fixed"
    assert tables["material"]["spall_pressure"] == "2 GPa"


# Overrides


def test_overrides_as_toml_or_plain_text():
    quoted = load_scene("section4", ['domain.cell_size="6 um"'])
    plain = load_scene("section4", ["domain.cell_size=6 um"])
    assert quoted == plain
    assert plain.domain.cells == (58, 58, 100)
    scene = load_scene("splat", ["output.picture = false", "numerics.remap_order=1",
                                 'output.fields=["peeq","pressure"]'])
    assert not scene.output.picture
    assert scene.numerics.remap_order == 1
    assert scene.output.fields == ("peeq", "pressure")


def test_material_keys_come_over_the_library():
    scene = load_scene("splat", ["material.flow_stress.hardening_A=300 MPa", "material.taylor_quinney=0.9"])
    assert scene.material.flow_stress.hardening_A == 300e6
    assert scene.material.flow_stress.sigma_y0 == 39e6
    assert scene.material.taylor_quinney == 0.9
    assert scene.material.density == 8960.0
    elastic = load_scene("splat", ["material.flow_stress.model=elastic"])
    assert elastic.material.flow_stress.model == "elastic"
    assert not hasattr(elastic.material.flow_stress, "sigma_y0")


def test_custom_material_takes_all_its_keys_from_the_scene(scene_file):
    assert "material.density is missing" in message(scene_file('name = "copper-ge"', 'name = "custom"'))
    keys = ['name = "custom"', 'density = "10490 kg/m3"', 'young_modulus = "83 GPa"', "poisson_ratio = 0.37",
            'specific_heat = "235 J/kg/K"', 'conductivity = "429 W/m/K"', "taylor_quinney = 0.9",
            'flow_stress = { model = "linear_hardening", yield_stress = "60 MPa", hardening_modulus = "50 MPa" }']
    scene = load_scene(scene_file('name = "copper-ge"', "\n".join(keys)))
    assert scene.material.density == 10490.0
    assert scene.material.pressure.model == "linear"


@pytest.mark.parametrize(("override", "words"), [
    ("domain.cel_size=6 um", ["--set domain.cel_size:", 'did you mean "domain.cell_size"']),
    ("doman.cell_size=6 um", ["--set doman.cell_size:", 'unknown key "doman"', 'did you mean "domain"']),
    ("cell_size=6 um", ["--set cell_size:", 'did you mean "domain.cell_size"']),
    ("domain.cell_size=6", ["--set domain.cell_size:", "needs a unit", '"6 um"']),
    ("domain.cell_size=6 s", ["--set domain.cell_size:", '"6 s"', "this is a time, but a length is needed"]),
    ("domain.cell_size", ["--set domain.cell_size: expected key=value"]),
    ("=6 um", ["expected key=value"]), ("domain..cell_size=1", ["expected key=value"]),
    ("title.x=1", ["--set title.x:", '"title" is a value, not a section']),
    ("batches.count=0", ["--set batches.count:", "has no particles"]),
    ("material.name=coper-ge", ["--set material.name:", 'did you mean "copper-ge"']),
    ("material.name=gold", ["no such material", "copper-ge", "tantalum"]),
    ("output.fields=[peeq]", ["--set output.fields:", "must be a list in brackets, each text in it in quotes"]),
    ("output.fields=peeq", ["must be a list in brackets"]),
    ("material.flow_stress.A=90 MPa", ['"material.flow_stress.A"; another model has it; possible here: model']),
    ("material.flow_stress.hardening_a=1 MPa", ['did you mean "material.flow_stress.hardening_A"']),
])
def test_wrong_override_names_its_key(override, words):
    """Fails when ``_explain`` offers the very key that it refuses, for one of another flow stress model, or does not
    look at what begins with a bracket.
    """
    text = message("quickstart", override)
    for word in words:
        assert word in text


# Errors in files


@pytest.mark.parametrize(("old", "new", "words"), [
    ('cell_size = "6 um"', 'cel_size = "6 um"', ['unknown key "domain.cel_size"', 'did you mean "domain.cell_size"?']),
    ('cell_size = "6 um"', "cell_size = 6", ["domain.cell_size = 6", "a length needs a unit", '"3 um"', '"6 um"']),
    ('cell_size = "6 um"', 'cell_size = "3 s"', ['domain.cell_size = "3 s"', "a time", "a length is needed", '"3 um"']),
    ('cell_size = "6 um"', 'cell_size = "-3 um"', ['domain.cell_size = "-3 um"', "must be above 0"]),
    ('cell_size = "6 um"', 'cell_size = "1 mm"', ["domain.cell_size is larger than the box", "120 um"]),
    ('cell_size = "6 um"', 'cell_size = "6 nm"', ["domain.cell_size gives", "nodes", "is its unit right"]),
    ('cell_size = "6 um"', "cell_size = 6 um", ["not valid TOML", "line 16", "need quotes"]),
    ('cell_size = "6 um"', "", ["domain.cell_size is missing", 'cell_size = "3 um"']),
    ('size = ["0.12 mm", "0.12 mm", "0.3 mm"]', 'size = ["1 mm", "1 mm"]', ["domain.size[2] is missing"]),
    ('size = ["0.12 mm", "0.12 mm", "0.3 mm"]', 'size = ["1 mm", "1 s", "1 mm"]', ['domain.size[1] = "1 s"']),
    ('size = ["0.12 mm", "0.12 mm", "0.3 mm"]', 'size = ["1 m","1 m","1 m","1 m"]', ["domain.size", "4 values, 3"]),
    ('size = ["0.12 mm", "0.12 mm", "0.3 mm"]', 'size = "1 mm"', ['domain.size = "1 mm"', "a list in brackets"]),
    ('"0.048 mm"', '"0.3 mm"', ["domain.substrate_height must be lower than the box", "300 um"]),
    ('"0.102 mm"', '"0.26 mm"', ["domain.particle_layer_height does not fit", "252 um"]),
    ('"0.102 mm"', '"0.04 mm"', ["domain.particle_layer_height leaves 40 um", "batches.diameter_max (45 um)"]),
    ('temperature = "450 degC"', 'temperature = "-300 degC"', ["particles.temperature", "must be at least 0"]),
    ('speed = "615 m/s"', 'velocity = "1 m/s"', ['unknown key "particles.velocity"', "particles.speed is missing)"]),
    ('speed = "615 m/s"', "", ["particles.speed is missing", 'speed = "615 m/s"']),
    ('scheme = "recurring"', 'scheme = "recuring"', ['scheme = "recuring"', "'recurring' or 'standard'"]),
    ('scheme = "recurring"', 'scheme = "standard"', ["cycles.count must be 1"]),
    ("count = 3", "count = -3", ["batches.count = -3", "at least 0"]),
    ("count = 3", "count = 3.5", ["batches.count = 3.5", "a whole number"]),
    ("count = 3", 'count = "3"', ['batches.count = "3"', "a whole number"]),
    ("count = 3", "count = 0", ["batches has no particles"]),
    ("count = 3", 'spheres = [["1 um", "1 um", "20 um", "5 um"]]\ncount = 3',
     ["batches has spheres as well as count and particles", "exactly one source"]),
    ('diameter_d50 = "27 um"', 'diameter_d50 = "16 um"', ["batches.diameter_d50 must be above diameter_d10 (17 um)"]),
    ("count = 4", "count = 0", ["cycles.count = 0", "at least 1"]),
    ('last_duration = "0.5 us"', 'last_duration = "0 us"', ["cycles.last_duration", "must be above 0"]),
    ("[domain]", "[domain.faces]\nx_low = 'symetry'\n[domain]", ['domain.faces.x_low = "symetry"', "'symmetry'"]),
])
def test_wrong_file_names_key_and_remedy(scene_file, old, new, words):
    path = scene_file(old, new)
    text = message(path)
    assert text.startswith(path + ": ")
    for word in words:
        assert word in text


@pytest.mark.parametrize(("section", "words"), [
    ("[numerics]\ncourant = 1.5", ["numerics.courant = 1.5", "must be below 1"]),
    ("[numerics]\ncourant = '0.5'", ["numerics.courant", "a plain number"]),
    ("[numerics]\ncourant = nan", ["numerics.courant", "must be"]),
    ("[numerics]\nremap_order = 3", ["numerics.remap_order = 3", "must be 1 or 2"]),
    ("[numerics]\nconduction = 1", ["numerics.conduction = 1", "true or false"]),
    ("[output]\nfields = ['volume_fraction', 'plastic']", ['no field "plastic"', "peeq", "von_mises"]),
    ("[output]\nfields = ['peeq', 'peeq']", ["output.fields", "named twice"]),
    ("[output]\nfields = []", ["output.fields", "at least one value"]),
    ("[output]\nfields = ['internal_energy']", ["output.fields internal_energy", "mie_grueneisen"]),
    ("[output]\nfields = ['particle_fraction']", ["output.fields particle_fraction", "output.origin"]),
    ("[output]\nprogress_seconds = 5", ["output.progress_seconds = 5", "a time needs a unit"]),
    ("[output]\nkeep_checkpoints = 0", ["output.keep_checkpoints = 0", "at least 1"]),
    ("[run]\nwall_time = '2 hours'", ["run.wall_time", 'unknown unit "hours"']),
    ("[run]\nwalltime = '2 h'", ['did you mean "run.wall_time"']),
    ("[numerics]\nxyz = 1", ['unknown key "numerics.xyz"', "possible here: courant"]),
])
def test_wrong_section_names_key_and_remedy(scene_file, section, words):
    text = message(scene_file("", "\n" + section + "\n"))
    for word in words:
        assert word in text


@pytest.mark.parametrize(("overrides", "words"), [
    (["material.flow_stress.model=gee"], ['material.flow_stress.model = "gee"', "'ge'"]),
    (["material.flow_stress.rate_u=1e-4 1/s"], ["material.flow_stress.rate_u must be above rate_s"]),
    (["material.flow_stress={model='johnson_cook'}"], ["material.flow_stress.A is missing", "(and 7 more)"]),
    (["material.poisson_ratio=0.5"], ["material.poisson_ratio = 0.5", "must be below 0.5"]),
    (["material.taylor_quinney=1.1"], ["material.taylor_quinney = 1.1", "at most 1"]),
    (["material.density=8960 kg"], ["material.density", "this is a mass", "a density is needed"]),
    (["material.name=copper-johnson-cook", "particles.temperature=1100 degC"],
     ["--set particles.temperature:", "below the melting temperature", "1083 degC"]),
    (["material.name=copper-johnson-cook", "material.flow_stress.melting_temperature=290 K"],
     ["melting_temperature must be above reference_temperature"]),
    (["material.flow_stress={model='elastic'}", "substrate.temperature=4001 K"],
     ["--set substrate.temperature:", "must be at most 3727 degC", "no metal is solid"]),
    (["particles.direction=[0, 0, 0]"], ["particles.direction", "zero vector"]),
    (["particles.direction=[0, 0]"], ["particles.direction[2] is missing"]),
    (["batches.spheres=[['48 um', '48 um', '10 um', '15 um']]"], ["batches.spheres[0] spans -5 um to 25 um"]),
    (["batches.spheres=[['48 um', '48 um', '30 um', '15 um']]"], ["batches.spheres[0] spans", "ends at 42 um"]),
    (["batches.spheres=[['97 um', '48 um', '20 um', '15 um']]"], ["batches.spheres[0]", "outside the box"]),
    (["batches.spheres=[['40 um','48 um','20 um','9 um'],['50 um','48 um','20 um','9 um']]"],
     ["batches.spheres[1] overlaps batches.spheres[0]"]),
    (["batches.spheres=[[1, 2, 3, 4]]"], ["batches.spheres[0][0] = 1", "a length needs a unit"]),
])
def test_impossible_values_are_refused(overrides, words):
    text = message("splat", *overrides)
    for word in words:
        assert word in text


def test_several_problems_are_counted_and_a_typo_comes_first(scene_file):
    path = scene_file('cell_size = "6 um"', 'cel_size = "6 um"')
    assert message(path, "particles.speed=3").startswith(f'{path}: unknown key "domain.cel_size"')
    assert message(path, "particles.speed=3").endswith("(and 1 more)")
    assert "more)" not in message(path)


def test_files_that_are_no_scenes(tmp_path, monkeypatch):
    """Fails if ``_read`` does not look for the file beside, whose ending was forgotten."""
    assert 'did you mean "section4"' in message("sektion4")
    assert "possible: multitrack, quickstart, section4" in message("xyz")
    (tmp_path / "mine.toml").write_text("")
    assert message(str(tmp_path / "mine")) == f"{tmp_path / 'mine'}: no such file"
    monkeypatch.chdir(tmp_path)
    assert 'did you mean "mine.toml"?' in message("mine")
    assert "no such file" in message(str(tmp_path / "missing.toml"))
    assert "not a file" in message(str(tmp_path))
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00title")
    assert "not a text file" in message(str(tmp_path / "binary.toml"))
    (tmp_path / "empty.toml").write_text("")
    assert "title is missing" in message(str(tmp_path / "empty.toml"))
    with pytest.raises(InputError, match='did you mean "splat"'):
        scene_text("splatt")
    with pytest.raises(InputError, match="checkpoint: not valid TOML"):
        parse_scene("= 3", "checkpoint")


# CSV files


def test_csv_paths_are_resolved_where_they_were_written(tmp_path, monkeypatch):
    """Fails if the base folder is always the current directory."""
    for folder in ("scenes", "here"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.csv").write_text("x,y,z,r\n")
    monkeypatch.chdir(tmp_path / "here")
    path = tmp_path / "scenes" / "case.toml"
    path.write_text(TEXT.replace("count = 3\nparticles = 36", 'files = ["a.csv", "../here/a.csv"]'))
    scene = load_scene(str(path))
    assert scene.batches.files == (str(tmp_path / "scenes" / "a.csv"), str(tmp_path / "here" / "a.csv"))
    assert scene.batches.source == "files"
    assert scene.batches.number == 2
    assert load_scene(str(path), ['batches.files=["a.csv"]']).batches.files == (str(tmp_path / "here" / "a.csv"),)
    built_in = load_scene("section4", ['batches.files=["a.csv", "a.csv"]', "domain.cell_size=6 um"])
    assert built_in.batches.files == (str(tmp_path / "here" / "a.csv"),) * 2
    assert (built_in.batches.count, built_in.batches.particles) == (0, 0)
    assert particle_count(built_in) is None
    assert load_scene("section4", ["batches.files=a.csv"]).batches.number == 1
    assert parse_scene(dump_scene(built_in), "dump") == built_in


def test_missing_csv_names_key_and_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = message("section4", 'batches.files=["b.csv"]')
    assert text == f'--set batches.files: batches.files: no file "b.csv" (looked for {tmp_path / "b.csv"})'
    (tmp_path / "case.toml").write_text(TEXT.replace("count = 3", 'files = ["b.csv"]'))
    assert message("case.toml").startswith("case.toml: batches.files: no file")
    assert "must be" in message("section4", "batches.files=[1]")


def test_listed_spheres_replace_generated_ones_from_the_command_line():
    scene = load_scene("quickstart", ["batches.spheres=[['10 um','10 um','30 um','10 um']]"])
    assert scene.batches.source == "spheres"
    assert scene.batches.count == 0
    both = message("quickstart", "batches.spheres=[['10 um','10 um','30 um','10 um']]", "batches.count=2",
                   "batches.particles=5")
    assert "exactly one source" in both


# Description


def test_description_states_size_time_and_output():
    scene = load_scene("section4", ["domain.cell_size=6 um", "run.wall_time=2 h"])
    text = describe(scene, 2, [(29, 58, 100), (29, 58, 100)], painted_volume=40e-12, particles=5000)
    assert text.startswith(dump_scene(scene))
    assert 'wall_time = "2 h"' in text
    for words in ("58 x 58 x 100 = 336,400", "29 x 58 x 100",
                  "10 cycles", "0.597 ns", "5,904", "10 of 6.4 MiB", "36.4 MiB each", "5,000 particles",
                  "painted volume 0.04 mm3", "330.3 um of dense height", scene_hash(scene)[:16]):
        assert words in text, words
    assert parse_scene(text, "check") == scene


def test_output_sizes():
    scene = load_scene("splat")
    assert frame_bytes(scene) == 4 * 32 * 32 * 28 * 5
    assert checkpoint_bytes(scene) == 8 * (10 * 32 * 32 * 28 + 4 * 33 * 33 * 29)
    cold = load_scene("splat", ["numerics.loss_heating=false"])
    assert checkpoint_bytes(cold) == 8 * (10 * 32 * 32 * 28 + 3 * 33 * 33 * 29)
    assert frame_count(scene) == 8  # each 10 ns, and the last is that of the cycle
    assert frame_count(load_scene("splat", ["output.frame_interval=30 ns"])) == 1 + 2
    assert particle_count(scene) == 1
    assert frame_count(load_scene("splat", ["output.frames=none", "output.frame_interval=30 ns"])) == 2
    assert checkpoint_bytes(load_scene("splat", ["material.name=copper-piston"])) - checkpoint_bytes(scene) == 8 * 28672
