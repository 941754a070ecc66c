# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What navigation reads: a cost for every cell of a horizontal grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

UNKNOWN = -1

OBSTACLE = 100


@dataclass(frozen=True, slots=True, eq=False)
class CostGrid:
    """
    Costs of the cells of an area.

    Attributes
    ----------
    resolution_m : float
        Edge of a cell.
    origin : (2,) float64, m
        x and y of the outer corner of the first cell.
    cost : (rows along y, columns along x) int8
        0 free to 100 obstacle, -1 never seen.

    """

    resolution_m: float
    origin: npt.NDArray[np.float64]
    cost: npt.NDArray[np.int8]
