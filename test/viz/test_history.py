# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A history has a row for every scan."""

from types import SimpleNamespace

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.viz.history import History

IDENTITY = Config().replace({'pose.source': 'identity', 'map.min_points': 2})


def mapped(num_scans):
    mapper, history = Mapper(IDENTITY), History()
    rng = np.random.default_rng(1)
    for number in range(num_scans):
        points = rng.uniform(-5.0, 5.0, (50, 3)).astype(np.float32) + np.float32(5 * number)
        mapper.add_scan(Scan(points=points, stamp_ns=number * 10**8 + 7, frame_id='odom'))
        mapper.add_scan(Scan(points=points[:0], stamp_ns=number * 10**8 + 8, frame_id='odom'))
        for update in mapper.insert_ready():
            history.add(mapper, update)
    return mapper, history


def test_a_history_ends_where_the_map_does():
    mapper, history = mapped(5)

    np.testing.assert_array_equal(history.seconds, np.arange(5) / 10.0)
    assert (np.diff(history.voxels) > 0).all()
    assert history.voxels[-1] == mapper.map.num_voxels
    assert history.dropped.tolist() == [1, 2, 3, 4, 5]  # each scan is followed by an empty one
    np.testing.assert_array_equal(history.trajectory, np.zeros((5, 3)))
    assert {'reduce', 'insert', 'normals', 'total'} <= set(history.milliseconds)
    assert all(len(times) == 5 for times in history.milliseconds.values())


def test_a_stage_that_comes_and_goes_leaves_gaps():
    mapper, history = Mapper(IDENTITY), History()
    for times in ({'total': 1.0}, {'total': 2.0, 'filter': 5.0}, {'filter': 6.0}):
        update = SimpleNamespace(stamp_ns=0, milliseconds=times, T_map_sensor=np.eye(4))
        history.add(mapper, update)

    np.testing.assert_array_equal(history.milliseconds['total'], [1.0, 2.0, np.nan])
    np.testing.assert_array_equal(history.milliseconds['filter'], [np.nan, 5.0, 6.0])


def test_no_scan_at_all_is_an_empty_history():
    history = History()
    assert len(history) == len(history.seconds) == len(history.voxels) == 0
    assert history.trajectory.shape == (0, 3)


def test_scans_of_workers_have_times_and_positions_alone():
    positions = np.arange(9.0).reshape(3, 3)

    history = History([10**9, 11 * 10**8, 2 * 10**9], positions)

    np.testing.assert_allclose(history.seconds, [0.0, 0.1, 1.0])
    np.testing.assert_array_equal(history.trajectory, positions)
    assert np.isnan(history.voxels).all()
    assert not history.dropped.any()
    assert history.milliseconds == {}


def test_an_alignment_moves_the_positions():
    _, history = mapped(3)
    positions = np.arange(9.0).reshape(3, 3)
    history.move(positions[:2])  # of a map that was begun again
    np.testing.assert_array_equal(history.trajectory, np.zeros((3, 3)))
    seconds = history.seconds
    history.move(positions)
    np.testing.assert_array_equal(history.trajectory, positions)
    np.testing.assert_array_equal(history.seconds, seconds)
