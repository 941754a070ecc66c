# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map that was moved by a known motion is moved back onto its truth, or refused."""

import numpy as np
import pytest

from surfel_mapper.errors import AlignmentError
from surfel_mapper.evaluation import frames
from surfel_mapper.evaluation.comparison import CloudTruth
from surfel_mapper.evaluation.frames import (
    find_motion,
    gauss_newton_step,
    looks_needed,
    moved_discs,
)
from surfel_mapper.evaluation.map_files import Discs
from surfel_mapper.evaluation.truth import WorldTruth
from surfel_mapper.geometry import compose, inverse, pose_matrix, rotation_angle, se3_exp
from surfel_mapper.simulation import World
from test import extras

WIDTH_M = 0.5


def faces(seed=3, number=12):
    """Return discs on the faces of boxes that stand at random on a ground, with their normals."""
    rng = np.random.default_rng(seed)
    position = [np.column_stack([rng.uniform(-20.0, 20.0, (3000, 2)), np.zeros(3000)])]
    normal = [np.tile([0.0, 0.0, 1.0], (3000, 1))]
    for _ in range(number):
        turn = pose_matrix([*rng.uniform(-15, 15, 2), 0], se3_turn(rng.uniform(0, 6)))
        size = rng.uniform(1.0, 5.0, 3)
        for axis in range(3):
            points = rng.uniform(-0.5, 0.5, (200, 3)) * size
            points[:, axis] = 0.5 * size[axis]
            points[:, 2] += 0.5 * size[2]
            position.append(points @ turn[:3, :3].T + turn[:3, 3])
            normal.append(np.tile(turn[:3, axis], (200, 1)))
    return Discs(np.concatenate(position), np.concatenate(normal))


def se3_turn(yaw):
    return [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]


MOTION = se3_exp(np.array([0.4, -0.3, 0.2, 0.02, -0.03, 0.05]))


def off(found, expected):
    """Return the difference of two motions, m and deg."""
    rest = compose(inverse(expected), found)
    return np.linalg.norm(rest[:3, 3]), np.degrees(rotation_angle(rest))


@pytest.mark.parametrize('normals', [True, False])
def test_a_small_motion_is_found_from_the_frames_as_they_are(normals):
    truth = faces()
    shifted = moved_discs(truth, inverse(MOTION))
    known = truth if normals else Discs(truth.position, None)
    found = find_motion(shifted, CloudTruth(known), {}, WIDTH_M)
    assert found.start == 'frames'
    way_m, turn_deg = off(found.T_truth_map, MOTION)
    assert way_m < 1e-3
    assert turn_deg < 0.01
    assert found.share == 1.0


@extras.needs('kiss_matcher')
def test_any_motion_is_found_by_features():
    truth, motion = faces(), pose_matrix([40.0, -25.0, 3.0], se3_turn(2.5))
    found = find_motion(moved_discs(truth, inverse(motion)), CloudTruth(truth), {}, WIDTH_M)
    assert found.start == 'features'
    way_m, turn_deg = off(found.T_truth_map, motion)
    assert way_m < 1e-3
    assert turn_deg < 0.01


@pytest.mark.parametrize('known', [0, 5])
def test_a_truth_with_too_few_normals_moves_no_map(known):
    truth = faces()
    normal = np.full_like(truth.normal, np.nan)
    normal[:known] = truth.normal[:known]
    position = truth.position + np.array([0.0, 0.0, 1e-4])  # next to its own point

    step = gauss_newton_step(position, CloudTruth(Discs(truth.position, normal)), WIDTH_M)

    np.testing.assert_array_equal(step, np.zeros(6))


def test_a_known_start_comes_first():
    truth, motion = faces(), pose_matrix([40.0, -25.0, 3.0], se3_turn(2.5))
    start = compose(MOTION, motion)
    shifted = moved_discs(truth, inverse(motion))
    found = find_motion(shifted, CloudTruth(truth), {'trajectories': start}, WIDTH_M)
    assert found.start == 'trajectories'
    assert off(found.T_truth_map, motion)[0] < 1e-3


def test_a_part_of_the_truth_is_placed_and_so_is_a_map_that_is_larger_than_the_truth():
    truth = faces()
    part = truth.position[:, 0] < 0.0
    half = Discs(truth.position[part], truth.normal[part])
    for surfels, reference in ((half, truth), (truth, half)):
        shifted = moved_discs(surfels, inverse(MOTION))
        found = find_motion(shifted, CloudTruth(reference), {}, WIDTH_M)
        assert off(found.T_truth_map, MOTION)[0] < 0.02


def test_a_map_of_another_place_is_refused(monkeypatch):
    monkeypatch.setattr(frames, 'has_kiss_matcher', lambda: False)
    rng = np.random.default_rng(0)
    elsewhere = Discs(rng.uniform([180.0, -20.0, -20.0], [220.0, 20.0, 20.0], (4000, 3)), None)
    with pytest.raises(AlignmentError, match=r'tried from: frames; pip install'):
        find_motion(elsewhere, CloudTruth(faces()), {}, WIDTH_M)


def test_a_world_is_a_truth_on_both_sides_of_its_surfaces():
    world = World.street(seed=1, length_m=30.0)
    rng = np.random.default_rng(2)
    position = rng.uniform([0.0, -10.0, -1.0], [30.0, 10.0, 6.0], (500, 3))
    nearest = WorldTruth(world).nearest(position)
    known = np.isfinite(nearest.point).all(axis=1)
    assert known.mean() > 0.7  # the others are nearest to an edge
    distance_m = np.linalg.norm(position - nearest.point, axis=1)[known]
    np.testing.assert_allclose(distance_m, nearest.distance_m[known], atol=1e-9)
    np.testing.assert_allclose(world.surface_at(nearest.point[known])[1], 0.0, atol=1e-6)


def test_only_maps_in_different_frames_look_as_if_they_need_it():
    truth = faces()
    noisy = Discs(
        truth.position + np.random.default_rng(1).normal(0.0, 0.01, (len(truth), 3)), None
    )
    assert looks_needed(noisy, CloudTruth(truth), WIDTH_M) == ''
    slightly = se3_exp(np.array([0.15, 0.1, 0.08, 0.0, 0.0, 0.0]))
    assert 'halves' in looks_needed(moved_discs(truth, slightly), CloudTruth(truth), WIDTH_M)
    far = pose_matrix([60.0, 0.0, 0.0], se3_turn(0.0))
    assert '0%' in looks_needed(moved_discs(truth, far), CloudTruth(truth), WIDTH_M)
    assert looks_needed(Discs(np.empty((0, 3)), None), CloudTruth(truth), WIDTH_M) == ''
