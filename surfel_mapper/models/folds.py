# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""How to halve a surface that turns too far from its mean normal to be a graph over one plane."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.folds import halve_normals

Array = npt.NDArray[np.float64]

FOLD_PERCENTILE = 98.0


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
    if percentile(cosines, 100.0 - FOLD_PERCENTILE) >= limit:
        return None
    side = np.empty(len(normals), np.bool_)
    return side if halve_normals(normals, side) else None


def percentile(values: Array, share: float) -> float:
    """Return a percentile as numpy does, whose checks take longer than a few values."""
    ordered, place = np.sort(values), 0.01 * share * (len(values) - 1)
    low = int(place)
    high = min(low + 1, len(values) - 1)
    return float(ordered[low] + (place - low) * (ordered[high] - ordered[low]))
