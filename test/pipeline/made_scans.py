# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mappers, scans and poses for the tests of Mapper, and the expected digests."""

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan

S = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)
TURNED = (0.0, 0.0, 0.6, 0.8)
MOUNTED = (0.3, -0.2, 1.5, 0.0, 0.1, 0.0, 0.99**0.5)


def mapper_with(**changes):
    """Return a mapper with some settings changed; odometry and a sensor at its base otherwise."""
    changes = {name.replace('__', '.', 1): value for name, value in changes.items()}
    defaults = {
        'pose.source': 'odometry',
        'pose.max_gap_s': 0.0,
        'frames.base_to_sensor': (0.0, 0.0, 0.0, *LEVEL),
        'window.max_scans': 0,
        'map.min_points': 1,
    }
    return Mapper(Config.from_mapping({**defaults, **changes}))


def scan_at(stamp_s, frame_id='lidar', points=None):
    """Return a scan; its points depend on the stamp alone."""
    if points is None:
        rng = np.random.default_rng(round(stamp_s * 1000))
        points = rng.uniform([-3, -3, 1], [3, 3, 1.2], (40, 3)).astype(np.float32)
    return Scan(points=np.asarray(points), stamp_ns=round(stamp_s * S), frame_id=frame_id)


def add_pose(mapper, stamp_s, x=0.0, q_xyzw=LEVEL, parent='odom', child='base_link'):
    mapper.add_pose(parent, child, round(stamp_s * S), (x, 0.0, 0.0), q_xyzw)


def insert(mapper, *scans):
    """Add scans and return the updates that they lead to."""
    updates = []
    for scan in scans:
        mapper.add_scan(scan)
        updates += mapper.insert_ready()
    return updates


def digest_of(*posed_scans):
    """Return the digest of a map of scans at their poses, without points within 0.1 m."""
    surfel_map = SurfelMap(0.5)
    for scan, pose in posed_scans:
        moments = surfel_map.reduce(scan.points, pose, origin=pose[:3, 3], min_range_m=0.1)
        surfel_map.insert(moments)
    return surfel_map.digest()


def assert_counts_add_up(mapper, waiting=0):
    counters = mapper.counters
    dropped = sum(counters.dropped.values())
    assert counters.received == counters.mapped + counters.gated + dropped + waiting


def dropped(mapper):
    return dict(mapper.counters.dropped)
