# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds and times as rclpy messages; a file of its own because it runs without a node."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import QUALITY, surfel_columns
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.ros.messages import cloud_message, time_message
from test.ros.live import room


def test_surfels_survive_serialization():
    surfel_map = SurfelMap(voxel_size_m=0.5)
    surfel_map.add(room(seed=1))
    surfels = surfel_map.surfels(min_points=3)
    sent = cloud_message(from_columns(surfel_columns(surfels)), 12_000_000_034, 'odom')

    scan = to_scan(deserialize_message(serialize_message(sent), PointCloud2))

    assert (scan.stamp_ns, scan.frame_id) == (12_000_000_034, 'odom')
    assert len(scan) == len(surfels) > 50
    np.testing.assert_array_equal(scan.points, surfels.position.astype(np.float32))
    expected = {
        'normal_x': surfels.normal[:, 0],
        'normal_y': surfels.normal[:, 1],
        'normal_z': surfels.normal[:, 2],
        'curvature': surfels.curvature,
        'planarity': surfels.planarity,
        'num_points': surfels.num_points,
        **{name: getattr(surfels, name) for name in QUALITY},
    }
    assert list(scan.columns) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(scan.columns[name], values.astype(scan.columns[name].dtype))


def test_an_empty_map_gives_an_empty_cloud():
    empty = surfel_columns(SurfelMap(0.5).surfels())
    scan = to_scan(cloud_message(from_columns(empty), 0, 'odom'))
    assert len(scan) == 0


def test_negative_times_have_positive_nanoseconds():
    assert (time_message(-1).sec, time_message(-1).nanosec) == (-1, 999_999_999)
