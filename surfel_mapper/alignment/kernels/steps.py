# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A Gauss-Newton step from its normal equations.

A search takes 35 steps a scan, each on a few numbers: in numpy a step took 120 us, most of it the
overhead of calls, here 10.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel


@kernel(error_model='numpy')
def solve_step(hessian, gradient, least, step, values, vectors):
    """
    Solve normal equations in the directions that have enough information.

    hessian   (6, 6) float64, for position (m) and rotation (rad)
    gradient  (6,) float64
    least     float64, smallest eigenvalue of a determined direction
    step      (6,) float64, out
    values    (6,) float64, out: eigenvalues, ascending, scaled so that those of position sum to 1
              and those of rotation too; 0 without any information
    vectors   (6, 6) float64, out: a row for each eigenvalue, a unit vector, rotations scaled

    Returns the scale of rotations, m.
    """
    for i in range(6):
        step[i] = values[i] = 0.0
        for j in range(6):
            vectors[i, j] = 1.0 if i == j else 0.0
    weight = hessian[0, 0] + hessian[1, 1] + hessian[2, 2]
    if not weight > 0.0:
        return 1.0
    radius = math.sqrt((hessian[3, 3] + hessian[4, 4] + hessian[5, 5]) / weight)
    if not radius > 0.0:
        radius = 1.0
    scale, matrix = np.empty(6), np.empty((6, 6))
    for i in range(6):
        scale[i] = 1.0 if i < 3 else radius
    for i in range(6):
        for j in range(6):
            matrix[i, j] = hessian[i, j] / (weight * scale[i] * scale[j])
    ascending, columns = np.linalg.eigh(matrix)
    for i in range(6):
        values[i] = ascending[i]
        for j in range(6):
            vectors[i, j] = columns[j, i]
    for i in range(6):
        if values[i] < least:
            continue
        along = 0.0
        for j in range(6):
            along += vectors[i, j] * gradient[j] / (weight * scale[j])
        for j in range(6):
            step[j] -= along / values[i] * vectors[i, j] / scale[j]
    return radius
