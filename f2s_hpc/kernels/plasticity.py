"""Plastic flow and heating of a chunk of cells: radial return of those that yield, and the temperature it gives."""

from __future__ import annotations

import numpy as np

from f2s_hpc._jit import inlined, kernel
from f2s_hpc.kernels.scratch import W, of_rank, rank
from f2s_hpc.materials.flow_stress import (
    LOWEST,
    MAX_ITERATIONS,
    hardening,
    rate_onsets,
    return_start,
    return_step,
    softening,
    static_flow_stress,
)

GRADIENT, TRIAL, MISES, STRAIN, STATIC, RATIO, PLASTIC, FLOW, AFTER, VOLUME, SHAPE_BEFORE, SHAPE_AFTER = (
    0, 9, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24)
"""Scratch rows of a chunk of cells: nine of the velocity gradient, six of the trial stress, its von Mises stress, the
equivalent strain increment, static flow stress, return ratio, plastic strain increment, flow stress; volume
fraction after, volume ratio, s:s before and after."""

ELASTIC_BEFORE, ELASTIC_AFTER, POWER, HEAT, VISCOUS, RETURNED, CLOSING, COMPRESSION, NORM = (
    25, 26, 27, 28, 29, 30, 31, 32, 47)
"""Energies per cell volume (J/m3), in the order of the sums: elastic before and after, plastic work, heat, shock
viscosity, heat from numerical losses, closing, work of a pressure that is kept as internal energy; then the squared
norm of the gradient."""

THETA, PEEQ, RATE, SLOPE, RATE_SLOPE = 33, 34, 35, 36, 37
"""Rows of thermal factor, PEEQ, first rate coefficient, slopes of hardening and of that coefficient in the logarithm
of PEEQ: of the chunk, then of its yielding cells side by side."""

TRIAL_MISES, EXCESS, LOGARITHM, LOW, HIGH, LAST, INCREMENT, RETURNED_STRESS = (
    38, 39, 40, 41, 42, 43, 44, 45)
"""Rows of the yielding cells alone, side by side."""

VOLUME_BEFORE, ROWS = 46, 48
"""Row of the volume ratio before the step; number of rows."""

LANES = 8
"""Cells side by side are filled up to a multiple of this: what is left over would not be worked on in vectors."""


@inlined
def _filled(count):
    """Return ``count`` raised to a multiple of LANES."""
    return (count + LANES - 1) // LANES * LANES


@kernel
def _may_yield(flow, mass, peeq, temperature, s):
    """Return whether any trial stress of a chunk exceeds what its softest and its hottest cell bear together.

    Flow stress rises with PEEQ and falls with temperature, so no cell yields below that.
    """
    largest, softest, hottest = np.int64(0), rank(1e9), rank(1.0)
    for i in range(mass.size):
        solid = mass[i] > 0.0
        largest = max(largest, rank(s[MISES * W + i] if solid else 0.0))
        softest = min(softest, rank(peeq[i] if solid else 1e9))
        hottest = max(hottest, rank(temperature[i] if solid else 1.0))
    bound = static_flow_stress(flow, of_rank(softest), of_rank(hottest))
    return not of_rank(largest) <= (1.0 - 1e-9) * bound


@kernel
def _static_stress(flow, peeq, temperature, s):
    """Put thermal factor, static flow stress, first rate coefficient and slopes of a chunk into their rows."""
    n = peeq.size
    for i in range(n):
        s[PEEQ * W + i] = peeq[i]
        s[THETA * W + i] = max(temperature[i], 1.0)
    for i in range(n, _filled(n)):
        s[PEEQ * W + i] = peeq[n - 1]
        s[THETA * W + i] = max(temperature[n - 1], 1.0)
    for i in range(_filled(n)):
        theta = softening(flow, s[THETA * W + i])
        h, r, h_slope, r_slope, _ = hardening(flow, s[PEEQ * W + i])
        s[THETA * W + i] = theta
        s[STATIC * W + i] = theta * h
        s[RATE * W + i] = r
        s[SLOPE * W + i] = h_slope
        s[RATE_SLOPE * W + i] = r_slope


@kernel
def _gather_yielding(flow, mass, stiffness, onset_1, onset_2, place, s):
    """List the cells of a chunk whose trial stress exceeds the static flow stress; return how many there are.

    ``place`` takes their indices; rows THETA to HIGH what the return needs of them.
    """
    n = mass.size
    count = 0
    for i in range(n):
        place[count] = i
        count += 1 if (s[MISES * W + i] > s[STATIC * W + i] and mass[i] > 0.0) else 0
    for c in range(count):
        i = place[c]
        s[THETA * W + c] = s[THETA * W + i]
        s[PEEQ * W + c] = s[PEEQ * W + i]
        s[RATE * W + c] = s[RATE * W + i]
        s[SLOPE * W + c] = s[SLOPE * W + i]
        s[RATE_SLOPE * W + c] = s[RATE_SLOPE * W + i]
        s[TRIAL_MISES * W + c] = s[MISES * W + i]
        s[EXCESS * W + c] = s[MISES * W + i] - s[STATIC * W + i]
        s[LOGARITHM * W + c] = s[STRAIN * W + i]
    for c in range(count, _filled(count)):
        for row in range(THETA, LOGARITHM + 1):
            s[row * W + c] = s[row * W + count - 1]
    for c in range(_filled(count)):
        x, high = return_start(flow, s[THETA * W + c], s[EXCESS * W + c], stiffness, s[PEEQ * W + c], s[RATE * W + c],
                               s[SLOPE * W + c], s[RATE_SLOPE * W + c], onset_1, onset_2, s[LOGARITHM * W + c])
        s[LOGARITHM * W + c] = x
        s[LOW * W + c] = LOWEST
        s[HIGH * W + c] = high
    return count


@kernel
def _step_together(flow, stiffness, onset_1, onset_2, count, s):
    """Do one step of the return for ``count`` cells side by side."""
    for c in range(_filled(count)):
        x, low, high, last, increment, stress = return_step(
            flow, s[THETA * W + c], s[TRIAL_MISES * W + c], stiffness, s[PEEQ * W + c], onset_1, onset_2,
            s[LOGARITHM * W + c], s[LOW * W + c], s[HIGH * W + c])
        s[LOGARITHM * W + c] = x
        s[LOW * W + c] = low
        s[HIGH * W + c] = high
        s[LAST * W + c] = last
        s[INCREMENT * W + c] = increment
        s[RETURNED_STRESS * W + c] = stress


@kernel
def _settle(count, every, peeq, place, s):
    """Hand back what the cells with a root (or every one) found, set the others side by side anew; return their number.

    A cell is left alone once it has its root, so it does not matter which others need more steps.
    """
    left = 0
    for c in range(count):
        i = place[c]
        if every or s[LAST * W + c] > 0.0:
            plastic, stress = s[INCREMENT * W + c], s[RETURNED_STRESS * W + c]
            s[PLASTIC * W + i] = plastic
            s[FLOW * W + i] = stress
            s[RATIO * W + i] = stress / s[MISES * W + i]
            peeq[i] += plastic
        else:
            place[left] = i
            s[THETA * W + left] = s[THETA * W + c]
            s[PEEQ * W + left] = s[PEEQ * W + c]
            s[TRIAL_MISES * W + left] = s[TRIAL_MISES * W + c]
            s[LOGARITHM * W + left] = s[LOGARITHM * W + c]
            s[LOW * W + left] = s[LOW * W + c]
            s[HIGH * W + left] = s[HIGH * W + c]
            left += 1
    return left


@kernel
def return_chunk(flow, mass, peeq, temperature, dt, shear_modulus, place, s):
    """Return the trial stress of the cells of a chunk that yield to their flow stress, and raise their PEEQ.

    The yielding cells are set side by side and take their steps together, so the logarithms and powers run
    in vector registers. One step finds most roots; the cells without go on by themselves. What a cell gets does not
    depend on its neighbours.
    """
    n, stiffness = mass.size, 3.0 * shear_modulus
    for i in range(n):
        s[RATIO * W + i] = 1.0
        s[PLASTIC * W + i] = 0.0
        s[FLOW * W + i] = 0.0
    if not _may_yield(flow, mass, peeq, temperature, s):
        return
    _static_stress(flow, peeq, temperature, s)
    onset_1, onset_2 = rate_onsets(flow, dt)
    count = _gather_yielding(flow, mass, stiffness, onset_1, onset_2, place, s)
    for step in range(1, MAX_ITERATIONS + 1):
        if count == 0:
            break
        _step_together(flow, stiffness, onset_1, onset_2, count, s)
        count = _settle(count, step == MAX_ITERATIONS, peeq, place, s)


@inlined
def heat_chunk(mass, temperature, bulk, heating, dt_over_volume, hourglass, q00, q10, q01, q11, s):
    """Heat per cell volume (J/m3) of a chunk, and the temperature it gives.

    Plastic work is the mean of the stresses before and after the step times the plastic strain increment, d along the
    stress after: (sigma + 3/2 s_0 : s_1 / sigma) d / 2. That is the work that the nodes' forces do on the cell, so
    the two differ at third order; with the stress after alone they differ at second.
    ``heating``: (share of the shock viscosity's work, share of the numerical losses); ``hourglass`` (W per
    cell); ``q``: heat (J/kg) on the node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1).
    """
    viscous, losses = heating
    for i in range(mass.size):
        ratio, trial = s[RATIO * W + i], s[SHAPE_AFTER * W + i]
        step = bulk.shear_modulus * s[STRAIN * W + i]  # trial less rotated old stress has (trial - s_0)^2 = 6 step^2
        old = 0.75 * (trial + s[SHAPE_BEFORE * W + i] - 6.0 * step * step) / max(s[MISES * W + i], 1e-300)
        mean = 0.5 * max(s[FLOW * W + i] + old, 0.0)
        s[SHAPE_AFTER * W + i] = trial * ratio * ratio
        s[POWER * W + i] = mean * s[PLASTIC * W + i] * s[AFTER * W + i] * s[VOLUME * W + i]
        specific = 0.125 * (((q00[i] + q00[i + 1]) + (q10[i] + q10[i + 1])) + ((q01[i] + q01[i + 1])
                                                                              + (q11[i] + q11[i + 1])))
        lost = mass[i] * bulk.density * specific + hourglass[i] * dt_over_volume + s[CLOSING * W + i]
        # (what the ringing of the remap made may cool, but not more than by half)
        held = mass[i] * bulk.density * bulk.specific_heat * temperature[i]
        s[RETURNED * W + i] = losses * max(bulk.taylor_quinney * lost, -0.5 * held) if mass[i] > 0.0 else 0.0
        s[VISCOUS * W + i] = s[VISCOUS * W + i] if mass[i] > 0.0 else 0.0
        s[POWER * W + i] = s[POWER * W + i] if mass[i] > 0.0 else 0.0
        s[HEAT * W + i] = (bulk.taylor_quinney * s[POWER * W + i] + viscous * s[VISCOUS * W + i]) + s[RETURNED * W + i]
    for i in range(mass.size):
        capacity = max(mass[i], 1e-300) * bulk.density * bulk.specific_heat
        temperature[i] += s[HEAT * W + i] / capacity if mass[i] > 0.0 else 0.0
