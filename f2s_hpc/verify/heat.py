"""Heat: conduction in a slab, and the heat of plastic work."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc.errors import InputError
from f2s_hpc.fields import STRESS
from f2s_hpc.materials.params import Elastic, LinearHardening
from f2s_hpc.solver.heat import diffusivity
from f2s_hpc.solver.model import Model
from f2s_hpc.verify import sample
from f2s_hpc.verify.box import cell_coordinates, make_block, make_model, warm_up
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.motion import few_cells, shear_step
from f2s_hpc.verify.setting import Setting, material

THIN = 3
_MEAN, _SWING = 600.0, 100.0
"""K: the slab's mean temperature, and the amplitude of the cosine in it."""

FOURIER = 0.04
"""Largest Fourier number of a step of heat in the slab, D dt / dx^2: it takes 6 FOURIER off the error of the mesh."""

_MORE = 1.1
"""The error may be this times that of central differences."""


def _check_slab(options: Options) -> None:
    model = make_model(1e-6, options["material"], overrides=options.overrides)
    if not (model.settings.conduction and model.bulk.conductivity > 0.0):
        raise InputError("heat-slab: without conduction there is nothing to compare; it needs numerics.conduction = "
                         "true and material.conductivity above 0 W/m/K")


def _slab_model(options: Options, cells: int, number: float = math.inf) -> tuple[Model, float]:
    """Return the model of a slab of ``cells`` with steps of heat of the Fourier number ``number``, and that number.

    Or of the largest that the Courant number allows.

    It moves once between two remaps: dt = number dx^2 / D, in so many steps of sound dt = courant dx / c.
    """
    model = make_model(options["thickness"] / cells, options["material"], overrides=options.overrides)
    per_courant = model.settings.steps_per_remap * diffusivity(model) / (model.sound * model.dx)
    courant = min(model.settings.courant, number / per_courant)
    return model._replace(settings=model.settings._replace(courant=courant)), courant * per_courant


def _slab(options: Options) -> Iterator[Measured]:
    _, coarsest = _slab_model(options, round(options.levels[0]), FOURIER)
    for number, level in enumerate(options.levels):
        cells = round(level)
        # with the same Fourier number on all meshes the error of the step is the same share of that of the mesh
        model, _ = _slab_model(options, cells, coarsest)
        warm_up(model)
        watch = Stopwatch()
        setup = make_block((cells, THIN, THIN), model)
        state = setup.state
        profile = np.cos(math.pi * cell_coordinates(state)[0] / cells)
        state.views["temperature"][...] = _MEAN + _SWING * profile
        state.exchange(("temperature",))
        decay = diffusivity(model) * (math.pi / options["thickness"]) ** 2
        setup.advance_to(options["decay"] / decay)
        exact = _MEAN + _SWING * math.exp(-options["decay"]) * profile
        off = (state.views["temperature"] - exact)[state.part.owned_cells]
        square, count = sample.sums([(off**2).sum(), off.size])
        error = math.sqrt(2.0 * square / count) / _SWING
        # central differences see k^2 (1 - (k dx)^2 / 12)
        bar = _MORE * options["decay"] * math.exp(-options["decay"]) * (math.pi / cells) ** 2 / 12.0
        yield Measured("temperature, L2", level, model.dx, error, 0.0, error, bar, 1.8 if number else None,
                       **sample.cost(setup.clock, watch))


def mean_stress(old: float, new: float, plastic: float, strain: float, shear_modulus: float) -> float:
    """Return the mean of the stresses before and after a step along its plastic strain (Pa).

    ``old``, ``new``: von Mises stresses (Pa); ``plastic``: PEEQ increment; ``strain``: equivalent strain increment. The
    trial stress, of size new + 3 G plastic, is parallel to the stress after; its elastic increment has the size
    3 G strain; so the old stress along it follows from the law of cosines.
    """
    trial, elastic = new + 3.0 * shear_modulus * plastic, 3.0 * shear_modulus * strain
    return 0.5 * (new + (trial * trial + old * old - elastic * elastic) / (2.0 * trial))


def _check_plastic(options: Options) -> None:
    model = make_model(1e-6, options["material"], overrides=options.overrides)
    if isinstance(model.flow, Elastic) or not model.bulk.taylor_quinney > 0.0:
        raise InputError("plastic-heating: no plastic work becomes heat; it needs a flow stress and "
                         "material.taylor_quinney above 0")


def _plastic(options: Options) -> Iterator[Measured]:
    for number, level in enumerate(options.levels):
        model = make_model(1e-6, options["material"], overrides=options.overrides)
        # energies are counted in quanta that suit the whole box: here it is a few cells
        model = model._replace(energy_quantum=model.energy_quantum * THIN**3 * model.dx**3 / 1e-9)
        bulk, start = model.bulk, options["temperature"]
        warm_up(model)
        watch = Stopwatch()
        setup = few_cells(model, start)
        state = setup.state
        step, work, old = 1.0 / level, 0.0, 0.0
        for _ in range(math.ceil(options["shear"] / step)):
            before = state.owned("peeq")[0, 0, 0]
            shear_step(setup, options["rate"], step / options["rate"])
            parts = [state.owned(name)[0, 0, 0] for name in STRESS]
            mises = math.sqrt(1.5 * (sum(s * s for s in parts[:3]) + 2.0 * sum(s * s for s in parts[3:])))
            work += mean_stress(old, mises, state.owned("peeq")[0, 0, 0] - before, step / math.sqrt(3.0),
                                bulk.shear_modulus) * (state.owned("peeq")[0, 0, 0] - before)
            old = mises
        warmer = bulk.taylor_quinney / (bulk.density * bulk.specific_heat)
        rise = float(state.owned("temperature")[0, 0, 0]) - start
        spread = float(sample.largest(np.abs(state.owned("temperature") - start - rise).max()))
        spent = sample.cost(setup.clock, watch)
        error = float(np.maximum(abs(rise / (warmer * work) - 1.0), spread / rise))
        yield Measured("temperature rise, sum of stress times strain (K)", level, step, rise, warmer * work, error,
                       1e-12 * max(1.0, start / rise), compares=False, **spent)
        if isinstance(model.flow, LinearHardening):
            strain = float(state.owned("peeq")[0, 0, 0])
            exact = warmer * (model.flow.yield_stress + 0.5 * model.flow.modulus * strain) * strain
            yield Measured("temperature rise, closed form (K)", level, step, rise, exact, abs(rise / exact - 1.0),
                           least_order=0.9 if number else None, **spent)
        totals = setup.ledger.totals()
        heat = totals["heat"] * model.energy_quantum
        volume = math.prod(state.part.box.extents)
        exact = bulk.density * bulk.specific_heat * rise * volume
        yield Measured("heat in the ledger (J)", level, step, heat, exact, abs(heat / exact - 1.0), 1e-8,
                       compares=False, **spent)


CASES = (
    Case("heat-slab", """Conduction through a slab against the decaying cosine
A slab at rest between insulating mirrors, its temperature a cosine of 100 K, decays by the factor exp(-decay) in the
full solver, in steps of one Fourier number on all meshes (0.04, or less where sound limits them). Error: L2 norm of the
difference over that of the first cosine; at most 1.1 times that of central differences.""",
         _slab, (8, 16, 32), (16, 32, 64), {"thickness": Setting("20 um", "length"), "decay": Setting("0.1"),
                                            "material": material("copper-ge")}, 4, whole=True, check=_check_slab),
    Case("plastic-heating", """Heat of plastic work in sheared cells (Taylor-Quinney)
Cells in simple shear, one Lagrangian step after another. The temperature rise against the sum of the step's mean stress
(before and after, along the plastic strain) times PEEQ increment over rho c, times the Taylor-Quinney share (round-off
of the temperature), and against the closed form for linear hardening, (Y + H e / 2) e (order 1 of backward Euler, or
better); the heat that the ledger counted. "cells" and "dx" stand for steps per unit shear and shear per step.""",
         _plastic, (50, 100, 200), (100, 300, 1000),
         {"shear": Setting("1.0"), "rate": Setting("1e6 1/s", "rate"), "temperature": Setting("25 degC", "temperature"),
          "material": material("copper-taylor")}, whole=True, check=_check_plastic),
)
