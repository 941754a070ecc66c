# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""How to halve a surface that turns too far from its mean normal to be a graph over one plane."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FOLD_PERCENTILE = 98.0
MEANS_ITERATIONS = 20


def folded(normals: Array, mean: Array, limit: float) -> npt.NDArray[np.bool_] | None:
    """
    Return how to halve a surface (n,) bool, or None where it has one height everywhere.

    Parameters
    ----------
    normals : (n, 3) float64
        Unit normals of its pieces.
    mean : (3,) float64
        Their mean.
    limit : float
        Least cosine between these that nearly all pieces have.

    """
    cosines = normals @ mean
    if len(normals) < 2 or cosines.min() >= limit:
        return None
    if np.percentile(cosines, 100.0 - FOLD_PERCENTILE) >= limit:
        return None
    centred = normals - normals.mean(axis=0)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    side: npt.NDArray[np.bool_] = centred @ axis > 0.0
    for _ in range(MEANS_ITERATIONS):
        if side.all() or not side.any():
            return None
        first, second = normals[side].mean(axis=0), normals[~side].mean(axis=0)
        nearer = normals @ (first - second) > 0.5 * (first @ first - second @ second)
        if (nearer == side).all():
            break
        side = nearer
    return side if 0 < side.sum() < len(side) else None
