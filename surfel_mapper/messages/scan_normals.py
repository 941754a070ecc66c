# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The input cloud with the surfel of each of its points.

Points are copied with all their fields; appended are normal, planarity and number of points of the
surfel in whose voxel the point lies. Normals are in the frame of the cloud.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.moments import point_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import (
    append_fields,
    CloudBytes,
    FLOAT32,
    from_columns,
    UINT32,
)
from surfel_mapper.scan import Scan

ADDED = ('normal_x', 'normal_y', 'normal_z', 'planarity', 'num_points')
"""The appended fields, four bytes each; the last is uint32, the others are float32."""


def scan_with_normals(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, min_points: int
) -> CloudBytes:
    """
    Return the cloud of a scan with the surfel of each point.

    Parameters
    ----------
    scan : Scan
        Deskewed, if its sensor moved; in the map or not.
    T_map_sensor : (4, 4) float64
        Its pose.
    surfel_map : SurfelMap
        In the fixed frame.
    min_points : int
        Voxels with fewer points are no surfels.

    """
    added = surfels_of_points(scan, T_map_sensor, surfel_map, min_points)
    return cloud_of_scan(scan, added) if scan.msg is None else extended_cloud(scan.msg, added)


def surfels_of_points(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, min_points: int
) -> npt.NDArray[np.float32]:
    """
    Return normal, planarity and number of points of the surfel of each point.

    Returns
    -------
    (N, 5) float32
        Normal x y z in the sensor frame, planarity, and the number of points, which is a uint32
        of the same bytes. nan and 0 for points without a surfel.

    """
    added = np.full((len(scan), len(ADDED)), np.nan, np.float32)
    count = added.view(np.uint32)[:, -1]
    count[:] = 0
    rows = surfel_map.find(point_keys(scan.points, T_map_sensor, surfel_map.voxel_size_m))
    is_mapped = rows >= 0
    if is_mapped.any():
        used = np.flatnonzero(np.bincount(rows[is_mapped])).astype(rows.dtype)
        surfels = surfel_map.surfels_of(used)
        values = np.column_stack([surfels.normal @ T_map_sensor[:3, :3], surfels.planarity])
        values[surfels.num_points < min_points] = np.nan
        numbers = np.where(surfels.num_points < min_points, 0, surfels.num_points)
        row = np.searchsorted(used, rows[is_mapped])
        added[is_mapped, :-1], count[is_mapped] = values[row], numbers[row]
    return added


def extended_cloud(msg: Any, added: npt.NDArray[np.float32]) -> CloudBytes:
    """
    Return a cloud with the fields of ``ADDED`` appended.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        A message that could be decoded. If it has a field of the same name as a new one, the new
        one gets the prefix ``surfel_``, repeated until the name differs from all others.
    added : (N, 5) float32
        From surfels_of_points, one row per point.

    """
    names = {field.name for field in msg.fields}
    types = [FLOAT32] * (len(ADDED) - 1) + [UINT32]
    fields = [(unused(name, names), type_, 1) for name, type_ in zip(ADDED, types, strict=True)]
    return replace(append_fields(msg, added.view(np.uint32), fields), is_dense=False)


def unused(name: str, names: set[str]) -> str:
    """Prefix a field name until it is none of the names."""
    while name in names:
        name = f'surfel_{name}'
    return name


def cloud_of_scan(scan: Scan, added: npt.NDArray[np.float32]) -> CloudBytes:
    """Return the same for a scan that came from a depth image, so has no message."""
    columns = {**dict(zip('xyz', scan.points.T, strict=True)), **scan.columns}
    columns.update(zip(ADDED[:-1], added.T[:-1], strict=True))
    return from_columns({**columns, ADDED[-1]: added.view(np.uint32)[:, -1]})
