"""Reads scenes: TOML and command-line overrides in, a checked ``Scene`` in SI out."""

from __future__ import annotations

import copy
import importlib.resources
import math
import os
import pathlib
import tomllib
from collections.abc import Sequence

from pydantic import ValidationError

from f2s_hpc import places
from f2s_hpc.config.messages import did_you_mean, one_line, origin, which_material
from f2s_hpc.config.schema import Scene
from f2s_hpc.config.sections import length_text
from f2s_hpc.config.stream import KEY, take_stream
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

CUSTOM = "custom"
_GENERATED = ("count", "particles", "distribution", "jet_width")
"""Keys of batches that say what to generate; a jet's axis counts for the speed law too."""
_SOURCES = {"files": ("spheres", *_GENERATED), "spheres": ("files", *_GENERATED)}


def scene_names() -> tuple[str, ...]:
    """Return the names of the built-in scenes, sorted."""
    folder = importlib.resources.files("f2s_hpc") / "scenes"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def scene_text(name: str) -> str:
    """Return the TOML text of the built-in scene ``name``. Raises InputError for an unknown name."""
    names = scene_names()
    if name not in names:
        raise InputError(f'no built-in scene "{name}"; {did_you_mean(name, names)}')
    return (importlib.resources.files("f2s_hpc") / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


def load_scene(name_or_path: str | os.PathLike, overrides: Sequence[str] = ()) -> Scene:
    """Return the checked scene of a built-in name or a TOML file, every number in SI.

    ``overrides`` are ``key.path=value`` texts; a value is read as TOML if that works, else as plain
    text. An override that gives ``batches.files`` or ``batches.spheres`` replaces the scene's other
    sources of particles, and ``batches.distribution="uniform"`` its jet width. ``particles.stream`` names a
    file of ``f2s stream --json``: its jet width and speed law stand in the result; keys beside it in the scene, or in
    ``overrides``, win over those of the file. Paths of files are relative to the TOML file, and for built-in scenes and
    overrides to the current directory; they are absolute in the result. A setting that would have no effect is refused.

    Raises InputError, one line that names the file or ``--set key``, the key and what would be right.
    """
    raw, source, folder = _read(os.fspath(name_or_path))
    keys = _overridden(raw, overrides)
    _drop_replaced_sources(raw, keys)
    take_stream(raw, pathlib.Path.cwd() if KEY in keys else folder, keys)
    _add_library_entry(raw, source, keys)
    _resolve_files(raw, source, folder, keys)
    scene = _validated(raw, source, keys)
    # (only here: scenes of older checkpoints must still be read)
    _refuse_low_box(scene, source, keys)
    _refuse_ignored(scene, source, keys)
    return scene


def parse_scene(text: str, source: str, overrides: Sequence[str] = ()) -> Scene:
    """Return the scene written in ``text`` (TOML, as ``dump_scene`` writes it); ``source`` names it in errors.

    ``overrides`` as in ``load_scene``. Raises InputError like ``load_scene``. CSV files are not looked for: the text
    may be read back on another machine or after they were moved.
    """
    raw = _parse_toml(text, source)
    keys = _overridden(raw, overrides)
    take_stream(raw, pathlib.Path.cwd(), keys)
    _add_library_entry(raw, source, keys)
    return _validated(raw, source, keys)


def _validated(raw: dict, source: str, keys: Sequence[str]) -> Scene:
    try:
        return Scene.model_validate(raw)
    except ValidationError as error:
        raise InputError(one_line(error, source, keys)) from None


def _read(name: str) -> tuple[dict, str, pathlib.Path]:
    """Return the raw tables, how to name the source in errors, and the folder of relative paths."""
    if name in scene_names():
        return _parse_toml(scene_text(name), f"scene {name}"), f"scene {name}", pathlib.Path.cwd()
    path = places.expanded(name)
    found = places.kind(path)
    if found != places.FILE:
        if path.suffix == ".toml" or os.sep in name or found != places.NOTHING:
            raise InputError(f"{name}: no such file" if found == places.NOTHING else f"{name}: not a file")
        beside = path.with_name(f"{path.name}.toml")
        hint = (f'did you mean "{beside}"?' if places.kind(beside) == places.FILE else
                did_you_mean(name, scene_names()))
        raise InputError(f'no scene "{name}": neither a built-in one nor a file; {hint}')
    try:
        text = path.read_text(encoding="utf-8-sig")  # (editors of Windows put a mark of their own first)
    except UnicodeDecodeError:
        raise InputError(f"{name}: not a text file in UTF-8") from None
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from None
    return _parse_toml(text, name), name, path.absolute().parent


def _parse_toml(text: str, source: str) -> dict:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f'{source}: not valid TOML: {error}; values with a unit need quotes, as in "3 um"') from None
    except RecursionError:
        raise InputError(f"{source}: brackets within brackets, too deep to be read; no scene needs that") from None


def _refuse_low_box(scene: Scene, source: str, keys: Sequence[str]) -> None:
    """Raise where the box, rounded to whole cells, is too low for substrate and particle layer above each other."""
    domain = scene.domain
    needed = domain.substrate_height + domain.particle_layer_height
    height = domain.extents[2]
    if needed <= height * (1.0 + 1e-9):
        return
    least = math.ceil(needed / domain.cell_size * (1.0 - 1e-9)) * domain.cell_size
    key = next((k for k in ("domain.cell_size", "domain.substrate_height", "domain.size", "domain")
                if k in keys), "domain.particle_layer_height")
    raise InputError(f"{origin(key, source, keys)}: domain.particle_layer_height does not fit: the box is "
                     f"{length_text(height)} high in whole cells, less than substrate and layer together "
                     f"({length_text(needed)}); domain.size[2] of {length_text(least)} makes room")


def _refuse_ignored(scene: Scene, source: str, keys: Sequence[str]) -> None:
    """Raise for settings of the batches that the source of their particles, or their distribution, leaves no use."""
    batches = scene.batches
    given = {"files": "batches.files are", "spheres": "batches.spheres are"}.get(batches.source)
    counted = ("particles",) if batches.source == "files" and scene.scheme == "standard" else ("count", "particles")
    for name in counted if given else ():
        if getattr(batches, name):
            key = f"batches.{name}"
            raise InputError(f"{origin(key, source, keys)}: {key} = {getattr(batches, name)} has no effect where "
                             f"{given} given; leave it out")
    if given and batches.even_sides:
        raise InputError(f"{origin('batches.even_sides', source, keys)}: batches.even_sides has no effect where "
                         f"{given} given; leave it out")
    if given and batches.distribution != "uniform":
        raise InputError(f'{origin("batches.distribution", source, keys)}: batches.distribution = '
                         f'"{batches.distribution}" has no effect where {given} given; leave it and jet_width out')
    if batches.jet_width is not None and batches.distribution == "uniform":
        raise InputError(f"{origin('batches.jet_width', source, keys)}: batches.jet_width has no effect on a uniform "
                         'distribution; leave it out, or set batches.distribution = "sech"')


def _overridden(raw: dict, overrides: Sequence[str]) -> list[str]:
    """Put the values of ``overrides`` into ``raw`` and return their keys; none may undo another that came before."""
    keys = []
    for text in overrides:
        key = _override(raw, text)
        undone = next((name for name in keys if name.startswith(f"{key}.")), None)
        if undone is not None:
            raise InputError(f"--set {key}: replaces the whole section, and --set {undone} with it; put it first")
        keys.append(key)
    return keys


def _override(raw: dict, text: str) -> str:
    """Put the value of ``key.path=value`` into ``raw`` and return its key."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not all(key.split(".")):
        raise InputError(f"--set {text}: expected key=value, for example --set domain.cell_size='6 um'")
    *sections, last = key.split(".")
    table = raw
    for depth, section in enumerate(sections):
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            raise InputError(f'--set {key}: "{".".join(sections[:depth + 1])}" is a value, not a section')
    table[last] = _parse_value(value)
    return key


def _parse_value(text: str) -> object:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _drop_replaced_sources(raw: dict, keys: Sequence[str]) -> None:
    batches = raw.get("batches")
    if not isinstance(batches, dict):
        return
    for name, others in _SOURCES.items():
        if f"batches.{name}" in keys and batches.get(name):
            for other in others:
                if f"batches.{other}" not in keys:
                    batches.pop(other, None)
    if "batches.distribution" in keys and "batches.jet_width" not in keys and batches.get("distribution") == "uniform":
        batches.pop("jet_width", None)


def _add_library_entry(raw: dict, source: str, keys: Sequence[str]) -> None:
    """Put the library's constants under the scene's own material keys."""
    material = raw.get("material")
    if not isinstance(material, dict) or not isinstance(material.get("name"), str):
        return
    name = material["name"]
    if name == CUSTOM:
        return
    if name not in library.names():
        raise InputError(f'{origin("material.name", source, keys)}: material.name = "{name}": no such material; '
                         f'{which_material(name, (CUSTOM,))}')
    raw["material"] = _merged(library.entry(name), material)


def _merged(base: dict, own: dict) -> dict:
    """Return ``own`` over ``base``; a table that names another model replaces the base's table."""
    result = copy.copy(base)
    for key, value in own.items():
        below = base.get(key)
        same_model = isinstance(value, dict) and isinstance(below, dict) and (
            value.get("model", below.get("model")) == below.get("model"))
        result[key] = _merged(below, value) if same_model else value
    return result


def _resolve_files(raw: dict, source: str, folder: pathlib.Path, keys: Sequence[str]) -> None:
    """Make the paths of ``batches.files`` absolute and look whether the files are there."""
    batches = raw.get("batches")
    files = batches.get("files") if isinstance(batches, dict) else None
    if isinstance(files, str):
        batches["files"] = files = [files]
    if not isinstance(files, list) or not all(isinstance(f, str) for f in files):
        return
    where = origin("batches.files", source, keys)
    base = pathlib.Path.cwd() if where != source else folder
    try:
        absolute = [pathlib.Path(os.path.abspath(base / places.expanded(f))) for f in files]
        missing = next(((f, path) for f, path in zip(files, absolute) if places.kind(path) != places.FILE), None)
    except InputError as error:
        raise InputError(f"{where}: batches.files: {error}") from None
    if missing is not None:
        raise InputError(f'{where}: batches.files: no file "{missing[0]}" (looked for {missing[1]})')
    batches["files"] = [str(path) for path in absolute]
