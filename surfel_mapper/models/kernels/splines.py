# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
B-splines: basis functions at many parameters, and sums of their tensor products.

A room has dozens of curved patches of some thousand points. In numpy half of the time of a fit was
spent here, in a dozen passes over short arrays for each patch.

Source: de Boor 1978 (the recurrence).
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel, U


@kernel(error_model='numpy')
def basis_functions(u, knot, degree, first, values, slopes):
    """
    Evaluate the basis functions that are not 0 at each parameter.

    u       (M,) float64 in [0, 1]; nan gives nan
    knot    (n,) float64, clamped, with equal steps between
    first   (M,) int64, out: index of the first of the functions
    values  (M, degree + 1) float64, out
    slopes  (M, degree + 1) float64, out: their derivatives
    """
    last = len(knot) - degree - 2
    for m in range(len(u)):
        x = 1.0 if math.isnan(u[m]) else u[m]
        span = min(np.int64(x * (last + 1 - degree)) + degree, last)
        if span > degree and x < knot[span]:  # rounding
            span -= 1
        elif span < last and x >= knot[span + 1]:
            span += 1
        first[m] = span - degree
        values[m, 0], slopes[m, 0] = (1.0 if x == u[m] else math.nan), 0.0
        for order in range(1, degree + 1):
            values[m, order] = slopes[m, order] = 0.0
            carried = slope = 0.0
            for k in range(order):
                low, high = knot[span + 1 - order + k], knot[span + 1 + k]
                quotient = values[m, k] / (high - low)
                if order == degree:
                    slopes[m, k] = slope - degree * quotient
                    slope = degree * quotient
                values[m, k] = carried + (high - x) * quotient
                carried = (x - low) * quotient
            values[m, order] = carried
            if order == degree:
                slopes[m, order] = slope


@kernel(error_model='numpy')
def tensor_heights(first_x, along_x, first_y, along_y, control, heights):
    """
    Sum the control points (Nx, Ny) by the products of basis functions, into heights (M,).

    first_x, along_x  (M,) int64, (M, degree + 1) float64: see basis_functions; y alike
    """
    for m in range(len(heights)):
        total = 0.0
        for i in range(along_x.shape[1]):
            row = 0.0
            for j in range(along_y.shape[1]):
                row += along_y[m, j] * control[first_x[m] + i, first_y[m] + j]
            total += along_x[m, i] * row
        heights[m] = total


@kernel(error_model='numpy')
def sum_equations(bases, share, z, columns, band, right):
    """
    Sum the lower band (number, width) and right side (number,) of normal equations.

    bases    of tensor_heights: first_x, along_x, first_y, along_y
    share, z (M,) float64, weights and values of the samples
    columns  control points along y
    band     element c, k is that of row c + k, column c; changed in place, as right is
    """
    first_x, x, first_y, y = bases
    for m in range(len(z)):
        corner = first_x[m] * columns + first_y[m]
        for k in range(x.shape[1]):
            for n in range(y.shape[1]):
                row, weight = corner + k * columns + n, share[m] * x[m, k] * y[m, n]
                right[row] += weight * z[m]
                for i in range(k, x.shape[1]):
                    product, shift = weight * x[m, i], (i - k) * columns - n
                    for j in range(n if i == k else 0, y.shape[1]):
                        band[U(row), U(shift + j)] += product * y[m, U(j)]
