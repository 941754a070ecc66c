# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Loops of simulated drives: recognised, verified and closed, or refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from surfel_mapper.alignment.loop_search import key_numbers, LoopSearch
from surfel_mapper.alignment.loops import Loop
from surfel_mapper.alignment.recognition import Recognition
from surfel_mapper.errors import DependencyError
from test import extras
from test.alignment.circuit import circuit, drifted, gap, SAME_WAY, THERE_AND_BACK
from test.fields import config_of

SETTINGS = {'loops.recognise_distance_m': 20.0}


def search(scans, poses, **changed):
    config = config_of({**SETTINGS, **changed})
    voxel_size_m = config.map.voxel_size_m
    return LoopSearch(scans, poses, config.loops, config.registration, voxel_size_m)


@extras.needs('map_closures')
@pytest.mark.parametrize('half_deg', [180.0, 60.0], ids=['full turn', '120 deg'])
def test_a_loop_in_the_same_direction_closes(half_deg):
    seen = circuit(SAME_WAY)
    before = drifted(seen.poses)

    closure = search(seen.narrowed(half_deg), before).close()

    first, last = 12, len(seen) - 12
    assert gap(before, seen.poses, first, last) > 2.0
    assert gap(closure.T_map_sensor, seen.poses, first, last) < 0.3
    assert any(loop.votes > 0 for loop in closure.loops)
    np.testing.assert_array_equal(closure.T_map_sensor[0], before[0])


@extras.needs('map_closures')
def test_a_loop_with_the_heading_reversed_closes():
    seen = circuit(THERE_AND_BACK)
    before = drifted(seen.poses)

    closure = search(seen, before).close()

    first, last = 12, len(seen) - 12
    assert gap(before, seen.poses, first, last) > 2.0
    assert gap(closure.T_map_sensor, seen.poses, first, last) < 0.3
    turned = [loop for loop in closure.loops if loop.T_target_source[0, 0] < -0.9]
    assert turned


def test_a_wrong_candidate_is_refused_by_registration():
    seen = circuit(SAME_WAY)
    loops = search(seen, seen.poses)
    found = loops.register(Loop(20, 8, np.eye(4)))  # 60 m of another street between them

    assert loops.reason_against(20, found)


def test_a_drive_without_loops_keeps_its_poses():
    seen = circuit(SAME_WAY)
    before = drifted(seen.poses)[:60]

    closure = search(seen, before).close()

    assert not closure.loops
    np.testing.assert_array_equal(closure.T_map_sensor, before)


def test_recognition_without_its_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, 'map_closures', None)

    with pytest.raises(DependencyError, match=r"pip install 'surfel_mapper\[loops\]'"):
        Recognition(5)


def test_small_drift_is_corrected_without_recognition(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, 'map_closures', None)
    seen = circuit(SAME_WAY)
    before = drifted(seen.poses, turn_deg_m=0.005)

    closure = search(seen, before).close()

    assert not closure.recognises
    assert 'map-closures' in caplog.text
    first, last = 12, len(seen) - 12
    assert gap(closure.T_map_sensor, seen.poses, first, last) < 0.3
    assert closure.loops


def test_an_earlier_visit_is_compared_although_later_ones_are_nearer():
    # past a place, away for 200 m, and then to and fro 3 m beside it
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = [3.0, 103.0, 0.0, 20.0, 0.0, 20.0, 0.0, 20.0, 0.0, 20.0, 0.0]
    loops = search((), poses, **{'loops.near_distance_m': 5.0, 'loops.local_map_m': 85.0})

    found = [(each.source, each.target) for each in loops._near(poses)]

    assert found == [(2, 0), (4, 0), (6, 0), (8, 0), (10, 0)]  # others within 170 m of path


def test_a_short_walk_to_and_fro_has_loops():
    # 45 m into a hall and 20 m back: less than two local maps of 40 m
    poses = np.tile(np.eye(4), (14, 1, 1))
    poses[:, 0, 3] = [*np.arange(0.0, 46.0, 5.0), 40.0, 35.0, 30.0, 25.0]

    pairs = {(each.source, each.target) for each in search((), poses)._near(poses)}

    assert (13, 5) in pairs  # at 25 m again, 40 m of path later


def test_keyframes_of_two_sensors_follow_the_path_of_each():
    poses = np.tile(np.eye(4), (82, 1, 1))
    poses[:, 0, 3] = 0.25 * np.repeat(np.arange(41), 2)  # 10 m
    poses[1::2, 0, 3] -= 3.0
    config = config_of({})

    found = LoopSearch(
        (), poses, config.loops, config.registration, 0.5, frame_ids=['front', 'rear'] * 41
    )

    assert found.keys == [0, 40, 80, 81]


def test_keyframes_are_first_last_and_those_far_enough():
    assert key_numbers(np.array([0.0, 1.0, 5.0, 5.5, 10.0, 11.0]), 5.0) == [0, 2, 4, 5]
