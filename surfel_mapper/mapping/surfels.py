# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels: position, normal and shape of the voxels of a map, as arrays.

Derived from the exact moments in float64 on request, and only for the requested voxels; a map
does not store them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.kernels.surfels import derive_surfels
from surfel_mapper.threads import share


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """
    Surfels of K voxels, a row each, in the frame of the map.

    Attributes
    ----------
    position : (K, 3) float64, m
        Mean of the points.
    normal : (K, 3) float64
        Unit eigenvector of the smallest eigenvalue, turned towards the sensor; if its position
        is unknown, the component of largest magnitude is positive. nan for a single point and
        for identical points.
    planarity : (K,) float64
        2 (e1 - e0) / (e0 + e1 + e2) in [0, 1]; nan if the normal is nan.
    curvature : (K,) float64
        e0 / (e0 + e1 + e2) in [0, 1/3] (Pauly et al. 2002); nan if the normal is nan.
    eigenvalues : (K, 3) float64, m^2
        Eigenvalues of the covariance scatter / (n - 1), ascending; 0 for a single point.
    num_points : (K,) int64
        Number of points.
    voxel_index : (K, 3) int32
        floor(point / voxel size).
    channels : mapping of str to (K,) float64
        Means of the channels of the map: ``intensity``; ``red``, ``green``, ``blue`` in 0 to 255.

    """

    position: npt.NDArray[np.float64]
    normal: npt.NDArray[np.float64]
    planarity: npt.NDArray[np.float64]
    curvature: npt.NDArray[np.float64]
    eigenvalues: npt.NDArray[np.float64]
    num_points: npt.NDArray[np.int64]
    voxel_index: npt.NDArray[np.int32]
    channels: Mapping[str, npt.NDArray[np.float64]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of surfels."""
        return len(self.num_points)

    def select(self, rows: npt.NDArray[Any]) -> Surfels:
        """Return selected surfels: by a mask (K,) bool or by row indices."""
        return Surfels(
            position=self.position[rows],
            normal=self.normal[rows],
            planarity=self.planarity[rows],
            curvature=self.curvature[rows],
            eigenvalues=self.eigenvalues[rows],
            num_points=self.num_points[rows],
            voxel_index=self.voxel_index[rows],
            channels={name: values[rows] for name, values in self.channels.items()},
        )

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """All arrays but the channels, in the order of declaration."""
        return (
            self.position,
            self.normal,
            self.planarity,
            self.curvature,
            self.eigenvalues,
            self.num_points,
            self.voxel_index,
        )


def derive(
    rows: npt.NDArray[np.int64],
    chosen: npt.NDArray[np.int32],
    voxel_size_m: float,
    bits: int,
    threads: int = 1,
) -> Surfels:
    """
    Derive the surfels of selected rows of a slab.

    Parameters
    ----------
    rows : (R, 16) int64
        In the layout of kernels/layout.py.
    chosen : (K,) int32
        Rows that hold points.
    voxel_size_m : float
        Edge of a voxel, m.
    bits : int
        A voxel is 2^bits lattice units wide.
    threads : int
        Number of threads that share the work.

    """
    num = len(chosen)
    surfels = Surfels(
        position=np.empty((num, 3)),
        normal=np.empty((num, 3)),
        planarity=np.empty(num),
        curvature=np.empty(num),
        eigenvalues=np.empty((num, 3)),
        num_points=np.empty(num, np.int64),
        voxel_index=np.empty((num, 3), np.int32),
    )

    def derive_part(part: slice) -> None:
        outputs = tuple(values[part] for values in surfels.arrays)
        derive_surfels(rows, chosen[part], voxel_size_m, bits, outputs)

    share(derive_part, num, threads)
    return surfels
