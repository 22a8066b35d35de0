"""The arguments of ``f2s stream`` and ``f2s feed``; imports nothing, so that ``f2s doctor`` starts anywhere."""

from __future__ import annotations

import argparse

PICTURE = "stream.png"
DEFAULT_SPEEDS = ("160 mm/s", "120 mm/s", "80 mm/s")
DIAMETERS = (("d10", "19 um", "diameter below which 10 %% of the volume lies"),
             ("d50", "30 um", "diameter below which 50 %% of the volume lies"),
             ("d90", "52 um", "diameter below which 90 %% of the volume lies"),
             ("smallest", "10 um", "smallest diameter"), ("largest", "85 um", "largest diameter"))


def stream(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``f2s stream``."""
    sub.add_argument("measurement", metavar="CSV",
                     help='particles measured in flight, header like "diameter [um],velocity [m/s],lateral position '
                          '[mm],lateral velocity [m/s]" (the last may be absent); or the name "synthetic": the '
                          "made-up sample that comes with the code")
    sub.add_argument("--json", metavar="FILE", help="write the fits as JSON, for particles.stream of a scene")
    sub.add_argument("--out", metavar="DIR", help=f"folder for {PICTURE} (default: no picture)")


def feed(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``f2s feed``; the defaults are the paper's."""
    sub.add_argument("--scan-speed", dest="scan_speeds", metavar="SPEED", action="append",
                     help=f"speed of the nozzle; may be repeated (default: {', '.join(DEFAULT_SPEEDS)})")
    sub.add_argument("--feed-rate", metavar="RATE", default="42.2 g/min",
                     help="powder that leaves the nozzle (%(default)s)")
    sub.add_argument("--share", metavar="PERCENT", default="2.06 %", help="share of it on the strip (2.06 %%)")
    sub.add_argument("--path", metavar="LENGTH", default="7.3 mm",
                     help="way of the nozzle during which the strip is under the jet (%(default)s)")
    sub.add_argument("--density", metavar="DENSITY", default="8960 kg/m3", help="of the powder (%(default)s)")
    for name, default, text in DIAMETERS:
        sub.add_argument(f"--{name}", metavar="LENGTH", help=f"{text} ({default})")
    sub.add_argument("--stream", metavar="FILE", help="take the mean volume of a particle as measured, from what "
                                                      '"f2s stream --json FILE" wrote, in the place of diameters')
    sub.add_argument("--per-batch", metavar="N", type=int, default=2559, help="particles in a batch (%(default)s)")
    sub.add_argument("--json", metavar="FILE", help="write the numbers as JSON")
