"""The commands about the particle stream: ``f2s stream`` (fits to a measurement) and ``f2s feed`` (numbers)."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from typing import TYPE_CHECKING

from f2s_hpc import mpi, places, units
from f2s_hpc.analysis.table import aligned
from f2s_hpc.cli.stream_options import DEFAULT_SPEEDS, DIAMETERS, PICTURE
from f2s_hpc.errors import InputError

if TYPE_CHECKING:
    from f2s_hpc.particles.feed import Feed, FeedCount


def stream(arguments: argparse.Namespace) -> int:
    """Fit a measurement, print the fits, write JSON and picture; return the exit code. Done by rank 0."""
    def work() -> str:
        from f2s_hpc.analysis.stream import draw_stream, format_stream
        from f2s_hpc.config.stream import LAWS, scene_keys
        from f2s_hpc.particles.measurement import read_measurement
        from f2s_hpc.particles.stream import as_record, fit_stream
        _test_places(arguments.json, arguments.out)
        fit = fit_stream(read_measurement(arguments.measurement))
        record = as_record(fit)
        laws = [law for law in LAWS if law != "lateral" or fit.lateral_signed]
        keys = _written(scene_keys(record, fit.measurement.name))
        more = [text for text in _written(scene_keys(record, fit.measurement.name, laws)) if text not in keys]
        lines = [format_stream(fit), "for a scene, with its own axis: " + ", ".join(keys),
                 "if asked for (particles.stream_laws): " + ", ".join(more)]
        if fit.lateral is not None and not fit.lateral_signed:
            lines.append("the lateral velocities have no sign, inwards or outwards: a scene takes none")
        if arguments.json:
            _write_json(arguments.json, record)
            lines.append(f'fits {arguments.json}; a scene takes them with particles.stream = "{arguments.json}"')
        if arguments.out:
            folder = places.make_folder(arguments.out, "--out")
            draw_stream(fit, folder / PICTURE)
            lines.append(f"picture {folder / PICTURE}")
        return "\n".join(lines)

    mpi.say(mpi.run_together(work))
    return 0


def _written(sections: dict[str, dict[str, str]]) -> list[str]:
    return [f'{section}.{name} = "{_short(text)}"' for section, table in sections.items()
            for name, text in table.items()]


def _short(text: str) -> str:
    number, _, unit = text.partition(" ")
    return f"{float(number):.5g} {unit}" if unit else text


def feed(arguments: argparse.Namespace) -> int:
    """Print the particles on the strip at each scanning speed, beside table 4 of the paper; return the exit code."""
    def work() -> str:
        from f2s_hpc.particles.feed import Feed, count_particles
        _test_places(arguments.json)
        volume, note = _measured_volume(arguments) if arguments.stream else _powder_volume(arguments)
        powder = Feed(_quantity(arguments, "feed_rate", "mass flow"), _percent(arguments.share),
                      _quantity(arguments, "path", "length"), _quantity(arguments, "density", "density"), volume)
        speeds = [_parsed("--scan-speed", text, "speed") for text in arguments.scan_speeds or DEFAULT_SPEEDS]
        counts = [count_particles(powder, speed, arguments.per_batch) for speed in speeds]
        if arguments.json:
            _write_json(arguments.json, {
                "feed_rate_kg_s": powder.rate, "share": powder.share, "path_m": powder.path,
                "density_kg_m3": powder.density, "mean_particle_volume_m3": volume,
                "particles_per_batch": arguments.per_batch, "speeds": [dataclasses.asdict(c) for c in counts]})
        return "\n".join([_feed_table(powder, counts, arguments.per_batch), "note: " + note])

    mpi.say(mpi.run_together(work))
    return 0


def _powder_volume(arguments: argparse.Namespace) -> tuple[float, str]:
    """Return the mean volume (m3) of a particle of the powder with the given diameters, and a note on it."""
    from f2s_hpc.particles.sizes import RosinRammler
    diameters = [_parsed(f"--{name}", getattr(arguments, name) or default, "length") for name, default, _ in DIAMETERS]
    sizes = RosinRammler.fit(*diameters)
    return sizes.mean_particle_volume(), sizes.message(*diameters[:3])


def _measured_volume(arguments: argparse.Namespace) -> tuple[float, str]:
    """Return the mean volume (m3) of a particle as it was measured in flight, and a note on it."""
    from f2s_hpc.config.stream import mean_volume, read_record
    for name, _, _ in DIAMETERS:
        if getattr(arguments, name):
            raise InputError(f"--{name} has no effect with --stream, whose file has the mean volume; leave one of them "
                             "out")
    volume, error = mean_volume(read_record(arguments.stream), arguments.stream)
    return volume, (f"mean volume as measured ({arguments.stream}), +-{1e18 * error:,.0f} um3; batches with D10, D50, "
                    "D90 of that file have what a Rosin-Rammler distribution through them has")


def _feed_table(powder: Feed, counts: list[FeedCount], per_batch: int) -> str:
    volume = powder.mean_volume
    diameter = math.cbrt(6.0 * volume / math.pi)
    head = ("scan speed", "time", "mass", "particles", "batches", "whole batches", "Table 4", "Table 4 row 1 as 1/V_s")
    rows = [(f"{1e3 * c.scan_speed:g} mm/s", units.pretty(c.time, "time"), units.pretty(c.mass, "mass"),
             f"{c.particles:,.0f}", f"{c.batches:.2f}", f"{c.whole_batches} = {c.whole_particles:,}",
             "-" if c.paper is None else f"{c.paper:,}", f"{c.paper_law:,.0f}") for c in counts]
    first = (f"{6e4 * powder.rate:.4g} g/min fed, {100 * powder.share:g} % of it on the strip while the nozzle goes "
             f"{units.pretty(powder.path, 'length')}; mean particle {1e18 * volume:,.0f} um3 (a sphere of "
             f"{1e6 * diameter:.2f} um), {units.pretty(powder.density, 'density')}")
    law = (f"particles: the law feed x share x path / (V_s x density x mean volume); whole batches of {per_batch:,}: "
           "the law rounded up.")
    table = ("Table 4 (Ge et al. 2026) has whole batches, 4, 6 and 8 of 2,559: its 120 mm/s is six batches, 15,354, "
             "where its 160 mm/s by 1/V_s gives 13,648.")
    return "\n".join([first, "", *aligned([head, *rows]), "", law, table])


def _quantity(arguments: argparse.Namespace, name: str, dimension: str) -> float:
    return _parsed(f"--{name.replace('_', '-')}", getattr(arguments, name), dimension)


def _parsed(option: str, text: str, dimension: str) -> float:
    try:
        value = units.parse(text, dimension)
    except units.UnitError as error:
        raise InputError(f'{option} "{text}": {error}') from None
    if value <= 0.0:
        raise InputError(f'{option} "{text}": must be positive')
    return value


def _percent(text: str) -> float:
    number, mark, rest = text.partition("%")
    try:
        value = float(number) / 100.0
    except ValueError:
        mark, value = "", 0.0
    if not mark or rest.strip() or not 0.0 < value <= 1.0:
        raise InputError(f'--share "{text}": write a percentage above 0 and up to 100, for example "2.06 %"')
    return value


def _test_places(json_file: str | None, folder: str | None = None) -> None:
    """Raise ``InputError`` if one of the places could not be written, before anything is."""
    if json_file:
        places.check_file(json_file, "--json")
    if folder:
        places.check_folder(folder, "--out")


def _write_json(path: str, record: dict) -> None:
    places.write_text(path, json.dumps(record, indent=2, allow_nan=False) + "\n")
