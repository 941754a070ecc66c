# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surroundings that seem to move along with the sensor, as trucks on all sides do.

They fit the map well, at a pose that hardly moves, while the world between them streams past: scan
after scan has voxels that the map does not know, more than the motion explains. Boxed in by nine
trucks (test/pipeline/scenarios.py) 8 % of the voxels of a scan are new, at 0.1 m a scan; in the
same street 0.1 % are new at rest, 2 % at rest with three trucks that pass, 9 % at 0.9 m a scan.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import compose, inverse, rotation_angle, Transform
from surfel_mapper.mapping.moments import point_keys
from surfel_mapper.mapping.surfel_map import SurfelMap

SCANS = 10
"""Number of scans of which most have to agree: a single turn shows much that is new."""

NEW_AT_REST = 0.04
"""Share of new voxels that vehicles which pass a sensor at rest explain."""

NEW_A_VOXEL = 0.07
"""Further share that a motion of one voxel a scan explains: at most 0.05 in halls and streets, and
0.09 among nine trucks that came within two scans."""

LEVER_M = 5.0
"""Distance at which rotations count as motion, m."""

MOST_NEW = 0.25
"""Share of new voxels above which a scan looks into a new area: among trucks at most 0.2 are new,
and 0.2 to 0.6 in each of seven scans of half the beams that leave the corner of a hall."""

YOUNG = 10
"""Number of scans after which a map holds what stands around it."""


class SurroundingMotion:
    """Shares of new voxels in the latest scans that their motion does not explain."""

    def __init__(self) -> None:
        self._latest: deque[float] = deque(maxlen=SCANS)
        self._num_scans = 0
        self._previous: Transform | None = None

    def clear(self) -> None:
        """Forget all scans, after a loss."""
        self._latest.clear()
        self._previous = None

    def move_along(
        self, cells: npt.NDArray[np.float64], T_map_body: Transform, surfel_map: SurfelMap
    ) -> bool:
        """
        Take a scan; return whether most of what the latest scans saw seems to move along.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Cells of the scan in the tracked frame.
        T_map_body : (4, 4) float64
            Its pose.
        surfel_map : SurfelMap
            The map before the scan.

        """
        keys = np.unique(point_keys(cells, T_map_body, surfel_map.voxel_size_m))
        share = float((surfel_map.find(keys) < 0).mean()) if len(keys) else 0.0
        self._num_scans += 1
        if self._previous is not None and self._num_scans > YOUNG:
            off = compose(inverse(self._previous), T_map_body)
            way_m = float(np.linalg.norm(off[:3, 3])) + LEVER_M * rotation_angle(off)
            explained = NEW_A_VOXEL * way_m / surfel_map.voxel_size_m
            self._latest.append(share - explained if share <= MOST_NEW else 0.0)
        self._previous = T_map_body
        return len(self._latest) == SCANS and bool(np.median(self._latest) > NEW_AT_REST)
