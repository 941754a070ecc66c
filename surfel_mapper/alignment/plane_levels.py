# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The levels from coarse to fine that an alignment goes through, made when first asked for.

Most alignments need the map itself alone. A coarser level is made of the moments of the voxels
that the scan may reach, so that it costs the same however large the map is.
"""

from __future__ import annotations

from collections.abc import Iterable
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.surfel_planes import SurfelPlanes
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.surfel_map import SurfelMap


class PlaneLevels:
    """
    Planes of a map and of its coarser levels around a scan.

    Parameters
    ----------
    config : RegistrationConfig
    surfel_map : SurfelMap
        The map, level 0.
    cells : (K, 3) float64, m
        Of the scan, in the sensor frame: how far it reaches.
    starts : iterable of (4, 4) float64
        Where the sensor may be.

    """

    def __init__(
        self,
        config: RegistrationConfig,
        surfel_map: SurfelMap,
        cells: npt.NDArray[np.float64],
        starts: Iterable[Transform],
    ) -> None:
        """Begin without any level."""
        self._config = config
        self._map = surfel_map
        self._cells = cells
        self._starts = list(starts)
        self._planes: dict[int, SurfelPlanes] = {}

    def voxel_size_m(self, level: int) -> float:
        """Return the edge of a voxel of a level."""
        return float(self._map.voxel_size_m * 2**level)

    def planes(self, level: int) -> SurfelPlanes:
        """
        Return the planes of a level.

        Raises
        ------
        MapLimitError
            If a voxel of that level would hold too many points; see SurfelMap.coarsen.

        """
        if level not in self._planes:
            target = self._map.coarsen(level, self._box()) if level else self._map
            self._planes[level] = SurfelPlanes(
                target, self._config.min_points, self._config.noise_m
            )
        return self._planes[level]

    def _box(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the voxels that the scan may reach, wherever it turns."""
        reach_m = math.sqrt(float((self._cells**2).sum(axis=1).max(initial=0.0)))
        reach_m += self.voxel_size_m(self._config.coarse_levels)
        at = np.array([start[:3, 3] for start in self._starts])
        low = np.floor((at.min(axis=0) - reach_m) / self._map.voxel_size_m)
        high = np.floor((at.max(axis=0) + reach_m) / self._map.voxel_size_m)
        return low.astype(np.int64), high.astype(np.int64)
