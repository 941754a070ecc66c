# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Means, covariances and axes of groups of points, all groups together."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.frames import eigen_frames, group_scatters

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PACKED = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Place of each element of a symmetric matrix among xx xy xz yy yz zz."""


LEAST_SHARE = 0.4
"""Least length of the mean of unit normals within 60 deg of it, with some outliers."""


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
    number = len(starts) - 1
    totals, means, scatters = np.empty(number), np.empty((number, 3)), np.empty((number, 3, 3))
    group_scatters(points, weights, starts, totals, means, scatters)
    return totals, means, scatters


def eigen(matrices: Array) -> tuple[Array, Array]:
    """Return eigenvalues (K, 3), ascending, and their vectors as rows of (K, 3, 3)."""
    values, vectors = np.empty((len(matrices), 3)), np.empty((len(matrices), 3, 3))
    eigen_frames(matrices, values, vectors)
    return values, vectors


def plane_frames(points: Array, weights: Array, starts: Indices) -> tuple[Array, Array, Array]:
    """Return mean, normal and eigenvalues (K, 3) each of every group of points; 0 if empty."""
    total, means, scatters = means_and_scatters(points, weights, starts)
    values, axes = eigen(scatters / np.where(total > 0.0, total, 1.0)[:, None, None])
    normals = np.where(total[:, None] > 0.0, axes[:, 0], 0.0)
    return means, normals, values


def mean_normals(normals: Array, starts: Indices) -> Array:
    """
    Return the mean unit normals (K, 3) of groups.

    Normals of a chart lie within a cone. If they cancel, the voxels have no common viewpoint; they
    are then flipped to the side of the majority.

    Parameters
    ----------
    normals : (M, 3) float64
        Unit normals, group after group; 0 for none.
    starts : (K + 1,) int64
        First normal of each group, and M.

    """
    totals: Array = np.add.reduceat(normals, starts[:-1])
    number = np.add.reduceat(normals.any(axis=1).astype(np.int64), starts[:-1])
    cancelled = (np.linalg.norm(totals, axis=1) <= LEAST_SHARE * number) & (number > 0)
    for k in np.flatnonzero(cancelled):
        own = normals[starts[k] : starts[k + 1]]
        totals[k] = own[own.any(axis=1).argmax()]
        for _ in range(2):
            side = np.where(own @ totals[k] < 0.0, -1.0, 1.0)
            totals[k] = side @ own
    totals /= np.maximum(np.linalg.norm(totals, axis=1), 1e-300)[:, None]
    return totals


def oriented(axes: Array, directions: Array) -> Array:
    """
    Return frames (K, 3, 3) of eigenvectors, rows ascending by eigenvalue.

    The normal is on the side of a direction (K, 3), and the largest component of x is positive.
    """
    side = np.where(np.einsum('ij,ij->i', axes[:, 0], directions) < 0.0, -1.0, 1.0)
    z, x = axes[:, 0] * side[:, None], axes[:, 2]  # its largest component is positive
    frames: Array = np.stack([x, np.cross(z, x), z], axis=1)
    return frames
