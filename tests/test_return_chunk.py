"""Radial return of cells side by side: each gets what it gets alone, whatever its neighbours and the cut of the row."""

from __future__ import annotations

import numpy as np
import pytest
from solver_setup import make_model

from f2s_hpc._jit import borrowed, kernel
from f2s_hpc.kernels.plasticity import FLOW, MISES, PLASTIC, RATIO, ROWS, STRAIN, return_chunk
from f2s_hpc.kernels.scratch import W
from f2s_hpc.materials.flow_stress import return_map
from f2s_hpc.materials.params import Elastic, LinearHardening

SHEAR_MODULUS = 47.761e9
DT = 2.7e-10
MODELS = {"ge": make_model(3e-6).flow, "johnson_cook": make_model(3e-6, "copper-johnson-cook").flow,
          "linear": LinearHardening(400e6, 100e6), "elastic": Elastic()}


@kernel
def in_chunks(flow, cuts, mass, trial, guess, peeq, temperature, out):
    """Return the cells between each two of ``cuts`` together; ratio, increment, flow stress and PEEQ into ``out``."""
    scratch, places = np.full(ROWS * W, 7.0), np.empty(W, dtype=np.int64)
    s, place = borrowed(scratch), borrowed(places)
    for chunk in range(cuts.size - 1):
        a, b = cuts[chunk], cuts[chunk + 1]
        strain = peeq[a:b].copy()
        for i in range(b - a):
            s[MISES * W + i], s[STRAIN * W + i] = trial[a + i], guess[a + i]
        return_chunk(flow, mass[a:b], strain, temperature[a:b], DT, SHEAR_MODULUS, place, s)
        for i in range(b - a):
            out[0, a + i], out[1, a + i] = s[RATIO * W + i], s[PLASTIC * W + i]
            out[2, a + i], out[3, a + i] = s[FLOW * W + i], strain[i]
    scratch[0], places[0] = 0.0, 0


def random_cells(rng, count):
    """Return mass, trial stress, guess, PEEQ and temperature: quiet stretches, void, elastic, cells that flow fast."""
    strength = 10.0 ** rng.uniform(6.0, 10.0, count)
    quiet = np.repeat(rng.random(count // 100 + 1) < 0.3, 100)[:count]
    trial = np.where(quiet, 1e-3 * strength, strength)
    mass = np.where(rng.random(count) < 0.1, 0.0, 1.0)
    peeq = np.where(rng.random(count) < 0.2, 0.0, 10.0 ** rng.uniform(-8.0, 1.0, count))
    guess = trial / (3.0 * SHEAR_MODULUS) * rng.choice([0.0, 0.01, 0.3, 1.0, 3.0], count)
    return mass, trial, guess, peeq, rng.uniform(250.0, 1500.0, count)


@pytest.mark.parametrize("name", MODELS)
def test_a_cell_gets_what_it_gets_alone(name, rng):
    """20,000 cells in chunks of 1 to 64, twice cut anew: bit for bit the increment and stress of ``return_map``.

    Fails when ``place[left] = i`` of ``_settle`` is dropped, ``s[LAST * W + c] > 0.0`` there becomes ``left == 0``, or
    the ``solid`` of ``softest`` in ``_may_yield`` is negated.
    """
    flow, count = MODELS[name], 20000
    mass, trial, guess, peeq, temperature = random_cells(rng, count)
    alone = np.zeros((4, count))
    for i in range(count):
        increment, stress, _ = return_map(flow, trial[i], SHEAR_MODULUS, peeq[i], DT, temperature[i], guess[i])
        flows = increment > 0.0 and mass[i] > 0.0
        alone[:, i] = ((stress / trial[i], increment, stress, peeq[i] + increment) if flows
                       else (1.0, 0.0, 0.0, peeq[i]))
    share = np.count_nonzero(alone[1]) / count
    assert share == 0.0 if name == "elastic" else 0.1 < share < 0.8
    for _ in range(2):
        cuts = np.concatenate([[0], np.cumsum(rng.integers(1, W + 1, count))])
        cuts = np.append(cuts[cuts < count], count)
        out = np.empty((4, count))
        in_chunks(flow, cuts, mass, trial, guess, peeq, temperature, out)
        assert np.array_equal(out, alone)
