"""Writes a scene back as TOML with units: the effective configuration, nothing left to defaults."""

from __future__ import annotations

import hashlib
import json
import typing

from pydantic import BaseModel

from f2s_hpc import units
from f2s_hpc.config.quantities import Unit
from f2s_hpc.config.schema import Scene


def dump_scene(scene: Scene) -> str:
    """Return ``scene`` as TOML text that loads back to an equal scene, to the last bit of every number."""
    return "\n".join(_section(scene, "")) + "\n"


def scene_hash(scene: Scene) -> str:
    """Return the SHA-256 of ``dump_scene(scene)``, hexadecimal."""
    return hashlib.sha256(dump_scene(scene).encode("utf-8")).hexdigest()


def _section(section: BaseModel, path: str) -> list[str]:
    """Return the lines of one table, its plain keys first, then its own tables."""
    lines, tables = [f"[{path}]"] if path else [], []
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            tables += ["", *_section(value, f"{path}.{name}" if path else name)]
        elif value is not None:
            lines.append(f"{name} = {toml_value(value, info.annotation, info.metadata)}")
    return lines + tables


def toml_value(value: object, kind: object, metadata: typing.Iterable[object] = ()) -> str:
    """Return one value as TOML; quantities with their unit.

    ``kind`` and ``metadata``: annotation and metadata of its field.
    """
    if type(None) in typing.get_args(kind):  # (what may be absent and is not)
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    marks = [m for m in (*metadata, *getattr(kind, "__metadata__", ())) if isinstance(m, Unit)]
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        kinds = [k for k in typing.get_args(kind) if k is not Ellipsis]
        return "[" + ", ".join(toml_value(v, kinds[min(i, len(kinds) - 1)]) for i, v in enumerate(value)) + "]"
    if marks:
        return f'"{units.show(value, marks[0].dimension)}"'
    return repr(value)
