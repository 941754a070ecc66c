# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
B-splines that are not zero at a parameter, and height fields of them: heights, normal equations.

A place is worked on from its parameters to what it adds to a height or to the equations, in
registers: the sixteen weights of each in arrays of numpy take three times as long.

A band is symmetric and kept by rows: band[i, k] is the entry of row i and column i + k.

Source: de Boor 1972 for the recurrence.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True, error_model='numpy')
def nonzero(t, knot, degree, values, lower):
    """
    Evaluate the splines that are not zero at a parameter in [0, 1]; return the first of them.

    knot    (n,) float64, clamped, even in between
    values  (degree + 1,) float64, out
    lower   (degree + 1,) float64, out: those of one degree less
    """
    last = len(knot) - degree - 2
    span = min(degree + np.int64(t * (last + 1 - degree)), last)
    while span > degree and t < knot[span]:  # rounding
        span -= 1
    while span < last and t >= knot[span + 1]:
        span += 1
    values[0] = 1.0
    for order in range(1, degree + 1):
        for k in range(order):
            lower[k] = values[k]
        values[0] = 0.0
        for k in range(order):
            left, right = knot[span + 1 - order + k], knot[span + 1 + k]
            share = (t - left) / (right - left) * lower[k]
            values[k] += lower[k] - share
            values[k + 1] = share
    return span - degree


@njit(cache=True, nogil=True, error_model='numpy')
def basis_at(u, knot, degree, first, values, slopes):
    """
    Evaluate the splines that are not zero at each parameter.

    u       (M,) float64, in [0, 1]
    knot    (n,) float64, clamped, even in between
    degree  at least 1
    first   (M,) int64, out: the first that is not zero
    values  (M, degree + 1) float64, out
    slopes  (M, degree + 1) float64, out: derivatives
    """
    lower = np.empty(degree + 1)
    for i in range(len(u)):
        first[i] = nonzero(u[i], knot, degree, values[i], lower)
        slopes[i, 0] = 0.0
        for k in range(degree):
            left, right = knot[first[i] + 1 + k], knot[first[i] + degree + 1 + k]
            slope = degree * lower[k] / (right - left)
            slopes[i, k] -= slope
            slopes[i, k + 1] = slope


@njit(cache=True, nogil=True, error_model='numpy')
def parameter(x, origin, pitch, width):
    """Return the parameter of a coordinate, that of the end beyond it."""
    return min(max((x - origin + 0.5 * pitch) / width, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model='numpy')
def heights_at(xy, field, found):
    """
    Evaluate a height field.

    xy     (M, 2) float64, m
    field  origin (2,) float64, m; pitch, m; degrees: two; knots: two (n,) float64;
           control (Nx + 2, Ny + 2) float64, m
    found  (M,) float64, out, m
    """
    origin, pitch, degrees, knots, control = field
    knot_x, knot_y = knots
    degree_x, degree_y = degrees
    width_x, width_y = (control.shape[0] - 1) * pitch, (control.shape[1] - 1) * pitch
    x_values, y_values = np.empty(degree_x + 1), np.empty(degree_y + 1)
    lower = np.empty(max(degree_x, degree_y) + 1)
    for i in range(len(xy)):
        u = parameter(xy[i, 0], origin[0], pitch, width_x)
        v = parameter(xy[i, 1], origin[1], pitch, width_y)
        first_x = nonzero(u, knot_x, degree_x, x_values, lower)
        first_y = nonzero(v, knot_y, degree_y, y_values, lower)
        height = 0.0
        for j in range(degree_x + 1):
            along = 0.0
            for k in range(degree_y + 1):
                along += y_values[k] * control[first_x + j, first_y + k]
            height += x_values[j] * along
        found[i] = height


@njit(cache=True, nogil=True, error_model='numpy')
def add_equations(xyz, weight, field, band, right):
    """
    Add the normal equations of weighted least squares at places to a band, in place.

    xyz     (M, 3) float64, m
    weight  (M,) float64
    field   see heights_at
    band    (n, W) float64, n control points, y within x
    right   (n,) float64
    """
    origin, pitch, degrees, knots, control = field
    knot_x, knot_y = knots
    degree_x, degree_y = degrees
    num_y = control.shape[1]
    width_x, width_y = (control.shape[0] - 1) * pitch, (num_y - 1) * pitch
    x_values, y_values = np.empty(degree_x + 1), np.empty(degree_y + 1)
    lower = np.empty(max(degree_x, degree_y) + 1)
    across = degree_y + 1
    rows = np.empty((degree_x + 1) * across, np.int64)
    values = np.empty(len(rows))
    for i in range(len(xyz)):
        u = parameter(xyz[i, 0], origin[0], pitch, width_x)
        v = parameter(xyz[i, 1], origin[1], pitch, width_y)
        first_x = nonzero(u, knot_x, degree_x, x_values, lower)
        first_y = nonzero(v, knot_y, degree_y, y_values, lower)
        for j in range(degree_x + 1):
            for k in range(across):
                rows[j * across + k] = (first_x + j) * num_y + first_y + k
                values[j * across + k] = x_values[j] * y_values[k]
        for p in range(len(rows)):
            row, value = rows[p], weight[i] * values[p]
            right[row] += value * xyz[i, 2]
            for q in range(p, len(rows)):
                band[row, rows[q] - row] += value * values[q]


@njit(cache=True, nogil=True, error_model='numpy')
def add_differences(places_x, places_y, smoothing, band):
    """
    Add the squares of the second differences along both axes to a band, in place.

    places_x   (Nx + 2,) float64, where the control points stand along x; places_y likewise
    smoothing  what they are multiplied by
    band       (n, W) float64, n control points, y within x
    """
    num_x, num_y = len(places_x), len(places_y)
    second = np.empty(3)
    for axis in range(2):
        places = places_x if axis == 0 else places_y
        step, others = (num_y, num_y) if axis == 0 else (1, num_x)
        for i in range(len(places) - 2):
            before, after = places[i + 1] - places[i], places[i + 2] - places[i + 1]
            second[0] = 2.0 * after / (before + after)
            second[1] = -2.0
            second[2] = 2.0 * before / (before + after)
            for other in range(others):
                first = i * num_y + other if axis == 0 else other * num_y + i
                for j in range(3):
                    for k in range(j, 3):
                        product = smoothing * second[j] * second[k]
                        band[first + j * step, (k - j) * step] += product
