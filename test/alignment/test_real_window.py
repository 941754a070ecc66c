# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A real hall, its recorded poses made to drift: alignment brings them back."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import Config
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.offline.bag_recording import feed
from surfel_mapper.offline.pose_sources import pose_topics
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.alignment.street import drifted, relative_errors

SETTINGS = {'pose.source': 'odometry', 'window.max_scans': 0, 'window.keep_points': True}


@pytest.fixture(scope='module')
def recorded(data_folder):
    """Return the scans of the bag, mapped at the poses of its odometry."""
    config = Config.from_mapping(SETTINGS)
    mapper = Mapper(config)
    with BagReader(data_folder / 'data' / 'bags' / 'hall_os0_full') as reader:
        for _ in feed(reader, mapper, '/points', pose_topics(reader.topics, config)):
            pass
    return list(mapper.window)


def mapped(scans, poses):
    """Return a mapper with scans at poses."""
    mapper = Mapper(Config.from_mapping({**SETTINGS, 'frames.base': 'lidar'}))
    for scan, pose in zip(scans, poses, strict=True):
        mapper.add_pose('odom', 'lidar', scan.stamp_ns, pose[:3, 3], q_xyzw(pose))
        mapper.add_scan(Scan(points=scan.points, stamp_ns=scan.stamp_ns, frame_id='lidar'))
        list(mapper.insert_ready())
    return mapper


def thickness_m(mapper):
    surfels = mapper.map.surfels(30)
    return np.median(np.sqrt(surfels.eigenvalues[surfels.planarity > 0.5, 0]))


def test_drift_goes_and_surfaces_get_no_thicker_than_recorded(recorded):
    poses = np.array([scan.T_map_sensor for scan in recorded])
    drift = drifted(poses, 0.02, 0.5)
    mapper = mapped(recorded, drift)

    aligned = mapper.align()

    last = len(poses) - 1
    found, before = (relative_errors(some, poses, last) for some in (aligned.T_map_sensor, drift))
    assert aligned.solution.settled
    assert not aligned.solution.unconnected
    assert before[0] > 0.2
    assert found[0] < 0.06  # the recorded poses are an odometry's too
    assert found[1] < 0.1 * before[1]
    assert thickness_m(mapper) < thickness_m(mapped(recorded, poses))
