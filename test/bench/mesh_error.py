# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Distances from mesh to truth and from truth to mesh, at points spread over both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

FloatArray = npt.NDArray[np.float64]

MAX_SAMPLES = 400_000

MAX_JUDGES = 40_000

NEAREST = 4
"""Number of nearest samples whose triangles are compared with a true point."""


def mesh_error(
    vertices: npt.NDArray[Any],
    triangles: npt.NDArray[Any],
    distance: Callable[[FloatArray], FloatArray],
    truth: FloatArray,
    voxel_size_m: float,
) -> dict[str, float]:
    """
    Return errors of a mesh.

    Parameters
    ----------
    vertices : (V, 3), m
        Of the mesh.
    triangles : (T, 3)
        Likewise.
    distance : callable
        Distance of (N, 3) points from the true surface, m.
    truth : (N, 3) float64, m
        Points of the true surface that were in view.
    voxel_size_m : float
        Distance within which a point counts as found.

    Returns
    -------
    dict
        accuracy_mm: mean distance of the mesh to the truth; complete_mm: mean distance of the
        truth to the mesh, cut at four voxels, to triangles, because the spacing of samples would
        exceed it; f_score: harmonic mean of the shares of both within a voxel.

    Raises
    ------
    RuntimeError
        If the mesh is empty.

    """
    if not len(triangles):
        raise RuntimeError('the mesh is empty')
    corners = np.asarray(vertices, np.float64)[triangles]
    off = distance(spread_over(corners, voxel_size_m / 3.0)[0])
    missing = np.minimum(distances_to_mesh(truth, corners, voxel_size_m), 4.0 * voxel_size_m)
    precision = float((off <= voxel_size_m).mean())
    recall = float((missing <= voxel_size_m).mean())
    return {
        'accuracy_mm': float(off.mean()) * 1e3,
        'complete_mm': float(missing.mean()) * 1e3,
        'f_score': 2.0 * precision * recall / max(precision + recall, 1e-9),
    }


def point_error(
    vertices: npt.NDArray[Any],
    triangles: npt.NDArray[Any],
    points: FloatArray,
    voxel_size_m: float,
) -> dict[str, float]:
    """
    Return errors of a mesh by points that were measured, but not fused.

    Parameters
    ----------
    vertices, triangles
        Of the mesh, as mesh_error.
    points : (N, 3) float64, m
        The points.
    voxel_size_m : float
        Edge of a voxel.

    Returns
    -------
    dict
        median_mm: distance of points from the mesh; recall: share within 1.5 voxels; area_m2: of
        the mesh; empty: share of it without a point within 1.5 voxels.

    Raises
    ------
    RuntimeError
        If the mesh is empty.

    """
    if not len(triangles):
        raise RuntimeError('the mesh is empty')
    corners = np.asarray(vertices, np.float64)[triangles]
    rng = np.random.default_rng(0)
    judges = points[rng.choice(len(points), min(len(points), MAX_JUDGES), replace=False)]
    off = distances_to_mesh(judges, corners, voxel_size_m)
    samples, _ = spread_over(corners, voxel_size_m / 3.0)
    reach_m = 1.5 * voxel_size_m
    nearest, _ = cKDTree(points).query(samples, distance_upper_bound=reach_m)
    sides = corners[:, 1:] - corners[:, :1]
    return {
        'median_mm': float(np.median(off)) * 1e3,
        'recall': float((off < reach_m).mean()),
        'area_m2': float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()) / 2.0,
        'empty': float(np.isinf(nearest).mean()),
    }


def distances_to_mesh(points: FloatArray, corners: FloatArray, voxel_size_m: float) -> FloatArray:
    """Return the distance of (N, 3) points from the nearest of (T, 3, 3) triangles, (N,) m."""
    samples, chosen = spread_over(corners, voxel_size_m / 3.0)
    _, nearest = cKDTree(samples).query(points, min(NEAREST, len(samples)))
    near = corners[chosen[nearest.reshape(len(points), -1)]]
    found: FloatArray = np.min(
        [to_triangles(points, near[:, n]) for n in range(near.shape[1])], axis=0
    )
    return found


def spread_over(corners: FloatArray, spacing_m: float) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return random points spread evenly over (T, 3, 3) triangles, and the triangle of each."""
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2.0
    count = int(np.clip(area.sum() / spacing_m**2, 1, MAX_SAMPLES))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    found: FloatArray = corners[chosen, 0] + u * sides[chosen, 0] + v * sides[chosen, 1]
    return found, chosen


def to_triangles(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the distance of each of (N, 3) points from its triangle of (N, 3, 3), m."""
    ends = np.roll(corners, -1, axis=1)
    normal = np.cross(ends[:, 0] - corners[:, 0], ends[:, 1] - corners[:, 1])
    length = np.linalg.norm(normal, axis=1)
    off = np.einsum('ij,ij->i', points - corners[:, 0], normal)
    best = np.full(len(points), np.inf)
    inside = length > 0.0
    for n in range(3):
        side, start = ends[:, n] - corners[:, n], points - corners[:, n]
        inside &= np.einsum('ij,ij->i', np.cross(side, start), normal) >= 0.0
        square = np.maximum(np.einsum('ij,ij->i', side, side), 1e-300)
        place = np.clip(np.einsum('ij,ij->i', start, side) / square, 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(start - place[:, None] * side, axis=1))
    found: FloatArray = np.where(inside, np.abs(off) / np.maximum(length, 1e-300), best)
    return found
