# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframes: right loops correct the drift, wrong loops change nothing."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment.loops import Loop, solve_loops
from surfel_mapper.errors import AlignmentError
from surfel_mapper.geometry import pose_matrix, q_xyzw, se3_exp
from test.alignment.circuit import distances

KEY_M, KEYS_A_SIDE = 5.0, 10
A_ROUND = 4 * KEYS_A_SIDE


def square(num):
    """Return the poses of keyframes around a square, again and again."""
    poses = [np.eye(4)]
    for number in range(1, num):
        turn = 0.5 * np.pi if number % KEYS_A_SIDE == 0 else 0.0
        step = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, turn]))
        step[0, 3] = KEY_M
        poses.append(poses[-1] @ step)
    return np.array(poses)


def drifting(true, seed=0):
    rng = np.random.default_rng(seed)
    poses = [true[0]]
    for number in range(1, len(true)):
        step = np.linalg.inv(true[number - 1]) @ true[number]
        error = [*rng.normal(0.0, 0.03, 3), *np.radians(rng.normal([0.0, 0.0, 0.05], 0.1))]
        moved = poses[-1] @ step @ se3_exp(np.array(error))
        poses.append(pose_matrix(moved[:3, 3], q_xyzw(moved)))
    return np.array(poses)


def right(true, source, target, rng):
    noise = np.array([0.01, 0.01, 0.01, 0.001, 0.001, 0.001]) * rng.normal(size=6)
    return Loop(source, target, np.linalg.inv(true[target]) @ true[source] @ se3_exp(noise))


def wrong(num, rng):
    """Return loops between any keyframes, with any motion of a few metres."""
    ends = [
        (int(rng.integers(A_ROUND, 2 * A_ROUND)), int(rng.integers(A_ROUND))) for _ in range(num)
    ]
    scale = np.array([4.0, 4.0, 0.3, 0.05, 0.05, 1.0])
    return [Loop(s, t, se3_exp(scale * rng.normal(size=6))) for s, t in ends]


@pytest.fixture(scope='module')
def drive():
    true = square(2 * A_ROUND)
    return true, drifting(true)


def test_right_loops_correct_the_drift(drive):
    true, before = drive
    rng = np.random.default_rng(1)
    loops = [right(true, s, s - A_ROUND, rng) for s in range(A_ROUND + 2, 2 * A_ROUND, 4)]

    found = solve_loops(before, loops, 0.01)

    assert found.is_kept.all()
    np.testing.assert_array_equal(found.T_map_key[0], before[0])
    for loop in loops:
        motion = np.linalg.inv(found.T_map_key[loop.target]) @ found.T_map_key[loop.source]
        expected = np.linalg.inv(true[loop.target]) @ true[loop.source]
        assert np.linalg.norm(motion[:3, 3] - expected[:3, 3]) < 0.05
    assert distances(found.T_map_key, true).max() < 0.5 * distances(before, true).max()


@pytest.mark.parametrize('num_wrong', [1, 5, 15])
def test_wrong_loops_do_not_bend_the_map(drive, num_wrong):
    true, before = drive
    rng = np.random.default_rng(2)
    loops = [right(true, s, s - A_ROUND, rng) for s in range(A_ROUND + 2, 2 * A_ROUND, 4)]

    clean = solve_loops(before, loops, 0.01)
    found = solve_loops(before, [*loops, *wrong(num_wrong, rng)], 0.01)

    assert found.is_kept.tolist() == [True] * len(loops) + [False] * num_wrong
    np.testing.assert_allclose(found.T_map_key, clean.T_map_key, rtol=0, atol=1e-6)


def test_a_single_wrong_loop_changes_nothing(drive):
    _, before = drive
    loop = Loop(70, 10, se3_exp(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.3])))

    found = solve_loops(before, [loop], 0.01)

    assert not found.is_kept.any()
    np.testing.assert_allclose(found.T_map_key, before, rtol=0, atol=1e-9)


def test_poses_stay_without_loops(drive):
    _, before = drive

    np.testing.assert_array_equal(solve_loops(before, [], 0.01).T_map_key, before)


@pytest.mark.parametrize(('source', 'target'), [(3, 3), (2, 5), (99, 0), (1, -1)])
def test_loops_between_missing_keyframes_are_refused(source, target):
    with pytest.raises(AlignmentError, match=rf'loop {source} -> {target}: expected a later'):
        solve_loops(square(6), [Loop(source, target, np.eye(4))], 0.01)


def test_one_keyframe_is_refused():
    with pytest.raises(AlignmentError, match='1 keyframe, expected two'):
        solve_loops(square(1), [], 0.01)
