"""Impacts against the Lagrangian solution that is computed beside them: on a block, and against a mirror.

No published run of an impact comes with all of its definitions, and most lose part of the energy. Here both sides have
the same material, temperature history (adiabatic), bond and measures, and the reference tells its own error: a coarser
mesh, and the energy that it does not explain.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from f2s_hpc import mpi
from f2s_hpc.errors import InputError
from f2s_hpc.materials.params import LinearPressure
from f2s_hpc.solver.model import Model
from f2s_hpc.verify import lagrangian
from f2s_hpc.verify.box import make_model
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.impact import ADIABATIC, JOHNSON_COOK, PLACES, check_scenes, impact_of, places_of, settings_of
from f2s_hpc.verify.lagrangian import Solution
from f2s_hpc.verify.splat import Impact, Splat, mean_splat, splats

MESHES = {False: (20.0, 28.0), True: (24.0, 36.0)}
"""Cells per diameter of the Lagrangian meshes, by full size; the finer one is the reference."""

BARS = ((24.0, {"height / D": 0.015, "width / D": 0.01, "crater depth / D": 0.03, "mean PEEQ": 0.03}),
        (12.0, {"height / D": 0.03, "width / D": 0.015, "crater depth / D": 0.08, "mean PEEQ": 0.07}))
"""From how many cells per diameter on which bars hold; coarser runs show the way there."""

REFERENCE_BAR, ENERGY_BAR = 0.03, 0.01
"""How far the two Lagrangian meshes may differ, and how much of the energy the finer one may leave unexplained."""


def _model(impact: Impact, options: Options) -> Model:
    """Return the material of the case for the Lagrangian solution; raises ``InputError`` for other pressures."""
    model = make_model(impact.diameter / 8.0, impact.material, impact.speed, options.overrides)
    if not isinstance(model.eos, LinearPressure):
        raise InputError(f"--set material={impact.material}: the Lagrangian solution knows linear pressure only")
    return model


def _check(options: Options) -> None:
    _model(impact_of(options), options)
    check_scenes(options)


def _numbers(impact: Impact, found: Solution | Splat) -> dict[str, float]:
    """Return what is compared, by name; there is no crater in a mirror."""
    numbers = {"height / D": found.height / impact.diameter, "width / D": found.width / impact.diameter,
               "mean PEEQ": found.peeq_mean}
    return numbers | ({"crater depth / D": found.crater / impact.diameter} if impact.depth else {})


def _solved(impact: Impact, model: Model, cells: float) -> tuple[Solution, dict]:
    """Return a Lagrangian solution and what it cost; serial, the same on all ranks."""
    watch = Stopwatch()
    solution = mpi.run_together(lagrangian.solve, model.bulk, model.flow, impact.diameter, impact.speed,
                                impact.temperature, impact.duration, cells, impact.depth > 0.0)
    return solution, {"resolution": cells, "dx_m": impact.diameter / cells, "compares": False,
                      "steps": solution.steps, "wall_s": watch.read()}


def run(options: Options) -> Iterator[Measured]:
    """Yield the shape, mean PEEQ and loss of a sphere on a block, or at a mirror, against the Lagrangian solution."""
    impact = impact_of(options)
    model = _model(impact, options)
    (coarse, _), (fine, cost) = (_solved(impact, model, cells) for cells in MESHES[options.full])
    wanted, coarser = _numbers(impact, fine), _numbers(impact, coarse)
    for name, value in wanted.items():
        yield Measured(f"{name}: Lagrangian, finer mesh against coarser", value=value, reference=coarser[name],
                       error=abs(value / coarser[name] - 1.0), bar=REFERENCE_BAR, **cost)
    unexplained = fine.energy["unexplained"]
    yield Measured("energy that the Lagrangian solution leaves unexplained", value=unexplained, reference=0.0,
                   error=abs(unexplained), bar=ENERGY_BAR, **cost)
    for level in options.levels:
        runs = splats(impact, level, (ADIABATIC, *options.overrides), places_of(options))
        result = mean_splat(runs)
        bars = next((bars for least, bars in BARS if level >= least), {})
        for name, value in _numbers(impact, result).items():
            yield Measured(name, level, result.dx, value, wanted[name], abs(value / wanted[name] - 1.0),
                           bars.get(name), **result.cost)
        loss = sum(run.balance["numerical_loss_fraction"] for run in runs) / len(runs)
        yield Measured("numerical loss", level, result.dx, loss, 0.0, loss, **result.cost)
        # no bar: on a mesh that moves it hangs on how thick the layer of cells at the interface is
        yield Measured("PEEQ p95", level, result.dx, result.peeq_p95, fine.peeq_p95,
                       abs(result.peeq_p95 / fine.peeq_p95 - 1.0), compares=False, **result.cost)


_ON_BLOCK = settings_of(dataclasses.replace(JOHNSON_COOK, speed=300.0))
_AT_MIRROR = settings_of(dataclasses.replace(JOHNSON_COOK, speed=200.0, duration=60e-9, half_width=1.25, depth=0.0))

CASES = (
    Case("impact-lagrangian",
         "25 um copper sphere on copper at 300 m/s, bonded where it touches, Johnson-Cook, adiabatic, 80 ns: height, "
         "width (second moments), mean PEEQ and crater depth on the axis against an axisymmetric Lagrangian solution "
         "that is computed beside it and tells its own error. Mean over places of the surface between two faces of the "
         "cells.",
         run, (6.0, 8.0, 12.0), (12.0, 18.0, 24.0), _ON_BLOCK | PLACES, 2, check=_check),
    Case("sphere-mirror",
         "25 um copper sphere into its mirror image at 200 m/s, Johnson-Cook, adiabatic, 60 ns: height, width and mean "
         "PEEQ against the same Lagrangian solution.",
         run, (6.0, 8.0, 12.0), (12.0, 18.0, 24.0), _AT_MIRROR, 2, check=_check),
)
