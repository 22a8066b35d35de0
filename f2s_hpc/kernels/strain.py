"""Lagrangian step of the cells: face volume fluxes, velocity gradient, stress and heating."""

from __future__ import annotations

import math

import numpy as np

from f2s_hpc._jit import inlined, kernel
from f2s_hpc.materials.flow_stress import return_map
from f2s_hpc.materials.pressure import pressure, stored_energy


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
def _gradient_rows(p00, p10, p01, p11, scale, gx, gy, gz):
    """Mean gradient (1/s) of a velocity component over a run of cells; node rows as in :mod:`f2s_hpc.kernels.force`."""
    for i in range(gx.size):
        a0, a1, b0, b1 = p00[i], p00[i + 1], p10[i], p10[i + 1]
        c0, c1, d0, d1 = p01[i], p01[i + 1], p11[i], p11[i + 1]
        gx[i] = scale * ((a1 - a0) + (b1 - b0) + (c1 - c0) + (d1 - d0))
        gy[i] = scale * ((b0 - a0) + (b1 - a1) + (d0 - c0) + (d1 - c1))
        gz[i] = scale * ((c0 - a0) + (c1 - a1) + (d0 - b0) + (d1 - b1))


@kernel
def _trial_stress(sxx_row, syy_row, szz_row, sxy_row, syz_row, sxz_row, dt, shear_modulus, largest, g, trial, mises,
                  strain):
    """Rotate the old stress and add the elastic increment over a run of cells.

    The gradient is taken at the middle of the step, L (1 + dt L / 2)^-1 to second order; the rotation
    is the half-step Cayley form of the Jaumann rate (Hughes and Winget 1980), exact in the invariants.
    Light cells can see gradients that mean nothing; beyond ``largest`` per step the increment is scaled
    down. ``g``: nine rows of L; ``trial``: six rows; ``mises`` (Pa) and ``strain`` (equivalent
    increment): rows.
    """
    for n in range(mises.size):
        norm = 0.0
        for a in range(9):
            norm += g[a, n] * g[a, n]
        norm = math.sqrt(norm)
        h = dt * min(1.0, largest / max(dt * norm, 1e-300))
        xx, xy, xz = g[0, n], g[1, n], g[2, n]
        yx, yy, yz = g[3, n], g[4, n], g[5, n]
        zx, zy, zz = g[6, n], g[7, n], g[8, n]
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
        txx, txy, txz = rxx * sxx + rxy * sxy + rxz * sxz, rxx * sxy + rxy * syy + rxz * syz, \
            rxx * sxz + rxy * syz + rxz * szz
        tyx, tyy, tyz = ryx * sxx + ryy * sxy + ryz * sxz, ryx * sxy + ryy * syy + ryz * syz, \
            ryx * sxz + ryy * syz + ryz * szz
        tzx, tzy, tzz = rzx * sxx + rzy * sxy + rzz * sxz, rzx * sxy + rzy * syy + rzz * syz, \
            rzx * sxz + rzy * syz + rzz * szz
        two_g = 2.0 * shear_modulus
        qxx = txx * rxx + txy * rxy + txz * rxz + two_g * dxx
        qyy = tyx * ryx + tyy * ryy + tyz * ryz + two_g * dyy
        qzz = tzx * rzx + tzy * rzy + tzz * rzz + two_g * dzz
        qxy = txx * ryx + txy * ryy + txz * ryz + two_g * dxy
        qyz = tyx * rzx + tyy * rzy + tyz * rzz + two_g * dyz
        qxz = txx * rzx + txy * rzy + txz * rzz + two_g * dxz
        trial[0, n], trial[1, n], trial[2, n] = qxx, qyy, qzz
        trial[3, n], trial[4, n], trial[5, n] = qxy, qyz, qxz
        mises[n] = math.sqrt(1.5 * (qxx * qxx + qyy * qyy + qzz * qzz + 2.0 * (qxy * qxy + qyz * qyz + qxz * qxz)))
        strain[n] = math.sqrt(2.0 / 3.0 * (dxx * dxx + dyy * dyy + dzz * dzz
                                           + 2.0 * (dxy * dxy + dyz * dyz + dxz * dxz)))


@inlined
def closure(x, fraction, jacobian, energy, eos, spall):
    """Return the volume fraction of a cell after its volume changed by ``jacobian``.

    ``x``: mass in full cells; ``fraction`` before. The rule that keeps mixed cells sound: void
    closes before material is squeezed, a free surface carries no pressure, full material bears tension up to ``spall`` (Pa).
    """
    if x >= jacobian:
        return 1.0
    if fraction >= 1.0 and pressure(eos, x / jacobian, energy) > -spall:
        return 1.0
    return x / jacobian


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
    width = 0
    for r in range(count):
        width = max(width, runs[r, 3] - runs[r, 2])
    g, trial, pair = np.empty((9, width)), np.empty((6, width)), np.empty((2, width))
    volume = dx * dx * dx
    fastest, where = 0.0, 0
    for r in range(count):
        k, j = runs[r, 0], runs[r, 1]
        if k < window[0] or k >= window[1] or j < window[2] or j >= window[3]:
            continue
        first, last = max(runs[r, 2], window[4]), min(runs[r, 3], window[5])
        if last <= first:
            continue
        n1 = last - first
        cell = (k * ny + j) * nx + first
        a = (k * (ny + 1) + j) * (nx + 1) + first
        b, c, m = a + nx + 1, a + (nx + 1) * (ny + 1), n1 + 1
        d = c + nx + 1
        mises, strain = pair[0, :n1], pair[1, :n1]
        scale = 0.25 / dx
        _gradient_rows(u[a:a + m], u[b:b + m], u[c:c + m], u[d:d + m], scale, g[0, :n1], g[1, :n1], g[2, :n1])
        _gradient_rows(v[a:a + m], v[b:b + m], v[c:c + m], v[d:d + m], scale, g[3, :n1], g[4, :n1], g[5, :n1])
        _gradient_rows(w[a:a + m], w[b:b + m], w[c:c + m], w[d:d + m], scale, g[6, :n1], g[7, :n1], g[8, :n1])
        e1 = cell + n1
        _trial_stress(stress[0][cell:e1], stress[1][cell:e1], stress[2][cell:e1], stress[3][cell:e1],
                      stress[4][cell:e1], stress[5][cell:e1], dt, bulk.shear_modulus, largest, g, trial, mises, strain)
        for n in range(n1):
            c = cell + n
            x = mass[c]
            if x <= 0.0:
                continue
            e = energy[c] if energy.size > 1 else 0.0
            divergence = g[0, n] + g[4, n] + g[8, n]
            jacobian = 1.0 + dt * divergence
            before = fraction[c]
            after = closure(x, before, jacobian, e, eos, bulk.spall_pressure)
            if after >= 0.5:
                norm = 0.0
                for b in range(9):
                    norm += g[b, n] * g[b, n]
                if not norm <= fastest:
                    fastest, where = norm, c
            old = 0.0
            for b in range(3):
                old += stress[b][c] * stress[b][c] + 2.0 * stress[b + 3][c] * stress[b + 3][c]
            plastic, flow_now, _ = return_map(flow, mises[n], bulk.shear_modulus, peeq[c], dt, temperature[c],
                                              strain[n])
            ratio = 1.0
            if plastic > 0.0:
                ratio = flow_now / mises[n]
                peeq[c] += plastic
            inner_power = 0.0
            new = 0.0
            for b in range(6):
                s = ratio * trial[b, n]
                weight = 1.0 if b < 3 else 2.0
                new += weight * s * s
                mid = 0.5 * (s + stress[b][c])
                if b < 3:
                    inner_power += mid * g[4 * b, n]
                elif b == 3:
                    inner_power += mid * (g[1, n] + g[3, n])
                elif b == 4:
                    inner_power += mid * (g[5, n] + g[7, n])
                else:
                    inner_power += mid * (g[2, n] + g[6, n])
                stress[b][c] = s
            work = flow_now * plastic * after * jacobian
            viscous = 0.0
            if divergence < 0.0 and before >= 1.0:
                sound = math.sqrt((bulk.bulk_modulus + 4.0 / 3.0 * bulk.shear_modulus) / (bulk.density * x))
                viscous = -bulk.density * x * dx * divergence * (
                    viscosity[0] * sound - viscosity[1] * viscosity[1] * dx * divergence) * (-divergence) * dt
            heat = bulk.taylor_quinney * work + heat_viscous * viscous
            temperature[c] += heat / (x * bulk.density * bulk.specific_heat)
            p_old = pressure(eos, x, e) if before >= 1.0 else 0.0
            if energy.size > 1:
                deviatoric = dt * inner_power * after * jacobian + viscous
                x_new = x / jacobian if after >= 1.0 else 1.0
                p_new = pressure(eos, x_new, e) if after >= 1.0 else 0.0
                energy[c] = e + (deviatoric - 0.5 * (p_old + p_new) * dt * divergence) / (x * bulk.density)
            sums[0] += np.int64((before * old / (4.0 * bulk.shear_modulus)
                                 + (x * stored_energy(eos, x) if before >= 1.0 else 0.0)) * volume / quantum)
            sums[1] += np.int64((after * jacobian * new / (4.0 * bulk.shear_modulus)
                                 + (x * stored_energy(eos, x / jacobian) if after >= 1.0 else 0.0)) * volume / quantum)
            sums[2] += np.int64(work * volume / quantum)
            sums[3] += np.int64(heat * volume / quantum)
            fraction[c] = after
    return math.sqrt(fastest), where
