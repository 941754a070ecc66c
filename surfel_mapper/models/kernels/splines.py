# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
B-splines: basis functions at many parameters, tensor products, and the band of their equations.

A room has dozens of curved patches of some thousand points. In numpy half of the time of a fit was
spent here, in a dozen passes over short arrays for each patch.

Source: de Boor 1978 (the recurrence).
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel


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
                part = values[m, k] / (high - low)
                if order == degree:
                    slopes[m, k] = slope - degree * part
                    slope = degree * part
                values[m, k] = carried + (high - x) * part
                carried = (x - low) * part
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
def tensor_rows(first_x, along_x, first_y, along_y, num_y, rows, weights):
    """
    List the control points on which each location depends, y within x, and their weights.

    num_y    control points along y
    rows     (M, W) int64, out
    weights  (M, W) float64, out
    """
    for m in range(len(rows)):
        k = 0
        for i in range(along_x.shape[1]):
            for j in range(along_y.shape[1]):
                rows[m, k] = (first_x[m] + i) * num_y + first_y[m] + j
                weights[m, k] = along_x[m, i] * along_y[m, j]
                k += 1


@kernel(error_model='numpy')
def add_equations(rows, weights, z, share, band, right):
    """
    Add the normal equations of samples to a lower band and a right side.

    rows, weights  (M, W): see tensor_rows; rows ascend
    z, share       (M,) float64, heights and weights of the samples
    band           (B, N) float64, in place: element k, i is that of row i + k, column i
    right          (N,) float64, in place
    """
    for m in range(len(z)):
        for i in range(rows.shape[1]):
            weighted, column = share[m] * weights[m, i], rows[m, i]
            right[column] += weighted * z[m]
            for j in range(i, rows.shape[1]):
                band[rows[m, j] - column, column] += weighted * weights[m, j]
