# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The models of a mapper: when they follow; windows, alignments, clearing and restoring."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.geometry import q_xyzw
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.alignment.street import drifted, street_scans
from test.fields import config_of
from test.models.live_scenes import groups, ids, live

S = 10**9
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base': 'lidar',
    'map.voxel_size_m': 0.5,
    'layers.models.enabled': True,
    'layers.models.noise_m': 0.02,
}


@pytest.fixture(scope='module')
def street():
    scans, poses = street_scans(8)
    return scans, poses


def mapper_with(**settings):
    settings = {name.replace('__', '.'): value for name, value in settings.items()}
    return Mapper(config_of({**SETTINGS, **settings}))


def feed(mapper, scans, poses):
    updates = []
    for scan, pose in zip(scans, poses, strict=True):
        mapper.add_pose('odom', 'lidar', scan.stamp_ns, pose[:3, 3], q_xyzw(pose))
        mapper.add_scan(scan)
        updates += mapper.insert_ready()
    return updates


def assert_up_to_date(mapper):
    """The models are those that a map read at once has."""
    mapper.models.update()
    assert groups(mapper.models) == groups(live(mapper.map.copy(), mapper.config.models))


def test_models_follow_by_the_stamps_of_the_scans():
    mapper = mapper_with(layers__models__extract_period_s=1.0)
    points = np.random.default_rng(0).uniform(-5, 5, (500, 3)).astype(np.float32)
    stamps = (10.0, 10.4, 10.99, 11.0, 11.5, 12.1)
    scans = [Scan(points=points, stamp_ns=round(s * S), frame_id='lidar') for s in stamps]
    updates = feed(mapper, scans, [np.eye(4)] * len(stamps))
    due = [update.models is not None for update in updates]
    assert due == [True, False, False, True, False, True]
    assert ['models' in update.milliseconds for update in updates] == due


def test_evicted_scans_leave_the_models(street):
    mapper = mapper_with(layers__models__extract_period_s=0.0, window__max_scans=2)
    scans, poses = street
    far = [pose.copy() for pose in poses]
    for number, pose in enumerate(far):
        pose[0, 3] += 200.0 * (number // 4)  # the second half sees another street
    updates = feed(mapper, scans, far)
    gone = {number for update in updates for number in update.models.removed}
    assert set(updates[0].models.created) & gone
    assert ids(mapper.models) == set(mapper.models.versions)
    assert mapper.models.surfels.position[:, 0].min() > 100.0
    assert_up_to_date(mapper)


def test_an_alignment_moves_the_models(street):
    scans, poses = street
    mapper = mapper_with(window__keep_points=True, align__key_distance_m=0.0)
    feed(mapper, scans, drifted(poses, 0.02, 0.2))
    before = mapper.map.digest()
    mapper.models.update()
    kept = ids(mapper.models)
    mapper.align()
    assert mapper.map.digest() != before
    assert_up_to_date(mapper)
    largest = max(mapper.models.model.patches, key=lambda patch: patch.num_points)
    assert largest.id in kept


def test_models_follow_a_map_that_is_cleared_or_restored(street):
    scans, poses = street
    mapper = mapper_with()
    feed(mapper, scans[:3], poses[:3])
    mapper.models.update()
    before = ids(mapper.models)
    saved = mapper.map.copy()
    mapper.clear()
    assert ids(mapper.models) == set()
    update = feed(mapper, scans[3:4], poses[3:4])[0]  # due at once again
    assert set(update.models.removed) == before
    mapper.restore(saved, [])
    assert_up_to_date(mapper)
    assert len(mapper.models.surfels) == saved.num_voxels
