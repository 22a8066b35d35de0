"""Plastic flow and heating of a chunk of cells: radial return of those that yield, and the temperature it gives."""

from __future__ import annotations

from f2s_hpc._jit import kernel
from f2s_hpc.kernels.scratch import W
from f2s_hpc.materials.flow_stress import MAX_ITERATIONS, return_step, softening, static_flow_stress

GRADIENT, TRIAL, MISES, STRAIN, STATIC, RATIO, PLASTIC, FLOW, AFTER, VOLUME, SHAPE_BEFORE, SHAPE_AFTER = (
    0, 9, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24)
"""Scratch rows of a chunk of cells: nine of the velocity gradient, six of the trial stress, its von Mises stress, the
equivalent strain increment, static flow stress, return ratio, plastic strain increment, flow stress; volume
fraction after, volume ratio, s:s before and after."""

ELASTIC_BEFORE, ELASTIC_AFTER, POWER, HEAT, VISCOUS, RETURNED, NORM = 25, 26, 27, 28, 29, 30, 31
"""Energies per cell volume (J/m3), in the order of the sums: elastic before and after, plastic work, heat, shock
viscosity, heat from numerical losses; then the squared norm of the gradient."""

THETA, TRIAL_MISES, STRAIN_BEFORE, INCREMENT, LOW, HIGH, LAST, RETURNED_STRESS, VOLUME_BEFORE, ROWS = (
    32, 33, 34, 35, 36, 37, 38, 39, 40, 41)
"""Rows of the yielding cells alone, side by side."""


@kernel
def _gather_yielding(flow, mass, peeq, temperature, stiffness, place, s):
    """List the cells of a chunk whose trial stress exceeds the static flow stress; return how many there are.

    ``place`` takes their indices; rows THETA to RETURNED_STRESS what the return needs of them.
    """
    n = mass.size
    for i in range(n):
        s[STATIC * W + i] = static_flow_stress(flow, peeq[i], max(temperature[i], 1.0))
        s[RATIO * W + i] = 1.0
        s[PLASTIC * W + i] = 0.0
        s[FLOW * W + i] = 0.0
    count = 0
    for i in range(n):
        if s[MISES * W + i] > s[STATIC * W + i] and mass[i] > 0.0:
            place[count] = i
            count += 1
    for c in range(count):
        i = place[c]
        high = (s[MISES * W + i] - s[STATIC * W + i]) / stiffness
        guess = s[STRAIN * W + i]
        s[THETA * W + c] = max(temperature[i], 1.0)
        s[TRIAL_MISES * W + c] = s[MISES * W + i]
        s[STRAIN_BEFORE * W + c] = peeq[i]
        s[INCREMENT * W + c] = guess if guess > 0.0 and guess < high else 0.5 * high
        s[LOW * W + c] = 0.0
        s[HIGH * W + c] = high
        s[LAST * W + c] = 0.0
        s[RETURNED_STRESS * W + c] = 0.0
    return count


@kernel
def return_chunk(flow, mass, peeq, temperature, dt, shear_modulus, place, s):
    """Return the trial stress of the cells of a chunk that yield to their flow stress, and raise their PEEQ.

    The yielding cells are set side by side and take their Newton steps together, so the logarithms and powers run
    in vector registers; a cell that has its root keeps it, so neighbours do not change a bit of it.
    """
    stiffness = 3.0 * shear_modulus
    count = _gather_yielding(flow, mass, peeq, temperature, stiffness, place, s)
    if count == 0:
        return
    for c in range(count):
        s[THETA * W + c] = softening(flow, s[THETA * W + c])
    for _ in range(MAX_ITERATIONS):
        for c in range(count):
            before = s[INCREMENT * W + c]
            found, low, high, last, stress = return_step(flow, s[THETA * W + c], s[TRIAL_MISES * W + c], stiffness,
                                                         s[STRAIN_BEFORE * W + c], dt, before, s[LOW * W + c],
                                                         s[HIGH * W + c])
            done = s[LAST * W + c]
            s[INCREMENT * W + c] = before if done > 0.0 else found
            s[RETURNED_STRESS * W + c] = s[RETURNED_STRESS * W + c] if done > 0.0 else stress
            s[LOW * W + c] = low
            s[HIGH * W + c] = high
            s[LAST * W + c] = max(done, last)
        running = 0.0
        for c in range(count):
            running = max(running, 1.0 - s[LAST * W + c])
        if running == 0.0:
            break
    for c in range(count):
        i, plastic, stress = place[c], s[INCREMENT * W + c], s[RETURNED_STRESS * W + c]
        s[PLASTIC * W + i] = plastic
        s[FLOW * W + i] = stress
        s[RATIO * W + i] = stress / s[TRIAL_MISES * W + c]
        peeq[i] += plastic


@kernel
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
        lost = mass[i] * bulk.density * specific + hourglass[i] * dt_over_volume
        s[RETURNED * W + i] = losses * bulk.taylor_quinney * lost if mass[i] > 0.0 else 0.0
        s[VISCOUS * W + i] = s[VISCOUS * W + i] if mass[i] > 0.0 else 0.0
        s[POWER * W + i] = s[POWER * W + i] if mass[i] > 0.0 else 0.0
        s[HEAT * W + i] = (bulk.taylor_quinney * s[POWER * W + i] + viscous * s[VISCOUS * W + i]) + s[RETURNED * W + i]
    for i in range(mass.size):
        capacity = max(mass[i], 1e-300) * bulk.density * bulk.specific_heat
        temperature[i] += s[HEAT * W + i] / capacity if mass[i] > 0.0 else 0.0
