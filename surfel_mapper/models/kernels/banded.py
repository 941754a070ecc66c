# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Small symmetric banded systems, and how far voxels are off the fields that come out.

Of a field with a hundred control points the checks around LAPACK take longer than the solve.

Source: Golub and Van Loan, Matrix Computations, section 4.3 (Cholesky's factors of a band).
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.splines import heights_at


@njit(cache=True, nogil=True, error_model='numpy')
def solve_band(band, right):
    """
    Solve a positive definite system, in place.

    band   (n, W) float64, kept by rows as in splines.py; becomes the upper factor
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
def rms_off_field(rows, held, frame, origin, field):
    """
    Return the root mean square distance of the points of voxels from a field, m.

    rows    (n,) int32
    held    count (R,) int64; position (R, 3) m; eigenvalues (R, 3) m^2, the least first
    frame   (3, 3) float64, rows x, y, z of the field
    origin  (3,) float64, what it is about, m
    field   see heights_at
    """
    count, position, eigenvalues = held
    local, found = np.empty((len(rows), 3)), np.empty(len(rows))
    for i in range(len(rows)):
        for k in range(3):
            local[i, k] = 0.0
            for j in range(3):
                local[i, k] += frame[k, j] * (position[rows[i], j] - origin[j])
    heights_at(local, field, found)
    total = points = 0.0
    for i in range(len(rows)):
        number, away = np.float64(count[rows[i]]), local[i, 2] - found[i]
        points += number
        total += number * (away * away + eigenvalues[rows[i], 0])
    return math.sqrt(total / points)
