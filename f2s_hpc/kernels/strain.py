"""Lagrangian step of the cells: velocity gradient, stress and heating."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import borrowed, inlined, kernel
from f2s_hpc.kernels.deformed import gradient, to_deformed, volume_ratios
from f2s_hpc.kernels.plasticity import (
    AFTER,
    CLOSING,
    COMPRESSION,
    ELASTIC_AFTER,
    ELASTIC_BEFORE,
    MISES,
    NORM,
    RATIO,
    RETURNED,
    ROWS,
    SHAPE_AFTER,
    SHAPE_BEFORE,
    STRAIN,
    TRIAL,
    VISCOUS,
    VOLUME,
    VOLUME_BEFORE,
    heat_chunk,
    return_chunk,
)
from f2s_hpc.kernels.scratch import W, place_of_largest
from f2s_hpc.kernels.skin import surface_strain
from f2s_hpc.materials.pressure import pressure, stiffness, stored_energy, unloaded


@inlined
def _trial_stress(sxx_row, syy_row, szz_row, sxy_row, syz_row, sxz_row, dt, shear_modulus, largest, s):
    """Rotate the old stress and add the elastic increment over a chunk of cells, into rows TRIAL, MISES, STRAIN.

    The gradient is taken at the middle of the step, L (1 + dt L / 2)^-1 to second order; the rotation
    is the half-step Cayley form of the Jaumann rate (Hughes and Winget 1980), exact in the invariants.
    Light cells can see gradients that mean nothing; beyond ``largest`` per step the increment is scaled
    down. Also keeps s:s of the old stress in row SHAPE_BEFORE.
    """
    for n in range(sxx_row.size):
        xx, xy, xz = s[n], s[W + n], s[2 * W + n]
        yx, yy, yz = s[3 * W + n], s[4 * W + n], s[5 * W + n]
        zx, zy, zz = s[6 * W + n], s[7 * W + n], s[8 * W + n]
        norm = math.sqrt(((xx * xx + xy * xy + xz * xz) + (yx * yx + yy * yy + yz * yz))
                         + (zx * zx + zy * zy + zz * zz))
        h = dt * min(1.0, largest / max(dt * norm, 1e-300))
        half = 0.5 * h
        lxx = h * (xx - half * (xx * xx + xy * yx + xz * zx))
        lxy = h * (xy - half * (xx * xy + xy * yy + xz * zy))
        lxz = h * (xz - half * (xx * xz + xy * yz + xz * zz))
        lyx = h * (yx - half * (yx * xx + yy * yx + yz * zx))
        lyy = h * (yy - half * (yx * xy + yy * yy + yz * zy))
        lyz = h * (yz - half * (yx * xz + yy * yz + yz * zz))
        lzx = h * (zx - half * (zx * xx + zy * yx + zz * zx))
        lzy = h * (zy - half * (zx * xy + zy * yy + zz * zy))
        lzz = h * (zz - half * (zx * xz + zy * yz + zz * zz))
        mean = (lxx + lyy + lzz) / 3.0
        dxx, dyy, dzz = lxx - mean, lyy - mean, lzz - mean
        dxy, dyz, dxz = 0.5 * (lxy + lyx), 0.5 * (lyz + lzy), 0.5 * (lxz + lzx)
        # half-step rotation vector; R = 1 + 2 (A + A A) / (1 + |a|^2)
        ax, ay, az = 0.25 * (lzy - lyz), 0.25 * (lxz - lzx), 0.25 * (lyx - lxy)
        scale = 2.0 / (1.0 + ax * ax + ay * ay + az * az)
        rxx, ryy, rzz = (1.0 - scale * (ay * ay + az * az), 1.0 - scale * (ax * ax + az * az),
                         1.0 - scale * (ax * ax + ay * ay))
        rxy, ryx = scale * (ax * ay - az), scale * (ax * ay + az)
        rxz, rzx = scale * (ax * az + ay), scale * (ax * az - ay)
        ryz, rzy = scale * (ay * az - ax), scale * (ay * az + ax)
        sxx, syy, szz = sxx_row[n], syy_row[n], szz_row[n]
        sxy, syz, sxz = sxy_row[n], syz_row[n], sxz_row[n]
        s[SHAPE_BEFORE * W + n] = sxx * sxx + syy * syy + szz * szz + 2.0 * (sxy * sxy + syz * syz + sxz * sxz)
        # half of the elastic increment, 2 G d, before the rotation and half after: second order in the angle
        sxx, syy, szz = sxx + shear_modulus * dxx, syy + shear_modulus * dyy, szz + shear_modulus * dzz
        sxy, syz, sxz = sxy + shear_modulus * dxy, syz + shear_modulus * dyz, sxz + shear_modulus * dxz
        txx, txy, txz = rxx * sxx + rxy * sxy + rxz * sxz, rxx * sxy + rxy * syy + rxz * syz, \
            rxx * sxz + rxy * syz + rxz * szz
        tyx, tyy, tyz = ryx * sxx + ryy * sxy + ryz * sxz, ryx * sxy + ryy * syy + ryz * syz, \
            ryx * sxz + ryy * syz + ryz * szz
        tzx, tzy, tzz = rzx * sxx + rzy * sxy + rzz * sxz, rzx * sxy + rzy * syy + rzz * syz, \
            rzx * sxz + rzy * syz + rzz * szz
        qxx = txx * rxx + txy * rxy + txz * rxz + shear_modulus * dxx
        qyy = tyx * ryx + tyy * ryy + tyz * ryz + shear_modulus * dyy
        qzz = tzx * rzx + tzy * rzy + tzz * rzz + shear_modulus * dzz
        qxy = txx * ryx + txy * ryy + txz * ryz + shear_modulus * dxy
        qyz = tyx * rzx + tyy * rzy + tyz * rzz + shear_modulus * dyz
        qxz = txx * rzx + txy * rzy + txz * rzz + shear_modulus * dxz
        s[TRIAL * W + n], s[(TRIAL + 1) * W + n], s[(TRIAL + 2) * W + n] = qxx, qyy, qzz
        s[(TRIAL + 3) * W + n], s[(TRIAL + 4) * W + n], s[(TRIAL + 5) * W + n] = qxy, qyz, qxz
        new = qxx * qxx + qyy * qyy + qzz * qzz + 2.0 * (qxy * qxy + qyz * qyz + qxz * qxz)
        s[MISES * W + n] = math.sqrt(1.5 * new)
        s[SHAPE_AFTER * W + n] = new
        s[STRAIN * W + n] = math.sqrt(2.0 / 3.0 * (dxx * dxx + dyy * dyy + dzz * dzz
                                                   + 2.0 * (dxy * dxy + dyz * dyz + dxz * dxz)))


@inlined
def closure(x, fraction, jacobian, energy, eos, spall):
    """Return the volume fraction of a cell after its volume changed by ``jacobian``.

    ``x``: mass in full cells; ``fraction`` before; ``energy`` (J/kg). The rule that keeps mixed cells sound: void
    closes before material is squeezed, a free surface carries no pressure, so what is beside void has the density of
    none (less when hot, with Mie-Grueneisen pressure), full material bears tension up to ``spall`` (Pa).
    """
    ratio, free = x / jacobian, unloaded(eos, energy)
    holds = fraction >= 1.0 and pressure(eos, ratio, energy) > -spall
    return 1.0 if (x >= free * jacobian) or holds else ratio / free


@inlined
def _close_chunk(mass, fraction, energy, shock, closing, times, bulk, eos, s):
    """Volume fraction after, and work of shock viscosity and of closing per cell volume (J/m3) of a chunk.

    ``shock``, ``closing``: viscous pressure (Pa) in this step's forces, and the divergence (1/s) before them;
    ``times``: how long (s) it works on that, and on the divergence after, as the nodes' kicks have it; and whether (1)
    it works over the second half of the step too, on the cell as it is then. So does the pressure of a cell that closes
    in the step; what of that is over the void that it had left no compression stores.
    """
    for i in range(mass.size):
        rate = s[i] + s[4 * W + i] + s[8 * W + i]
        x, volume, f, before = mass[i], s[VOLUME * W + i], fraction[i], s[VOLUME_BEFORE * W + i]
        after = closure(x, f, volume, energy[i], eos, bulk.spall_pressure)
        closed = f * before * (times[0] * closing[i] + times[1] * rate)
        second = volume - before - before * times[1] * rate
        s[AFTER * W + i] = after
        s[VISCOUS * W + i] = -shock[i] * (closed + times[2] * after * second)
        closes = (x > 0.0) & (f < 1.0) & (after >= 1.0)
        stored = 0.5 * (x / unloaded(eos, energy[i]) - volume)
        s[CLOSING * W + i] = pressure(eos, x / volume, energy[i]) * max(-second - stored, 0.0) if closes else 0.0


@inlined
def _internal_energy(mass, fraction, energy, temperature, stress, cell, dt, bulk, eos, s):
    """Add pressure, stress and viscous work, and what the numerics lost, to the internal energy of a chunk (J/kg).

    The pressure that does the work is that of the new energy, linear in it. Temperature follows the pressure as along
    an isentrope, dT / T = Gamma dp / K (dT at constant pressure is heat over c_p, so heating is not counted twice).
    """
    # Gamma rho_0: pressure (Pa) of one J/kg
    thermal = pressure(eos, 1.0, 1.0)
    for i in range(mass.size):
        x, e = mass[i], energy[i]
        s[COMPRESSION * W + i] = 0.0
        if x <= 0.0:
            continue
        power = 0.0
        for b in range(6):
            mid = 0.5 * (s[RATIO * W + i] * s[(TRIAL + b) * W + i] + stress[b][cell + i])
            if b < 3:
                power += mid * s[4 * b * W + i]
            elif b == 3:
                power += mid * (s[W + i] + s[3 * W + i])
            elif b == 4:
                power += mid * (s[5 * W + i] + s[7 * W + i])
            else:
                power += mid * (s[2 * W + i] + s[6 * W + i])
        jacobian, after, volume = s[VOLUME * W + i], s[AFTER * W + i], s[VOLUME_BEFORE * W + i]
        p_old = pressure(eos, x / volume, e) if fraction[i] >= 1.0 else 0.0
        p_new = pressure(eos, x / jacobian, e) if after >= 1.0 else 0.0
        # while there is void the volume changes at no pressure: it closes, or opens, at the volume of no pressure
        free = x / unloaded(eos, e)
        # (what tears keeps the energy of its tension as heat)
        whole = (after >= 1.0) | ((fraction[i] >= 1.0) & (p_old < 0.0))
        swept = (jacobian if whole else free) - (volume if fraction[i] >= 1.0 else free)
        lost = s[RETURNED * W + i] / max(bulk.taylor_quinney, 1e-300)
        work = dt * power * after * jacobian + s[VISCOUS * W + i] + lost - 0.5 * (p_old + p_new) * swept
        slope = thermal if after >= 1.0 else 0.0
        gain = work / (x * bulk.density + 0.5 * slope * swept)
        p_new += slope * gain
        s[COMPRESSION * W + i] = -0.5 * (p_old + p_new) * swept
        energy[i] = e + gain
        hard = stiffness(eos, 2.0 * x / (jacobian + volume), e)
        temperature[i] *= math.exp(thermal / bulk.density * (p_new - p_old) / hard)


@inlined
def _write_stress(stress, mass, trial, s):
    """Write one component of the returned stress of a chunk back to its array; void keeps zero."""
    for i in range(mass.size):
        stress[i] = s[RATIO * W + i] * s[trial * W + i] if mass[i] > 0.0 else 0.0


@inlined
def _elastic_chunk(mass, fraction, energy, stores, bulk, eos, s):
    """Elastic energy per cell volume (J/m3) before and after, and squared gradient norm of the solid cells.

    ``stores``: 1.0 where pressure stores elastic energy, 0.0 where its work goes into the internal energy.
    """
    inverse = 1.0 / (4.0 * bulk.shear_modulus)
    for i in range(mass.size):
        x, before, after = mass[i], fraction[i], s[AFTER * W + i]
        some = max(x, 1e-300)
        jacobian, volume = s[VOLUME * W + i], s[VOLUME_BEFORE * W + i]
        stored = some * stored_energy(eos, some / volume) if before >= 1.0 else 0.0
        old = before * volume * s[SHAPE_BEFORE * W + i] * inverse + stored
        new = after * jacobian * s[SHAPE_AFTER * W + i] * inverse + (
            some * stored_energy(eos, some / jacobian) if after >= 1.0 else 0.0)
        # a cell that spalls was strained at its old pressure over the first half; what it stored the closure takes
        given = 0.5 * pressure(eos, some / volume, energy[i]) * (jacobian - volume)
        new += stored - given if (before >= 1.0) & (after < 1.0) & (stores > 0.0) else 0.0
        s[ELASTIC_BEFORE * W + i] = old if x > 0.0 else 0.0
        s[ELASTIC_AFTER * W + i] = new if x > 0.0 else 0.0
    for i in range(mass.size):
        norm = 0.0
        for a in range(9):
            norm += s[a * W + i] * s[a * W + i]
        s[NORM * W + i] = norm if s[AFTER * W + i] >= 0.5 and mass[i] > 0.0 else 0.0


@inlined
def _sum_row(row, n, scale, s):
    """Return the exact integer sum of a scratch row in quanta; ``scale``: quanta per unit."""
    total = np.int64(0)
    for i in range(n):
        total += np.int64(math.floor(s[row * W + i] * scale + 0.5))
    return total


@kernel
def lagrangian_step(runs, count, window, shape, dt, times, dx, largest, bulk, eos, flow, heating, mass, fraction,
                    energy, stress, peeq, temperature, u, v, w, displaced, x, y, z, gx, gy, gz, before, shock,
                    hourglass, node_heat, closing, quantum, sums):
    """Strain, stress, plastic flow, heating and closure of the cells in ``window``.

    ``times``: how long (s) the viscous pressure works on the divergence before and after the kick, whether (1) it does
    in the second half of the step, and how long hourglass control works.
    Jaumann rate with implicit J2 radial return; Taylor-Quinney heating dT = beta sigma d / (rho c_p).
    ``heating``: (share of the shock viscosity's work that heats, share of what hourglass control, remap and light-node
    exchange took that heats as plastic work does). ``displaced``: nodes are displaced by ``x``, ``y``, ``z`` (in cells)
    since the last remap, and cells had the volume ratios ``before``; ``gx``, ``gy``, ``gz``: what their faces have
    swept at the end of this step. ``shock`` (Pa), ``hourglass`` (W per cell), ``node_heat`` (J/kg), ``closing`` (1/s):
    node-shaped arrays; what the forces of this step and the losses of the last one left to be turned into heat.
    ``fraction`` becomes the volume fraction of the deformed cell. ``sums`` int64[8] in units of ``quantum`` (J):
    elastic energy before and after, plastic work, heat, work of the shock viscosity, heat from numerical losses, work
    of closing, work of a pressure that is kept as internal energy.
    Returns the largest velocity-gradient norm (1/s) of the cells at least half full and the flat index of that cell.
    """
    ny, nx = shape
    scratch, places = np.empty(ROWS * W), np.empty(W, dtype=np.int64)
    s, place, nothing, carried = borrowed(scratch), borrowed(places), np.zeros(W), energy.size > 1
    moved = s[TRIAL * W:]
    mass, fraction, peeq, temperature = borrowed(mass), borrowed(fraction), borrowed(peeq), borrowed(temperature)
    u, v, w, shock, hourglass = borrowed(u), borrowed(v), borrowed(w), borrowed(shock), borrowed(hourglass)
    x, y, z, gx, gy, gz, before = (borrowed(x), borrowed(y), borrowed(z), borrowed(gx), borrowed(gy), borrowed(gz),
                                   borrowed(before))
    node_heat, closing, energy = borrowed(node_heat), borrowed(closing), borrowed(energy)
    stress = (borrowed(stress[0]), borrowed(stress[1]), borrowed(stress[2]), borrowed(stress[3]), borrowed(stress[4]),
              borrowed(stress[5]))
    scale = dx * dx * dx / quantum
    fastest, where = 0.0, 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        last = min(runs[r, 3], window[5])
        for first in range(max(runs[r, 2], window[4]), last, W):
            n = min(last - first, W)
            cell = (k * ny + j) * nx + first
            end = cell + n
            a = (k * (ny + 1) + j) * (nx + 1) + first
            b, c, m = a + nx + 1, a + (nx + 1) * (ny + 1), n + 1
            d = c + nx + 1
            gradient(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], 0.25 / dx, s)
            gradient(v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m], 0.25 / dx, s[3 * W:])
            gradient(w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, s[6 * W:])
            if displaced:
                gradient(x[a:a + m], x[b:b + m], x[c:c + m], x[d:d + m], 0.25, moved)
                gradient(y[a:a + m], y[b:b + m], y[c:c + m], y[d:d + m], 0.25, moved[3 * W:])
                gradient(z[a:a + m], z[b:b + m], z[c:c + m], z[d:d + m], 0.25, moved[6 * W:])
                s[VOLUME_BEFORE * W:VOLUME_BEFORE * W + n] = before[a:a + n]
                to_deformed(n, s, moved, s[VOLUME_BEFORE * W:])
            else:
                s[VOLUME_BEFORE * W:VOLUME_BEFORE * W + n] = 1.0
            volume_ratios(gx[a:a + n], gx[a + 1:a + n + 1], gy[a:a + n], gy[b:b + n], gz[a:a + n], gz[c:c + n],
                          s[VOLUME * W:VOLUME * W + n])
            filled, f, t = mass[cell:end], fraction[cell:end], temperature[cell:end]
            e = energy[cell:end] if carried else nothing[:n]
            _close_chunk(filled, f, e, shock[a:a + n], closing[a:a + n], times, bulk, eos, s)
            surface_strain(mass, f, cell, shape, s, moved)
            _trial_stress(stress[0][cell:end], stress[1][cell:end], stress[2][cell:end], stress[3][cell:end],
                          stress[4][cell:end], stress[5][cell:end], dt, bulk.shear_modulus, largest, s)
            return_chunk(flow, filled, peeq[cell:end], t, dt, bulk.shear_modulus, place, s)
            heat_chunk(filled, t, bulk, heating, times[3] / (dx * dx * dx), hourglass[a:a + n], node_heat[a:a + m],
                       node_heat[b:b + m], node_heat[c:c + m], node_heat[d:d + m], s)
            if carried:
                _internal_energy(filled, f, e, t, stress, cell, dt, bulk, eos, s)
            for component in range(6):
                _write_stress(stress[component][cell:end], filled, TRIAL + component, s)
            _elastic_chunk(filled, f, e, 0.0 if carried else 1.0, bulk, eos, s)
            for i in range(n):
                f[i] = s[AFTER * W + i] if filled[i] > 0.0 else f[i]
            for term in range(8 if carried else 7):
                sums[term] += _sum_row(ELASTIC_BEFORE + term, n, scale, s)
            at = place_of_largest(s[NORM * W:NORM * W + n], fastest)
            if at >= 0:
                fastest, where = s[NORM * W + at], cell + at
    scratch[0], places[0] = 0.0, 0  # alive to here
    return math.sqrt(fastest), where
