# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Two threads: the next scan is prepared while one is inserted, and nothing is different for it.

A mapper with one thread gets the same input and has to do the same, update by update, whatever
comes between two scans.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball
from surfel_mapper.scan import Scan

S = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)


def mapper_with(threads, **changes):
    settings = {
        'pose.source': 'odometry',
        'frames.base_to_sensor': (0.0, 0.0, 0.0, *LEVEL),
        'map.min_points': 1,
        'window.max_scans': 4,
        'window.keep_points': True,
        'map.threads': threads,
    }
    return Mapper(Config.from_mapping({**settings, **changes}))


def add(mapper, number):
    """Add a scan of a corner that stands still, and a pose that is a little off."""
    rng = np.random.default_rng(number)
    corner = rng.uniform(0.0, 6.0, (3000, 3))
    corner[np.arange(3000), rng.integers(0, 3, 3000)] = 0.0
    x = 0.3 * number
    points = (corner - (x + 3.0, 3.0, 3.0)).astype(np.float32)
    at = rng.normal(scale=0.05, size=3)
    at[0] += x
    before = (at[0] - 0.05, *at[1:])  # where the sweep begins
    mapper.add_pose('odom', 'base_link', number * S - S // 5, before, LEVEL)
    mapper.add_pose('odom', 'base_link', number * S, at, LEVEL)
    times = np.linspace(-0.1, 0.0, len(points), dtype=np.float32)
    columns = {'time': times}
    mapper.add_scan(Scan(points=points, stamp_ns=number * S, frame_id='lidar', columns=columns))


def drive(mapper, first, last):
    """Add scans as fast as can be; return the updates."""
    updates = []
    for number in range(first, last):
        add(mapper, number)
        updates += mapper.insert_ready(more_follows=True)
    return updates


def same(found, expected):
    assert [update.stamp_ns for update in found] == [update.stamp_ns for update in expected]
    for left, right in zip(found, expected, strict=True):
        assert left.num_points == right.num_points
        np.testing.assert_array_equal(left.T_map_sensor, right.T_map_sensor)
        np.testing.assert_array_equal(left.removed_voxel_index, right.removed_voxel_index)
        for one, other in zip(left.changed.arrays, right.changed.arrays, strict=True):
            np.testing.assert_array_equal(one, other)


def without_times(mapper):
    summary = mapper.summary()
    timed = ('milliseconds', 'milliseconds_p99', 'stage_s')
    for step in summary.get('filters', {}).values():
        del step['milliseconds']
    return {name: value for name, value in summary.items() if name not in timed}


CHAIN = """
- range_limit: {max_m: 4.0}
- fix_step_sampling: {start_step: 2}
- statistical_outliers
- body_box: {x_min_m: -1.0, x_max_m: 3.5, y_min_m: -9.0, y_max_m: 9.0, z_min_m: -9.0}
- surface_normal: {num_neighbours: 6}
"""


@pytest.fixture
def settings_of(tmp_path):
    """Return the settings of a way to prepare scans, by its name."""
    path = tmp_path / 'chain.yaml'
    path.write_text(CHAIN)
    ways = {
        'as they came': {},
        'filtered': {'filters': str(path)},
        'deskewed': {'deskew.enabled': True},
        'both': {'filters': str(path), 'deskew.enabled': True},
    }
    return ways.__getitem__


WAYS = pytest.mark.parametrize('way', ['as they came', 'filtered', 'deskewed', 'both'])


@WAYS
@pytest.mark.parametrize('threads', [2, 3])
def test_every_update_is_that_of_one_thread(threads, way, settings_of):
    one, several = mapper_with(1, **settings_of(way)), mapper_with(threads, **settings_of(way))
    expected, found = drive(one, 1, 12), drive(several, 1, 12)
    assert len(expected) == 11
    assert len(found) == 10  # the newest is kept
    found += several.insert_ready()
    same(found, expected)
    assert without_times(several) == without_times(one)


def test_scans_that_wait_together_are_mapped_together():
    one, two = mapper_with(1), mapper_with(2)
    for mapper in (one, two):
        for number in range(1, 7):
            add(mapper, number)
    same(list(two.insert_ready()), list(one.insert_ready()))
    assert two.map == one.map


def filter_more(mapper):
    """Double the points that the filters drop; without effect on mappers without filters."""
    if mapper.config.filters:
        path = Path(mapper.config.filters).with_name('more.yaml')
        path.write_text(CHAIN.replace('start_step: 2', 'start_step: 4'))
        changed = {**mapper.config.to_mapping(), 'filters': str(path)}
        mapper.reconfigure(Config.from_mapping(changed))


def shorten(mapper):
    mapper.reconfigure(Config.from_mapping({**mapper.config.to_mapping(), 'window.max_scans': 2}))


def gate(mapper):
    mapper.reconfigure(
        Config.from_mapping({**mapper.config.to_mapping(), 'window.gate_distance_m': 1.0})
    )


def carve(mapper):
    mapper.clear_region(Ball(np.zeros(3), 2.0))


@WAYS
@pytest.mark.parametrize(
    'between', [shorten, gate, carve, filter_more], ids=lambda act: act.__name__
)
def test_changes_between_two_scans_hold_for_the_scan_that_waits(between, way, settings_of):
    one, two = (mapper_with(threads, **settings_of(way)) for threads in (1, 2))
    expected, found = drive(one, 1, 7), drive(two, 1, 8)  # two keeps the last
    assert [update.stamp_ns for update in found] == [update.stamp_ns for update in expected]
    for mapper in (one, two):
        between(mapper)
    same(list(two.insert_ready()), drive(one, 7, 8))
    assert two.map == one.map


@WAYS
def test_scans_that_were_kept_go_where_alignment_has_moved_the_map(way, settings_of):
    one, two = (mapper_with(threads, **settings_of(way)) for threads in (1, 2))
    drive(one, 1, 7)
    drive(two, 1, 8)
    for mapper in (one, two):
        mapper.align()
    assert not np.array_equal(two.T_map_fixed, np.eye(4))
    same(list(two.insert_ready()), drive(one, 7, 8))
    assert two.map == one.map


def test_a_scan_that_a_filter_refuses_is_dropped_and_the_next_comes(tmp_path):
    path = tmp_path / 'chain.yaml'
    path.write_text('- label_mask: {labels: [1]}')
    mapper = mapper_with(2, filters=str(path))
    assert drive(mapper, 1, 4) == []
    assert list(mapper.insert_ready()) == []
    assert mapper.counters.dropped['filter'] == 3


def test_filters_that_count_their_scans_are_not_applied_ahead(tmp_path):
    path = tmp_path / 'chain.yaml'
    path.write_text('- fix_step_sampling: {start_step: 2, end_step: 8, step_factor: 2.0}')
    one, two = (mapper_with(threads, filters=str(path)) for threads in (1, 2))
    same(drive(two, 1, 6), drive(one, 1, 6))
    assert without_times(two) == without_times(one)


def test_clearing_drops_and_counts_the_scans_that_were_kept():
    mapper = mapper_with(2)
    drive(mapper, 1, 5)
    mapper.clear()
    assert mapper.counters.dropped['cleared'] == 1
    assert list(mapper.insert_ready()) == []
    assert mapper.counters.received == mapper.counters.mapped + 1
    assert mapper.map.num_voxels == 0


def test_a_scan_that_cannot_be_mapped_is_dropped_and_the_next_comes():
    mapper = mapper_with(2)
    add(mapper, 1)
    mapper.add_pose('odom', 'base_link', 2 * S, (0.6, 0.0, 0.0), LEVEL)
    nothing = np.full((9, 3), np.nan, np.float32)
    mapper.add_scan(Scan(points=nothing, stamp_ns=2 * S, frame_id='lidar'))
    add(mapper, 3)
    assert [update.stamp_ns // S for update in mapper.insert_ready()] == [1, 3]
    assert mapper.counters.dropped['no_valid_points'] == 1


@pytest.mark.parametrize(
    'settings',
    [
        {'map.threads': 1},
        {'map.mode': 'frozen', 'map.load': 'map.npz'},
        {'layers.tsdf.enabled': True},
        {'pose.source': 'registration'},
    ],
)
def test_no_scan_waits_if_scans_depend_on_the_ones_before(settings):
    mapper = mapper_with(2, **settings)
    add(mapper, 1)
    assert len(list(mapper.insert_ready(more_follows=True))) == 1
