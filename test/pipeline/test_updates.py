# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper: updates keep a copy of the map up to date; limits of the window, the motion gate."""

import numpy as np
import pytest

from surfel_mapper.geometry import pose_matrix
from test import reference
from test.pipeline.made_scans import (
    add_pose,
    assert_counts_add_up,
    digest_of,
    insert,
    LEVEL,
    mapper_with,
    S,
    scan_at,
)

pytestmark = pytest.mark.filterwarnings('error')


# What an update says


def surfels_by_voxel(surfels):
    names = ('position', 'normal', 'planarity', 'curvature', 'eigenvalues', 'num_points')
    rows = zip(*(getattr(surfels, name).tolist() for name in names), strict=True)
    voxels = map(tuple, surfels.voxel_index.tolist())
    return {voxel: repr(row) for voxel, row in zip(voxels, rows, strict=True)}


@pytest.mark.parametrize('min_points', [1, 3])
def test_updates_keep_a_copy_of_the_map_up_to_date(min_points):
    mapper = mapper_with(map__min_points=min_points, window__max_scans=5)
    copy, moments = {}, {}
    for stamp_s in range(20):
        add_pose(mapper, stamp_s, x=0.4 * stamp_s)
        scan = scan_at(stamp_s)
        (update,) = insert(mapper, scan)
        changed = surfels_by_voxel(update.changed)

        pose = update.T_map_sensor
        twins = [reference.scan_moments(scan.points, 0.5, pose[:3, 3], pose)]
        reference.add_moments(moments, twins[0])
        for eviction in update.evictions:
            twins.append(reference.as_twin(eviction.scan.moments))
            reference.add_moments(moments, twins[-1], -1)
        touched = set().union(*twins)
        assert set(changed) == {v for v in touched if moments.get(v, [0])[0] >= min_points}

        for voxel in map(tuple, update.removed_voxel_index.tolist()):
            assert moments.get(voxel, [0])[0] < min_points
            copy.pop(voxel, None)
        copy.update(changed)
        assert copy == surfels_by_voxel(mapper.map.surfels(min_points))
    assert mapper.map.digest() == reference.digest(moments, 0.5)
    assert dict(mapper.counters.evicted) == {'max_scans': 15}


def test_without_deriving_updates_hold_no_surfels_and_the_map_is_the_same():
    mappers = [mapper_with(window__max_scans=3) for _ in range(2)]
    mappers[1].derives = False
    for stamp_s in range(6):
        updates = []
        for mapper in mappers:
            add_pose(mapper, stamp_s, x=0.4 * stamp_s)
            updates += insert(mapper, scan_at(stamp_s))
        assert len(updates[0].changed) > 0
        assert len(updates[1].changed) == 0
        removed = [set(map(tuple, each.removed_voxel_index.tolist())) for each in updates]
        assert removed[0] == removed[1]
    assert mappers[0].map.digest() == mappers[1].map.digest()


# Window and gate


@pytest.mark.parametrize(
    ('limits', 'left'),
    [
        ({'window__max_scans': 4}, 4),
        ({'window__max_age_s': 2.5}, 3),
        ({'window__max_distance_m': 1.3}, 3),
        ({'window__max_bytes': 1}, 1),
        ({'window__max_scans': 4, 'window__max_age_s': 1.5}, 2),
    ],
)
def test_the_limits_of_the_configuration_hold(limits, left):
    mapper = mapper_with(**limits)
    for stamp_s in range(9):
        add_pose(mapper, stamp_s, x=0.5 * stamp_s)
        insert(mapper, scan_at(stamp_s))
    assert len(mapper.window) == left
    scans = [scan_at(stamp_s) for stamp_s in range(9 - left, 9)]
    poses = [pose_matrix((0.5 * s, 0, 0), LEVEL) for s in range(9 - left, 9)]
    assert mapper.map.digest() == digest_of(*zip(scans, poses, strict=True))
    assert sum(mapper.counters.evicted.values()) == 9 - left
    assert set(mapper.counters.evicted) <= {name.split('__')[1] for name in limits}


def drive_gated(**gate):
    """Return which of 13 scans are mapped: x rises by 0.25 m to 1.5 m, then a turn by 10 deg."""
    mapper = mapper_with(**gate)
    mapped = []
    for number in range(13):
        angle = np.radians(10.0 * max(number - 6, 0)) / 2.0
        q = (0.0, 0.0, np.sin(angle), np.cos(angle))
        add_pose(mapper, number, x=0.25 * min(number, 6), q_xyzw=q)
        mapped += [update.stamp_ns // S for update in insert(mapper, scan_at(number))]
    assert mapper.counters.gated == 13 - len(mapped)
    assert_counts_add_up(mapper)
    return mapped


def test_the_motion_gate_leaves_out_scans_taken_while_standing_still():
    assert drive_gated() == list(range(13))
    assert drive_gated(window__gate_distance_m=0.5) == [0, 2, 4, 6]
    assert drive_gated(window__gate_angle_deg=25.0) == [0, 9, 12]
    both = drive_gated(window__gate_distance_m=0.7, window__gate_angle_deg=15.0)
    assert both == [0, 3, 6, 8, 10, 12]
    assert drive_gated(window__gate_distance_m=100.0) == [0]


def test_the_motion_gate_looks_back_to_the_last_scan_mapped():
    mapper = mapper_with(window__gate_distance_m=1.0)
    for number in range(20):  # 0.3 m a scan: each alone would be too little
        add_pose(mapper, number, x=0.3 * number)
        insert(mapper, scan_at(number))
    assert mapper.counters.mapped == 5
    mapper.clear()
    add_pose(mapper, 30.0, x=6.0)
    assert len(insert(mapper, scan_at(30.0))) == 1  # nothing to look back to
