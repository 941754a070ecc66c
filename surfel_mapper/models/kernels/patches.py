# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Frame and kind (plane or curved) of patches.

The points of patch k are rows starts[k] to starts[k + 1] - 1.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame
from surfel_mapper.models.kernels.frames import orient, range_moments

LEAST_CELLS = 8
"""The curvature of a patch is not tested with fewer cells."""


@njit(cache=True, nogil=True, error_model='numpy')
def describe_patches(
    points, starts, normals, viewpoint, rules, means, covariances, frames, curved
):
    """
    Compute mean, covariance, frame and kind of every patch.

    points       (N, 3) float64, m
    starts       (K + 1,) int64
    normals      (K, 3) float64, mean normals of the clusters in each
    viewpoint    (3,) float64, m
    rules        thickness (K,) float64, m: of a plane; pitch, m: of the cells for the test of
                 curvature; bent: whether it is tested; mean_normal: whether the z of surfaces is
                 their mean normal
    means        (K, 3) float64, out
    covariances  (K, 3, 3) float64, out
    frames       (K, 3, 3) float64, out: rows x, y, normal
    curved       (K,) bool, out
    """
    thickness, pitch, bent, mean_normal = rules
    mean, value = np.empty(3), np.empty(3)
    scatter, frame = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(starts) - 1):
        low, high = starts[k], starts[k + 1]
        range_moments(points, low, high, mean, scatter)
        scatter /= max(high - low - 1, 1)
        means[k], covariances[k] = mean, scatter
        eigen_frame(scatter, value, frame)
        orient(frame, mean, viewpoint)
        frames[k] = frame
        thick = 6.0 * math.sqrt(value[0])
        align_frame(frame, normals[k])
        curved[k] = thick >= thickness[k]
        if bent and curved[k]:  # what bends by a thickness is thicker than that
            bend = bend_height(points, low, high, mean, frame, pitch)
            if bend >= 0.0:
                curved[k] = bend > thickness[k] or thick >= 2.0 * thickness[k]
        if curved[k] and mean_normal:
            frames[k] = frame


@njit(cache=True, nogil=True, error_model='numpy')
def align_frame(frame, normal):
    """Rotate a frame so that its z is a normal, and its x changes least."""
    along = 0.0
    for j in range(3):
        along += frame[0, j] * normal[j]
    x = np.empty(3)
    length = 0.0
    for j in range(3):
        x[j] = frame[0, j] - along * normal[j]
        length += x[j] * x[j]
    if length < 1e-12:
        return
    length = math.sqrt(length)
    for j in range(3):
        frame[0, j], frame[2, j] = x[j] / length, normal[j]
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        frame[1, j] = frame[2, a] * frame[0, b] - frame[2, b] * frame[0, a]


@njit(cache=True, nogil=True, error_model='numpy')
def bend_height(points, low, high, mean, frame, pitch):
    """
    Return the 5th to 95th percentile range of the curved part of a patch, m.

    0 if a quadric does not fit twice as well as a plane; -1 if there are too few cells.
    """
    local = np.empty((high - low, 3))
    ends = np.empty((2, 2))
    to_local(points, low, high, mean, frame, local, ends)
    nx = np.int64((ends[1, 0] - ends[0, 0]) / pitch) + 1
    ny = np.int64((ends[1, 1] - ends[0, 1]) / pitch) + 1
    sums = np.zeros((nx * ny, 4))
    for i in range(len(local)):
        x = np.int64((local[i, 0] - ends[0, 0]) / pitch)
        y = np.int64((local[i, 1] - ends[0, 1]) / pitch)
        row = x * ny + y
        for j in range(3):
            sums[row, j] += local[i, j]
        sums[row, 3] += 1.0
    num = 0
    scale = max(ends[1, 0], -ends[0, 0], ends[1, 1], -ends[0, 1])
    for row in range(len(sums)):
        if sums[row, 3] > 0.0:
            weight = sums[row, 3]
            for j in range(3):
                sums[num, j] = sums[row, j] / (weight * scale)
            sums[num, 3] = weight
            num += 1
    if num < LEAST_CELLS:
        return -1.0
    cells = sums[:num]
    plane, quadric = np.zeros(6), np.zeros(6)
    error_plane = fit_quadric(cells, 3, plane)
    error_quadric = fit_quadric(cells, 6, quadric)
    if not error_quadric < 0.25 * error_plane:  # squares: half of the root mean square
        return 0.0
    rise = np.empty(num)
    for i in range(num):
        x, y = cells[i, 0], cells[i, 1]
        rise[i] = quadric[3] * x * x + quadric[4] * x * y + quadric[5] * y * y
    rise.sort()
    return scale * (rise[np.int64(0.95 * (num - 1))] - rise[np.int64(0.05 * (num - 1))])


@njit(cache=True, nogil=True, error_model='numpy')
def fit_quadric(cells, terms, coefficients):
    """
    Fit z by 1, x, y and with six terms also x^2, x y, y^2; return the weighted sum of squares.

    cells         (C, 4) float64: x, y, z, weight
    coefficients  (6,) float64, out
    """
    normal, right = np.zeros((6, 6)), np.zeros(6)
    basis = np.empty(6)
    total = 0.0
    for i in range(len(cells)):
        x, y = cells[i, 0], cells[i, 1]
        basis[0], basis[1], basis[2] = 1.0, x, y
        basis[3], basis[4], basis[5] = x * x, x * y, y * y
        weight = cells[i, 3]
        total += weight
        for p in range(terms):
            right[p] += weight * basis[p] * cells[i, 2]
            for q in range(p + 1):
                normal[p, q] += weight * basis[p] * basis[q]
    for p in range(terms):  # Cholesky, with a ridge for cells in one line
        normal[p, p] += 1e-12 * total
        for q in range(p + 1):
            value = normal[p, q]
            for m in range(q):
                value -= normal[p, m] * normal[q, m]
            normal[p, q] = math.sqrt(max(value, 1e-14 * total)) if p == q else value / normal[q, q]
    for p in range(terms):
        for m in range(p):
            right[p] -= normal[p, m] * right[m]
        right[p] /= normal[p, p]
    for p in range(terms - 1, -1, -1):
        for m in range(p + 1, terms):
            right[p] -= normal[m, p] * right[m]
        right[p] /= normal[p, p]
    error = 0.0
    for p in range(terms):
        coefficients[p] = right[p]
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        z -= coefficients[0] + coefficients[1] * x + coefficients[2] * y
        if terms == 6:
            z -= coefficients[3] * x * x + coefficients[4] * x * y + coefficients[5] * y * y
        error += cells[i, 3] * z * z
    return error


@njit(cache=True, nogil=True, error_model='numpy')
def to_local(points, low, high, mean, frame, local, ends):
    """
    Transform points into the frame of their patch.

    local  (high - low, 3) float64, out
    ends   (2, 2) float64, out: least and largest x, y
    """
    for j in range(2):
        ends[0, j], ends[1, j] = np.inf, -np.inf
    for i in range(low, high):
        x, y, z = points[i, 0] - mean[0], points[i, 1] - mean[1], points[i, 2] - mean[2]
        for j in range(3):
            value = frame[j, 0] * x + frame[j, 1] * y + frame[j, 2] * z
            local[i - low, j] = value
            if j < 2:
                ends[0, j] = min(ends[0, j], value)
                ends[1, j] = max(ends[1, j], value)
