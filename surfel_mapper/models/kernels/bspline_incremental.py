# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Incremental least squares of large height fields, by conjugate gradients from the previous fit.

A banded solve for a street's ground, 26,000 control points, takes seconds; from the previous
field, conjugate gradients take a few steps. Control points on which no covered cell depends are
excluded: their equations are ill-conditioned, and they are never evaluated.

Source: Golub and Van Loan, Matrix Computations, section 11.5 (Jacobi preconditioner).
"""

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.bspline import nonzero, parameter

MOST_STEPS = 200
"""Most conjugate gradient steps of one fit."""


@njit(cache=True, nogil=True, error_model='numpy')
def mark_active(filled, field, active):
    """
    Mark the control points on which heights in filled cells depend.

    filled  (Nx, Ny) bool
    field   see evaluate_field
    active  (Nx + 2, Ny + 2) bool, all False; out
    """
    _, pitch, degrees, knots, control = field
    values, lower = np.empty(degrees[0] + degrees[1] + 2), np.empty(degrees[0] + degrees[1] + 2)
    ends = np.empty((2, max(filled.shape), 2), np.int64)
    for axis in range(2):
        degree, knot = degrees[axis], knots[axis]
        width = (control.shape[axis] - 1) * pitch
        for i in range(filled.shape[axis]):
            for side in range(2):
                u = parameter((i + side) * pitch, 0.0, pitch, width)
                first = nonzero(u, knot, degree, values, lower)
                ends[axis, i, side] = first if side == 0 else first + degree + 1
    for i in range(filled.shape[0]):
        for j in range(filled.shape[1]):
            if filled[i, j]:
                for x in range(ends[0, i, 0], ends[0, i, 1]):
                    for y in range(ends[1, j, 0], ends[1, j, 1]):
                        active[x, y] = True


@njit(cache=True, nogil=True, error_model='numpy')
def mark_near(touched, margin, active, free):
    """
    Mark the active control points near touched cells.

    touched  (Nx, Ny) bool
    margin   cells
    active   (Nx + 2, Ny + 2) bool
    free     (Nx + 2, Ny + 2) bool, all False; out
    """
    for i in range(touched.shape[0]):
        for j in range(touched.shape[1]):
            if touched[i, j]:
                for x in range(max(i + 1 - margin, 0), min(i + 2 + margin, free.shape[0])):
                    for y in range(max(j + 1 - margin, 0), min(j + 2 + margin, free.shape[1])):
                        free[x, y] |= active[x, y]


@njit(cache=True, nogil=True, error_model='numpy')
def extrapolate(control, known, active):
    """
    Set active control points of unknown height to the mean of known neighbours, outwards.

    control  (Nx + 2, Ny + 2) float64, m, in place
    known    (Nx + 2, Ny + 2) bool, in place; all that are active become known
    active   (Nx + 2, Ny + 2) bool
    """
    num_x, num_y = control.shape
    found = True
    while found:
        found = False
        before = known.copy()
        for i in range(num_x):
            for j in range(num_y):
                if known[i, j] or not active[i, j]:
                    continue
                total, number = 0.0, 0
                for x in range(max(i - 1, 0), min(i + 2, num_x)):
                    for y in range(max(j - 1, 0), min(j + 2, num_y)):
                        if before[x, y]:
                            total += control[x, y]
                            number += 1
                if number:
                    control[i, j] = total / number
                    known[i, j] = found = True


@njit(cache=True, nogil=True, error_model='numpy')
def equations(xyz, field, free, first, values):
    """
    List the samples that depend on free control points; return how many there are.

    xyz     (M, 3) float64, m
    field   see evaluate_field; degrees are 3
    free    (Nx + 2, Ny + 2) bool
    first   (M, 2) int64, out: first control point, counted y within x; row of xyz
    values  (M, 2, 4) float64, out: the basis functions along x and y
    """
    origin, pitch, _, knots, control = field
    lower = np.empty(4)
    num_y = control.shape[1]
    width_x, width_y = (control.shape[0] - 1) * pitch, (num_y - 1) * pitch
    num = 0
    for i in range(len(xyz)):
        u = parameter(xyz[i, 0], origin[0], pitch, width_x)
        v = parameter(xyz[i, 1], origin[1], pitch, width_y)
        x = nonzero(u, knots[0], 3, values[num, 0], lower)
        y = nonzero(v, knots[1], 3, values[num, 1], lower)
        some = False
        for j in range(4):
            for k in range(4):
                some |= free[x + j, y + k]
        if some:
            first[num, 0], first[num, 1] = x * num_y + y, i
            num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def second_differences(places, axis, active, free, at, second):
    """
    List the second differences along an axis of active control points, with at least one free.

    places  (N,) float64, Greville abscissae along the axis
    at      (T, 2) int64, out: first of three control points, and the step to the next
    second  (T, 3) float64, out: their coefficients

    Returns how many there are.
    """
    num_x, num_y = active.shape
    dx = 1 - axis
    num = 0
    for i in range(num_x - 2 * dx):
        for j in range(num_y - 2 * axis):
            every, some = True, False
            for k in range(3):
                every &= active[i + k * dx, j + k * axis]
                some |= free[i + k * dx, j + k * axis]
            if every and some:
                here = i if axis == 0 else j
                before = places[here + 1] - places[here]
                after = places[here + 2] - places[here + 1]
                at[num, 0], at[num, 1] = i * num_y + j, num_y * dx + axis
                second[num, 0] = 2.0 * after / (before + after)
                second[num, 1] = -2.0
                second[num, 2] = 2.0 * before / (before + after)
                num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def multiply(first, values, num_y, at, second, smoothing, ridge, x, result):
    """
    Multiply by the matrix of the normal equations.

    first, values, at, second  of equations and second_differences
    num_y                      control points along y
    x, result                  (n,) float64, of all control points
    """
    for i in range(len(x)):
        result[i] = ridge * x[i]
    one, step = np.uint64(1), np.uint64(num_y)  # unsigned indices: no wrap-around checks
    two, three = one + one, one + one + one
    for i in range(len(first)):
        row, height = np.uint64(first[i, 0]), 0.0
        a, b, c, d = values[i, 1, 0], values[i, 1, 1], values[i, 1, 2], values[i, 1, 3]
        for j in range(4):
            along = a * x[row] + b * x[row + one] + c * x[row + two] + d * x[row + three]
            height += values[i, 0, j] * along
            row += step
        row = np.uint64(first[i, 0])
        for j in range(4):
            share = height * values[i, 0, j]
            result[row] += share * a
            result[row + one] += share * b
            result[row + two] += share * c
            result[row + three] += share * d
            row += step
    for i in range(len(at)):
        left, step = np.uint64(at[i, 0]), np.uint64(at[i, 1])
        middle, right = left + step, left + step + step
        a, b, c = second[i, 0], second[i, 1], second[i, 2]
        bend = smoothing * (a * x[left] + b * x[middle] + c * x[right])
        result[left] += bend * a
        result[middle] += bend * b
        result[right] += bend * c


@njit(cache=True, nogil=True, error_model='numpy')
def preconditioner(first, values, num_y, at, second, smoothing, ridge, diagonal):
    """Write the inverse of the diagonal (n,) of the matrix of multiply."""
    for i in range(len(diagonal)):
        diagonal[i] = ridge
    for i in range(len(first)):
        for j in range(4):
            for k in range(4):
                share = values[i, 0, j] * values[i, 1, k]
                diagonal[first[i, 0] + j * num_y + k] += share * share
    for i in range(len(at)):
        for j in range(3):
            diagonal[at[i, 0] + j * at[i, 1]] += smoothing * second[i, j] * second[i, j]
    for i in range(len(diagonal)):
        diagonal[i] = 1.0 / diagonal[i]


@njit(cache=True, nogil=True, error_model='numpy')
def conjugate_gradients(first, values, z, num_y, at, second, rules, free, control):
    """
    Minimise the sum of squares over the free control points.

    first, values, num_y, at, second  see multiply
    z                                 (M,) float64, m, of the equations
    rules                             smoothing; ridge; tolerance: the last step is shorter, m
    free                              (F,) int64, indices of the free control points
    control                           (n,) float64, m, in place

    Returns the number of steps taken.
    """
    smoothing, ridge, tolerance = rules
    product, inverse = np.empty(len(control)), np.empty(len(control))
    residual, direction = np.zeros(len(control)), np.zeros(len(control))
    multiply(first, values, num_y, at, second, smoothing, ridge, control, product)
    preconditioner(first, values, num_y, at, second, smoothing, ridge, inverse)
    for i in range(len(first)):
        for j in range(4):
            for k in range(4):
                share = values[i, 0, j] * values[i, 1, k]
                residual[first[i, 0] + j * num_y + k] += share * z[i]
    energy = 0.0
    for f in free:
        residual[f] -= product[f]
        direction[f] = residual[f] * inverse[f]
        energy += residual[f] * direction[f]
    for step in range(MOST_STEPS):
        multiply(first, values, num_y, at, second, smoothing, ridge, direction, product)
        along = 0.0
        for f in free:
            along += direction[f] * product[f]
        if not along > 0.0:
            return step
        length, longest, before = energy / along, 0.0, energy
        energy = 0.0
        for f in free:
            control[f] += length * direction[f]
            longest = max(longest, abs(length * direction[f]))
            residual[f] -= length * product[f]
            energy += residual[f] * residual[f] * inverse[f]
        if longest < tolerance:
            return step + 1
        for f in free:
            direction[f] = residual[f] * inverse[f] + energy / before * direction[f]
    return MOST_STEPS
