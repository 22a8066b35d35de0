"""Reads scenes: TOML and command-line overrides in, a checked ``Scene`` in SI out."""

from __future__ import annotations

import copy
import importlib.resources
import os
import pathlib
import tomllib
from collections.abc import Sequence

from pydantic import ValidationError

from f2s_hpc.config.messages import did_you_mean, one_line, origin
from f2s_hpc.config.schema import Scene
from f2s_hpc.config.stream import KEY, take_stream
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

CUSTOM = "custom"
_SOURCES = {"files": ("spheres", "count", "particles"), "spheres": ("files", "count", "particles")}


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
    sources of particles. ``particles.stream`` names a file of ``f2s stream --json``: its jet width and speed law stand
    in the result; keys beside it in the scene, or in ``overrides``, win over those of the file. Paths of files are
    relative to the TOML file, and for built-in scenes and overrides to the current directory; they are absolute in the
    result.

    Raises InputError, one line that names the file or ``--set key``, the key and what would be right.
    """
    raw, source, folder = _read(os.fspath(name_or_path))
    keys = [_override(raw, text) for text in overrides]
    _drop_replaced_sources(raw, keys)
    take_stream(raw, pathlib.Path.cwd() if KEY in keys else folder, keys)
    _add_library_entry(raw, source, keys)
    _resolve_files(raw, source, folder, keys)
    return _validated(raw, source, keys)


def parse_scene(text: str, source: str, overrides: Sequence[str] = ()) -> Scene:
    """Return the scene written in ``text`` (TOML, as ``dump_scene`` writes it); ``source`` names it in errors.

    ``overrides`` as in ``load_scene``. Raises InputError like ``load_scene``. CSV files are not looked for: the text
    may be read back on another machine or after they were moved.
    """
    raw = _parse_toml(text, source)
    keys = [_override(raw, override) for override in overrides]
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
    path = pathlib.Path(name).expanduser()
    if not path.is_file():
        if path.suffix == ".toml" or os.sep in name or path.exists():
            raise InputError(f"{name}: no such file" if not path.exists() else f"{name}: not a file")
        raise InputError(f'no scene "{name}": neither a built-in one nor a file; {did_you_mean(name, scene_names())}')
    try:
        text = path.read_text(encoding="utf-8")
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
    except tomllib.TOMLDecodeError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _drop_replaced_sources(raw: dict, keys: Sequence[str]) -> None:
    batches = raw.get("batches")
    if not isinstance(batches, dict):
        return
    for name, others in _SOURCES.items():
        if f"batches.{name}" in keys and batches[name]:
            for other in others:
                if f"batches.{other}" not in keys:
                    batches.pop(other, None)


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
                         f'{did_you_mean(name, (*library.names(), CUSTOM))}')
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
    absolute = [pathlib.Path(os.path.abspath(base / pathlib.Path(f).expanduser())) for f in files]
    for given, path in zip(files, absolute):
        if not path.is_file():
            raise InputError(f'{where}: batches.files: no file "{given}" (looked for {path})')
    batches["files"] = [str(path) for path in absolute]
