# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""How to halve a surface that turns too far from its mean normal to be a graph over one plane."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.folds import fold

Array = npt.NDArray[np.float64]


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
    side = np.empty(len(normals), np.bool_)
    return side if fold(normals, mean, limit, side) else None
