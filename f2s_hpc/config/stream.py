"""The file that ``f2s stream --json`` writes, and what a scene takes from it: the jet's width and its speed law.

Ge et al. 2026, section 5.2.1: particles are placed by the fitted number over the lateral distance and fly at the fitted
speed of their place. A track is symmetric, so the scene takes the even part of the speed law, and its own axis.
"""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import Sequence

from f2s_hpc import units
from f2s_hpc.errors import InputError

FORMAT = "f2s stream 1"
KEY = "particles.stream"


def read_record(path: str | os.PathLike) -> dict:
    """Return what ``f2s stream --json`` wrote. Raises InputError, one line, for any other file."""
    try:
        record = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); "
                         "'f2s stream CSV --json FILE' writes one") from None
    except ValueError:
        record = None
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise InputError(f"{path}: not a file that 'f2s stream CSV --json FILE' has written")
    return record


def scene_keys(record: dict, source: str | os.PathLike) -> dict[str, dict[str, str]]:
    """Return the keys, by section, that a scene takes from the fits in ``record``, as it would write them.

    Raises InputError, naming ``source``, when a number is missing.
    """
    try:
        speed, number = record["velocity_over_lateral_position"], record["number_over_lateral_position"]
        values = [float(part["value"]) for part in (speed["axis_m_s"], speed["curvature_1_m_s"], number["width_m"])]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{source}: lacks the fits of number and velocity over the lateral position; write it anew "
                         "with 'f2s stream CSV --json FILE'") from None
    return {"particles": {"speed": units.show(values[0], "speed"),
                          "speed_curvature": units.show(values[1], "speed curvature")},
            "batches": {"distribution": "sech", "jet_width": units.show(values[2], "length")}}


def take_stream(raw: dict, folder: pathlib.Path, overrides: Sequence[str]) -> None:
    """Put the fits of the file named by ``particles.stream`` into ``raw``, a scene as tables, in place of that key.

    What is said nearer to the run wins: a scene's own keys over a file that the scene names, a file named on the
    command line (``overrides``: the keys set there) over the scene's keys, other keys set there over the file.
    A relative path counts from ``folder``. Raises InputError.
    """
    particles = raw.get("particles")
    if not isinstance(particles, dict) or "stream" not in particles:
        return
    name = particles.pop("stream")
    if not isinstance(name, str):
        raise InputError(f'{KEY}: must be the name of a file in quotes, written by "f2s stream CSV --json FILE"')
    path = folder / pathlib.Path(name).expanduser()
    for section, keys in scene_keys(read_record(path), path).items():
        table = raw.setdefault(section, {})
        if isinstance(table, dict):
            kept = {key: value for key, value in table.items()
                    if KEY not in overrides or f"{section}.{key}" in overrides}
            raw[section] = table | keys | kept
