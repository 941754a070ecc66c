# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The published changes of a map, and a MapMirror that applies them: it always equals the map.

Imports no ROS: messages are built from the bytes that the node publishes.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper import Mapper, Scan, SurfelMap
from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.messages.map_cloud import (
    halves,
    MapMirror,
    moment_cloud,
    voxel_columns,
    whole,
)
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.pipeline.regions import Ball
from surfel_mapper.ros.changes import AdaptiveTracker, ChangeTracker

SECOND = 10**9
NO_VOXELS = np.empty((0, 3), np.int32)


def config_with(**changes):
    return Config.from_mapping(
        {
            'pose.source': 'identity',
            'map.min_points': 4,
            'window.max_scans': 4,
            'publish.moments': True,
            **changes,
        }
    )


class Node:
    """A mapper, and the messages that a node would publish about it."""

    def __init__(self, **changes):
        self.mapper = Mapper(config_with(**changes))
        self.changes = ChangeTracker(self.mapper)
        self.stamp_ns = 0
        self._rng = np.random.default_rng(1)

    def message(self, surfels, removed=NO_VOXELS):
        moments = self.mapper.map.moments(surfels.voxel_index)
        content = moment_cloud(surfels, moments, removed)
        stamp = SimpleNamespace(sec=self.stamp_ns // SECOND, nanosec=self.stamp_ns % SECOND)
        header = SimpleNamespace(stamp=stamp, frame_id='odom')
        return SimpleNamespace(
            header=header, **{name: getattr(content, name) for name in content.__slots__}
        )

    def full(self):
        return self.message(self.mapper.map.surfels(1))

    def map_scan(self, stamp_ns, num=300):
        """Map a random scan; return its changes as (MapChange, message)."""
        center = self._rng.integers(-3, 3, 3)
        points = self._rng.normal(scale=0.8, size=(num, 3)) + center
        colors = self._rng.integers(0, 2**24, num).astype(np.uint32)
        columns = {'rgb': colors, 'intensity': self._rng.uniform(0, 255, num)}
        self.mapper.add_scan(
            Scan(points=points, stamp_ns=stamp_ns, frame_id='odom', columns=columns)
        )
        (update,) = self.mapper.insert_ready()
        self.stamp_ns = stamp_ns
        change = self.changes.after_scan(update)
        return change, self.message(change.surfels, change.removed)

    def collect(self):
        change = self.changes.collect()
        return change, self.message(change.surfels, change.removed)


def assert_equal(mirror, node):
    assert mirror.map.digest() == node.mapper.map.digest()
    num_scans = [m.moments().num_scans for m in (mirror.map, node.mapper.map)]
    np.testing.assert_array_equal(*num_scans)


@pytest.mark.parametrize('channels', [(), ('intensity',), ('rgb',), ('intensity', 'rgb')])
def test_a_mirror_follows_scans_that_come_and_go(channels):
    sums = {'map.intensity': 'intensity' in channels, 'map.color': 'rgb' in channels}
    node, mirror = Node(**sums), MapMirror(0.5, channels)
    for number in range(12):
        _, message = node.map_scan(number * SECOND)
        mirror.change(message)
        assert_equal(mirror, node)
        assert mirror.stamp_ns == number * SECOND
    assert node.mapper.counters.evicted['max_scans'] == 8


def test_a_late_client_is_complete_after_the_next_full_map():
    node, mirror = Node(), MapMirror(0.5)
    for number in range(3):
        node.map_scan(number * SECOND)
    _, message = node.map_scan(3 * SECOND)
    mirror.change(message)
    assert not mirror.is_complete
    mirror.replace(node.full())
    assert mirror.is_complete
    assert_equal(mirror, node)


def test_the_next_full_map_repairs_a_lost_change():
    node, mirror = Node(), MapMirror(0.5)
    for number in range(6):
        _, message = node.map_scan(number * SECOND)
        if number != 3:
            mirror.change(message)
    assert mirror.map.digest() != node.mapper.map.digest()
    mirror.replace(node.full())
    assert_equal(mirror, node)


def test_a_mirror_follows_clearing_and_loading():
    node, mirror = Node(), MapMirror(0.5)
    for number in range(3):
        mirror.change(node.map_scan(number * SECOND)[1])
    node.mapper.clear_region(Ball((0.0, 0.0, 0.0), 1.5))
    mirror.change(node.collect()[1])
    assert_equal(mirror, node)
    mirror.change(node.map_scan(3 * SECOND)[1])
    assert_equal(mirror, node)

    node.mapper.clear()
    change, message = node.collect()
    mirror.change(message)
    assert len(mirror.map) == 0
    assert len(change.removed) > 100

    other = SurfelMap(0.5)
    other.add(np.random.default_rng(5).normal(size=(500, 3)))
    node.mapper.restore(other, [])
    mirror.change(node.collect()[1])
    assert_equal(mirror, node)


@pytest.mark.parametrize(
    ('before', 'after'),
    [
        ({'publish.moments': False, 'map.min_points': 8}, {'map.min_points': 3}),
        ({'publish.moments': False, 'map.min_points': 8}, {'publish.moments': True}),
        ({'publish.moments': False, 'map.min_points': 1}, {'publish.moments': True}),
    ],
)
def test_all_voxels_are_collected_once_settings_publish_more(before, after):
    node = Node(**before)
    for number in range(3):
        node.map_scan(number * SECOND)
    node.mapper.reconfigure(node.mapper.config.replace(after))

    change, message = node.collect()

    expected = node.mapper.map.keys(node.changes.min_points)
    assert set(pack_keys(change.surfels.voxel_index).tolist()) == set(expected.tolist())
    assert not len(change.removed)
    assert not len(node.collect()[0].surfels)
    if node.mapper.config.publish.moments:
        mirror = MapMirror(0.5)
        mirror.change(message)
        assert_equal(mirror, node)


def test_voxels_that_no_longer_qualify_are_removed_and_others_not_sent_again():
    node = Node(**{'publish.moments': False, 'map.min_points': 3})
    node.map_scan(0)
    least_3, least_8 = (set(node.mapper.map.keys(number).tolist()) for number in (3, 8))
    node.mapper.reconfigure(node.mapper.config.replace({'map.min_points': 8}))

    change, _ = node.collect()

    assert not len(change.surfels)
    assert set(pack_keys(change.removed).tolist()) == least_3 - least_8


def test_without_moments_only_surfels_are_published():
    node = Node(**{'publish.moments': False})
    known = set()
    for number in range(10):
        change, _ = node.map_scan(number * SECOND)
        assert (change.surfels.num_points >= 4).all()
        known |= set(pack_keys(change.surfels.voxel_index).tolist())
        removed = set(pack_keys(change.removed).tolist())
        assert removed <= known
        known -= removed
        now = node.mapper.map.surfels(4)
        assert known == set(pack_keys(now.voxel_index).tolist())
    node.mapper.clear()
    change, _ = node.collect()
    assert set(pack_keys(change.removed).tolist()) == known


def test_integers_keep_all_their_bits():
    values = np.array([0, 1, -1, 2**62, -(2**63), 2**63 - 1, 0x0123456789ABCDEF])
    pairs = halves(values.reshape(-1, 1))
    assert pairs.dtype == np.uint32
    assert pairs[6].tolist() == [0x89ABCDEF, 0x01234567]  # the low half first
    np.testing.assert_array_equal(whole(pairs), values)


def test_removed_voxels_have_position_and_index():
    columns = voxel_columns(np.array([[0, -1, 3]], np.int32), 0.5)
    assert {name: values.tolist() for name, values in columns.items()} == {
        'x': [0.25],
        'y': [-0.25],
        'z': [1.75],
        'voxel_x': [0],
        'voxel_y': [-1],
        'voxel_z': [3],
        'size': [0.5],
    }


def test_mirror_derives_the_adaptive_surfels_of_the_node():
    node, mirror = Node(**{'window.max_scans': 3}), MapMirror(0.5)
    for number in range(6):
        mirror.change(node.map_scan(number * SECOND)[1])
    cuts = [m.adaptive_cut(max_thickness_m=0.3) for m in (node.mapper.map, mirror.map)]
    surfels = [cut.refresh().surfels for cut in cuts]
    assert cuts[0].digest() == cuts[1].digest()
    assert len(np.unique(surfels[0].size)) > 1


def test_adaptive_changes_add_up_to_the_adaptive_surfels():
    settings = {'publish.moments': False, 'publish.adaptive': True, 'window.max_scans': 2}
    node = Node(**settings)
    tracker, shown = AdaptiveTracker(node.mapper), {}

    def follow(change):
        sizes = np.broadcast_to(change.removed_size_m, len(change.removed)).tolist()
        for key in zip(sizes, map(tuple, change.removed.tolist()), strict=True):
            shown.pop(key)
        index = map(tuple, change.surfels.voxel_index.tolist())
        keys = zip(change.surfels.size.tolist(), index, strict=True)
        shown.update(zip(keys, change.surfels.num_points.tolist(), strict=True))

    for number in range(8):
        change_of_voxels, _ = node.map_scan(number * SECOND)
        assert not len(change_of_voxels.surfels)  # none are derived
        follow(tracker.after_scan(None))
        check_shown(node, shown)
    node.mapper.clear()
    follow(tracker.collect())
    assert not shown


def check_shown(node, shown):
    surfels = node.mapper.map.adaptive(node.mapper.config.map.min_points)
    index = map(tuple, surfels.voxel_index.tolist())
    keys = zip(surfels.size.tolist(), index, strict=True)
    assert shown == dict(zip(keys, surfels.num_points.tolist(), strict=True))


def test_clouds_without_moments_are_refused_and_change_nothing():
    node, mirror = Node(), MapMirror(0.5)
    mirror.change(node.map_scan(0)[1])
    digest = mirror.map.digest()
    full = node.full()
    plain = to_scan(full)
    without = {**dict(zip('xyz', plain.points.T, strict=True)), 'num_points': np.zeros(len(plain))}
    content = from_columns(without)
    names = content.__slots__
    message = SimpleNamespace(header=full.header, **{n: getattr(content, n) for n in names})
    with pytest.raises(CloudFormatError, match=r'no field voxel_x.*publish\.moments'):
        mirror.replace(message)
    with pytest.raises(CloudFormatError, match='no field sum_intensity'):
        MapMirror(0.5, ('intensity',)).replace(full)
    with pytest.raises(CloudFormatError, match=r'voxels of 0\.4 m'):
        MapMirror(0.4).change(full)
    assert mirror.map.digest() == digest
