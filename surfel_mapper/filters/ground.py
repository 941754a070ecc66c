# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ground: selects the points on nearly level surfaces.

Points are grouped into voxels aligned with the vertical, and the surfel of a voxel, the plane
through its points, gives the slope of the surface. In voxels that hold both floor and wall the
plane is tilted and neither is ground; smaller voxels keep that strip narrow. A table or a roof is
as level as the floor: ``max_height_m`` excludes surfaces above the robot's wheels.

Alone in its module: it combines grouping, shapes and poses, which no other filter does.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import FiniteFilter, Mask, parameter, select, with_columns
from surfel_mapper.filters.grids import ScanVoxels
from surfel_mapper.filters.limits import cosine
from surfel_mapper.filters.neighbours import coordinates, Points
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import eigen, Moments, shares
from surfel_mapper.scan import Scan


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class Ground(FiniteFilter):
    """Select the points on level surfaces: keep them, keep the rest, or mark both."""

    keep_part: str = parameter(
        'mark',
        'Keep the ground, the rest, or all points with a column ground (1 or 0).',
        choices=('ground', 'rest', 'mark'),
    )
    max_slope_deg: float = parameter(15.0, 'Largest slope of ground, deg.', low=0.0, high=90.0)
    voxel_size_m: float = parameter(0.5, 'Edge of the voxels, m.', low=0.001)
    min_points: int = parameter(
        5, 'Voxels with fewer points are not ground.', low=3, high=2**31 - 1
    )
    min_planarity: float = parameter(
        0.05,
        'Surfels less planar are not ground: 1 is a plane, 0 a line or a ball.',
        low=0.0,
        high=1.0,
    )
    max_height_m: float = parameter(
        math.inf,
        'Surfels higher than this above the origin of the robot (frames.base) are not ground, m.',
    )
    up: str = parameter(
        'fixed',
        'Frame whose z axis is up: fixed (level if its source is), base or sensor.',
        choices=('fixed', 'base', 'sensor'),
    )

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the selected points, or all with the column."""
        points = coordinates(scan)
        is_ground = self.is_ground(scan, points)
        if self.keep_part == 'mark':
            return with_columns(scan, ground=is_ground.astype(np.uint8))
        return select(scan, is_ground if self.keep_part == 'ground' else ~is_ground)

    def is_ground(self, scan: Scan, points: Points) -> Mask:
        """Return which points are ground."""
        R_up_sensor = self.upright(scan)
        if not len(points):
            return np.zeros(0, np.bool_)
        x, y, z = points.T.copy()
        points = np.stack([(a * x + b * y) + c * z for a, b, c in R_up_sensor]).T
        grid = ScanVoxels.over(points, np.full(3, self.voxel_size_m), 'origin')
        _, _, groups = grid.group(points, True)
        moments = Moments.of_groups(points, groups.rows, len(groups.first))
        values, vectors = eigen(moments.covariance)
        level = np.abs(vectors[:, 0, 2]) >= cosine(self.max_slope_deg)
        level &= moments.count >= self.min_points
        level &= shares(values)[:, 0] >= self.min_planarity
        if self.max_height_m < math.inf:
            height_m = moments.mean[:, 2] - (R_up_sensor @ self.robot(scan))[2]
            level &= height_m <= self.max_height_m
        return np.asarray(level[groups.rows])

    def upright(self, scan: Scan) -> Points:
        """Return the rotation from the frame of the points to one whose z is up, (3, 3)."""
        if self.up == 'sensor':
            return np.eye(3)
        pose = scan.T_map_sensor if self.up == 'fixed' else scan.T_base_sensor
        if pose is None:
            raise FilterError(
                f'the pose of {scan.frame_id!r} in the {self.up} frame is not known, so up is '
                'not; provide poses, or set up: sensor'
            )
        return np.asarray(pose[:3, :3], np.float64)

    def robot(self, scan: Scan) -> Points:
        """Return the origin of the robot in the frame of the points, (3,) m."""
        if scan.T_base_sensor is None:
            raise FilterError(
                f'the place of {scan.frame_id!r} on the robot is not known, so max_height_m has '
                'no origin; set frames.base_to_sensor, or publish it on /tf_static'
            )
        R_base_sensor, sensor_in_base = scan.T_base_sensor[:3, :3], scan.T_base_sensor[:3, 3]
        return np.asarray(-R_base_sensor.T @ sensor_in_base, np.float64)
