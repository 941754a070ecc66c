# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A chain in the pipeline: poses for filters, and the report of points and times."""

from __future__ import annotations

import json

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan

S = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)


def mapper_with(tmp_path, chain, mount=(0.0, 0.0, 1.0, *LEVEL)):
    path = tmp_path / 'filters.yaml'
    path.write_text(chain, encoding='utf-8')
    mapper = Mapper(
        Config.from_mapping(
            {
                'pose.source': 'odometry',
                'pose.max_gap_s': 5.0,  # the two poses below
                'frames.base_to_sensor': mount,
                'filters': str(path),
                'map.min_points': 1,
            }
        )
    )
    mapper.add_pose('odom', 'base_link', 0, (0.0, 0.0, 0.0), LEVEL)
    mapper.add_pose('odom', 'base_link', 5 * S, (0.0, 0.0, 0.0), LEVEL)
    return mapper


def cloud(number=500, seed=1):
    return np.random.default_rng(seed).uniform(-5.0, 5.0, (number, 3)).astype(np.float32)


def insert(mapper, *clouds):
    updates = []
    for second, points in enumerate(clouds, start=1):
        mapper.add_scan(Scan(points=points, stamp_ns=second * S, frame_id='lidar'))
        updates += mapper.insert_ready()
    return updates


def test_only_what_the_chain_leaves_is_mapped_and_each_filter_is_reported(tmp_path):
    mapper = mapper_with(tmp_path, '- range_limit: {min_m: 0.0, max_m: 4.0}\n- max_point_count')
    clouds = [cloud(seed=seed) for seed in (1, 2)]
    updates = insert(mapper, *clouds)
    near = [points[np.linalg.norm(points, axis=1) <= 4.0] for points in clouds]
    expected = SurfelMap(0.5)
    for points in near:
        pose = np.eye(4)
        pose[2, 3] = 1.0
        expected.insert(expected.reduce(points, pose, origin=pose[:3, 3], min_range_m=0.1))
    assert mapper.map.digest() == expected.digest()
    assert all(update.milliseconds['filter'] >= 0.0 for update in updates)

    number = sum(map(len, near))
    summary = json.loads(json.dumps(mapper.summary()))
    assert list(summary['filters']) == ['1 range_limit', '2 max_point_count']
    first, second = summary['filters'].values()
    assert (first['points_in'], first['points_out']) == (1000, number)
    assert (second['points_in'], second['points_out']) == (number, number)
    assert set(first['milliseconds']) >= {'median', 'p99'}
    assert summary['points_left_out']['filtered'] == 1000 - number
    assert Chain.from_list(summary['filter_chain']).filters == mapper.chain.filters


def test_filters_know_where_the_sensor_is_on_the_robot(tmp_path):
    box = '{x_min_m: -9, x_max_m: 9, y_min_m: -9, y_max_m: 9, z_min_m: -9, z_max_m: 0}'
    mapper = mapper_with(tmp_path, f'- body_box: {box}')
    insert(mapper, np.array([[1.0, 1.0, -0.9], [1.0, 1.0, -1.1]], np.float32))
    assert mapper.counters.points == 1


def test_a_scan_that_a_filter_cannot_take_is_dropped_and_counted(tmp_path):
    mapper = mapper_with(tmp_path, '- shadow')
    insert(mapper, cloud())
    assert dict(mapper.counters.dropped) == {'filter': 1}


def test_a_scan_of_which_nothing_is_left_is_dropped_and_counted(tmp_path):
    mapper = mapper_with(tmp_path, '- max_dist: {max_m: 0}')
    insert(mapper, cloud())
    assert dict(mapper.counters.dropped) == {'filtered_out': 1}


def test_a_chain_that_cannot_be_built_is_refused_at_once(tmp_path):
    with pytest.raises(ConfigError, match=r'filters.yaml: filter 1: shadw: .*did you mean shadow'):
        mapper_with(tmp_path, '- shadw')


def test_an_update_has_the_filtered_scan_with_the_columns_added(tmp_path):
    chain = '- range_limit: {max_m: 4.0}\n- surface_normal\n'
    points = cloud()
    (update,) = insert(mapper_with(tmp_path, chain), points)
    expected = Chain.from_yaml(chain).apply(points)
    np.testing.assert_array_equal(update.filtered.points, expected.points)
    np.testing.assert_array_equal(update.filtered.columns['normals'], expected.columns['normals'])
    assert len(update.scan) == len(points)
    (update,) = insert(mapper_with(tmp_path, ''), points)
    assert update.filtered is update.scan


def test_a_scan_with_points_that_are_not_finite_is_mapped_and_they_are_counted(tmp_path):
    points = cloud()
    points[:7, 2] = np.inf
    mapper = mapper_with(tmp_path, '- voxel_grid')
    (update,) = insert(mapper, points)
    assert len(update.filtered) > 0
    assert mapper.counters.summary()['filters']['1 voxel_grid']['not_finite'] == 7
