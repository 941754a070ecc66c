# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper: scans and points that are left out are counted and logged."""

import logging

import numpy as np
import pytest

from test.pipeline.made_scans import (
    add_pose,
    assert_counts_add_up,
    digest_of,
    dropped,
    insert,
    mapper_with,
    scan_at,
)

pytestmark = pytest.mark.filterwarnings('error')


def test_scans_without_a_frame_or_points_are_dropped():
    mapper = mapper_with(pose__source='identity')
    nothing = np.empty((0, 3), np.float32)
    all_nan = np.full((9, 3), np.nan, np.float32)
    far = np.full((9, 3), 1e30, np.float32)
    updates = insert(
        mapper,
        scan_at(1.0, ''),
        scan_at(2.0, points=nothing),
        scan_at(3.0, points=all_nan),
        scan_at(4.0, points=far),
        scan_at(5.0),
    )
    assert len(updates) == 1
    assert dropped(mapper) == {
        'empty_frame_id': 1,
        'no_points': 1,
        'no_valid_points': 1,
        'map_limit': 1,
    }
    assert dict(mapper.counters.points_left_out) == {'not_finite': 9, 'beyond_map': 9}
    assert_counts_add_up(mapper)


def test_points_that_cannot_be_mapped_are_left_out_and_counted_and_the_others_mapped():
    points = scan_at(1.0).points.copy()
    points[[3, 9], 1] = np.nan
    points[5] = np.inf
    points[7] = [0.0, 3e38, 0.0]
    points[8] = [6e5, 0.0, 0.0]
    points[20] = [0.05, 0.0, 0.0]
    points[21] = [0.0, 0.0, 60.0]
    mapper = mapper_with(input__max_range_m=1e6)
    add_pose(mapper, 1.0)
    (update,) = insert(mapper, scan_at(1.0, points=points))
    assert dict(mapper.counters.points_left_out) == {
        'not_finite': 3,
        'too_near': 1,
        'too_far': 1,
        'beyond_map': 1,
    }
    assert update.num_points == mapper.counters.points == mapper.map.num_points == 34
    good = np.delete(points, [3, 9, 5, 7, 8, 20], axis=0)
    assert mapper.map.digest() == digest_of((scan_at(1.0, points=good), np.eye(4)))


def test_the_range_is_measured_from_the_sensor():
    mapper = mapper_with(input__min_range_m=1.0, input__max_range_m=4.0)
    add_pose(mapper, 1.0, x=1000.0)
    points = np.array([[0.9, 0, 0], [1.0, 0, 0], [0, 4.0, 0], [0, 4.1, 0]])
    (update,) = insert(mapper, scan_at(1.0, points=points))
    assert update.num_points == 2
    assert dict(mapper.counters.points_left_out) == {'too_near': 1, 'too_far': 1}


def test_a_scan_that_the_map_refuses_is_dropped_and_the_next_one_mapped():
    mapper = mapper_with(pose__source='identity')
    crowd = np.ones((2**23 + 1, 3), np.float32, order='F')
    assert insert(mapper, scan_at(1.0, points=crowd)) == []
    assert dropped(mapper) == {'map_limit': 1}
    assert mapper.map.num_points == 0
    assert len(insert(mapper, scan_at(2.0))) == 1
    assert_counts_add_up(mapper)


def test_a_warning_names_the_cause_once_a_second_but_every_drop_is_counted(caplog):
    mapper = mapper_with()
    with caplog.at_level(logging.WARNING):
        insert(mapper, *[scan_at(stamp_s, '') for stamp_s in range(20)])
        insert(mapper, scan_at(1.0, points=np.empty((0, 3))))
    texts = [record.getMessage() for record in caplog.records]
    assert 1 <= sum('no frame_id' in text for text in texts) < 20
    assert any("in frame 'lidar' dropped: it has no points" in text for text in texts)
    assert dropped(mapper)['empty_frame_id'] == 20
