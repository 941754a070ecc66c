# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Correspondences of samples, weights of their gaps, and loop candidates."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment import Limits, loop_candidates, match, Samples, surface_weights
from surfel_mapper.alignment.angles import transforms
from surfel_mapper.alignment.correspondences import path_lengths
from surfel_mapper.errors import AlignmentError
from surfel_mapper.mapping.surfel_map import SurfelMap


def unit(rng, num):
    vectors = rng.normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def surfels(rng, num=200):
    return Samples(
        rng.uniform(-3.0, 3.0, (num, 3)),
        unit(rng, num),
        rng.uniform(1e-6, 1e-4, num),
        rng.uniform(1e-5, 1e-3, num),
    )


def brute_force(source, target, T, limits):
    """Return the expected pairs, one sample at a time."""
    moved = source.position @ T[:3, :3].T + T[:3, 3]
    pairs = []
    for i, point in enumerate(moved):
        distance = np.linalg.norm(target.position - point, axis=1)
        j = int(distance.argmin())
        if distance[j] >= limits.max_distance_m:
            continue
        if limits.max_angle_deg < 180.0:
            cosine = (T[:3, :3] @ source.normal[i]) @ target.normal[j]
            if np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > limits.max_angle_deg:
                continue
        if limits.reciprocal:
            back = np.linalg.norm(moved - target.position[j], axis=1)
            if back.argmin() != i:
                continue
        pairs.append((i, j))
    return np.array(pairs).reshape(-1, 2)


@pytest.mark.parametrize('max_angle_deg', [180.0, 60.0])
@pytest.mark.parametrize('reciprocal', [False, True])
@pytest.mark.parametrize('max_distance_m', [0.3, 5.0])
def test_pairs_are_those_that_comparing_all_finds(max_distance_m, max_angle_deg, reciprocal):
    rng = np.random.default_rng(1)
    source, target = surfels(rng), surfels(rng)
    T = transforms(np.array([[0.2, -0.1, 0.1, 0.3, -0.2, 1.0]]))[0]
    limits = Limits(
        max_distance_m=max_distance_m, max_angle_deg=max_angle_deg, reciprocal=reciprocal
    )

    found = match(source, target, T, limits)

    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, brute_force(source, target, T, limits))


def test_weights_are_one_over_the_variance_along_the_normal():
    source = Samples([[0.3, 0.4, 0.0]], [[0.0, 0.0, 1.0]], [0.002], [0.5])
    target = Samples([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]], [0.001], [0.01])

    found = surface_weights(source, target, np.array([[0, 0]], np.int32), np.eye(4), 0.1)

    variance = 0.002 + 0.001 + 0.01 * (0.3**2 + 0.4**2)
    np.testing.assert_allclose(found[0, 2, 2], 1.0 / variance, rtol=1e-3)
    assert found[0, 0, 0] < 1e-3 * found[0, 2, 2]


def test_surfels_of_a_map_become_samples_where_they_are_flat():
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(0.1, 0.9, (100, 2)), rng.normal(0.5, 0.01, 100)])
    line = np.column_stack([rng.uniform(5.1, 5.9, 50), rng.normal(0.5, 0.01, (50, 2))])
    surfel_map = SurfelMap(1.0)
    surfel_map.add(np.concatenate([flat, line]), origin=[0.5, 0.5, 9.0])

    found = Samples.of_surfels(surfel_map.surfels())

    assert len(found) == 1
    np.testing.assert_allclose(found.position[0], flat.mean(axis=0), atol=1e-4)
    assert found.normal[0, 2] > 0.99
    assert found.variance[0] == pytest.approx((0.01**2 + 0.005**2) / 100, rel=0.3)


def test_loops_are_near_in_space_and_far_on_the_way():
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    T = np.tile(np.eye(4), (41, 1, 1))
    T[:, :3, 3] = 20.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])

    found = loop_candidates(T, 5.0)

    way = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() / 40
    assert (40, 0) in found
    for source, target in found:
        assert source > target
        assert np.linalg.norm(T[source, :3, 3] - T[target, :3, 3]) <= 5.0
        assert (source - target) * way >= 15.0
    assert max(sum(s == source for s, _ in found) for source, _ in found) <= 3
    assert loop_candidates(T, 0.0) == []
    assert loop_candidates(T[:20], 5.0) == []


def test_loops_of_a_long_path_are_found_among_nearer_ones_of_a_short_path():
    # past a place, away for 200 m, and then to and fro 3 m beside it
    x = [3.0, 103.0, 0.0, 20.0, 0.0, 20.0, 0.0, 20.0, 0.0, 20.0, 0.0]
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = x

    found = loop_candidates(T, 5.0, min_path_m=170.0)

    assert found == [(2, 0), (4, 0), (6, 0), (8, 0), (10, 0)]


def test_paths_of_sensors_mounted_apart_are_those_of_each():
    # the one in front travels 3 m, the one behind it 2.5 m from the third scan on
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, 0, 3] = [0.0, 1.0, -2.0, 2.0, 0.5, 3.0]
    frames = ['front', 'front', 'rear', 'front', 'rear', 'front']

    np.testing.assert_array_equal(path_lengths(T, frames), [0.0, 1.0, 1.0, 2.0, 3.5, 3.5])
    np.testing.assert_array_equal(path_lengths(T), [0.0, 1.0, 4.0, 8.0, 9.5, 12.0])


@pytest.mark.parametrize(
    ('refused', 'message'),
    [
        (lambda: Samples(np.zeros((3, 2))), r'shape \(3, 2\)'),
        (lambda: Samples([[np.nan, 0.0, 0.0]]), 'position'),
        (lambda: Samples(np.eye(3), np.eye(2)), 'normal'),
        (lambda: Samples(np.eye(3), np.eye(3), [1.0]), 'variance'),
        (lambda: Limits(max_distance_m=0.0), 'max_distance_m'),
        (lambda: Limits(max_distance_m=np.nan), 'max_distance_m'),
        (lambda: Limits(max_distance_m=1.0, max_angle_deg=0.0), 'max_angle_deg'),
        (
            lambda: match(
                Samples(np.eye(3)),
                Samples(np.eye(3)),
                np.eye(4),
                Limits(max_distance_m=1.0, max_angle_deg=30.0),
            ),
            'no normals',
        ),
        (
            lambda: surface_weights(
                Samples(np.eye(3)), Samples(np.eye(3)), np.array([[0, 0]]), np.eye(4), 0.1
            ),
            'not surfels',
        ),
    ],
)
def test_bad_input_is_refused(refused, message):
    with pytest.raises(AlignmentError, match=message):
        refused()
