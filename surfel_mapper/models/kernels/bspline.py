# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
B-spline basis functions, height fields of them, and their normal equations.

Each sample is processed in registers: temporary arrays of its sixteen weights take three times as
long. For a field of a hundred control points, LAPACK's argument checks take longer than the solve.

The normal equations are a symmetric matrix of the control points, counted y within x, of which the
entries on and above the diagonal are stored by rows, in one of two layouts:

band      band[i, k] is the entry of row i and column i + k
stencils  stencils[i, dx * stride + dy] is the entry of row i and the control point dx and dy
          farther, both up to a reach, stride = 2 reach + 1: 25 columns for degree 3

The same kernels add to both, as dx * Ny + dy is the column of a band, so this is one module.
Vectors that stencils are multiplied with continue with zeros, up to the largest offset.

Source: de Boor 1972 (recurrence); Golub and Van Loan, Matrix Computations, sections 4.3 (banded
Cholesky factorisation) and 10.1 (Gauss-Seidel); Hackbusch 1985 (coarse matrices).
"""

import math

from numba import njit
import numpy as np


@njit(cache=True, nogil=True, error_model='numpy')
def nonzero(t, knot, degree, values, lower):
    """
    Evaluate the basis functions that are non-zero at a parameter; return the index of the first.

    t       parameter in [0, 1], or nan
    knot    (n,) float64, clamped, uniform in between
    values  (degree + 1,) float64, out; nan for nan
    lower   (degree + 1,) float64, out: the basis functions of one degree less
    """
    last = len(knot) - degree - 2
    span = last if math.isnan(t) else min(degree + np.int64(t * (last + 1 - degree)), last)
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
def evaluate_basis(u, knot, degree, first, values, slopes):
    """
    Evaluate the non-zero basis functions at each parameter.

    u       (M,) float64, in [0, 1]
    knot    (n,) float64, clamped, uniform in between
    degree  at least 1
    first   (M,) int64, out: index of the first non-zero one
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
    """Return the parameter of a coordinate, clamped to the ends of the field."""
    return min(max((x - origin + 0.5 * pitch) / width, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model='numpy')
def evaluate_field(xy, field, height):
    """
    Evaluate a height field.

    xy      (M, 2) float64, m
    field   origin (2,) float64, m; pitch, m; degrees: two; knots: two (n,) float64;
            control (Nx + 2, Ny + 2) float64, m
    height  (M,) float64, out, m
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
        total = 0.0
        for j in range(degree_x + 1):
            along = 0.0
            for k in range(degree_y + 1):
                along += y_values[k] * control[first_x + j, first_y + k]
            total += x_values[j] * along
        height[i] = total


@njit(cache=True, nogil=True, error_model='numpy')
def add_equations(xyz, weight, field, stride, matrix, right):
    """
    Add the normal equations of weighted least squares for samples to a matrix, in place.

    xyz     (M, 3) float64, m
    weight  (M,) float64
    field   see evaluate_field
    stride  of the columns, from a control point to the next along x
    matrix  (n, W) float64, n control points: a band or stencils
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
    columns, values = np.empty(len(rows), np.int64), np.empty(len(rows))
    for p in range(len(rows)):
        columns[p] = p // across * stride + p % across
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
                matrix[row, columns[q] - columns[p]] += value * values[q]


@njit(cache=True, nogil=True, error_model='numpy')
def add_differences(places_x, places_y, smoothing, stride, matrix):
    """
    Add the squared second differences along both axes to a matrix, in place.

    places_x   (Nx + 2,) float64, Greville abscissae along x; places_y: along y
    smoothing  weight of the squares
    stride     of the columns, from a control point to the next along x
    matrix     (n, W) float64, n control points: a band or stencils
    """
    num_x, num_y = len(places_x), len(places_y)
    second = np.empty(3)
    for axis in range(2):
        places = places_x if axis == 0 else places_y
        step, apart, others = (num_y, stride, num_y) if axis == 0 else (1, 1, num_x)
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
                        matrix[first + j * step, (k - j) * apart] += product


@njit(cache=True, nogil=True, error_model='numpy')
def solve_band(band, right):
    """
    Solve a positive definite system, in place.

    band   (n, W) float64, stored by rows; becomes the upper Cholesky factor
    right  (n,) float64; becomes the solution
    """
    number, width = band.shape
    for i in range(number):
        inverse = 1.0 / math.sqrt(band[i, 0])
        reach = min(width, number - i)
        for k in range(reach):
            band[i, k] *= inverse
        right[i] *= inverse
        for k in range(1, reach):
            factor = band[i, k]
            if factor != 0.0:
                right[i + k] -= factor * right[i]
                for m in range(reach - k):
                    band[i + k, m] -= factor * band[i, k + m]
    for i in range(number - 1, -1, -1):
        value = right[i]
        for k in range(1, min(width, number - i)):
            value -= band[i, k] * right[i + k]
        right[i] = value / band[i, 0]


@njit(cache=True, nogil=True, error_model='numpy')
def multiply_stencils(stencils, offsets, x, result):
    """
    Multiply a vector by a matrix.

    stencils  (n, W) float64
    offsets   (W,) int64, from a control point to that of each column; the first is 0
    x         (n + the largest offset,) float64, 0 from n on
    result    like x, out
    """
    result[:] = 0.0
    for i in range(len(stencils)):
        value, total = x[i], stencils[i, 0] * x[i]
        for k in range(1, len(offsets)):
            other = np.uint64(i + offsets[k])  # unsigned: no wrap-around checks
            total += stencils[i, k] * x[other]
            result[other] += stencils[i, k] * value
        result[i] += total


@njit(cache=True, nogil=True, error_model='numpy')
def relax_forward(stencils, offsets, right, x, residual):
    """
    Start from 0 and make a Gauss-Seidel sweep, first control point first.

    stencils, offsets   see multiply_stencils
    right, x, residual  vectors like x there; x and residual are out

    With the matrix L + D + U, the sweep solves (L + D) x = right: the residual is -U x.
    """
    x[:] = right
    for i in range(len(stencils)):
        x[i] = value = x[i] / stencils[i, 0]
        for k in range(1, len(offsets)):
            x[np.uint64(i + offsets[k])] -= stencils[i, k] * value
    for i in range(len(stencils)):
        total = 0.0
        for k in range(1, len(offsets)):
            total -= stencils[i, k] * x[np.uint64(i + offsets[k])]
        residual[i] = total


@njit(cache=True, nogil=True, error_model='numpy')
def relax_backward(stencils, offsets, right, x, rest):
    """
    Make a Gauss-Seidel sweep, last control point first, in place: the adjoint of relax_forward.

    stencils, offsets  see multiply_stencils
    right, x, rest     vectors like x there; x is changed, rest is out: right - L x
    """
    rest[:] = right
    for i in range(len(stencils)):
        value = x[i]
        for k in range(1, len(offsets)):
            rest[np.uint64(i + offsets[k])] -= stencils[i, k] * value
    for i in range(len(stencils) - 1, -1, -1):
        total = rest[i]
        for k in range(1, len(offsets)):
            total -= stencils[i, k] * x[np.uint64(i + offsets[k])]
        x[i] = total / stencils[i, 0]


@njit(cache=True, nogil=True, error_model='numpy')
def coarsen_stencils(stencils, num_y, reach, coarse):
    """
    Halve the control points along x, and exchange the axes.

    stencils  (num_x * num_y, W) float64, A
    num_y     control points along y
    reach     of the stencils, at least 3
    coarse    (num_y * ((num_x + 5) // 2), W) float64, all 0; out, x within y: P^T A P, where
              P refines a uniform cubic spline along x
    """
    stride, num_x = 2 * reach + 1, len(stencils) // num_y
    halves = (num_x + 5) // 2
    share = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 8.0
    for i in range(len(stencils)):
        x, y = i // num_y, i % num_y
        for dx in range(reach + 1):
            for dy in range(0 if dx == 0 else -reach, reach + 1):
                entry, both = stencils[i, dx * stride + dy], dx > 0 or dy != 0
                if entry == 0.0:
                    continue
                for one in range((x + 1) // 2, (x + 4) // 2 + 1):
                    part = entry * share[x + 4 - 2 * one]
                    for two in range((x + dx + 1) // 2, (x + dx + 4) // 2 + 1):
                        value, step = part * share[x + dx + 4 - 2 * two], two - one
                        if dy > 0 or (dy == 0 and step > 0):
                            coarse[y * halves + one, dy * stride + step] += value
                        elif dy == 0 and step == 0:
                            coarse[y * halves + one, 0] += 2.0 * value if both else value
                        elif both:
                            coarse[(y + dy) * halves + two, -dy * stride - step] += value


@njit(cache=True, nogil=True, error_model='numpy')
def clamped_knots(num_cells, degree):
    """Return the clamped knots in [0, 1] for num_cells + 2 control points."""
    pieces = num_cells + 2 - degree
    knot = np.zeros(num_cells + degree + 3)
    for k in range(1, pieces):
        knot[degree + k] = k / pieces
    knot[degree + pieces :] = 1.0
    return knot


@njit(cache=True, nogil=True, error_model='numpy')
def greville_places(knot, degree, pitch):
    """Return the Greville abscissae (N + 2,) of clamped knots, m, from the lowest corner."""
    places = np.zeros(len(knot) - degree - 1)
    scale = (len(places) - 1) / degree
    for i in range(len(places)):
        for k in range(1, degree + 1):
            places[i] += knot[i + k]
        places[i] = pitch * (places[i] * scale - 0.5)
    return places


@njit(cache=True, nogil=True, error_model='numpy')
def fit_fields(sums, cells, chosen, pitches, origins, rules, begin, control, heights):
    """
    Fit small height fields to the means of their cells.

    One call for all: for a field of a hundred control points, NumPy's calls take ten times as
    long as the solve.

    sums      (C, 4) float64, sums of x, y, z and number of the points in every cell
    cells     first (K,) int64, first cell of each patch, y within x; sizes (K, 2) int64
    chosen    (F,) int64, patches to fit
    pitches   (K,) float64, m
    origins   (K, 2) float64, m, lowest corner of each grid
    rules     degree, weight of the second differences, weight that pulls to 0
    begin     (F,) int64, first control point of each field
    control   (P,) float64, out: heights of the control points, y within x, m
    heights   (C,) float64, out for cells of chosen patches: mean heights, nan if empty, m
    """
    first, sizes = cells
    degree, smoothing, ridge = rules
    for f in range(len(chosen)):
        patch = chosen[f]
        long = 0 if sizes[patch, 0] >= sizes[patch, 1] else 1  # the bandwidth is the short side
        num_x, num_y = sizes[patch, long] + 2, sizes[patch, 1 - long] + 2
        low, num = first[patch], sizes[patch, 0] * sizes[patch, 1]
        xyz, weight, used, total = np.empty((num, 3)), np.empty(num), 0, 0.0
        for cell in range(low, low + num):
            points = sums[cell, 3]
            heights[cell] = sums[cell, 2] / points if points > 0.0 else np.nan
            if points > 0.0:
                xyz[used, 0] = sums[cell, long] / points
                xyz[used, 1] = sums[cell, 1 - long] / points
                xyz[used, 2], weight[used] = heights[cell], points
                total += points
                used += 1
        weight[:used] *= used / total
        degrees = min(degree, num_x - 1), min(degree, num_y - 1)
        knot = clamped_knots(num_x - 2, degrees[0]), clamped_knots(num_y - 2, degrees[1])
        pitch, origin = pitches[patch], np.empty(2)
        origin[0], origin[1] = origins[patch, long], origins[patch, 1 - long]
        width = max(degrees[0] * num_y + degrees[1], 2 * num_y) + 1
        band, right = np.zeros((num_x * num_y, width)), np.zeros(num_x * num_y)
        field = origin, pitch, degrees, knot, np.empty((num_x, num_y))
        add_equations(xyz[:used], weight[:used], field, num_y, band, right)
        places_x = greville_places(knot[0], degrees[0], pitch)
        places_y = greville_places(knot[1], degrees[1], pitch)
        add_differences(places_x, places_y, smoothing, num_y, band)
        for i in range(len(right)):
            band[i, 0] += ridge
        solve_band(band, right)
        for i in range(num_x):
            for j in range(num_y):
                to = i * num_y + j if long == 0 else j * num_x + i
                control[begin[f] + to] = right[i * num_y + j]


@njit(cache=True, nogil=True, error_model='numpy')
def rms_off_field(rows, surfel, frame, origin, field):
    """
    Return the root mean square distance of the points of voxels from a field, m.

    rows    (n,) int32
    surfel  count (R,) int64; position (R, 3) m; eigenvalues (R, 3) m^2, ascending
    frame   (3, 3) float64, rows x, y, z of the field
    origin  (3,) float64, m, of the frame
    field   see evaluate_field
    """
    count, position, eigenvalues = surfel
    local, found = np.empty((len(rows), 3)), np.empty(len(rows))
    for i in range(len(rows)):
        for k in range(3):
            local[i, k] = 0.0
            for j in range(3):
                local[i, k] += frame[k, j] * (position[rows[i], j] - origin[j])
    evaluate_field(local, field, found)
    total = points = 0.0
    for i in range(len(rows)):
        number, away = np.float64(count[rows[i]]), local[i, 2] - found[i]
        points += number
        total += number * (away * away + eigenvalues[rows[i], 0])
    return math.sqrt(total / points)
