"""The file that ``f2s stream --json`` writes, and what a scene takes from it: jet width, speed law, diameters.

Ge et al. 2026, section 5.2.1: particles are placed by the fitted number over the lateral distance and fly at the fitted
speed of their place. They measured, but left out as small, how the speed depends on the diameter and how fast
particles fly sideways; a scene takes these only if asked (``particles.stream_laws``).

A track is symmetric, so the scene takes the even part of the speed law and the odd part of the lateral velocity, and
its own axis. Number, size and place are taken as independent: the speed on the axis, fitted to particles of all
sizes, is that of their mean diameter.
"""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Sequence

from f2s_hpc import places, units
from f2s_hpc.errors import InputError

FORMAT = "f2s stream 1"
KEY = "particles.stream"
LAWS = ("diameter", "lateral")
LAWS_KEY = "particles.stream_laws"
MEANING = ("file that f2s stream --json has written; its fits give speed and speed_curvature, batches.distribution, "
           "batches.jet_width and the diameters of batches; what the scene writes itself goes before")
LAWS_MEANING = ("what else that file gives: speed_per_diameter with speed_diameter, and lateral_slope, which the paper "
                "measures but leaves out of its simulations")
"""What the keys give, for the reference of keys: they stand in no section of the schema, which has what they become."""


def read_record(path: str | os.PathLike) -> dict:
    """Return what ``f2s stream --json`` wrote. Raises InputError, one line, for any other file."""
    try:
        record = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); "
                         "'f2s stream CSV --json FILE' writes one") from None
    except (ValueError, RecursionError):
        record = None
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise InputError(f"{path}: not a file that 'f2s stream CSV --json FILE' has written")
    return record


def scene_keys(record: dict, source: str | os.PathLike, laws: Sequence[str] = ()) -> dict[str, dict[str, str]]:
    """Return the keys, by section, that a scene takes from the fits in ``record``, as it would write them.

    ``laws``: those of ``LAWS`` that are asked for besides: the speed over the diameter, the lateral velocity.
    Raises InputError, naming ``source``, when a number is missing or none, or the lateral velocity was not measured
    or has no sign.
    """
    speed = (("speed", "axis_m_s", "speed"), ("speed_curvature", "curvature_1_m_s", "speed curvature"))
    sizes = tuple((f"diameter_{name}", f"{name}_m", "length") for name in ("d10", "d50", "d90", "min", "max"))
    particles = _values(record, "velocity_over_lateral_position", speed, source)
    if "diameter" in laws:
        particles |= _values(record, "velocity_over_diameter", [
            ("speed_per_diameter", "slope_1_s", "speed per diameter")], source)
        particles |= _values(record, "diameter", [("speed_diameter", "mean_m", "length")], source)
    if "lateral" in laws:
        particles |= _values(record, "lateral_velocity", [("lateral_slope", "slope_1_s", "speed slope")], source)
        if not record["lateral_velocity"].get("signed"):
            raise InputError(f'{source}: its lateral velocities have no sign, so that nobody can tell inwards from '
                             f'outwards; leave "lateral" out of {LAWS_KEY}, or write particles.lateral_slope')
    width = _values(record, "number_over_lateral_position", [("jet_width", "width_m", "length")], source)
    return {"particles": particles,
            "batches": {"distribution": "sech", **width, **_values(record, "diameter", sizes, source)}}


def mean_volume(record: dict, source: str | os.PathLike) -> tuple[float, float]:
    """Return the mean volume (m3) of a measured particle and its standard error. Raises InputError without them."""
    try:
        pair = record["diameter"]["mean_volume_m3"]
        volume, error = float(pair["value"]), float(pair["standard_error"])
        if not (math.isfinite(volume) and math.isfinite(error) and volume > 0.0):
            raise ValueError("not a volume")
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{source}: lacks the mean volume of a particle; write it anew with 'f2s stream CSV --json "
                         "FILE'") from None
    return volume, error


def _values(record: dict, part: str, wanted: Sequence[tuple[str, str, str]],
            source: str | os.PathLike) -> dict[str, str]:
    """Return what ``part`` of the record has of ``wanted``: key of the scene, name in the record, dimension."""
    try:
        values = [float(record[part][name]["value"]) for _, name, _ in wanted]
        if not all(map(math.isfinite, values)):
            raise ValueError("not a number")
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{source}: lacks the fits ({part.replace('_', ' ')}); write it anew with 'f2s stream CSV "
                         "--json FILE', from a measurement that has it") from None
    return {key: units.show(value, dimension) for value, (key, _, dimension) in zip(values, wanted)}


def take_stream(raw: dict, folder: pathlib.Path, overrides: Sequence[str]) -> None:
    """Put the fits of the file named by ``particles.stream`` into ``raw``, a scene as tables, in place of that key.

    ``particles.stream_laws`` beside it names those of ``LAWS`` that are taken too.
    What is said nearer to the run wins: a scene's own keys over a file that the scene names, a file named on the
    command line (``overrides``: the keys set there) over the scene's keys, other keys set there over the file.
    Width and diameters are taken only where particles are generated, the width only by the sech. A relative path
    counts from ``folder``. Raises InputError.
    """
    particles = raw.get("particles")
    if not isinstance(particles, dict):
        return
    laws = _asked_laws(particles)
    if "stream" not in particles:
        return
    name = particles.pop("stream")
    if not isinstance(name, str):
        raise InputError(f'{KEY}: must be the name of a file in quotes, written by "f2s stream CSV --json FILE"')
    path = folder / places.expanded(name)
    for section, keys in scene_keys(read_record(path), path, laws).items():
        table = raw.setdefault(section, {})
        if isinstance(table, dict):
            kept = {key: value for key, value in table.items()
                    if KEY not in overrides or f"{section}.{key}" in overrides}
            raw[section] = table | (_used(keys, table, kept) if section == "batches" else keys) | kept


def _asked_laws(particles: dict) -> list[str]:
    """Take ``stream_laws`` out of the section ``particles`` and return it, empty where it is not there."""
    laws = particles.pop("stream_laws", [])
    if not isinstance(laws, list) or any(law not in LAWS for law in laws):
        raise InputError(f'{LAWS_KEY}: must be a list out of "{LAWS[0]}" and "{LAWS[1]}", as in ["{LAWS[0]}"]')
    if laws and "stream" not in particles:
        raise InputError(f"{LAWS_KEY} has no effect without {KEY}; leave it out")
    return laws


def _used(keys: dict[str, str], table: dict, kept: dict) -> dict[str, str]:
    """Return those of the file's ``keys`` of the batches that have a use beside the scene's ``table``."""
    if table.get("files") or table.get("spheres"):
        return {}
    return {key: value for key, value in keys.items() if key != "jet_width" or kept.get("distribution") != "uniform"}
