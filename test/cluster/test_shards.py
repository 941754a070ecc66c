# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Shards of a bag, cut anywhere, give the map and the counts of one run."""

from itertools import pairwise

import numpy as np
import pytest

from surfel_mapper.cluster.map_reduce import map_bags
from surfel_mapper.cluster.workers import never, Workers
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, MapError
from test import extras
from test.cluster.bags import BAGS, counted, in_one_go, RECORDED_S, shards_of, written

pytestmark = extras.needs('pyarrow')


@pytest.mark.parametrize('name', BAGS)
def test_shards_make_the_map_and_the_counts_of_one_go(tmp_path, name):
    bag, config = written(tmp_path, name)
    expected = in_one_go(bag, config)
    shards = shards_of(bag, config, 0.9)

    mapped = map_bags([shards], Workers())

    assert mapped.mapper.map == expected.map
    assert expected.map.num_voxels > 100
    assert counted(mapped.counts) == counted(expected.summary())


def test_a_bag_is_cut_into_equal_parts_without_gaps(tmp_path):
    bag, config = written(tmp_path, 'plain')
    shards = shards_of(bag, config, 1.0)

    assert len(shards) == 6
    spans = [shard.span for shard in shards]
    assert spans[0].start_ns is spans[-1].stop_ns is None
    assert all(a.stop_ns == b.start_ns for a, b in pairwise(spans))
    lengths = [(s.stop_ns - s.start_ns) / 1e9 for s in spans[1:-1]]
    assert lengths == pytest.approx([RECORDED_S / 6] * 4)
    assert len(shards_of(bag, config, 100.0)) == 1


@pytest.mark.parametrize(
    'settings',
    [
        {'window.gate_distance_m': 1.0},
        {'align.every_scans': 5, 'window.keep_points': True},
        {'pose.source': 'registration'},
        {'pose.max_wait_s': 9.0},
        {'pose.max_gap_s': 0.0},
    ],
)
def test_a_bag_whose_scans_depend_on_all_before_is_not_cut(tmp_path, settings):
    bag, _ = written(tmp_path, 'plain')
    assert len(shards_of(bag, Config().replace(settings), 1.0)) == 1


def test_a_bag_whose_scans_are_out_of_order_is_mapped_as_one(tmp_path):
    bag, config = written(tmp_path, 'time set back')
    expected = in_one_go(bag, config)

    mapped = map_bags([shards_of(bag, config, 1.0)], Workers())

    assert mapped.repeated == 1
    assert mapped.mapper.map == expected.map


@pytest.mark.parametrize('every', [1, 3])
def test_a_part_of_a_bag_is_mapped_alike(tmp_path, every):
    bag, config = written(tmp_path, 'plain')
    part = {'start_s': 1.25, 'duration_s': 3.0, 'every': every}
    expected = in_one_go(bag, config, **part)

    shards = shards_of(bag, config, 0.7, **part)
    mapped = map_bags([shards], Workers())

    assert len(shards) == (5 if every == 1 else 1)
    assert mapped.mapper.map == expected.map
    assert mapped.counts['scans']['received'] == 30 // every


@pytest.mark.parametrize('has_stamps', [True, False])
def test_poses_of_a_file_are_known_in_the_middle_too(tmp_path, has_stamps):
    bag, config = written(tmp_path, 'plain')
    rows = np.zeros((60, 8))
    rows[:, 0], rows[:, 1], rows[:, 3], rows[:, 7] = np.arange(60) / 10, np.arange(60), 1.0, 1.0
    lines = [f'17000000{row[0]:04.1f} ' + ' '.join(map(str, row[1:])) for row in rows]
    if not has_stamps:
        lines = [f'1 0 0 {row[1]} 0 1 0 {row[2]} 0 0 1 {row[3]}' for row in rows]
    poses = tmp_path / 'poses.txt'
    poses.write_text('\n'.join([*lines, '']))
    config = config.replace({'pose.source': 'odometry'})
    part = {'poses': poses, 'poses_format': 'tum' if has_stamps else 'kitti'}
    expected = in_one_go(bag, config, **part)

    shards = shards_of(bag, config, 1.0, **part)
    mapped = map_bags([shards], Workers())

    assert len(shards) == (6 if has_stamps else 1)
    assert mapped.mapper.map == expected.map
    assert mapped.counts['scans']['mapped'] == 60


class LastFirst(Workers):
    """Runs the tasks in the opposite order, as may happen among several workers."""

    def run(self, function, items, stopped=never):
        for done, result in super().run(function, items[::-1], stopped):
            yield len(items) - 1 - done, result


def after(number):
    """Return a function that asks to stop after a number of shards."""
    asked = iter(range(number))
    return lambda: next(asked, None) is None


def test_shards_after_a_gap_are_left_out_when_it_is_stopped(tmp_path):
    first, config = written(tmp_path, 'plain')
    second, _ = written(tmp_path, 'faults')
    bags = [shards_of(first, config, 3.0), shards_of(second, config, 3.0)]
    expected = in_one_go(second, config)

    mapped = map_bags(bags, LastFirst(), stopped=after(3))

    assert mapped.interrupted
    assert mapped.num_shards == 2
    assert mapped.mapper.map == expected.map
    with pytest.raises(MapError, match='no scan was mapped'):
        map_bags(bags, LastFirst(), stopped=after(1))


def test_a_frozen_map_is_refused(tmp_path):
    bag, config = written(tmp_path, 'plain')
    with pytest.raises(ConfigError, match='several processes begin with empty maps'):
        shards_of(bag, config.replace({'map.load': 'old.npz'}), 1.0)


def test_progress_adds_up_to_the_recording(tmp_path):
    bag, config = written(tmp_path, 'plain')
    told = []
    map_bags([shards_of(bag, config, 1.0)], Workers(), told.append)
    assert sum(told) == pytest.approx(RECORDED_S, abs=0.01)
