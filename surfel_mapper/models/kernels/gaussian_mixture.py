# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Split points by a mixture of two Gaussians, by expectation maximisation (EM).

Each iteration is one pass over the points: the logarithm of the ratio of two Gaussians is one
quadric, and the moments of the first component are the total less those of the second.
Coordinates are three arrays, sums may be taken in any order (reassoc) and the exponential is a
polynomial, so that the compiler vectorises over four points: 6 ns a point and iteration.

Source: Dempster, Laird and Rubin 1977; covariances are regularised, as those of few points are
singular.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

ITERATIONS = 10
"""Most EM iterations."""
SETTLED = 1e-2
"""EM stops when no responsibility changes by more than this."""

LEAST_WEIGHT = 1e-6
"""A component with a smaller sum of responsibilities is empty."""

C2, C3, C4, C5, C6, C7, C8 = (1.0 / math.factorial(k) for k in range(2, 9))
"""Taylor coefficients of the exponential; the error is 1e-10."""

TERMS = 10
"""1, x, y, z, xx, xy, xz, yy, yz, zz: moments, and coefficients of a quadric."""


@inlined(error_model='numpy')
def split_mixture(x, y, z, mean, share):
    """
    Compute for each point the responsibility of the second of two Gaussians.

    x, y, z  (n,) float64, m
    mean     (3,) float64, of the points
    share    (n,) float64, in place: responsibility of the second Gaussian; 0 or 1 at the start
    """
    total, second, quadric = np.empty(TERMS), np.empty(TERMS), np.empty(TERMS)
    sum_moments(x, y, z, mean, share, total, second)
    for _ in range(ITERATIONS):
        quadric[:] = 0.0
        if not subtract_log_density(second, total[0], quadric, 1.0):
            break
        for k in range(TERMS):
            second[k] = total[k] - second[k]
        if not subtract_log_density(second, total[0], quadric, -1.0):
            break
        if em_step(x, y, z, mean, share, quadric, second) == 0.0:
            break


@kernel(error_model='numpy', fastmath={'reassoc'})
def em_step(x, y, z, mean, share, quadric, second):
    """Update responsibilities and moments of the second component; return how many change."""
    mx, my, mz = mean[0], mean[1], mean[2]
    q0, qx, qy, qz = quadric[0], quadric[1], quadric[2], quadric[3]
    qxx, qxy, qxz = quadric[4], quadric[5], quadric[6]
    qyy, qyz, qzz = quadric[7], quadric[8], quadric[9]
    w0 = wx = wy = wz = 0.0
    wxx = wxy = wxz = wyy = wyz = wzz = 0.0
    changing = 0.0
    for i in range(len(x)):
        a, b, c = x[i] - mx, y[i] - my, z[i] - mz
        against = (
            q0
            + a * (qx + qxx * a + qxy * b + qxz * c)
            + b * (qy + qyy * b + qyz * c)
            + c * (qz + qzz * c)
        )
        # exp(against) is exp(against / 256)^256, and beyond 40 the share is 0 or 1 all the same
        t = 40.0 if against > 40.0 else against
        t = (-40.0 if t < -40.0 else t) * (1.0 / 256.0)
        e = C5 + t * (C6 + t * (C7 + t * C8))
        e = 1.0 + t * (1.0 + t * (C2 + t * (C3 + t * (C4 + t * e))))
        e *= e
        e *= e
        e *= e
        e *= e
        e *= e
        e *= e
        e *= e
        e *= e
        new = 1.0 / (1.0 + e)
        changing += 1.0 if abs(new - share[i]) >= SETTLED else 0.0
        share[i] = new
        u, v, w = new * a, new * b, new * c
        w0 += new
        wx += u
        wy += v
        wz += w
        wxx += u * a
        wxy += u * b
        wxz += u * c
        wyy += v * b
        wyz += v * c
        wzz += w * c
    second[0], second[1], second[2], second[3] = w0, wx, wy, wz
    second[4], second[5], second[6] = wxx, wxy, wxz
    second[7], second[8], second[9] = wyy, wyz, wzz
    return changing


@inlined(error_model='numpy')
def sum_moments(x, y, z, mean, share, total, second):
    """Sum the moments (TERMS,) about the mean, of all points and of the second component."""
    for side in range(2):
        moments = second if side else total
        moments[:] = 0.0
        for i in range(len(x)):
            weight = share[i] if side else 1.0
            add_moments(moments, weight, x[i] - mean[0], y[i] - mean[1], z[i] - mean[2])


@inlined(error_model='numpy')
def add_moments(moments, weight, x, y, z):
    """Add a weighted point to moments (TERMS,)."""
    moments[0] += weight
    moments[1] += weight * x
    moments[2] += weight * y
    moments[3] += weight * z
    moments[4] += weight * x * x
    moments[5] += weight * x * y
    moments[6] += weight * x * z
    moments[7] += weight * y * y
    moments[8] += weight * y * z
    moments[9] += weight * z * z


@kernel(error_model='numpy')
def subtract_log_density(moments, number, quadric, factor):
    """
    Subtract factor times the logarithm of a Gaussian's weighted density; False if it is empty.

    moments  (TERMS,) float64, of its points
    number   of all points
    quadric  (TERMS,) float64, in place: coefficients
    """
    weight = moments[0]
    if weight < LEAST_WEIGHT:
        return False
    mx, my, mz = moments[1] / weight, moments[2] / weight, moments[3] / weight
    xx, xy = moments[4] / weight - mx * mx, moments[5] / weight - mx * my
    xz, yy = moments[6] / weight - mx * mz, moments[7] / weight - my * my
    yz, zz = moments[8] / weight - my * mz, moments[9] / weight - mz * mz
    add = 1e-8 + 1e-4 * max(xx + yy + zz, 0.0) / 3.0
    # lower Cholesky factor, then its inverse
    l11 = math.sqrt(max(xx, 0.0) + add)
    l21, l31 = xy / l11, xz / l11
    l22 = math.sqrt(max(yy + add - l21 * l21, 0.5 * add))
    l32 = (yz - l31 * l21) / l22
    l33 = math.sqrt(max(zz + add - l31 * l31 - l32 * l32, 0.5 * add))
    a, c, f = 1.0 / l11, 1.0 / l22, 1.0 / l33
    b, e = -l21 * a * c, -l32 * c * f
    d = -(l31 * a + l32 * b) * f
    # inverse covariance
    ixx, ixy, ixz = a * a + b * b + d * d, b * c + d * e, d * f
    iyy, iyz, izz = c * c + e * e, e * f, f * f
    half = 0.5 * factor
    tx = ixx * mx + ixy * my + ixz * mz
    ty = ixy * mx + iyy * my + iyz * mz
    tz = ixz * mx + iyz * my + izz * mz
    quadric[0] += half * (tx * mx + ty * my + tz * mz)
    quadric[0] -= factor * (math.log(weight / number) + math.log(a * c * f))
    quadric[1] -= factor * tx
    quadric[2] -= factor * ty
    quadric[3] -= factor * tz
    quadric[4] += half * ixx
    quadric[5] += factor * ixy
    quadric[6] += factor * ixz
    quadric[7] += half * iyy
    quadric[8] += factor * iyz
    quadric[9] += half * izz
    return True
