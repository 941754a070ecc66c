# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy and size of models: distances to and from the cloud that they represent, coverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

POINT_BYTES = 12
"""Bytes of a point as three float32."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """
    Comparison of models with the cloud that they represent; nan if either is empty.

    Attributes
    ----------
    precision_rms_m, precision_p95_m : float
        Distance from samples of the models to the nearest point of the cloud.
    completeness_rms_m, completeness_p95_m : float
        Distance from points of the cloud to the nearest sample.
    coverage : float
        Share of the points of the cloud nearer than a voxel to a sample.
    num_planes, num_surfaces, num_gaussians, size_bytes : int
        Numbers of primitives, and their bytes.
    compression : float
        Bytes of the cloud as float32 by those of the models.

    """

    precision_rms_m: float
    precision_p95_m: float
    completeness_rms_m: float
    completeness_p95_m: float
    coverage: float
    num_planes: int
    num_surfaces: int
    num_gaussians: int
    size_bytes: int
    compression: float


def nearest(
    points: npt.NDArray[np.float64], reference: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the distance of each point to the nearest reference point, m; empty if either is."""
    if not len(points) or not len(reference):
        return np.empty(0)
    from scipy.spatial import cKDTree  # 0.4 s that mapping without models saves

    distance: npt.NDArray[np.float64] = cKDTree(reference).query(points)[0]
    return distance


def rms(values: npt.NDArray[np.float64], weight: npt.NDArray[np.float64] | None = None) -> float:
    """Return the root mean square, weighted; nan for no values."""
    return float(np.sqrt(np.average(values**2, weights=weight))) if values.size else np.nan


def p95(values: npt.NDArray[np.float64], weight: npt.NDArray[np.float64] | None = None) -> float:
    """
    Return the 95th percentile; nan for no values.

    If weights differ, it is the least value with 95 % of the weight up to it, without
    interpolation.
    """
    if not values.size:
        return np.nan
    if weight is None or (weight == weight[0]).all():
        return float(np.percentile(values, 95.0))
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.95 * total[-1])]])
