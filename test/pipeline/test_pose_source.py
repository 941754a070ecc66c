# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A mapper while pose.source auto has not chosen, and after it has chosen registration."""

import pytest

from surfel_mapper.errors import ConfigError
from test.pipeline.made_scans import add_pose, insert, mapper_with, scan_at
from test.pipeline.test_registered_poses import feed
from test.pipeline.test_registered_poses import mapper_with as registering
from test.pipeline.test_registered_poses import scan_at as room_at


def test_scans_wait_while_the_source_is_unknown_and_are_mapped_then():
    mapper, expected = mapper_with(pose__source='auto'), mapper_with(pose__source='tf')
    mapper.knows_source = False
    scans = [scan_at(stamp_s) for stamp_s in (1.0, 3.0, 30.0)]
    assert insert(mapper, *scans) == []
    for each in (mapper, expected):
        for stamp_s in (0.9, 1.1, 2.9, 3.1, 29.9, 30.1):
            add_pose(each, stamp_s, x=stamp_s)
    assert list(mapper.insert_ready()) == []
    assert mapper.counters.dropped.total() == 0

    mapper.knows_source = True

    assert len(list(mapper.insert_ready())) == len(insert(expected, *scans)) == 3
    assert mapper.map.digest() == expected.map.digest()


def test_scans_beyond_the_bound_are_dropped_and_counted():
    mapper = mapper_with(pose__source='auto', pose__max_waiting_scans=2)
    mapper.knows_source = False
    insert(mapper, *(scan_at(1.0 + number) for number in range(5)))
    assert mapper.counters.dropped == {'queue_full': 3}


@pytest.mark.parametrize('loops', [False, True])
def test_registration_after_a_wait_gives_the_same_map(loops):
    scans = [room_at(number) for number in range(4)]
    settings = {'loops__enabled': loops, 'loops__odometry_map_m': 20.0}
    expected = registering(**settings)
    feed(expected, scans)
    mapper = registering(pose__source='auto', **settings)
    mapper.knows_source = False
    assert feed(mapper, scans) == []

    mapper.register_scans()
    mapper.knows_source = True

    assert len(list(mapper.insert_ready())) == 4
    assert mapper.map.digest() == expected.map.digest()


@pytest.mark.parametrize('changes', [{'pose__source': 'odometry'}, {'map__origin': 'auto'}])
def test_registration_is_refused_unless_auto_may_take_it(changes):
    mapper = mapper_with(**{'pose__source': 'auto', **changes})
    with pytest.raises(ConfigError, match='expected auto, none and none to take registration'):
        mapper.register_scans()
    assert mapper.registered is None


def test_registration_is_refused_once_scans_are_mapped():
    mapper = mapper_with(pose__source='auto')
    add_pose(mapper, 0.9)
    add_pose(mapper, 1.1)
    assert len(insert(mapper, scan_at(1.0))) == 1
    with pytest.raises(ConfigError, match='1 scan mapped'):
        mapper.register_scans()
