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


STEEP = 1e9
"""Slope of the first logarithm of the ratio, 1/m: points on either side of a plane are apart."""


@inlined(error_model='numpy')
def split_mixture(x, y, z, mean, plane, total, second, quadric, share):
    """
    Compute for each point the responsibility of the second of two Gaussians.

    x, y, z          (n,) float64, m
    mean             (3,) float64, of the points
    plane            (4,) float64, normal and offset from the mean: where EM starts
    total            (TERMS,) float64, moments of the points about the mean
    second, quadric  (TERMS,) float64, scratch
    share            (n,) float64, out: responsibility of the second Gaussian
    """
    quadric[:] = 0.0
    quadric[0] = STEEP * plane[3]
    for j in range(3):
        quadric[1 + j] = -STEEP * plane[j]
    for iteration in range(ITERATIONS + 1):
        changing = em_step(x, y, z, mean, share, quadric, second)
        quadric[:] = 0.0
        if iteration > 0 and changing == 0.0:
            break
        for side in range(2):
            is_empty = not subtract_log_density(second, total[0], quadric, 1.0 - 2.0 * side)
            for k in range(TERMS):
                second[k] = total[k] - second[k]
            if is_empty:
                return


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
