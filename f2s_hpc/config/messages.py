"""Turns the schema's errors into one line: where, which key, what is wrong, what would be right."""

from __future__ import annotations

import difflib
import json
import typing
from collections.abc import Iterable, Sequence

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from f2s_hpc import units
from f2s_hpc.config.quantities import Unit
from f2s_hpc.config.schema import Scene
from f2s_hpc.materials import library

Location = Sequence[str | int]

_BOUNDS = {"greater_than": ("above", "gt"), "greater_than_equal": ("at least", "ge"),
           "less_than": ("below", "lt"), "less_than_equal": ("at most", "le")}
_KINDS = {"string_type": "a text in quotes", "bool_type": "true or false", "int_type": "a whole number",
          "float_type": "a plain number", "tuple_type": "a list in brackets",
          "model_type": "a section with keys of its own", "model_attributes_type": "a section with keys of its own",
          "finite_number": "a finite number", "string_too_short": "at least one character",
          "too_short": "at least one value"}


def one_line(error: ValidationError, source: str, overrides: Sequence[str]) -> str:
    """Return the first problem of ``error`` as one line, and how many more there are.

    ``source`` names the file or scene. ``overrides`` are the keys set on the command line; a problem
    in one of them names it instead. Unknown keys come first: a mistyped key is also a missing one.
    """
    problems = [p for p in error.errors(include_url=False) if p["type"] != "default_factory_not_called"]
    typos = [p for p in problems if p["type"] == "extra_forbidden"]
    meant = {guess for p in typos for guess in _guesses(p["loc"])}
    rest = [p for p in problems if p not in typos and not (p["type"] == "missing" and _path(p["loc"]) in meant)]
    first, *more = typos + rest
    key, text = _explain(first)
    others = f"{len(more)} more"
    if [p["type"] for p in more] == ["missing"]:  # (what the unknown key was meant for)
        others = f"{_path(more[0]['loc'])} is missing"
    return f"{origin(key, source, overrides)}: {text}" + (f" (and {others})" if more else "")


def origin(key: str, source: str, overrides: Sequence[str]) -> str:
    """Return ``--set KEY`` if ``key`` was set on the command line, else ``source``."""
    for name in overrides:
        if key == name or key.startswith((f"{name}.", f"{name}[")) or name.startswith(f"{key}."):
            return f"--set {name}"
    return source


def did_you_mean(word: str, possible: Iterable[str]) -> str:
    """Return ``did you mean "..."?`` or, if nothing is close, the list of what is possible."""
    possible = list(possible)
    close = difflib.get_close_matches(word, possible, 1, 0.6)
    return f'did you mean "{close[0]}"?' if close else f"possible: {', '.join(possible)}"


def which_material(name: str, others: Iterable[str] = ()) -> str:
    """Return what to say of a ``name`` that no material has: the closest one, and all there are (and ``others``)."""
    listed = f"possible: {', '.join((*library.names(), *others))}"
    hint = did_you_mean(name, (*library.names(), *others))
    return f"{hint} {listed}" if hint != listed else listed


def _walk(loc: Location) -> tuple[str, type[BaseModel] | None, FieldInfo | None]:
    """Return the dotted path of ``loc`` without union tags, the section it is in, and its field if known."""
    path, inside, owner, info = "", Scene, None, None
    for part in loc:
        if isinstance(part, int):
            path += f"[{part}]"
        elif info is not None and info.discriminator:
            members = typing.get_args(info.annotation)
            inside = next(m for m in members if part in typing.get_args(m.model_fields["model"].annotation))
            info = None
        else:
            path += f".{part}" if path else part
            owner, info = inside, inside.model_fields.get(part) if inside else None
            inside = info.annotation if info and is_section(info.annotation) else None
    return path, owner, info


def _path(loc: Location) -> str:
    return _walk(loc)[0]


def is_section(kind: object) -> bool:
    """Tell whether the type of a field is a section with keys of its own."""
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def all_keys(section: type[BaseModel] = Scene, prefix: str = "") -> Iterable[str]:
    """Yield the dotted path of every key of a scene (of every model, where there is a choice)."""
    for name, info in section.model_fields.items():
        yield prefix + name
        for kind in (info.annotation, *typing.get_args(info.annotation)):
            if is_section(kind):
                yield from all_keys(kind, f"{prefix}{name}.")


def _guesses(loc: Location) -> list[str]:
    """Return the keys that an unknown key may stand for, the best first."""
    path, owner, _ = _walk(loc)
    prefix, _, word = path.rpartition(".")
    siblings = list(owner.model_fields) if owner else []
    close = [s for s in siblings if s.lower() == word.lower()] or difflib.get_close_matches(word, siblings, 1, 0.6)
    if close:
        return [f"{prefix}.{close[0]}" if prefix else close[0]]
    return [key for key in dict.fromkeys(all_keys()) if key.rpartition(".")[2] == word and key != path][:1]


def unit_of(kind: object, metadata: Iterable[object] = ()) -> Unit | None:
    """Return the unit mark of a field's type, looking into lists and options."""
    for mark in (*metadata, *getattr(kind, "__metadata__", ())):
        if isinstance(mark, Unit):
            return mark
    return next((unit for unit in map(unit_of, typing.get_args(kind)) if unit), None)


def _missing(loc: Location, key: str) -> str:
    _, _, info = _walk(loc)
    if isinstance(loc[-1], int):
        return f"{key} is missing: the list is too short"
    text = f"{key} is missing: {info.description}"
    unit = unit_of(info.annotation, info.metadata)
    if unit is None:
        return text
    example = f'"{units.DIMENSIONS[unit.dimension].example}"'
    several = typing.get_origin(info.annotation) is tuple
    return f"{text}; for example {key.rpartition('.')[2]} = {f'[{example}, ...]' if several else example}"


def _bound(loc: Location, bound: float) -> str:
    """Return a bound with its unit; behind one other than 0 a hint, as a wrong unit is what mostly leads there."""
    info = _walk(loc)[2]
    unit = unit_of(info.annotation, info.metadata) if info and bound else None
    return f"{units.pretty(bound, unit.dimension)}; is its unit right?" if unit else f"{bound:g}"


def _value(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _explain(problem: ErrorDetails) -> tuple[str, str]:
    """Return the key and the explanation of one problem."""
    kind, loc, context = problem["type"], problem["loc"], problem.get("ctx", {})
    key, owner, _ = _walk(loc)
    if kind == "check":
        key = ".".join(part for part in (key, context["key"]) if part)
        return key, f"{key} {problem['msg']}"
    if kind == "extra_forbidden":
        guesses = _guesses(loc)
        possible = list(owner.model_fields) if owner else []
        hint = f'did you mean "{guesses[0]}"?' if guesses else f"possible here: {', '.join(possible)}"
        if key in all_keys():
            hint = f"another model has it; possible here: {', '.join(possible)}"
        return key, f'unknown key "{key}"; {hint}'
    if kind == "missing":
        return key, _missing(loc, key)
    if kind.startswith("union_tag"):
        key += ".model"
        if kind == "union_tag_not_found":
            return key, f"{key} is missing: which model, with its constants"
        return key, f'{key} = "{context["tag"]}": must be one of {context["expected_tags"]}'
    shown = f"{key} = {_value(problem['input'])}"
    if kind == "value_error":
        return key, f"{shown}: {context['error']}"
    if kind == "literal_error":
        return key, f"{shown}: must be {context['expected']}"
    if kind == "too_long":
        return key, f"{shown}: has {context['actual_length']} values, {context['max_length']} are needed"
    if kind in _BOUNDS:
        word, bound = _BOUNDS[kind]
        return key, f"{shown}: must be {word} {_bound(loc, context[bound])}"
    if kind in _KINDS:
        # (what TOML cannot read as a list is taken for a text)
        more = ", each text in it in quotes" if kind == "tuple_type" and str(problem["input"]).startswith("[") else ""
        return key, f"{shown}: must be {_KINDS[kind]}{more}"
    return key, f"{shown}: {problem['msg']}"
