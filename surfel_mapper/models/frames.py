# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Means, covariances and axes of groups of points, all groups together."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.frames import eigen_frames, group_moments

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PACKED = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Place of each element of a symmetric matrix among xx xy xz yy yz zz."""


def means_and_scatters(
    points: Array, weights: Array, starts: Indices
) -> tuple[Array, Array, Array]:
    """
    Return the moments of groups of points about their means.

    Parameters
    ----------
    points : (N, 3) float64, m
        Group after group.
    weights : (N,) float64
        Of the points.
    starts : (K + 1,) int64
        First point of each group, and N.

    Returns
    -------
    (K,) float64
        Total weights.
    (K, 3) float64, m
        Means; 0 for groups without weight.
    (K, 3, 3) float64, m^2
        Weighted sums of outer products of deviations.

    """
    sums = np.empty((len(starts) - 1, 10))
    group_moments(points, weights, starts, sums)
    has_weight = sums[:, 0] > 0.0
    away = sums[:, 1:4] / np.where(has_weight, sums[:, 0], 1.0)[:, None]
    scatters = sums[:, 4:][:, PACKED] - sums[:, 1:4, None] * away[:, None, :]
    diagonal = np.arange(3)
    scatters[:, diagonal, diagonal] = np.maximum(scatters[:, diagonal, diagonal], 0.0)
    means = np.zeros_like(away)
    means[has_weight] = points[starts[:-1][has_weight]] + away[has_weight]
    return sums[:, 0], means, scatters


def eigen(matrices: Array) -> tuple[Array, Array]:
    """Return eigenvalues (K, 3), ascending, and their vectors as rows of (K, 3, 3)."""
    values, vectors = np.empty((len(matrices), 3)), np.empty((len(matrices), 3, 3))
    eigen_frames(matrices.copy(), values, vectors)
    return values, vectors


def plane_frames(points: Array, weights: Array, starts: Indices) -> tuple[Array, Array, Array]:
    """Return mean, normal and eigenvalues (K, 3) each of every group of points; 0 if empty."""
    total, means, scatters = means_and_scatters(points, weights, starts)
    values, axes = eigen(scatters / np.where(total > 0.0, total, 1.0)[:, None, None])
    normals = np.where(total[:, None] > 0.0, axes[:, 0], 0.0)
    return means, normals, values
