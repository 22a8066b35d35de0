"""What a newcomer can ask for: all keys of a scene, and the materials (``f2s scenes --keys``, ``f2s materials``)."""

from __future__ import annotations

import re
import tomllib

import pytest

from f2s_hpc import mpi
from f2s_hpc.cli.main import main
from f2s_hpc.config import load_scene, scene_hash, scene_text
from f2s_hpc.config.messages import all_keys
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

KEY_LINE = re.compile(r"([a-z][\w.]*)(?: = (.*)|  \((?:must be given|may be left out).*\))")
SECTIONS = ("domain", "domain.faces", "material", "material.flow_stress", "material.pressure", "substrate", "particles",
            "batches", "cycles", "numerics", "output", "output.view", "run")


def printed(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    assert main(list(arguments)) == 0
    out, err = capsys.readouterr()
    assert not err
    return out


def keys_of(text: str) -> list[tuple[str, str | None]]:
    """Return the keys that a reference tells of, each with its default."""
    return [match.groups() for match in map(KEY_LINE.fullmatch, text.splitlines()) if match]


def one(text: str) -> str:
    """Return a text without its line breaks."""
    return " ".join(text.split())


# --- keys ----------------------------------------------------------------------------------------------


def test_every_key_is_told_and_no_other(capsys):
    """Fails if a section, a model or the key that is no part of the schema is passed over, or a meaning asks for SI."""
    text = printed(capsys, "scenes", "--keys")
    assert not re.search(r", (m|s|m/s|K|1/K|1/s|Pa)([;,]|$)", text, re.MULTILINE), "any unit of the kind may be written"
    told = keys_of(text)
    taken = {"particles.stream", "particles.stream_laws"}
    assert sorted({key for key, _ in told}) == sorted({*all_keys(), *taken} - set(SECTIONS))
    flow = [key.rpartition(".")[2] for key, _ in told if key.startswith("material.flow_stress.")]
    assert flow.count("melting_temperature") == 3, "one of each model that has it"
    assert flow.count("model") == 1


def test_defaults_are_those_of_a_scene(capsys):
    """A scene that writes all of them is the same scene; fails if a default is rounded, or lacks its unit or quotes."""
    defaults = [f"{key}={value}" for key, value in keys_of(printed(capsys, "scenes", "--keys")) if value]
    assert len(defaults) >= 60
    given = [text for text in defaults if not text.startswith("batches.spheres")]
    assert scene_hash(load_scene("splat", given)) == scene_hash(load_scene("splat"))


@pytest.mark.parametrize(("key", "words"), [
    ("domain.cell_size", ["domain.cell_size (must be given)", "edge length of the cubic cells a length above 0, as in",
                          '"3 um"']),
    ("domain.size", ["edge lengths (x, y, z) of the box; rounded", "3 values in brackets, each a length above 0"]),
    ("z_low", ['domain.faces.z_low = "fixed"', '"symmetry", "fixed", "free", "outflow" or "absorbing"']),
    ("density", ["(must be given, unless the library does)",
                 'a density of at least 100 kg/m3 and at most 30000 kg/m3, as in "8960 kg/m3" (copper-ge)']),
    ("courant", ["numerics.courant = 0.7", "a number above 0 and below 1"]),
    ("seed", ["batches.seed = 1", "a whole number of at least 0 and below 9,223,372,036,854,775,808"]),
    ("spheres", ["4 values in brackets: a length, a length, a length, a length above 0"]),
    ("particles.temperature", ['a temperature of at least 0 K, as in "450 degC"']),
    ("wall_time", ["run.wall_time (may be left out)", 'a time above 0, as in "90 min"']),
    ("dwell", ["next batch, in which nothing moves", 'a time above 0, as in "10 ms"']),
    ("backing", ["below the box, through which", 'a length of at least 0, as in "3 mm"']),
    ("output.view.x", ["where along x; one length"]),
    ("conduction", ["numerics.conduction = true", "true or false"]),
    ("eta", ["an inverse temperature above 0"]),
    ("m", ["a number above 0, as in 1.09 (copper-johnson-cook)"]),
    ("material.name", list(library.names())),
    ("output.fields", ["one or more values in brackets", "volume_fraction", "von_mises"]),
    ("remap_order", ["2: of what cells hold at third order", "node velocities at fifth order", "1: of both at first"]),
    ("stream", ["particles.stream (may be left out)", "f2s stream --json"]),
    ("output.view.y", ["from where to where along y; one length without brackets: the layer of cells there"]),
])
def test_a_key_has_meaning_values_and_default(capsys, key, words):
    """Fails if a bound, a unit, a choice or an example of the schema is lost."""
    text = one(printed(capsys, "scenes", "--keys", key))
    for word in words:
        assert word in text


@pytest.mark.parametrize(("name", "first", "keys"), [
    ("cycles", "[cycles]", ["cycles.count", "cycles.duration", "cycles.last_duration", "cycles.dwell"]),
    ("output.view", "[output.view]", [f"output.view.{key}" for key in ("x", "y", "z", "interval")]),
    ("faces", "[domain.faces]", [f"domain.faces.{axis}_{end}" for axis in "xyz" for end in ("low", "high")]),
    ("mie_grueneisen", '[material.pressure] model = "mie_grueneisen"',
     [f"material.pressure.{key}" for key in ("sound_speed", "slope_s", "gamma")]),
    ("elastic", '[material.flow_stress] model = "elastic"', []),
    ("temperature", "substrate.temperature", ["substrate.temperature", "particles.temperature"]),
    ("model", "material.flow_stress.model", ["material.flow_stress.model", "material.pressure.model"]),
    ("particles", "[particles]",
     [f"particles.{key}" for key in ("speed", "speed_curvature", "speed_per_diameter", "speed_diameter",
                                     "lateral_velocity", "lateral_slope", "lateral_curvature", "direction",
                                     "temperature", "temperature_per_diameter", "temperature_diameter", "flight",
                                         "stream", "stream_laws")]),
])
def test_a_section_or_key_is_told_alone(capsys, name, first, keys):
    """Fails if more than what was asked for is printed, or a key named like a section (batches.particles) with it."""
    text = printed(capsys, "scenes", "--keys", name)
    assert text.startswith(first)
    assert [key for key, _ in keys_of(text)] == keys


def test_a_section_comes_with_those_below_it(capsys):
    """Fails if ``--keys material`` leaves out the models."""
    keys = {key for key, _ in keys_of(printed(capsys, "scenes", "--keys", "material"))}
    assert keys == {key for key in all_keys() if key.startswith("material.")} - set(SECTIONS)


@pytest.mark.parametrize(("name", "hint"), [
    ("domian", 'did you mean "domain"?'), ("cel_size", 'did you mean "domain.cell_size"?'),
    ("domain.x_low", 'did you mean "domain.faces.x_low"?'),
    ("hardening_a", 'did you mean "material.flow_stress.hardening_A"?'),
    ("johnson-cook", 'did you mean "johnson_cook"?'),
    ("xyzzy", f"sections: {', '.join(SECTIONS)}"),
])
def test_an_unknown_section_or_key_is_one_line_with_a_suggestion(capsys, name, hint):
    """Fails if nothing is printed for it, with exit code 0."""
    assert main(["scenes", "--keys", name]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.splitlines() == [f'no section or key "{name}"; {hint}']


def test_a_scene_and_keys_are_not_printed_at_once(capsys):
    """Fails if one of the two is dropped without a word."""
    assert main(["scenes", "splat", "--keys"]) == 2
    assert capsys.readouterr().err == "f2s scenes: a scene or --keys, one after the other, not both\n"


@pytest.mark.mpi
@pytest.mark.parametrize(("arguments", "code"), [(["scenes", "--keys", "run"], 0), (["scenes", "--keys", "rum"], 2),
                                                 (["materials"], 0), (["materials", "gold"], 2)])
def test_rank_0_speaks_for_all(capsys, arguments, code):
    """Fails if each rank prints the reference, or says what is wrong."""
    assert main(arguments) == code
    out, err = capsys.readouterr()
    assert (bool(out), bool(err)) == (mpi.is_root() and code == 0, mpi.is_root() and code == 2)


def test_the_help_of_resume_tells_what_may_be_set(capsys):
    """Fails if it leaves out ``cycles.count``, which is accepted."""
    with pytest.raises(SystemExit):
        main(["resume", "--help"])
    assert "the run or output section, or cycles.count" in one(capsys.readouterr().out)


# --- materials -----------------------------------------------------------------------------------------


def test_materials_are_listed_with_model_and_source(capsys):
    """Fails if an entry of the library is left out, or its source cut."""
    text = printed(capsys, "materials")
    names = [line.split()[0] for line in text.splitlines() if not line.startswith(" ")]
    assert names == list(library.names())
    for name in names:
        flow, pressure = (library.entry(name)[key]["model"] for key in ("flow_stress", "pressure"))
        assert re.search(rf"^{name} +flow stress {flow}, pressure {pressure}$", text, re.MULTILINE)
        assert one(library.source(name)) in one(text)


@pytest.mark.parametrize("name", library.names())
def test_a_printed_material_is_that_of_the_library(capsys, tmp_path, name):
    """With its own name, and as "custom" with nothing from the library; fails if a constant is left out or rounded."""
    section = printed(capsys, "materials", name)
    assert one(library.source(name)) in one(re.sub("^# ", "", section, flags=re.MULTILINE))
    path = tmp_path / "edited.toml"
    plain = '[material]\nname = "copper-ge"\n'
    assert plain in scene_text("splat")
    path.write_text(scene_text("splat").replace(plain, section), encoding="utf-8")
    expected = load_scene("splat", [f"material.name={name}"])
    assert scene_hash(load_scene(path)) == scene_hash(expected)
    custom = load_scene(path, ["material.name=custom"]).material
    assert custom == expected.material.model_copy(update={"name": "custom"})


def test_a_printed_material_has_the_units_of_its_source(capsys):
    """Fails if constants are printed in SI (39000000.0) or without their meaning."""
    text = printed(capsys, "materials", "copper-ge")
    table = tomllib.loads(text)["material"]
    assert (table["young_modulus"], table["flow_stress"]["sigma_y0"]) == ("128 GPa", "39 MPa")
    assert re.search(r'^eta = "0.0043 1/K" +# steepness of the thermal softening$', text, re.MULTILINE)


@pytest.mark.parametrize(("name", "hint"), [("coper-ge", 'did you mean "copper-ge"? '), ("gold", "")])
def test_a_wrong_name_lists_all_materials(capsys, name, hint):
    """Fails if a near miss gets a suggestion only: scenes say that a wrong name lists them all."""
    known = ", ".join(library.names())
    assert main(["materials", name]) == 2
    assert capsys.readouterr().err == f'no material "{name}"; {hint}possible: {known}\n'
    with pytest.raises(InputError) as caught:
        load_scene("splat", [f"material.name={name}"])
    assert str(caught.value) == (f'--set material.name: material.name = "{name}": no such material; {hint}possible: '
                                 f"{known}, custom")
