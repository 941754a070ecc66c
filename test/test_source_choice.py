# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The order and the reason of pose.source auto, and the tree of frames that decides for tf."""

import pytest

from surfel_mapper.poses import choose_source, has_chain, PoseCandidate, without_chain

TREE = PoseCandidate('tf', '/tf')
ODOMETRY = PoseCandidate('odometry', '/odom', settings='-r odom:=/odom')
POSE = PoseCandidate('pose', '/pose')
NO_TREE = PoseCandidate('tf', '/tf', 'tf2_msgs is not installed')


@pytest.mark.parametrize(
    ('candidates', 'expected'),
    [
        ([POSE, ODOMETRY, TREE], 'pose.source auto takes tf: /tf has them'),
        (
            [POSE, ODOMETRY, NO_TREE],
            'pose.source auto takes odometry: /odom has them (-r odom:=/odom); not from tf: '
            'tf2_msgs is not installed',
        ),
        (
            [NO_TREE],
            'pose.source auto takes registration: no topic gives the poses of the clouds; not '
            'from tf: tf2_msgs is not installed',
        ),
        ([], 'pose.source auto takes registration: no topic gives the poses of the clouds'),
    ],
)
def test_the_first_candidate_in_order_is_taken_and_those_before_it_named(candidates, expected):
    choice = choose_source(candidates)
    assert str(choice) == expected
    assert bool(choice.topic) == (choice.source != 'registration')


@pytest.mark.parametrize(
    ('parents', 'frame', 'expected'),
    [
        ({'lidar': 'base', 'base': 'odom'}, 'lidar', True),
        ({'lidar': 'base', 'base': 'odom', 'odom': 'map'}, 'lidar', True),
        ({'lidar': 'map', 'odom': 'map'}, 'lidar', True),  # beside each other below one root
        ({'odom': 'lidar'}, 'lidar', True),
        ({}, 'odom', True),
        ({}, 'lidar', False),
        ({'lidar': 'base', 'odom': 'map'}, 'lidar', False),
        ({'lidar': 'base', 'base': 'lidar'}, 'lidar', False),  # a loop
    ],
)
def test_frames_with_a_common_ancestor_have_a_chain(parents, frame, expected):
    assert has_chain(parents, 'odom', frame) == expected


def test_frames_without_a_chain_are_named():
    assert (
        without_chain('odom', ['rear', 'front']) == 'no transforms lead from odom to front, rear'
    )
