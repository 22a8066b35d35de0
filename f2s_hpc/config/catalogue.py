"""The materials of the library as text: a list of all, and the section of a scene that one stands for."""

from __future__ import annotations

import json
import textwrap

from pydantic import BaseModel

from f2s_hpc.config.dump import toml_value
from f2s_hpc.config.material import Material
from f2s_hpc.config.messages import which_material
from f2s_hpc.config.reference import WIDTH, plain_description
from f2s_hpc.errors import InputError
from f2s_hpc.materials import library


def material_list() -> str:
    """Return two lines or more on each material: name, models of flow stress and pressure, where it was published."""
    width = max(map(len, library.names())) + 2
    lines = []
    for name in library.names():
        entry = library.entry(name)
        lines += [f"{name:{width}}flow stress {entry['flow_stress']['model']}, pressure {entry['pressure']['model']}",
                  textwrap.fill(library.source(name), WIDTH, initial_indent="    ", subsequent_indent="    ",
                                break_on_hyphens=False)]
    return "\n".join(lines)


def material_text(name: str) -> str:
    """Return the ``[material]`` section of ``name`` as TOML to edit, each constant with its unit and what it is.

    It makes the same scene as the name alone. Raises InputError for a name that the library has not.
    """
    if name not in library.names():
        raise InputError(f'no material "{name}"; {which_material(name)}')
    entry = {"name": name, **library.entry(name)}
    head = [*textwrap.wrap(library.source(name), WIDTH - 2, break_on_hyphens=False),
            'For the place of [material] in a scene. With name = "custom" nothing more is taken from the library.']
    return "\n".join([*(f"# {line}" for line in head), *_section(Material.model_validate(entry), entry, "material")])


def _section(section: BaseModel, written: dict, path: str) -> list[str]:
    """Return the lines of one table, values as ``written``; what is not written there has its default."""
    rows, tables = [], []
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            tables += ["", *_section(value, written.get(name, {}), f"{path}.{name}")]
        elif value is not None:
            text = json.dumps(written[name]) if name in written else toml_value(value, info.annotation, info.metadata)
            meaning = {"name": "", "model": type(section).__doc__.rstrip(".")}.get(name, plain_description(info))
            rows.append((f"{name} = {text}", f"# {meaning}" if meaning else ""))
    width = max(len(row) for row, _ in rows) + 2
    return [f"[{path}]", *(f"{row:{width}}{comment}".rstrip() for row, comment in rows), *tables]
