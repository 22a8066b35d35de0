"""Contact and porosity: bodies pressed together leave no void behind, and feel each other only when they are close."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from f2s_hpc import mpi
from f2s_hpc.cycles import measure
from f2s_hpc.cycles.insert import paint_batch
from f2s_hpc.particles.batch import Batch
from f2s_hpc.verify import energy, sample
from f2s_hpc.verify.box import ALL_SYMMETRY, Setup
from f2s_hpc.verify.case import Case, Measured, Options, Stopwatch
from f2s_hpc.verify.scenes import empty_setup, write_scene
from f2s_hpc.verify.setting import Setting, material
from f2s_hpc.verify.shapes import paint_slab

ROOM = 298.15

TALLEST_VOID, FEWEST = 0.005, 16.0
"""Bar of this project for two blocks: void or misplaced height over height, with at least so many cells a block."""

STRAIN_OF_CONTACT = 0.05
"""Likewise for the plastic strain that closing the last gap leaves, times cells: bodies that meet do not deform yet."""


def _empty(cells: tuple[int, int, int], dx: float, options: Options) -> Setup:
    """Return an empty box between mirrors; the scene's own sphere is not painted."""
    top = 0.5 * min(cells) * dx
    return empty_setup(write_scene(cells, dx, options["material"], options["speed"], 1e-6, spheres=[(0, 0, top, top)],
                                   faces=ALL_SYMMETRY, overrides=options.overrides))


def _heights(setup: Setup) -> tuple[float, float, float]:
    """Return, in cells: mean height of the surface, height of the material by volume fraction, and by mass."""
    part = setup.state.part
    everything = setup.state.views["mass"] > 0.0
    surface = measure.surface_map(setup.state, everything) / setup.model.dx
    local = np.array([setup.state.owned("volume_fraction").sum(), setup.state.owned("mass").sum()])
    fraction, mass = sum(mpi.all_gather(local)) / (part.box.cells[0] * part.box.cells[1])
    return float(surface.mean()), float(fraction), float(mass)


def _profile(setup: Setup, name: str) -> np.ndarray:
    """Return the mean of a field of cells over each plane of the whole box, from the bottom up."""
    part = setup.state.part
    local = np.zeros(part.box.cells[2])
    local[part.start[2]:part.start[2] + part.count[2]] = setup.state.owned(name).sum(axis=(1, 2))
    return sum(mpi.all_gather(local)) / (part.box.cells[0] * part.box.cells[1])


def _strain_of_contact(setup: Setup, height: float) -> float:
    """Return the plastic strain that the two cells beside an interface ``height`` cells up have more than the next.

    Summed over cells. Behind the waves the blocks are strained evenly, so there should be none.
    """
    peeq, at = _profile(setup, "peeq"), round(height)
    even = np.median(np.concatenate([peeq[at - 5:at - 2], peeq[at + 2:at + 5]]))
    return float((peeq[at - 2:at + 2] - even).sum())


def _compression(setup: Setup) -> float:
    """Return the mean density ratio of the material by its mean pressure, linear pressure."""
    fraction = setup.state.owned("volume_fraction")
    pressure = measure.derived_field(setup.state, setup.model, "pressure")
    volume, sum_of_pressure = sum(mpi.all_gather(np.array([fraction.sum(), (fraction * pressure).sum()])))
    return 1.0 + float(sum_of_pressure / volume) / setup.model.bulk.bulk_modulus


# --- two blocks -------------------------------------------------------------------------------------------------


def _blocks(options: Options, height: float, gap: float, dx: float) -> Setup:
    """Return two blocks of ``height`` cells, ``gap`` cells apart; the lower rests on a mirror, the upper one falls."""
    setup = _empty((4, 4, math.ceil(2.0 * height + gap) + 3), dx, options)
    paint_slab(setup, 0.0, height, (0.0, 0.0, 0.0), ROOM)
    paint_slab(setup, height + gap, 2.0 * height + gap, (0.0, 0.0, -options["speed"]), ROOM)
    return setup


def run_blocks(options: Options) -> Iterator[Measured]:
    """Yield, when the wave has crossed half a block: void left, strain of the contact, height against flight, mass."""
    for level in options.levels:
        watch, dx = Stopwatch(), options["height"] / level
        gap = options["gap"] / dx
        setup = _blocks(options, level, gap, dx)
        time = options["gap"] / options["speed"] + 0.5 * options["height"] / setup.model.sound
        setup.advance_to(time)
        surface, fraction, mass = _heights(setup)
        cost, bar = sample.cost(setup.clock, watch), TALLEST_VOID if level >= FEWEST else None
        void = (surface - fraction) / (2.0 * level)
        yield Measured("void left / height", level, dx, void, 0.0, abs(void), bar, **cost)
        extra = _strain_of_contact(setup, level)
        yield Measured("PEEQ of the contact, cells", level, dx, extra, 0.0, abs(extra),
                       STRAIN_OF_CONTACT if level >= FEWEST else None, compares=False, **cost)
        # the wave has not reached the free top, which still flies
        top = 2.0 * level + gap - options["speed"] * time / dx
        yield Measured("height of the top", level, dx, surface * dx, top * dx, abs(surface / top - 1.0), bar, **cost)
        yield energy.row_of(setup, level, cost)
        yield Measured("mass height", level, dx, mass * dx, 2.0 * options["height"], abs(mass / (2.0 * level) - 1.0),
                       1e-10, compares=False, **cost)


# --- the gap at which bodies feel each other --------------------------------------------------------------------

FELT = 1e-3
"""A body has felt another when it moves at this share of the other's speed."""


def _felt_gap(options: Options, level: float, offset: float) -> tuple[float, Setup]:
    """Return the gap (cells) left when the lower block first moves, its top ``offset`` cells above a cell's bottom."""
    dx = options["height"] / level
    height = math.floor(level) + offset
    gap = 4.0
    setup = _blocks(options, height, gap, dx)
    while setup.clock.in_cycle < 2.0 * gap * dx / options["speed"]:
        setup.advance(1)
        part = setup.state.part
        below = int(height) - 1 - part.start[2]  # a node plane inside the lower block
        local = 0.0
        if 0 <= below < part.node_count[2]:
            local = float(np.abs(setup.state.owned("velocity_z")[below]).max())
        if mpi.maximum(local) > FELT * options["speed"]:
            break
    return gap - options["speed"] * setup.clock.in_cycle / dx, setup


def run_gap(options: Options) -> Iterator[Measured]:
    """Yield the gap in cells at first touch, largest and mean over places of the surfaces in their cells."""
    for level in options.levels:
        watch, gaps = Stopwatch(), []
        for offset in (0.0, 0.2, 0.4, 0.6, 0.8):
            gap, setup = _felt_gap(options, level, offset)
            gaps.append(gap)
        cost, dx = sample.cost(setup.clock, watch), options["height"] / level
        for quantity, gap in (("largest gap felt, cells", max(gaps)), ("mean gap felt, cells", sum(gaps) / len(gaps))):
            yield Measured(quantity, level, dx, gap, 0.0, abs(gap), compares=False, **cost)


# --- a layer of spheres -----------------------------------------------------------------------------------------


def run_spheres(options: Options) -> Iterator[Measured]:
    """Yield porosity, height and VF against mass of a square layer of spheres under a falling block, coarse to fine.

    A quarter of a sphere between mirrors is the whole layer. The block is four diameters thick: it hardly slows.
    """
    for level in options.levels:
        watch, dx = Stopwatch(), options["diameter"] / level
        half, thick = round(0.5 * level), 4.0 * level
        setup = _empty((half, half, math.ceil(level + thick) + 4), dx, options)
        radius = 0.5 * options["diameter"]
        batch = Batch(*(np.array([a]) for a in (0.0, 0.0, radius, radius)))
        paint_batch(setup.state, setup.model, batch, 0.0, (0.0, 0.0, 0.0), ROOM, setup.ledger, 1)
        paint_slab(setup, level, level + thick, (0.0, 0.0, -options["speed"]), ROOM)
        before, _, mass = _heights(setup)
        # time to close the voids, and as long again to press
        setup.advance_to(2.0 * (before - mass) * dx / options["speed"])
        surface, fraction, mass = _heights(setup)
        dense = mass / _compression(setup)  # the block still presses
        cost = sample.cost(setup.clock, watch)
        void = (surface - fraction) / surface
        start = (before - mass) / before
        yield Measured("void fraction before", level, dx, start, None, 0.0, compares=False, **cost)
        yield energy.row_of(setup, level, cost)
        yield Measured("void left / void before", level, dx, void / start, 0.0, abs(void / start), 0.02, **cost)
        for quantity, height in (("surface height over mass height", surface), ("VF over mass", fraction)):
            yield Measured(quantity, level, dx, height / dense, 1.0, abs(height / dense - 1.0), 0.005, **cost)


CASES = (
    Case("contact-blocks",
         "Two blocks, one at rest, pressed together at a known speed: void left between them, height of the top "
         "against its flight, mass, plastic strain left by closing the gap; resolutions are cells per block.",
         run_blocks, (8.0, 16.0, 32.0), (16.0, 32.0, 64.0),
         {"speed": Setting("100 m/s", "speed"), "height": Setting("0.1 mm", "length"),
          "gap": Setting("20 um", "length"), "material": material("copper-ge")}, 6),
    Case("contact-gap",
         "The gap in cells at which two approaching blocks first feel each other, over five places of the surface in "
         "its cell (printed, no bar).",
         run_gap, (8.0, 12.0, 16.0), (8.0, 16.0, 32.0),
         {"speed": Setting("100 m/s", "speed"), "height": Setting("0.1 mm", "length"),
          "material": material("copper-ge")}, 4),
    Case("contact-spheres",
         "A square layer of spheres compacted by a falling block: void left; height and volume fraction against mass, "
         "compressed as its mean pressure says (linear pressure); resolutions are cells per diameter.",
         run_spheres, (6.0, 8.0, 12.0), (8.0, 12.0, 16.0, 24.0),
         {"speed": Setting("300 m/s", "speed"), "diameter": Setting("30 um", "length"),
          "material": material("copper-ge")}, 4),
)
