# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""How far a mesh is from the truth and the truth from the mesh, in points spread over both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

FloatArray = npt.NDArray[np.float64]

MAX_SAMPLES = 400_000


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
        How far (N, 3) points are from the true surface, m.
    truth : (N, 3) float64, m
        Points of the true surface that were in view.
    voxel_size_m : float
        What counts as found lies within this.

    Returns
    -------
    dict
        accuracy_mm: mean distance of the mesh to the truth; complete_mm: mean distance of the
        truth to the mesh, cut at four voxels; f_score: harmonic mean of the shares of both within
        a voxel.

    Raises
    ------
    RuntimeError
        If the mesh is empty.

    """
    if not len(triangles):
        raise RuntimeError('the mesh is empty')
    samples = spread_over(vertices, triangles, voxel_size_m / 3.0)
    off = distance(samples)
    missing, _ = cKDTree(samples).query(truth, distance_upper_bound=4.0 * voxel_size_m)
    missing = np.minimum(missing, 4.0 * voxel_size_m)
    precision = float((off <= voxel_size_m).mean())
    recall = float((missing <= voxel_size_m).mean())
    return {
        'accuracy_mm': float(off.mean()) * 1e3,
        'complete_mm': float(missing.mean()) * 1e3,
        'f_score': 2.0 * precision * recall / max(precision + recall, 1e-9),
    }


def spread_over(
    vertices: npt.NDArray[Any], triangles: npt.NDArray[Any], spacing_m: float
) -> FloatArray:
    """Return points spread evenly over a mesh at random, about so far apart."""
    corners = np.asarray(vertices, np.float64)[triangles]
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2.0
    count = int(np.clip(area.sum() / spacing_m**2, 1, MAX_SAMPLES))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    found: FloatArray = corners[chosen, 0] + u * sides[chosen, 0] + v * sides[chosen, 1]
    return found
