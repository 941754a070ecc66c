# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
B-splines that are not zero at a parameter, and their derivatives.

Source: de Boor 1972 for the recurrence.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True, error_model='numpy')
def basis_at(u, knot, degree, first, values, slopes):
    """
    Evaluate the splines that are not zero at each parameter.

    u       (M,) float64, in [0, 1]
    knot    (n,) float64, clamped
    degree  at least 1
    first   (M,) int64, out: the first that is not zero
    values  (M, degree + 1) float64, out
    slopes  (M, degree + 1) float64, out: derivatives
    """
    last = len(knot) - degree - 2
    lower = np.empty(degree + 1)
    for i in range(len(u)):
        t = u[i]
        span = min(max(np.searchsorted(knot, t, side='right') - 1, degree), last)
        first[i] = span - degree
        row = values[i]
        row[0] = 1.0
        for order in range(1, degree + 1):
            for k in range(order):
                lower[k] = row[k]
            row[0] = 0.0
            for k in range(order):
                left, right = knot[span + 1 - order + k], knot[span + 1 + k]
                share = (t - left) / (right - left) * lower[k]
                row[k] += lower[k] - share
                row[k + 1] = share
        slopes[i, 0] = 0.0
        for k in range(degree):
            slope = degree * lower[k] / (knot[span + 1 + k] - knot[span + 1 - degree + k])
            slopes[i, k] -= slope
            slopes[i, k + 1] = slope
