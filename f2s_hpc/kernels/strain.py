"""Lagrangian step of the cells: face volume fluxes, velocity gradient, stress and heating."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import inlined, kernel
from f2s_hpc.kernels.force import W
from f2s_hpc.materials.flow_stress import return_map, static_flow_stress
from f2s_hpc.materials.pressure import pressure, stored_energy

GRADIENT, TRIAL, MISES, STRAIN, STATIC, RATIO, PLASTIC, FLOW = 0, 9, 15, 16, 17, 18, 19, 20
AFTER, VOLUME, VISCOUS, SHAPE_BEFORE, SHAPE_AFTER, POWER, HEAT, ROWS = 21, 22, 23, 24, 25, 26, 27, 28
"""Scratch rows of a chunk of cells: nine of the velocity gradient, six of the trial stress, its von
Mises stress, the equivalent strain increment, static flow stress, return ratio, plastic strain
increment, flow stress; volume fraction after, volume ratio, viscous heat, s:s before and after, stress
power, heat."""


@kernel
def face_fluxes(runs, count, window, shape, dt_over_dx, u, v, w, gx, gy, gz):
    """Volume (in cells) that each low face of a cell sweeps in the step: the mean of its four nodes' velocity.

    ``gx[k, j, i]`` belongs to the face between cells i - 1 and i; the arrays have the shape of node arrays.
    The divergence of these fluxes is the mean-gradient divergence times dt, so strain and remap agree.
    """
    ny, nx = shape
    quarter = 0.25 * dt_over_dx
    up, over = (nx + 1) * (ny + 1), nx + 1
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        row = (k * (ny + 1) + j) * (nx + 1)
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        for n in range(row + first, row + last):
            gx[n] = quarter * ((u[n] + u[n + over]) + (u[n + up] + u[n + up + over]))
            gy[n] = quarter * ((v[n] + v[n + 1]) + (v[n + up] + v[n + up + 1]))
            gz[n] = quarter * ((w[n] + w[n + 1]) + (w[n + over] + w[n + over + 1]))


@kernel
def _gradient(p00, p10, p01, p11, scale, row, s):
    """Mean gradient (1/s) of a velocity component over a chunk of cells into scratch rows ``row`` to ``row + 2``.

    ``p``: the component on the node rows (j, k), (j+1, k), (j, k+1), (j+1, k+1), each one longer than the chunk.
    """
    for i in range(p00.size - 1):
        a0, a1, b0, b1 = p00[i], p00[i + 1], p10[i], p10[i + 1]
        c0, c1, d0, d1 = p01[i], p01[i + 1], p11[i], p11[i + 1]
        s[row * W + i] = scale * ((a1 - a0) + (b1 - b0) + (c1 - c0) + (d1 - d0))
        s[(row + 1) * W + i] = scale * ((b0 - a0) + (b1 - a1) + (d0 - c0) + (d1 - c1))
        s[(row + 2) * W + i] = scale * ((c0 - a0) + (c1 - a1) + (d0 - b0) + (d1 - b1))


@kernel
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

    ``x``: mass in full cells; ``fraction`` before. The rule that keeps mixed cells sound: void closes
    before material is squeezed, a free surface carries no pressure, full material bears tension up to
    ``spall`` (Pa).
    """
    ratio = x / jacobian
    holds = fraction >= 1.0 and pressure(eos, ratio, energy) > -spall
    return 1.0 if (x >= jacobian) or holds else ratio


@kernel
def _close_chunk(mass, fraction, energy, dt, dx, bulk, eos, viscosity, s):
    """Volume ratio, volume fraction after, and work of the shock viscosity per cell volume (J/m3) of a chunk."""
    stiff = bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus
    for i in range(mass.size):
        x, before = mass[i], fraction[i]
        e = energy[i]
        rate = s[i] + s[4 * W + i] + s[8 * W + i]
        jacobian = 1.0 + dt * rate
        s[VOLUME * W + i] = jacobian
        s[AFTER * W + i] = closure(x, before, jacobian, e, eos, bulk.spall_pressure)
        closing = min(rate, 0.0) if before >= 1.0 else 0.0
        density = bulk.density * max(x, 1e-300)
        q = -density * dx * closing * (viscosity[0] * math.sqrt(stiff / density)
                                       - viscosity[1] * viscosity[1] * dx * closing)
        s[VISCOUS * W + i] = -q * closing * dt


@kernel
def _static_chunk(flow, mass, peeq, temperature, s):
    """Static flow stress of a chunk of cells; no return to it yet."""
    for i in range(peeq.size):
        s[STATIC * W + i] = static_flow_stress(flow, peeq[i], max(temperature[i], 1.0))
    for i in range(peeq.size):
        s[RATIO * W + i] = 1.0
        s[PLASTIC * W + i] = 0.0
        s[FLOW * W + i] = 0.0


@kernel
def _return_chunk(flow, mass, peeq, temperature, dt, shear_modulus, s):
    """Return the trial stress of the cells of a chunk that yield to their flow stress, and raise their PEEQ."""
    for i in range(peeq.size):
        mises = s[MISES * W + i]
        if mises > s[STATIC * W + i] and mass[i] > 0.0:
            plastic, stress, _ = return_map(flow, mises, shear_modulus, peeq[i], dt, temperature[i], s[STRAIN * W + i])
            s[PLASTIC * W + i] = plastic
            s[FLOW * W + i] = stress
            s[RATIO * W + i] = stress / mises
            peeq[i] += plastic


@kernel
def _write_stress(stress, mass, trial, s):
    """Write one component of the returned stress of a chunk back to its array; void keeps zero."""
    for i in range(mass.size):
        stress[i] = s[RATIO * W + i] * s[trial * W + i] if mass[i] > 0.0 else 0.0


@kernel
def _heat_chunk(mass, temperature, bulk, heat_viscous, s):
    """Taylor-Quinney and viscous heat per cell volume (J/m3) of a chunk, and the temperature it gives."""
    for i in range(mass.size):
        ratio = s[RATIO * W + i]
        s[SHAPE_AFTER * W + i] *= ratio * ratio
        s[POWER * W + i] = s[FLOW * W + i] * s[PLASTIC * W + i] * s[AFTER * W + i] * s[VOLUME * W + i]
        s[HEAT * W + i] = bulk.taylor_quinney * s[POWER * W + i] + heat_viscous * s[VISCOUS * W + i]
    for i in range(mass.size):
        capacity = max(mass[i], 1e-300) * bulk.density * bulk.specific_heat
        temperature[i] += s[HEAT * W + i] / capacity if mass[i] > 0.0 else 0.0


@kernel
def _internal_energy(mass, fraction, energy, stress, cell, dt, bulk, eos, s):
    """Add pressure, stress and viscous work to the specific internal energy of a chunk (Mie-Grueneisen only)."""
    for i in range(mass.size):
        x, e = mass[i], energy[i]
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
        jacobian, after = s[VOLUME * W + i], s[AFTER * W + i]
        p_old = pressure(eos, x, e) if fraction[i] >= 1.0 else 0.0
        p_new = pressure(eos, x / jacobian, e) if after >= 1.0 else 0.0
        work = dt * power * after * jacobian + s[VISCOUS * W + i] - 0.5 * (p_old + p_new) * (jacobian - 1.0)
        energy[i] = e + work / (x * bulk.density)


@kernel
def _sum_chunk(mass, fraction, bulk, eos, volume, quantum, s, sums):
    """Add a chunk's energies to ``sums``, write the new volume fraction; return the steepest gradient and its cell."""
    steepest, where = 0.0, 0
    modulus = 4.0 * bulk.shear_modulus
    for i in range(mass.size):
        x = mass[i]
        if x <= 0.0:
            continue
        before, after, jacobian = fraction[i], s[AFTER * W + i], s[VOLUME * W + i]
        old = before * s[SHAPE_BEFORE * W + i] / modulus + (x * stored_energy(eos, x) if before >= 1.0 else 0.0)
        new = after * jacobian * s[SHAPE_AFTER * W + i] / modulus + (
            x * stored_energy(eos, x / jacobian) if after >= 1.0 else 0.0)
        sums[0] += np.int64(old * volume / quantum)
        sums[1] += np.int64(new * volume / quantum)
        sums[2] += np.int64(s[POWER * W + i] * volume / quantum)
        sums[3] += np.int64(s[HEAT * W + i] * volume / quantum)
        fraction[i] = after
        if after >= 0.5:
            norm = 0.0
            for a in range(9):
                norm += s[a * W + i] * s[a * W + i]
            if not norm <= steepest:
                steepest, where = norm, i
    return steepest, where


@kernel
def lagrangian_step(runs, count, window, shape, dt, dx, largest, bulk, eos, flow, viscosity, heat_viscous, mass,
                    fraction, energy, stress, peeq, temperature, u, v, w, quantum, sums):
    """Strain, stress, plastic flow, heating and closure of the cells in ``window``.

    Jaumann rate with implicit J2 radial return; Taylor-Quinney heating dT = beta sigma d / (rho c_p),
    shock viscosity heats in full when ``heat_viscous`` is 1. ``fraction`` becomes the volume fraction
    of the deformed cell. ``sums`` int64[4] in units of ``quantum`` (J): elastic energy before and
    after, plastic work, heat. Returns the largest velocity-gradient norm (1/s) of the cells at least
    half full and the flat index of that cell.
    """
    ny, nx = shape
    s, nothing, carried = np.empty(ROWS * W), np.zeros(W), energy.size > 1
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
            _gradient(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], 0.25 / dx, GRADIENT, s)
            _gradient(v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m], 0.25 / dx, GRADIENT + 3, s)
            _gradient(w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], 0.25 / dx, GRADIENT + 6, s)
            _trial_stress(stress[0][cell:end], stress[1][cell:end], stress[2][cell:end], stress[3][cell:end],
                          stress[4][cell:end], stress[5][cell:end], dt, bulk.shear_modulus, largest, s)
            x, f, t = mass[cell:end], fraction[cell:end], temperature[cell:end]
            e = energy[cell:end] if carried else nothing[:n]
            _close_chunk(x, f, e, dt, dx, bulk, eos, viscosity, s)
            _static_chunk(flow, x, peeq[cell:end], t, s)
            _return_chunk(flow, x, peeq[cell:end], t, dt, bulk.shear_modulus, s)
            if carried:
                _internal_energy(x, f, e, stress, cell, dt, bulk, eos, s)
            for component in range(6):
                _write_stress(stress[component][cell:end], x, TRIAL + component, s)
            _heat_chunk(x, t, bulk, heat_viscous, s)
            steepest, at = _sum_chunk(x, f, bulk, eos, volume=dx * dx * dx, quantum=quantum, s=s, sums=sums)
            if not steepest <= fastest:
                fastest, where = steepest, cell + at
    return math.sqrt(fastest), where
