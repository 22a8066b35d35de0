"""The reference of all keys of a scene, as ``f2s scenes --keys`` prints it: made from the schema, never behind it."""

from __future__ import annotations

import difflib
import functools
import json
import re
import textwrap
import typing
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from f2s_hpc import units
from f2s_hpc.config import stream
from f2s_hpc.config.dump import toml_value
from f2s_hpc.config.messages import is_section, unit_of
from f2s_hpc.config.quantities import Unit
from f2s_hpc.config.schema import Scene
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library

WIDTH = 100
HEAD = '''\
All keys of a scene, by section; f2s scenes --keys domain prints one section, f2s scenes --keys
cell_size one key. Behind = stands the default. A quantity is text with a unit, any of its kind:
"3 um" or "0.003 mm". A key is set on the command line, as in --set domain.cell_size="3 um", or in
the file, below its section:

    [domain]
    cell_size = "3 um"'''
_SI_UNIT = re.compile(r", (?:m|s|m/s|1/\(m s\)|K|1/K|1/s|Pa|kg/m3|J/kg/K|W/m/K)(?=[;,]|$)")
_BOUNDS = (("gt", "above"), ("ge", "of at least"), ("lt", "below"), ("le", "at most"))
_PLAIN = {bool: "true or false", int: "a whole number", float: "a number", str: "a text in quotes"}
LEFT_OUT = "  (may be left out)"
MUST = "  (must be given)"
MUST_OR_LIBRARY = "  (must be given, unless the library does)"
"""What stands in the place of a default; what the library gives: :mod:`f2s_hpc.config.load`."""


@dataclass(frozen=True)
class Key:
    """One key: dotted path, its default (or what stands for it), what it means, which values it takes."""

    path: str
    default: str
    meaning: str
    values: str

    @property
    def text(self) -> str:
        """Three lines or more on the key."""
        return "\n".join([f"{self.path}{self.default}", _filled(self.meaning), _filled(self.values)])


@dataclass(frozen=True)
class Part:
    """A section, or what a section holds with one of its models: dotted path ("" of the scene), title, keys."""

    path: str
    title: str
    keys: tuple[Key, ...]
    model: str = ""

    @property
    def head(self) -> str:
        """The first line on the section."""
        place = f"[{self.path}]" if self.path else "Above all sections"
        chosen = f" model = {json.dumps(self.model)}" if self.model else ""
        return textwrap.fill(f"{place}{chosen}  {self.title}".rstrip(), WIDTH, subsequent_indent="    ",
                             break_on_hyphens=False)


def key_reference(name: str = "") -> str:
    """Return the text on all keys of a scene, or on the section or key ``name``.

    ``name``: dotted path, or the last part of one; a model stands for its keys. Raises InputError, with a suggestion,
    where there is no such section or key.
    """
    parts = tuple(_parts(Scene, "", ""))
    if not name:
        return "\n\n".join([HEAD, *map(_whole, parts)])
    for names in (_full_names, _last_names):
        found = [_whole(part) if names(part)[0] & {name} else _some(part, name, names(part)[1]) for part in parts]
        if any(found):
            return "\n\n".join(text for text in found if text)
    raise InputError(f'no section or key "{name}"; {_suggestion(name, parts)}')


def plain_description(info: FieldInfo) -> str:
    """Return the description of a field for who writes a scene: without the SI unit in which the value is held."""
    return _SI_UNIT.sub("", info.description or "")


def _full_names(part: Part) -> tuple[set[str], list[str]]:
    """Return the names that stand for a part, those of the sections around it too, and those of its keys."""
    steps = part.path.split(".") if part.path else []
    return {".".join(steps[:n + 1]) for n in range(len(steps))}, [key.path for key in part.keys]


def _last_names(part: Part) -> tuple[set[str], list[str]]:
    """Return the same without what comes before the last dot, and the name of the model."""
    sections, keys = _full_names(part)
    return {_last(path) for path in sections} | ({part.model} - {""}), list(map(_last, keys))


def _last(path: str) -> str:
    return path.rpartition(".")[2]


def _whole(part: Part) -> str:
    return "\n\n".join([part.head, *(key.text for key in part.keys)])


def _some(part: Part, name: str, names: list[str]) -> str:
    return "\n\n".join(key.text for key, own in zip(part.keys, names) if own == name)


def _suggestion(name: str, parts: Iterable[Part]) -> str:
    """Return the closest section, model or key, or all sections."""
    meant: dict[str, str] = {}
    for part in parts:
        for path in (part.path, part.model, *(key.path for key in part.keys)):
            meant.setdefault(path.lower(), path)
            meant.setdefault(_last(path).lower(), path)
    close = difflib.get_close_matches(name.lower(), meant, 1, 0.6)
    sections = dict.fromkeys(part.path for part in parts if part.path)
    return f'did you mean "{meant[close[0]]}"?' if close else f"sections: {', '.join(sections)}"


def _parts(section: type[BaseModel], path: str, title: str, model: str = "") -> Iterator[Part]:
    """Yield the section, its plain keys, then its own sections."""
    keys, below = [], []
    for name, info in section.model_fields.items():
        place = f"{path}.{name}" if path else name
        if is_section(info.annotation):
            below += _parts(info.annotation, place, plain_description(info))
        elif info.discriminator:
            below += _choice(place, info)
        elif name != "model":
            keys.append(Key(place, _default(place, info), plain_description(info), _values(place, info, model)))
    if path == stream.KEY.rpartition(".")[0]:
        keys.append(Key(stream.KEY, LEFT_OUT, stream.MEANING, _PLAIN[str]))
        laws = f"values in brackets, each {_one_of(stream.LAWS)}"
        keys.append(Key(stream.LAWS_KEY, LEFT_OUT, stream.LAWS_MEANING, laws))
    yield Part(path, title, tuple(keys), model)
    yield from below


def _choice(path: str, info: FieldInfo) -> Iterator[Part]:
    """Yield the section in which a model is chosen, then the keys of each model."""
    kinds = typing.get_args(info.annotation)
    models = {typing.get_args(kind.model_fields["model"].annotation)[0]: kind for kind in kinds}
    chosen = None if info.is_required() else info.get_default(call_default_factory=True).model
    default = f" = {json.dumps(chosen)}" if chosen else MUST_OR_LIBRARY
    yield Part(path, plain_description(info),
               (Key(f"{path}.model", default, "which model; its constants follow", _one_of(models)),))
    for model, kind in models.items():
        yield from _parts(kind, path, kind.__doc__.rstrip("."), model)


def _default(path: str, info: FieldInfo) -> str:
    """Return the default as TOML, or what there is in its place."""
    if info.is_required():
        return MUST_OR_LIBRARY if path.startswith("material.") and path != "material.name" else MUST
    if info.default is None or info.default_factory is not None:  # (a factory takes it from other keys, as it says)
        return LEFT_OUT
    return f" = {toml_value(info.default, info.annotation, info.metadata)}"


def _values(path: str, info: FieldInfo, model: str) -> str:
    """Return which values a key takes; of a quantity without default, and of a constant of metals, with an example."""
    text, unit = _kind(info.annotation, info.metadata), unit_of(info.annotation, info.metadata)
    if info.default is not None and not info.is_required():
        return text
    for name in library.names() if path.startswith("material.") else ():
        *sections, key = path.split(".")[1:]
        table = functools.reduce(dict.__getitem__, sections, library.entry(name))
        if key in table and table.get("model", "") == model:
            return f"{text}, as in {json.dumps(table[key])} ({name})"
    example = next(iter(info.examples or ()), units.DIMENSIONS[unit.dimension].example if unit else "")
    return f'{text}, as in "{example}"' if example else text


def _kind(kind: object, metadata: Iterable[object] = ()) -> str:
    """Return in words which values a type takes."""
    inside = [member for member in typing.get_args(kind) if member is not type(None)]
    marks = [mark for own in (*metadata, *getattr(kind, "__metadata__", ()))
             for mark in (own.metadata if isinstance(own, FieldInfo) else [own])]
    if typing.get_origin(kind) is typing.Annotated:
        return _kind(inside[0], marks)
    if typing.get_origin(kind) is typing.Literal:
        return _one_of(inside)
    if typing.get_origin(kind) is tuple:
        return _several(inside, any(getattr(mark, "min_length", 0) for mark in marks))
    if inside:
        return _kind(inside[0], marks)
    unit = unit_of(kind, marks)
    name = units.with_article(unit.dimension) if unit else _PLAIN[kind]
    bounds = [f"{word} {_bound(getattr(mark, sign), unit)}" for sign, word in _BOUNDS for mark in marks
              if hasattr(mark, sign)]
    return f"{name} {' and '.join(bounds)}" if bounds else name


def _several(kinds: list, some: bool) -> str:
    """Return in words what a list holds; ``some``: it must not be empty."""
    if kinds[-1] is Ellipsis:
        return f"{'one or more values' if some else 'values'} in brackets, each {_kind(kinds[0])}"
    each = [_kind(kind) for kind in kinds]
    return f"{len(each)} values in brackets{f', each {each[0]}' if len(set(each)) == 1 else ': ' + ', '.join(each)}"


def _one_of(values: Iterable[object]) -> str:
    *first, last = (json.dumps(value) for value in values)
    return f"{', '.join(first)} or {last}" if first else last


def _bound(value: float, unit: Unit | None) -> str:
    if unit is None or value == 0:
        return f"{value:,} K" if unit is not None and unit.dimension == "temperature" else f"{value:,}"
    return units.show(value, unit.dimension)


def _filled(text: str) -> str:
    return textwrap.fill(text, WIDTH, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
