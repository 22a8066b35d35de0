"""Arguments of the commands that measure runs or hand them on: analyse, compare, report, export."""

from __future__ import annotations

import argparse

from f2s_hpc.errors import InputError


def add_commands(command) -> None:
    """Add the commands; ``command(name, text)`` makes the parser of one."""
    sub = command("analyse", "measure a deposit: heights, roughness, porosity, flattening, distributions by depth")
    sub.add_argument("folder", metavar="DIR", help="folder of a run")
    _run_arguments(sub)
    sub.add_argument("--json", metavar="FILE", help="write the numbers to FILE too")
    sub.add_argument("--out", metavar="DIR", help="folder for JSON, CSV and PNG files (default: DIR/analysis)")
    sub = command("report", "write one self-contained HTML page about a run, or about two side by side")
    sub.add_argument("folder", metavar="DIR", help="folder of a run")
    sub.add_argument("--with", dest="second", metavar="DIR2", help="a second run, to show beside the first")
    _run_arguments(sub)
    sub.add_argument("--out", metavar="FILE", help="the page (default: DIR/report.html)")
    sub = command("compare", "compare two runs: measurements in percent, then field by field at each cycle")
    sub.add_argument("first", metavar="DIR", help="folder of a run")
    sub.add_argument("second", metavar="DIR2", help="folder of another")
    sub.add_argument("--exact", action="store_true",
                     help="field by field only; exit 0 only if every saved bit is equal")
    _settings_arguments(sub)
    _export_arguments(command("export", "write a deposit as a mesh for other codes"))


def _export_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("folder", metavar="DIR", help="folder of a run")
    sub.add_argument("--to", metavar="FILE", required=True,
                     help="file to write; its ending says the format: .vtu, .vtk, .xdmf, .xmf, .msh (Gmsh), .med, "
                          ".avs (UCD), .dat, .tec (Tecplot); cells only: .inp (Abaqus); triangles only: .stl, .ply, "
                          ".obj, .off")
    sub.add_argument("--cycle", type=int, metavar="N", help="export the end of cycle N (default: the last)")
    sub.add_argument("--what", choices=("cells", "boundary", "surface"),
                     help="landed cells as hexahedra with their fields; their outer faces as triangles; the height map "
                          "as triangles (default: cells, or surface where the format holds triangles only)")
    sub.add_argument("--unit", choices=("m", "mm", "um"), default="m",
                     help="of lengths (default: m); stresses are in Pa with m, else in MPa")
    sub.add_argument("--least-fraction", type=float, metavar="SHARE",
                     help="leave out cells with a volume fraction below (default: 0.5)")
    sub.add_argument("--no-substrate", action="store_true",
                     help="leave out what lies below the top of the substrate at the start")
    sub.add_argument("--open", action="store_true", help="the surface without sides and bottom")


def _run_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--cycle", type=int, metavar="N", help="measure the end of cycle N (default: the last)")
    sub.add_argument("--experiment", metavar="CSV",
                     help="a measured profile to overlap with; first line x_mm,height_mm or x_um,height_um; only the x "
                          "that both cover count, and what share of the widths that is stands beside the overlap")
    sub.add_argument("--align", action="store_true",
                     help="move the simulated profile onto the experiment: by the centroids of what stands above a "
                          "quarter of the maximum of each")
    sub.add_argument("--no-handover", action="store_true",
                     help="skip the check that a new batch changes nothing else (it takes the memory of a run)")
    _settings_arguments(sub)


def _settings_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--cutoff", metavar="LENGTH", default="80 um", help='of the Gaussian filter (default: "80 um")')
    sub.add_argument("--along", choices=("x", "y"), default="y",
                     help="direction of the track (default: y); the profile runs over the other axis")
    sub.add_argument("--symmetric", action=argparse.BooleanOptionalAction, default=None,
                     help="half a track was simulated, so mirror the profile at x = 0 (with --along x it runs over y "
                          "and is mirrored at y = 0), or do not (default: mirror it where that side is a symmetry side "
                          "and the scene centres its spray there)")
    sub.add_argument("--surface-zone", metavar="LENGTH",
                     help="what porosity leaves out below the surface (default: half the median particle diameter, but "
                          "at least two cells)")
    sub.add_argument("--sections", type=int, metavar="N", default=10,
                     help="sections along x, and along y, for image porosity (default: 10)")
    sub.add_argument("--smallest-pore", type=int, metavar="N", default=4,
                     help="pixels of the smallest pore of image analysis (default: 4)")
    sub.add_argument("--layer", metavar="LENGTH", default="10 um",
                     help='thickness of the layers of the distributions, rounded to whole cells, at least one; what it '
                          'became stands above them (default: "10 um")')
    sub.add_argument("--prominence", type=float, metavar="SHARE",
                     help="how far a ridge of PEEQ rises above the basins beside it to be a particle boundary, over "
                          "its own PEEQ (default: 0.15)")


def _length(text: str, option: str) -> float:
    from f2s_hpc import units
    try:
        value = units.parse(text, "length")
    except units.UnitError as error:
        raise InputError(f"{option} {text}: {error}") from None
    if value <= 0.0:
        raise InputError(f"{option} {text}: it must be above zero")
    return value


def _settings(arguments: argparse.Namespace):
    from f2s_hpc.analysis.boundaries import PROMINENCE
    from f2s_hpc.report.measure import Settings
    prominence = PROMINENCE if arguments.prominence is None else arguments.prominence
    if not 0.0 <= prominence < 1.0:
        raise InputError(f"--prominence {prominence:g}: it must be at least 0 and below 1")
    zone = arguments.surface_zone
    return Settings(
        along=arguments.along, cutoff=_length(arguments.cutoff, "--cutoff"),
        surface_zone=_length(zone, "--surface-zone") if zone is not None else None, sections=arguments.sections,
        smallest_pore=arguments.smallest_pore, layer=_length(arguments.layer, "--layer"), prominence=prominence,
        symmetric=arguments.symmetric, align=getattr(arguments, "align", False))


def analyse(arguments: argparse.Namespace) -> int:
    """Run ``f2s analyse``."""
    from f2s_hpc.report import commands
    return commands.analyse(arguments.folder, _settings(arguments), arguments.cycle, arguments.experiment,
                            arguments.out, arguments.json, not arguments.no_handover)


def report(arguments: argparse.Namespace) -> int:
    """Run ``f2s report``."""
    from f2s_hpc.report import commands
    return commands.report(arguments.folder, _settings(arguments), arguments.second, arguments.cycle,
                           arguments.experiment, arguments.out, not arguments.no_handover)


def export(arguments: argparse.Namespace) -> int:
    """Run ``f2s export``."""
    from f2s_hpc.report.export import ExportSettings
    from f2s_hpc.report.export import export as write
    settings = ExportSettings(arguments.what, arguments.unit, arguments.least_fraction, not arguments.no_substrate,
                              not arguments.open)
    return write(arguments.folder, arguments.to, settings, arguments.cycle)


def compare(arguments: argparse.Namespace) -> int:
    """Run ``f2s compare``: what was measured, unless only bits are asked for, then field by field."""
    from f2s_hpc.errors import F2SError
    from f2s_hpc.io.compare import compare_runs, format_comparison
    from f2s_hpc.report.commands import alone
    alone("compare")
    comparison = compare_runs(arguments.first, arguments.second)
    if not arguments.exact:
        from f2s_hpc.report import commands
        settings = _settings(arguments)
        try:
            print(commands.compare_measurements(arguments.first, arguments.second, settings), end="\n\n")
        except F2SError as error:
            # folders that hold tables or foreign frames only can still be compared field by field
            print(f"note: not measured: {error}")
    print(format_comparison(comparison))
    return 1 if arguments.exact and not comparison.identical else 0
