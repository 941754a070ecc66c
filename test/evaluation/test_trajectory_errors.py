# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of trajectories, against evo 1.38.1 and against known errors.

The golden numbers are those of evo's APE (after align without scale) and RPE (delta of 1 and of
5 frames), translation_part and rotation_angle_deg, of the trajectory of ``wandering``.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.evaluation.trajectory_errors import (
    absolute_errors,
    best_motion,
    common_stamps,
    compare,
    drift,
    relative_errors,
)
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import pose_matrix, se3_exp
from test import extras

EVO_APE = {
    'translation_m': (0.078256082561, 0.073111568851, 0.07155600095, 0.14670239253),
    'rotation_deg': (1.2724632176, 1.203464186, 1.1008974154, 2.1537438803),
}
EVO_RPE = {
    1: {
        'translation_m': (0.015210120524, 0.015006329694, 0.014185059554, 0.018972256304),
        'rotation_deg': (0.70415763038, 0.69925690845, 0.67326456963, 0.83395080663),
    },
    5: {
        'translation_m': (0.063087184622, 0.062630052114, 0.06092632331, 0.073825696948),
        'rotation_deg': (1.4372133508, 1.4253495199, 1.3934957695, 1.758486602),
    },
}
"""rmse, mean, median, max."""


def wandering():
    """Return poses along a bent way, and estimates of them that go astray."""
    true, estimated = [np.eye(4)], [se3_exp(np.array([5.0, -3.0, 1.0, 0.3, -0.2, 2.5]))]
    for k in range(60):
        step = np.array([0.5, 0.02 * math.sin(k), 0.01, 0.01, 0.02 * math.cos(k), 0.05])
        off = 0.01 * np.sin(np.arange(6) * 1.7 + 0.9 * k) + [0.005, 0.0, 0.0, 0.0, 0.0, 0.001]
        true.append(true[-1] @ se3_exp(step))
        estimated.append(estimated[-1] @ se3_exp(step + off))
    return np.array(estimated), np.array(true)


def line(num, step_m=1.0):
    """Return poses along x."""
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(num)
    return poses


@pytest.mark.parametrize('name', ['translation_m', 'rotation_deg'])
def test_absolute_errors_are_those_of_evo(name):
    found = absolute_errors(*wandering()).summary()[name]

    assert list(found.values()) == pytest.approx(EVO_APE[name], rel=1e-9)


@pytest.mark.parametrize('step', [1, 5])
@pytest.mark.parametrize('name', ['translation_m', 'rotation_deg'])
def test_relative_errors_are_those_of_evo(name, step):
    found = relative_errors(*wandering(), step=step).summary()[name]

    assert list(found.values()) == pytest.approx(EVO_RPE[step][name], rel=1e-7)


def test_evo_reads_our_files_and_finds_the_same_errors(tmp_path):
    metrics = extras.load('evo.core.metrics')
    from evo.core import sync
    from evo.tools import file_interface

    estimated, true = wandering()
    stamp_ns = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(len(true))
    trajectories = []
    for name, poses in (('true', true), ('estimated', estimated)):
        Trajectory.from_matrices(poses, stamp_ns).save(tmp_path / f'{name}.tum')
        read = file_interface.read_tum_trajectory_file(str(tmp_path / f'{name}.tum'))
        np.testing.assert_allclose(read.poses_se3, poses, atol=1e-8)
        np.testing.assert_allclose(read.timestamps, stamp_ns / 1e9, atol=1e-6)
        trajectories.append(read)
    reference, estimate = sync.associate_trajectories(*trajectories)
    assert len(reference.timestamps) == len(true)

    estimate.align(reference)
    for kind, relation in (
        ('translation_m', metrics.PoseRelation.translation_part),
        ('rotation_deg', metrics.PoseRelation.rotation_angle_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((reference, estimate))
        ours = absolute_errors(estimated, true).summary()[kind]
        for name, value in ours.items():
            assert value == pytest.approx(
                ape.get_statistic(metrics.StatisticsType[name]), rel=1e-5
            )


def test_a_trajectory_that_is_only_moved_has_no_error():
    _, true = wandering()
    moved = pose_matrix([3.0, 4.0, 0.0], [0.0, 0.0, 0.6, 0.8]) @ true

    assert absolute_errors(moved, true).translation_m.max() < 1e-12
    assert relative_errors(moved, true).rotation_deg.max() < 1e-6


def test_the_best_motion_is_found_again_and_never_mirrors():
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(20, 3)) * [5.0, 3.0, 0.0]  # in a plane: a mirror would fit too
    motion = se3_exp(np.array([1.0, -2.0, 3.0, 2.0, 1.0, -0.5]))
    moved = positions @ motion[:3, :3].T + motion[:3, 3]

    found = best_motion(positions, moved)

    np.testing.assert_allclose(found, motion, atol=1e-12)


def test_drift_is_stated_for_each_100_m():
    true = line(81)
    estimated = line(81, step_m=1.01)  # 1 % too far

    assert drift(estimated, true) == (pytest.approx(1.0), 0.0)


def test_a_turn_too_much_in_each_step_is_a_drift_of_rotation():
    true, estimated = line(41), line(41)
    for k in range(41):
        estimated[k, :3, :3] = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e-4 * k]))[:3, :3]

    assert drift(estimated, true)[1] == pytest.approx(math.degrees(1e-2))


def test_drift_without_motion_is_nan():
    still = np.tile(np.eye(4), (5, 1, 1))

    assert np.isnan(drift(still, still)).all()


def test_stamps_match_the_nearest_and_each_only_once():
    rows, others = common_stamps(
        np.array([0, 90, 100, 205, 1000]), np.array([1, 101, 199, 400]), max_difference_ns=10
    )

    assert rows.tolist() == [0, 2, 3]
    assert others.tolist() == [0, 1, 2]


@pytest.mark.parametrize(('first', 'second'), [([], [1]), ([1], []), ([5], [16])])
def test_distant_stamps_do_not_match(first, second):
    rows, others = common_stamps(np.array(first, int), np.array(second, int), 10)

    assert len(rows) == len(others) == 0


def test_a_comparison_states_all_errors_of_the_poses_in_common():
    estimated, true = wandering()
    stamps = np.arange(len(true)) * 10**8

    found = compare(stamps[10:], estimated[10:], stamps[:40] + 5, true[:40], max_difference_ns=9)

    assert found['num_poses'] == 30
    expected = relative_errors(estimated[10:40], true[10:40]).summary()
    assert found['relative'] == expected
    assert found['drift_m_per_100m'] == drift(estimated[10:40], true[10:40])[0]


def test_a_comparison_of_different_times_is_refused():
    with pytest.raises(ValueError, match='0 poses within 0 s of one another, of 3 and 3'):
        compare(np.arange(3), line(3), np.arange(3) + 10, line(3))


@pytest.mark.parametrize(
    ('bend', 'noise_m', 'is_straight'),
    [
        (0.0, 0.0, True),
        (0.0, 0.005, True),
        (1.0, 0.005, False),
        (1.0, 0.0, False),
    ],
)
def test_a_straight_drive_is_said_to_leave_the_rotation_open(bend, noise_m, is_straight):
    rng = np.random.default_rng(4)
    along = 0.5 * np.arange(60)
    places = np.column_stack([along, bend * np.sin(along / 5.0), np.zeros(60)])
    noise = rng.normal(0.0, 1.0, (2, 60, 3)) * noise_m
    true, estimated = np.tile(np.eye(4), (2, 60, 1, 1))
    true[:, :3, 3], estimated[:, :3, 3] = places + noise[0], places + noise[1]
    stamps = np.arange(60)

    assert compare(stamps, estimated, stamps, true)['on_a_line'] == is_straight
