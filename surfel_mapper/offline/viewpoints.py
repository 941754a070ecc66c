# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
VIEWPOINT of PCD files: poses of the sensor if those of a folder differ, else its place.

PCL leaves open whether points are in the frame of the sensor or in that of the viewpoint. Scans of
a folder with a viewpoint each are taken as the former. Points of one viewpoint stay as they are,
and it is the place that normals are turned to, as PCL estimates them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.pcd import ORIGIN, read_viewpoint
from surfel_mapper.files.trajectory import Trajectory

POSES = 'VIEWPOINT of the PCD files differs and is the pose of each scan'

NOT_USED = 'VIEWPOINT of the PCD files differs, but pose.source or frames are set'

PLACE = 'VIEWPOINT is the place of the sensor, to which normals are turned'


def viewpoints_of(files: Sequence[Path]) -> list[tuple[float, ...]]:
    """Return x y z qx qy qz qw of the viewpoint of each file; none unless all are PCD."""
    if not all(file.suffix.lower() == '.pcd' for file in files):
        return []
    viewpoints = []
    for file in files:
        try:
            x, y, z, w, *q_xyz = read_viewpoint(file)
        except FileFormatError:  # its scan is dropped
            x, y, z, w, *q_xyz = ORIGIN
        viewpoints.append((x, y, z, *q_xyz, w))
    return viewpoints


def viewpoint_poses(viewpoints: Sequence[tuple[float, ...]]) -> Trajectory | None:
    """Return the viewpoints as poses of the scans in their order; None unless they differ."""
    if len({*viewpoints}) < 2:
        return None
    table = np.array(viewpoints, np.float64)
    return Trajectory(None, table[:, :3], table[:, 3:])


def with_viewpoint(config: Config, viewpoints: Sequence[tuple[float, ...]]) -> Config | None:
    """Return the settings of points seen from one viewpoint; None if there is no such one."""
    is_stated = len({*viewpoints}) == 1 and any(viewpoints[0][:6])
    if not is_stated or config.frames.base_to_sensor:
        return None
    return config.replace(
        {'pose.source': 'identity', 'frames.base_to_sensor': list(viewpoints[0])}
    )
