# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Residuals of quadrics and quartics over the points of cubes.

A cube has at most 64 points. In numpy, batches of such small matrices take three times as long.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel

QUADRIC, QUARTIC = 6, 15
"""Terms of height fields."""

TRIMMING_ROUNDS = 2
"""Fits of a cube without its outliers; one leaves a tenth of outliers half of their effect."""

MEDIAN_TO_SIGMA = 1.4826
"""Sigma of normally distributed values by the median of their absolute values."""

RIDGE = 1e-10
"""Added to the normal equations, relative to the weight, for points in one line."""


@kernel(error_model='numpy', fastmath={'reassoc'})
def fit_heights(basis, weight, order, factor, away):
    """
    Subtract from heights their best fit by the first terms of a basis.

    basis   (QUARTIC + 1, n) float64, terms at each point, and its height
    weight  (n,) float64
    order   number of terms
    factor  (QUARTIC + 1, QUARTIC) float64, scratch: Cholesky factor and, below it, coefficients
    away    (n,) float64, out
    """
    ridge = RIDGE * weight.sum()
    for p in range(order + 1):
        row = QUARTIC if p == order else p
        for q in range(min(p, order - 1) + 1):
            total = ridge if p == q else 0.0
            for i in range(len(weight)):
                total += weight[i] * basis[row, i] * basis[q, i]
            for m in range(q):
                total -= factor[p, m] * factor[q, m]
            factor[p, q] = math.sqrt(max(total, ridge)) if p == q else total / factor[q, q]
    away[:] = basis[QUARTIC]
    for p in range(order - 1, -1, -1):
        for m in range(p + 1, order):
            factor[order, p] -= factor[m, p] * factor[order, m]
        factor[order, p] /= factor[p, p]
        for i in range(len(weight)):
            away[i] -= factor[order, p] * basis[p, i]


@kernel(error_model='numpy')
def trimmed_sigmas(points, weight, sigma, quartic, kept):
    """
    Compute residuals of quadrics and quartics without the points beyond three sigma.

    points  (B, n, 3) float64, height over x and y
    weight  (B, n) float64, of points; 0 for none
    sigma   (B,) float64, out: residual of the quadric
    quartic (B,) float64, out: residual of the quartic
    kept    (B,) float64, out: share of the points that remain
    """
    number = points.shape[1]
    basis, factor = np.empty((QUARTIC + 1, number)), np.empty((QUARTIC + 1, QUARTIC))
    away, sizes, used = np.empty(number), np.empty(number), np.empty(number)
    for b in range(len(points)):
        for i in range(number):
            basis[0, i], basis[QUARTIC, i], k = 1.0, points[b, i, 2], 1
            for degree in range(1, 5):
                for _ in range(degree):
                    basis[k, i] = points[b, i, 0] * basis[k - degree, i]
                    k += 1
                basis[k, i] = points[b, i, 1] * basis[k - degree - 1, i]
                k += 1
        used[:] = weight[b]
        for _ in range(TRIMMING_ROUNDS):
            fit_heights(basis, used, QUADRIC, factor, away)
            num = 0
            for i in range(number):
                sizes[num] = abs(away[i])
                num += weight[b, i] > 0.0
            limit = 3.0 * MEDIAN_TO_SIGMA * np.sort(sizes[:num])[(num - 1) // 2]
            for i in range(number):
                used[i] = weight[b, i] if abs(away[i]) <= limit else 0.0
        total = used.sum()
        effective = total * total / (used * used).sum()
        kept[b] = total / weight[b].sum()
        for order, residual in ((QUADRIC, sigma), (QUARTIC, quartic)):
            fit_heights(basis, used, order, factor, away)
            variance = (used * away * away).sum() / total
            residual[b] = math.sqrt(variance / max(1.0 - order / effective, 0.1))
