"""Stability on stiff and extreme cases: a matrix of scenes, each run to its end under :mod:`f2s_hpc.verify.watch`.

Nearly all of them are one sphere on a substrate of its own metal with one thing taken to an extreme.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from f2s_hpc.config.load import parse_scene
from f2s_hpc.errors import InputError, TooManyRanks
from f2s_hpc.verify import special
from f2s_hpc.verify.watch import FAILED, REFUSED, SMALL, Outcome, run_scene

DIAMETER = 24e-6
"""Diameter of the spheres (m) where the scene does not say otherwise."""


def impact(cells: float = 6, speed: float = 615.0, temperature: str = "450 degC", material: str = "copper-ge",
           diameter: float = DIAMETER, box: Sequence[float] = (2.0, 2.0, 3.0), substrate: float = 1.4,
           spheres: Sequence[tuple[float, float, float]] = ((1.0, 1.0, 0.51),), travel: float = 3.0,
           direction: Sequence[float] = (0.0, 0.0, -1.0), faces: dict[str, str] | None = None) -> str:
    """Return the TOML text of spheres of ``diameter`` (m) on a substrate.

    ``cells``: cells per diameter; ``speed`` (m/s). In diameters: ``box`` (x, y, z), ``substrate`` (height), ``spheres``
    (centres; z from the bottom of the layer), ``travel`` (how far a free particle flies in the simulated time).
    """
    d = diameter
    lengths = ", ".join(f'"{a * d!r} m"' for a in box)
    centres = ", ".join(f'["{x * d!r} m", "{y * d!r} m", "{z * d!r} m", "{0.5 * d!r} m"]' for x, y, z in spheres)
    sides = ", ".join(f'{side} = "{kind}"' for side, kind in (faces or {}).items())
    return f"""
title = "extreme"
[domain]
size = [{lengths}]
cell_size = "{d / cells!r} m"
substrate_height = "{substrate * d!r} m"
particle_layer_height = "{(box[2] - substrate) * d!r} m"
faces = {{ {sides} }}
[material]
name = "{material}"
[substrate]
temperature = "25 degC"
[particles]
speed = "{speed!r} m/s"
direction = {list(map(float, direction))}
temperature = "{temperature}"
[batches]
spheres = [{centres}]
[cycles]
count = 1
duration = "{travel * d / speed!r} s"
"""


@dataclass(frozen=True)
class Extreme:
    """A scene of the matrix: its name, TOML text, overrides, whether the quick matrix has it, and how it is run."""

    name: str
    text: str
    overrides: tuple[str, ...] = ()
    quick: bool = False
    run: Callable[..., Outcome] = run_scene


def _speeds() -> list[Extreme]:
    return [Extreme(f"speed {v} m/s", impact(speed=float(v)), quick=v in (100, 2000))
            for v in (50, 100, 200, 400, 615, 900, 1200, 1600, 2000)]


def _temperatures() -> list[Extreme]:
    scenes = [Extreme(f"particle at {t} degC", impact(temperature=f"{t} degC"), quick=t in (-196, 1050))
              for t in (-196, 25, 800, 1050)]
    return scenes + [
        Extreme("particle at 1050 degC, Johnson-Cook", impact(temperature="1050 degC", material="copper-johnson-cook"),
                quick=True),
        Extreme("all at 1050 degC, Johnson-Cook", impact(temperature="1050 degC", material="copper-johnson-cook"),
                ("substrate.temperature=1050 degC",))]


def _resolutions() -> list[Extreme]:
    scenes = [Extreme(f"D/dx {n:g}", impact(cells=n), quick=n < 3) for n in (2.0, 3.0, 4.5, 12.0, 20.0)]
    whole = impact(cells=1.5, box=(2.0, 2.0, 10.0 / 3.0), substrate=4.0 / 3.0)  # 3 x 3 x 5 cells
    fine = impact(cells=40, box=(1.3, 1.3, 1.6), substrate=0.5, travel=0.6, spheres=((0.65, 0.65, 0.51),))
    return [Extreme("D/dx 1.5", whole, quick=True), *scenes, Extreme("D/dx 40, short", fine)]


def _metals() -> list[Extreme]:
    names = ("tungsten-alloy", "tantalum", "titanium-ti64", "steel-316l", "aluminium-6061-t6", "copper-johnson-cook")
    return [Extreme(f"{name} at {v} m/s", impact(material=name, speed=float(v), temperature="25 degC"),
                    quick=(name, v) in (("tungsten-alloy", 600), ("aluminium-6061-t6", 1200)))
            for name in names for v in (600, 1200)]


def _materials() -> list[Extreme]:
    scenes = [Extreme(f"Poisson ratio {nu:g}", impact(), (f"material.poisson_ratio={nu!r}",), quick=nu == 0.49)
              for nu in (0.0, 0.45, 0.49)]
    scenes += [Extreme(f"perfectly plastic, {stress}", impact(material="copper-taylor"), (
        f"material.flow_stress.yield_stress={stress}", "material.flow_stress.hardening_modulus=0 Pa"),
        quick=stress == "90 MPa") for stress in ("1 MPa", "90 MPa", "2 GPa")]
    scenes += [
        Extreme("elastic", impact(speed=200.0), ("material.flow_stress={model = \"elastic\"}",)),
        Extreme("Mie-Grueneisen 600 m/s", impact(material="copper-piston", speed=600.0, temperature="25 degC")),
        Extreme("Mie-Grueneisen 2000 m/s", impact(material="copper-piston", speed=2000.0, temperature="25 degC")),
        Extreme("no spall", impact(speed=1200.0), ("material.spall_pressure=1e6 GPa",)),
        Extreme("spalls at once", impact(speed=1200.0), ("material.spall_pressure=1 MPa",)),
        Extreme("all plastic work is heat", impact(), ("material.taylor_quinney=1.0", "material.conductivity=0 W/m/K"))]
    return scenes


def _rates() -> list[Extreme]:
    """Ge model: its switches moved so that the rates of the impact, 1e5 to 1e9 1/s, lie on either side."""
    regions = (("below both switches", "1e12", "1e13", True), ("across the low switch", "1e7", "1e13", False),
               ("between the switches", "1e-3", "1e13", True), ("across the high switch", "1e-3", "1e7", False),
               ("above both switches", "1e-6", "1e-3", True), ("switches side by side", "1e7", "1.01e7", False))
    return [Extreme(f"rates {name}", impact(), (f"material.flow_stress.rate_s={low} 1/s",
                                                f"material.flow_stress.rate_u={high} 1/s"), quick=quick)
            for name, low, high, quick in regions]


def _geometries() -> list[Extreme]:
    ten = math.radians(10.0)
    graze = {"direction": (math.cos(ten), 0.0, -math.sin(ten)), "box": (4.0, 2.0, 2.6), "travel": 3.0,
             "spheres": ((0.7, 1.0, 0.51),), "faces": {"x_high": "outflow"}}
    pair, stack = ((1.0, 1.5, 0.51), (2.0, 1.5, 0.51)), ((1.0, 1.0, 0.5), (1.0, 1.0, 1.5))
    oblique = {"direction": (0.6, 0.5, -0.7), "box": (3.0, 3.0, 2.6), "spheres": ((1.0, 1.0, 0.51),)}
    return [
        Extreme("grazing, 10 degrees, 615 m/s", impact(**graze), quick=True),
        Extreme("grazing, 10 degrees, 1200 m/s", impact(**graze, speed=1200.0)),
        Extreme("oblique to all axes", impact(**oblique)),
        Extreme("cut by a corner", impact(box=(1.5, 1.5, 3.0), spheres=((0.0, 0.0, 0.51),)), quick=True),
        Extreme("cut by a corner, less than half in", impact(box=(1.5, 1.5, 3.0), spheres=((0.1, 1.45, 0.51),))),
        Extreme("touching side by side", impact(box=(3.0, 3.0, 3.0), spheres=pair), quick=True),
        Extreme("touching above each other", impact(box=(2.0, 2.0, 4.0), spheres=stack)),
        Extreme("starts on the substrate", impact(spheres=((1.0, 1.0, 0.5),))),
        Extreme("no substrate, onto the fixed bottom", impact(substrate=0.0, box=(2.0, 2.0, 2.0))),
        Extreme("open below", impact(speed=1200.0, substrate=0.6, box=(2.0, 2.0, 2.2), faces={"z_low": "free"}),
                quick=True),
        Extreme("all sides open", impact(speed=1200.0, **oblique, faces=dict.fromkeys(
            ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high"), "outflow"))),
        Extreme("one cell thick", impact(box=(2.0, 1 / 6, 3.0), spheres=((1.0, 1 / 12, 0.51),)), quick=True),
        Extreme("one cell thick, free sides", impact(box=(2.0, 1 / 6, 3.0), spheres=((1.0, 1 / 12, 0.51),),
                                                     faces={"y_low": "free", "y_high": "free"})),
        Extreme("a column of cells", impact(box=(1 / 6, 1 / 6, 3.0), spheres=((1 / 12, 1 / 12, 0.51),))),
        Extreme("head-on at twice 1200 m/s", impact(speed=1200.0, substrate=0.0, box=(2.0, 2.0, 3.0), spheres=(
            (1.0, 1.0, 0.98), (1.0, 1.0, 2.02)), faces={"z_low": "free", "z_high": "free"}), quick=True,
            run=special.head_on),
    ]


def _conduction() -> list[Extreme]:
    """A cell of 10 nm conducts faster than sound crosses it: the conduction is cut into sub-steps."""
    tiny = impact(diameter=6e-8, speed=615.0)
    return [Extreme("conduction limits, dx 10 nm", tiny, quick=True),
            Extreme("conduction limits, dx 10 nm, 100 times copper", tiny, ("material.conductivity=38500 W/m/K",))]


def matrix() -> list[Extreme]:
    """Return all scenes that are run once; the rest and the sweeps of the limits are in ``special``."""
    return [*_speeds(), *_temperatures(), *_resolutions(), *_metals(), *_materials(), *_rates(), *_geometries(),
            *_conduction()]


def check(overrides: Sequence[str]) -> None:
    """Raise ``InputError`` for an override that is no numerics, or a wrong one: the scenes say all the rest."""
    for override in overrides:
        if not override.strip().startswith("numerics."):
            raise InputError(f"--set {override}: --extreme takes numerics.KEY=value only; the rest is what its scenes "
                             "are about")
    parse_scene(impact(), "extreme", overrides)


def run(full: bool = False, numerics: Sequence[str] = (), only: str = "",
        report: Callable[[Outcome], None] = lambda outcome: None) -> list[Outcome]:
    """Run the matrix (``full``: all of it) and return the outcomes, the same on every rank. Collective.

    ``numerics``: "numerics.KEY=value" for every scene; ``only``: part of the names of the scenes wanted; ``report`` is
    called with every outcome as it comes. Each scene is written so that it can run: one that is refused has failed.
    Raises ``InputError`` if an override is wrong, or is none of the numerics.
    """
    check(numerics)
    outcomes: list[Outcome] = []

    def add(outcome: Outcome) -> None:
        if outcome.verdict == REFUSED:
            outcome = replace(outcome, verdict=FAILED, reason=f"refused: {outcome.reason}")
        outcomes.append(outcome)
        report(outcome)

    for extreme in matrix():
        if (full or extreme.quick) and only in extreme.name:
            add(extreme.run(extreme.name, extreme.text, (*extreme.overrides, *numerics)))
    for name, task in special.TASKS:
        if only in name:
            try:
                for outcome in task(name, impact(), full, tuple(numerics)):
                    add(outcome)
            except TooManyRanks as error:
                add(Outcome(name, SMALL, str(error)))
            except InputError as error:
                add(Outcome(name, REFUSED, str(error)))
    return outcomes
