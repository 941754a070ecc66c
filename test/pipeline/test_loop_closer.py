# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans move exactly when loops close, and the poses that come in do not."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment.loop_search import LoopClosure
from surfel_mapper.config import Config
from surfel_mapper.errors import AlignmentError, ConfigError
from surfel_mapper.geometry import compose, inverse, pose_matrix, q_xyzw
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball
from surfel_mapper.pipeline.saved_state import load_mapper, save_mapper
from surfel_mapper.scan import Scan
from test.alignment.circuit import circuit, drifted, gap, SAME_WAY
from test.alignment.test_registration import map_of, NOISE_M, ROOM
from test.fields import config_of
from test.pipeline.test_registered_poses import feed, pose_at
from test.pipeline.test_registered_poses import scan_at as room_scan

ALL_SCANS = {'window.max_scans': 0, 'map.max_bytes': 0, 'loops.enabled': True}


def fed(mapper, points, poses, first=0):
    """Feed scans at poses from odometry; return the updates."""
    updates = []
    for number, (each, pose) in enumerate(zip(points, poses, strict=True), start=first):
        stamp_ns = 10**9 + number * 10**8
        mapper.add_pose('odom', 'lidar', stamp_ns, pose[:3, 3], q_xyzw(pose))
        mapper.add_scan(Scan(points=each, stamp_ns=stamp_ns, frame_id='lidar'))
        updates += mapper.insert_ready()
    return updates


def mapper_of(**changed):
    odometry = {'pose.source': 'odometry', 'frames.base': 'lidar'}
    return Mapper(config_of({**odometry, **ALL_SCANS, **changed}))


def digest_at(points, poses):
    """Return the digest of a map that is made at poses."""
    surfel_map = SurfelMap(0.5)
    for each, pose in zip(points, poses, strict=True):
        surfel_map.insert(surfel_map.reduce(each, pose, origin=pose[:3, 3]))
    return surfel_map.digest()


def shifted(poses):
    """Return poses moved by a growing motion."""
    after = np.array(poses)
    after[:, :3, 3] += np.linspace(0.0, 1.0, len(poses))[:, None] * [0.3, -0.7, 0.1]
    return after


def closure_at(poses):
    return LoopClosure(
        T_map_sensor=poses, keys=(0, len(poses) - 1), loops=(), refusals=(), recognises=True
    )


def test_the_map_equals_one_made_at_the_corrected_poses():
    seen = circuit(SAME_WAY)
    before = drifted(seen.poses)
    mapper = mapper_of(**{'loops.recognise_distance_m': 20.0})
    fed(mapper, seen.scans, before)

    move = mapper.close_loops()

    poses = mapper.loops.T_map_sensor
    assert move.num_moved > 100
    assert mapper.map.digest() == digest_at(seen.scans, poses)
    first, last = 12, len(seen) - 12
    assert gap(poses, seen.poses, first, last) < 0.3 < 2.0 < gap(before, seen.poses, first, last)
    summary = move.summary()
    assert summary['accepted'] == len(move.closure.loops) > 0
    assert summary['found'] == summary['accepted'] + summary['refused']


def test_scans_of_the_window_move_with_it():
    seen = circuit(SAME_WAY)
    points = seen.scans[:6]
    mapper = mapper_of(**{'window.keep_points': True})
    fed(mapper, points, seen.poses[:6])
    before = mapper.loops.T_map_sensor

    mapper.loops.move(closure_at(shifted(before)), mapper.config)

    np.testing.assert_array_equal([s.T_map_sensor for s in mapper.window], shifted(before))
    assert mapper.map.digest() == digest_at(points, shifted(before))
    mapper.align()  # of the window, which the next move must start from
    assert mapper.map.digest() == digest_at(points, mapper.loops.T_map_sensor)
    mapper.loops.move(closure_at(before), mapper.config)
    assert mapper.map.digest() == digest_at(points, before)


def test_later_scans_follow_the_correction_and_move_again():
    seen = circuit(SAME_WAY)
    points, before = seen.scans[:9], seen.poses[:9]
    mapper = mapper_of()
    fed(mapper, points[:6], before[:6])
    after = shifted(mapper.loops.T_map_sensor)

    move = mapper.loops.move(closure_at(after), mapper.config)
    mapper._pipeline.aligner.correct(move.correction)
    updates = fed(mapper, points[6:], before[6:], first=6)

    jump = compose(after[-1], inverse(before[5]))
    np.testing.assert_allclose(mapper.T_map_fixed, jump, rtol=0, atol=1e-12)
    for update, pose in zip(updates, before[6:], strict=True):
        np.testing.assert_allclose(update.T_map_sensor, jump @ pose, rtol=0, atol=1e-9)
    poses = mapper.loops.T_map_sensor
    assert mapper.map.digest() == digest_at(points, poses)
    mapper.loops.move(closure_at(shifted(poses)), mapper.config)
    assert mapper.map.digest() == digest_at(points, mapper.loops.T_map_sensor)


def test_points_of_emptied_voxels_stay_removed_after_two_moves():
    seen = circuit(SAME_WAY)
    points, before = seen.scans[:6], seen.poses[:6]
    mapper = mapper_of()
    fed(mapper, points[:4], before[:4])
    mapper.clear_region(Ball(center=tuple(before[2, :3, 3]), radius_m=6.0))
    num_points = mapper.map.num_points
    fed(mapper, points[4:5], before[4:5], first=4)
    one_scan, known = mapper.map.num_points - num_points, mapper.loops.T_map_sensor

    mapper.loops.move(closure_at(shifted(known)), mapper.config)
    assert mapper.map.num_points == num_points + one_scan
    mapper.loops.move(closure_at(known), mapper.config)

    expected = mapper_of()
    fed(expected, points[:4], before[:4])
    expected.clear_region(Ball(center=tuple(before[2, :3, 3]), radius_m=6.0))
    fed(expected, points[4:5], before[4:5], first=4)
    assert mapper.map.digest() == expected.map.digest()


def test_later_scans_stay_at_their_poses_to_the_bit_if_no_scan_moves():
    seen = circuit(SAME_WAY)
    turned = pose_matrix((1.0, 2.0, 3.0), (0.1, -0.3, 0.5, 0.65**0.5))
    points, poses = seen.scans[:7], turned @ seen.poses[:7]
    mapper, expected = mapper_of(), mapper_of()
    for each in (mapper, expected):
        fed(each, points[:6], poses[:6])

    move = mapper.close_loops()
    updates = [fed(each, points[6:], poses[6:], first=6)[0] for each in (mapper, expected)]

    assert move.num_moved == 0
    np.testing.assert_array_equal(move.correction, np.eye(4))
    np.testing.assert_array_equal(updates[0].T_map_sensor, updates[1].T_map_sensor)
    assert mapper.map.digest() == expected.map.digest()


def test_loops_close_among_the_scans_after_a_loaded_map(tmp_path, caplog):
    seen = circuit(SAME_WAY)
    points, poses = seen.scans[:9], seen.poses[:9]
    settings = {'window.keep_points': True, 'align.every_scans': 2}
    saved = mapper_of(**settings)
    fed(saved, points[:6], poses[:6])
    save_mapper(tmp_path / 'map.npz', saved)
    loaded = [scan.T_map_sensor for scan in saved.window]
    mapper = mapper_of(**settings)
    load_mapper(tmp_path / 'map.npz', mapper)
    with pytest.raises(AlignmentError, match='0 scans since the map was cleared or loaded'):
        mapper.close_loops()

    updates = fed(mapper, points[6:], poses[6:], first=6)

    assert [update.alignment is not None for update in updates] == [False, True, False]
    window = [scan.T_map_sensor for scan in mapper.window]
    np.testing.assert_array_equal(mapper.loops.T_map_sensor, window[6:])
    mapper.close_loops()
    after = shifted(mapper.loops.T_map_sensor)
    mapper.loops.move(closure_at(after), mapper.config)
    window = np.array([scan.T_map_sensor for scan in mapper.window])
    np.testing.assert_array_equal(window[6:], after)
    assert mapper.map.digest() == digest_at(points, window)
    np.testing.assert_allclose(window[:6], loaded, rtol=0, atol=0.2)
    told = [record.message for record in caplog.records if 'was loaded' in record.message]
    assert told == ['a map was loaded: loops are closed only among the scans that come after it']


def test_loops_close_after_scans_of_a_loaded_map_have_left(tmp_path):
    seen = circuit(SAME_WAY)
    points, poses = seen.scans[:9], seen.poses[:9]
    saved = mapper_of(**{'window.max_scans': 5})
    fed(saved, points[:4], poses[:4])
    save_mapper(tmp_path / 'map.npz', saved)
    mapper = mapper_of(**{'window.max_scans': 5})
    load_mapper(tmp_path / 'map.npz', mapper)

    fed(mapper, points[4:7], poses[4:7], first=4)  # the window: 2 to 6
    after = shifted(mapper.loops.T_map_sensor)
    mapper.close_loops()
    mapper.loops.move(closure_at(after), mapper.config)
    assert mapper.map.digest() == digest_at(points[2:7], [*poses[2:4], *after])

    fed(mapper, points[7:9], after[[-1, -1]], first=7)  # 4 to 8: all since the map was loaded
    mapper.close_loops()
    fed(mapper, points[:1], after[[-1]], first=9)
    with pytest.raises(AlignmentError, match='the map holds 5 of 6 scans'):
        mapper.close_loops()


def test_a_window_that_evicted_scans_is_refused():
    seen = circuit(SAME_WAY)
    mapper = mapper_of(**{'window.max_scans': 3})
    fed(mapper, seen.scans[:5], seen.poses[:5])
    digest = mapper.map.digest()

    with pytest.raises(AlignmentError, match='the map holds 3 of 5 scans'):
        mapper.close_loops()

    assert mapper.map.digest() == digest


def test_loops_need_their_points():
    with pytest.raises(AlignmentError, match=r'set loops\.enabled'):
        mapper_of(**{'loops.enabled': False}).close_loops()


def test_a_cleared_map_starts_again():
    seen = circuit(SAME_WAY)
    mapper = mapper_of()
    fed(mapper, seen.scans[:3], seen.poses[:3])
    mapper.clear()
    fed(mapper, seen.scans[3:6], seen.poses[3:6], first=3)

    assert len(mapper.loops) == 3
    after = shifted(mapper.loops.T_map_sensor)
    mapper.loops.move(closure_at(after), mapper.config)
    assert mapper.map.digest() == digest_at(seen.scans[3:6], after)


def test_a_frozen_map_moves_no_scan():
    with pytest.raises(ConfigError, match=r'loops\.enabled: true, but map\.mode frozen'):
        Config().replace({'loops.enabled': True, 'map.mode': 'frozen', 'map.load': 'hall.npz'})


def test_registration_follows_the_last_metres_alone():
    seen = circuit(SAME_WAY)
    mapper = Mapper(
        config_of({'pose.source': 'registration', 'loops.odometry_map_m': 20.0, **ALL_SCANS})
    )
    for number, points in enumerate(seen.scans[:30]):
        mapper.add_scan(Scan(points=points, stamp_ns=10**9 + number * 10**8, frame_id='lidar'))
        list(mapper.insert_ready())

    expected = inverse(seen.poses[0]) @ seen.poses[29]
    found = mapper.loops.T_map_sensor[-1]
    assert len(mapper.loops) == 30
    assert mapper._pipeline._local_map.surfel_map.num_voxels < mapper.map.num_voxels
    np.testing.assert_allclose(found[:3, 3], expected[:3, 3], rtol=0, atol=0.2)


def rooms(**changed):
    """Return a mapper that registers scans from the middle of a hall."""
    start = (*pose_at(0)[:3, 3].tolist(), *q_xyzw(pose_at(0)).tolist())
    settings = {'pose.source': 'registration', 'registration.noise_m': NOISE_M}
    return Mapper(
        Config().replace({**settings, 'registration.start': start, **ALL_SCANS, **changed})
    )


def test_scans_are_registered_to_a_map_that_is_loaded():
    mapper = rooms()
    mapper.restore(map_of(ROOM), [])

    updates = feed(mapper, [room_scan(number) for number in range(3)])

    assert len(updates) == 3
    for number, update in enumerate(updates):
        assert update.registration is not None
        np.testing.assert_allclose(update.T_map_sensor, pose_at(number), atol=5e-3)
    assert mapper.loops.T_map_sensor.shape == (3, 4, 4)


def test_registered_odometry_goes_on_where_it_was_when_the_map_jumps():
    seen = circuit(SAME_WAY)
    mapper = mapper_of(**{'pose.source': 'registration'})

    def tracked(first, last):
        updates = []
        for number in range(first, last):
            stamp_ns = 10**9 + number * 10**8
            points = seen.scans[number]
            mapper.add_scan(Scan(points=points, stamp_ns=stamp_ns, frame_id='lidar'))
            updates += mapper.insert_ready()
        return updates

    before = tracked(0, 6)
    move = mapper.loops.move(closure_at(shifted(mapper.loops.T_map_sensor)), mapper.config)
    mapper._pipeline.aligner.correct(move.correction)
    after = tracked(6, 9)

    odometry = [update.T_fixed_body for update in (*before, *after)]
    start = inverse(seen.poses[0])
    for found, true in zip(odometry, seen.poses, strict=False):
        np.testing.assert_allclose(found[:3, 3], (start @ true)[:3, 3], atol=0.05)
    for update in after:  # the map alone has jumped
        expected = compose(move.correction, update.T_fixed_body)
        np.testing.assert_allclose(update.T_map_sensor, expected, rtol=0, atol=1e-9)
    assert np.linalg.norm(move.correction[:3, 3]) > 0.5
