# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Sensors that get a new mount while they are mapped: later scans follow it, with a warning."""

import pytest

from surfel_mapper.geometry import pose_matrix
from test.pipeline.made_scans import (
    add_pose,
    digest_of,
    dropped,
    insert,
    LEVEL,
    mapper_with,
    scan_at,
)


def mount(mapper, z, parent='base_link', child='lidar'):
    mapper.add_pose(parent, child, 0, (0.0, 0.0, z), LEVEL, static=True)


def at_height(z):
    return pose_matrix((0.0, 0.0, z), LEVEL)


@pytest.fixture
def mapper():
    """Return a mapper with a scan at 1.0 s of a lidar that is 1 m above the base."""
    mapper = mapper_with(pose__source='tf', frames__base_to_sensor=(), window__max_scans=2)
    for stamp_s in (0.0, 10.0):
        add_pose(mapper, stamp_s)
    mount(mapper, 1.0)
    insert(mapper, scan_at(1.0))
    assert mapper.mount_changes == ''
    return mapper


def test_scans_after_a_new_static_parent_have_the_new_mount(mapper, caplog):
    mount(mapper, 0.5, child='mast')
    mount(mapper, 1.5, parent='mast')
    insert(mapper, scan_at(2.0))

    expected = digest_of((scan_at(1.0), at_height(1.0)), (scan_at(2.0), at_height(2.0)))
    assert mapper.map.digest() == expected
    moved = (
        "'lidar' has moved from (0.000, 0.000, 1.000) m in 'base_link' to (0.000, 0.000, 1.500)"
    )
    assert mapper.mount_changes.startswith(f"{moved} m in 'mast'; the map holds scans of")
    assert [r.message for r in caplog.records] == [f"{moved} m in 'mast'"]


def test_the_warning_ends_with_the_last_scan_of_the_old_mount(mapper):
    mount(mapper, 2.0)
    assert 'to (0.000, 0.000, 2.000)' in mapper.mount_changes
    insert(mapper, scan_at(2.0))
    assert mapper.mount_changes
    insert(mapper, scan_at(3.0))
    assert mapper.mount_changes == ''


def test_the_same_mount_again_is_no_change(mapper):
    mount(mapper, 1.0)
    assert mapper.mount_changes == ''


def test_a_frame_that_carries_no_sensor_may_move(mapper, caplog):
    for parent in ('gripper', 'table', 'gripper'):
        mount(mapper, 1.0, parent=parent, child='cup')
        mount(mapper, 1.0, parent=parent, child='odom')
    assert mapper.mount_changes == ''
    assert caplog.records == []


def test_clearing_forgets_the_old_mount(mapper):
    add_pose(mapper, 20.0, parent='stray')
    add_pose(mapper, 30.0)
    assert "'stray'" in mapper.mount_changes
    insert(mapper, scan_at(15.0))
    add_pose(mapper, 40.0)
    insert(mapper, scan_at(25.0))
    assert dropped(mapper) == {'no_pose': 1}  # the one in the stray parent

    mapper.clear()
    assert mapper.mount_changes == ''
    insert(mapper, scan_at(29.0))
    assert dropped(mapper) == {'no_pose': 1}


def test_two_publishers_that_alternate_are_named(mapper):
    for stamp_s in range(11, 21):
        add_pose(mapper, stamp_s, parent='odom' if stamp_s % 2 else 'other')
    (text,) = (part for part in mapper.mount_changes.split('; ') if 'alternates' in part)
    assert "'base_link' alternates between" in text
    assert "'odom'" in text
    assert "'other': two publishers contradict each other" in text


def test_a_configured_mount_holds_against_transforms():
    mapper = mapper_with(pose__source='tf', frames__base_to_sensor=(0.0, 0.0, 3.0, *LEVEL))
    add_pose(mapper, 0.0)
    add_pose(mapper, 10.0)
    insert(mapper, scan_at(1.0))
    mount(mapper, 1.0)
    mount(mapper, 1.0, parent='mast')
    insert(mapper, scan_at(2.0))

    expected = digest_of((scan_at(1.0), at_height(3.0)), (scan_at(2.0), at_height(3.0)))
    assert mapper.map.digest() == expected
    assert dict(mapper.counters.messages_ignored) == {'bad_pose': 2}
