# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Large height fields fitted only where something has changed, from what they were.

A banded solve of a street's ground, 26,000 control points, takes seconds; from the field before,
conjugate gradients take a few steps. Control points on which nothing that is covered depends are
left out: there the equations are bad and nobody looks.

Source: Golub and Van Loan, Matrix Computations, section 11.5 (preconditioned by the diagonal).
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.splines import nonzero, parameter


@njit(cache=True, nogil=True, error_model='numpy')
def mark_active(filled, field, active):
    """
    Mark the control points on which heights in filled cells depend.

    filled  (Nx, Ny) bool
    field   see heights_at
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
    free     (Nx + 2, Ny + 2) bool, all False; out
    """
    for i in range(touched.shape[0]):
        for j in range(touched.shape[1]):
            if touched[i, j]:
                for x in range(max(i + 1 - margin, 0), min(i + 2 + margin, free.shape[0])):
                    for y in range(max(j + 1 - margin, 0), min(j + 2 + margin, free.shape[1])):
                        free[x, y] |= active[x, y]


@njit(cache=True, nogil=True, error_model='numpy')
def guess(control, known, active):
    """
    Give active control points of unknown height that of their neighbours, from the known ones on.

    control  (Nx + 2, Ny + 2) float64, in place
    known    bool, in place; all that are active become so
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
    List the heights that depend on free control points.

    xyz     (M, 3) float64, m
    field   see heights_at
    first   (M, 3) int64, out: first control point along x and y, row of xyz
    values  (M, 2, W) float64, out: the splines along x and y

    Returns how many there are.
    """
    origin, pitch, degrees, knots, control = field
    lower = np.empty(max(degrees[0], degrees[1]) + 1)
    width_x, width_y = (control.shape[0] - 1) * pitch, (control.shape[1] - 1) * pitch
    num = 0
    for i in range(len(xyz)):
        u = parameter(xyz[i, 0], origin[0], pitch, width_x)
        v = parameter(xyz[i, 1], origin[1], pitch, width_y)
        x = nonzero(u, knots[0], degrees[0], values[num, 0], lower)
        y = nonzero(v, knots[1], degrees[1], values[num, 1], lower)
        if free[x : x + degrees[0] + 1, y : y + degrees[1] + 1].any():
            first[num, 0], first[num, 1], first[num, 2] = x, y, i
            num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def bends(places, axis, active, free, at, second):
    """
    List the second differences along an axis among active control points, some of them free.

    places  (N,) float64, where the control points stand along the axis
    at      (T,) int64, out: first of three control points, counted y within x
    second  (T, 3) float64, out: what they are multiplied by

    Returns how many there are.
    """
    num_x, num_y = active.shape
    dx, dy = (1, 0) if axis == 0 else (0, 1)
    num = 0
    for i in range(num_x - 2 * dx):
        for j in range(num_y - 2 * dy):
            here, next_x, next_y = i if axis == 0 else j, i + dx, j + dy
            if not (active[i, j] and active[next_x, next_y] and active[next_x + dx, next_y + dy]):
                continue
            if free[i, j] or free[next_x, next_y] or free[next_x + dx, next_y + dy]:
                before = places[here + 1] - places[here]
                after = places[here + 2] - places[here + 1]
                at[num] = i * num_y + j
                second[num, 0] = 2.0 * after / (before + after)
                second[num, 1] = -2.0
                second[num, 2] = 2.0 * before / (before + after)
                num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def multiply(first, values, weight, degrees, differences, smoothing, ridge, free, x, result):
    """
    Multiply by the matrix of the normal equations, as far as the free control points go.

    first, values  of equations; weight (M,) of each
    differences    for x and y: step from one control point to the next, at and second of bends
    x, result      (Nx + 2, Ny + 2) float64
    """
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            result[i, j] = ridge * x[i, j]
    for i in range(len(first)):
        row, column = first[i, 0], first[i, 1]
        height = 0.0
        for j in range(degrees[0] + 1):
            along = 0.0
            for k in range(degrees[1] + 1):
                along += values[i, 1, k] * x[row + j, column + k]
            height += values[i, 0, j] * along
        height *= weight[i]
        for j in range(degrees[0] + 1):
            share = height * values[i, 0, j]
            for k in range(degrees[1] + 1):
                result[row + j, column + k] += share * values[i, 1, k]
    flat, out = x.ravel(), result.ravel()
    for step, at, second in differences:
        for i in range(len(at)):
            a = at[i]
            bend = smoothing * (second[i, 0] * flat[a] + second[i, 1] * flat[a + step]
                                + second[i, 2] * flat[a + 2 * step])  # fmt: skip
            for j in range(3):
                out[a + j * step] += bend * second[i, j]
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            if not free[i, j]:
                result[i, j] = 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def relax(first, values, weight, z, degrees, differences, rules, free, control):
    """
    Bring free control points to the least of the weighted squares, by conjugate gradients.

    first, values, weight, differences: see multiply
    z        (M,) float64, m, of the equations
    rules    smoothing; ridge; m: the last steps are shorter
    control  (Nx + 2, Ny + 2) float64, m, in place

    Returns how many steps that took.
    """
    smoothing, ridge, tolerance = rules
    shape = control.shape
    product, residual, diagonal = np.empty(shape), np.zeros(shape), np.full(shape, ridge)
    multiply(first, values, weight, degrees, differences, smoothing, ridge, free, control, product)
    for i in range(len(first)):
        for j in range(degrees[0] + 1):
            for k in range(degrees[1] + 1):
                row, column = first[i, 0] + j, first[i, 1] + k
                share = values[i, 0, j] * values[i, 1, k]
                residual[row, column] += weight[i] * share * z[i]
                diagonal[row, column] += weight[i] * share * share
    flat = diagonal.ravel()
    for step, at, second in differences:
        for i in range(len(at)):
            for j in range(3):
                flat[at[i] + j * step] += smoothing * second[i, j] * second[i, j]
    residual = np.where(free, residual - product, 0.0)
    scaled = residual / diagonal
    direction = scaled.copy()
    energy = np.sum(residual * scaled)
    for step in range(MOST_STEPS):
        multiply(
            first, values, weight, degrees, differences, smoothing, ridge, free, direction, product
        )
        along = np.sum(direction * product)
        if not along > 0.0:
            return step
        length = energy / along
        control += length * direction
        if length * np.abs(direction).max() < tolerance:
            return step + 1
        residual -= length * product
        scaled = residual / diagonal
        before, energy = energy, np.sum(residual * scaled)
        direction = scaled + (energy / before) * direction
    return MOST_STEPS


MOST_STEPS = 200
