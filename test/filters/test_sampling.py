# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters that thin a scan: at random, by count, by rank, by the directions of normals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.sampling import resistance
from test.filters.examples import filter_of, kept, random_scan, scan_of

NUMBER = 40_000


def line(number=NUMBER, stamp_ns=1, **columns):
    points = np.zeros((number, 3))
    points[:, 0] = np.arange(number)
    return scan_of(points, stamp_ns=stamp_ns, **columns)


def rows(name, scan=None, /, **parameters):
    return filter_of(name, **parameters).apply(scan or line()).points[:, 0].astype(int)


def assert_even(found, number=NUMBER, parts=10):
    """Check that no part of the scan is preferred, within 5 standard deviations."""
    counts = np.bincount(found * parts // number, minlength=parts)
    assert np.abs(counts - len(found) / parts).max() < 5.0 * math.sqrt(len(found) / parts)
    assert (np.diff(found) > 0).all()


@pytest.mark.parametrize('probability', [0.1, 0.75])
def test_random_sampling_keeps_each_point_with_its_probability(probability):
    found = rows('RandomSamplingDataPointsFilter', prob=probability)
    deviation = math.sqrt(NUMBER * probability * (1.0 - probability))
    assert abs(len(found) - NUMBER * probability) < 5.0 * deviation
    assert_even(found)


def test_random_sampling_keeps_all_or_nothing_at_the_limits():
    assert len(rows('RandomSamplingDataPointsFilter', prob=1)) == NUMBER
    assert len(rows('RandomSamplingDataPointsFilter', prob=0)) == 0


@pytest.mark.parametrize(
    ('number', 'count'), [(5, 1000), (1000, 1000), (1001, 1000), (NUMBER, 999), (3, 0)]
)
def test_max_point_count_keeps_that_number(number, count):
    found = rows('MaxPointCountDataPointsFilter', line(number), maxCount=count)
    assert len(found) == min(number, count)
    assert (np.diff(found) > 0).all()


def test_max_point_count_prefers_no_part_of_the_scan():
    assert_even(rows('MaxPointCountDataPointsFilter', maxCount=5000))


def test_fix_step_sampling_keeps_every_tenth_from_one_of_the_first_ten_on():
    found = rows('FixStepSamplingDataPointsFilter')
    assert found[0] < 10
    assert (np.diff(found) == 10).all()
    phases = {rows('fix_step_sampling', line(stamp_ns=stamp))[0] for stamp in range(100)}
    assert phases == set(range(10))


@pytest.mark.parametrize(
    ('start', 'end', 'factor', 'steps'),
    [
        (10, 100, 3.0, [10, 30, 90, 100, 100]),
        (100, 7, 0.25, [100, 25, 7, 7]),
        (10, 3, 2.0, [10, 3, 3]),  # on the far side of its end already
        (10, 99, 1.0, [10, 10, 10]),
    ],
)
def test_the_step_moves_to_its_end_from_scan_to_scan(start, end, factor, steps):
    each = filter_of(
        'FixStepSamplingDataPointsFilter', startStep=start, endStep=end, stepMult=factor
    )
    found = [np.diff(each.apply(line()).points[:, 0])[0] for _ in steps]
    assert found == steps


def test_max_density_thins_what_is_too_dense_and_only_that():
    densities = np.where(np.arange(NUMBER) < NUMBER // 2, 40.0, 5.0)
    found = rows('MaxDensityDataPointsFilter', line(densities=densities), maxDensity=10)
    dense = np.count_nonzero(found < NUMBER // 2)
    assert abs(dense - NUMBER / 2 / 4) < 5.0 * math.sqrt(NUMBER / 2 * 0.25 * 0.75)
    assert np.count_nonzero(found >= NUMBER // 2) == NUMBER // 2
    with pytest.raises(FilterError, match="needs the column 'densities'"):
        filter_of('max_density').apply(line(1))


def test_max_density_drops_what_has_no_density():
    scan = line(3, densities=[1.0, np.nan, np.inf])
    assert rows('max_density', scan).tolist() == [0]


def test_max_quantile_keeps_what_is_strictly_below_or_above():
    points = np.zeros((5, 3))
    points[:, 1] = [4.0, 0.0, 3.0, 1.0, 2.0]
    name = 'MaxQuantileOnAxisDataPointsFilter'
    assert kept(name, points, dim=1, ratio=0.5) == [1, 3]
    assert kept(name, points, dim=1, ratio=0.5, removeBeyond=0) == [0, 2]
    assert kept(name, points, dim=1, ratio=1e-7) == []
    assert kept(name, points, dim=1, ratio=0.9999999) == [1, 2, 3, 4]
    assert kept(name, points, dim=0) == []  # all are at the quantile


def test_a_quantile_is_that_of_the_points_that_have_the_coordinate():
    points = np.full((4, 3), np.nan)
    points[:3, 0] = [1.0, 2.0, 3.0]
    assert kept('max_quantile_on_axis', points, ratio=0.5) == [0]
    assert kept('max_quantile_on_axis', np.full((4, 3), np.nan)) == []


SPACE, COVARIANCE = 'NormalSpaceDataPointsFilter', 'CovarianceSamplingDataPointsFilter'

BY_NORMALS = pytest.mark.parametrize('name', [SPACE, COVARIANCE])


def floor_and_groove(number=5000, seed=4):
    """Return a floor of 20 m with a groove along x, of two walls 2 m wide, 1 % of the points."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform([-10, -10, 0], [10, 10, 0], (number, 3))
    wall = rng.uniform([-10, 0, -1], [10, 0, 0], (number // 100, 3))
    points = np.concatenate([floor, wall + np.eye(3)[1], wall - np.eye(3)[1]])
    normals = np.zeros_like(points)
    normals[:number, 2] = normals[number : -(number // 100), 1] = 1.0
    normals[-(number // 100) :, 1] = -1.0
    return scan_of(points, normals=normals, row=np.arange(len(points)))


@BY_NORMALS
def test_the_number_of_points_stays_in_order_with_columns(name):
    scan = random_scan(2000)
    found = filter_of(name, nbSample=300).apply(scan)
    rows = np.searchsorted(scan.columns['times'], found.columns['times'])
    assert len(found) == 300
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(found.points, scan.points[rows])
    np.testing.assert_array_equal(found.columns['rgb'], scan.columns['rgb'][rows])


@BY_NORMALS
def test_a_scan_of_fewer_points_stays_as_it_is(name):
    scan = random_scan(300)
    assert filter_of(name, nbSample=300).apply(scan) is scan


@BY_NORMALS
def test_points_without_a_normal_are_not_chosen(name):
    normals = np.tile([0.0, 0.0, 1.0], (10, 1))
    normals[3:] = np.nan
    points = np.random.default_rng(0).normal(size=(10, 3))
    found = filter_of(name, nbSample=5).apply(scan_of(points, normals=normals, row=range(10)))
    assert found.columns['row'].tolist() == [0, 1, 2]


@BY_NORMALS
def test_without_normals_there_is_nothing_to_choose_by(name):
    with pytest.raises(FilterError, match="needs the column 'normals'"):
        filter_of(name).apply(scan_of(np.zeros((2, 3))))
    with pytest.raises(FilterError, match=r'normals: shape \(2, 2\), expected \(N, 3\)'):
        filter_of(name).apply(scan_of(np.zeros((2, 3)), normals=np.zeros((2, 2))))


def test_rare_directions_are_all_kept_and_the_common_one_is_thinned():
    found = filter_of(SPACE, nbSample=150).apply(floor_and_groove())
    # 50 turns through three buckets: all points of the walls, 50 of the floor
    kinds = [
        np.count_nonzero((found.columns['normals'] == n).all(axis=1))
        for n in ([0, 0, 1], [0, 1, 0], [0, -1, 0])
    ]
    assert kinds == [50, 50, 50]


def test_directions_are_drawn_evenly_where_there_are_as_many_everywhere():
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(200_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = (
        filter_of(SPACE, nbSample=20_000, epsilon=0.3)
        .apply(scan_of(np.zeros((200_000, 3)), normals=normals))
        .columns['normals']
    )
    assert np.abs(found.mean(axis=0)).max() < 0.02
    np.testing.assert_allclose(found.T @ found / 20_000, np.eye(3) / 3.0, atol=0.02)


def stability(points, normals):
    """Return the eigenvalues of the information about motions over the largest, ascending."""
    arms = points - points.mean(axis=0)
    arms /= np.linalg.norm(arms, axis=1).mean()
    forces = np.hstack([np.cross(arms, normals), normals])
    values = np.linalg.eigvalsh(forces.T @ forces)
    return values / values[-1]


def test_covariance_sampling_constrains_motions_better_than_random_sampling():
    scan = floor_and_groove()
    stable = filter_of(COVARIANCE, nbSample=300).apply(scan)
    chance = filter_of('max_point_count', max_points=300).apply(scan)
    found, expected = (stability(s.points, s.columns['normals']) for s in (stable, chance))
    assert max(found[0], expected[0]) < 1e-12  # nothing holds the groove along x
    assert found[1] > 10.0 * expected[1]


@pytest.mark.parametrize(('norm', 'length'), [(0, 1.0), (1, 5.0), (2, 9.0)])
def test_rotations_are_measured_by_a_length(norm, length):
    points = np.array([[9.0, 0, 0], [-9.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    normals = np.array([[0.0, 0, 1]] * 4)
    found = resistance(points, normals, norm)
    arms = np.cross(points, normals) / length
    forces = np.hstack([arms, normals])
    held = np.linalg.eigvalsh(forces.T @ forces)[3:]  # nothing holds x, y and turns about z
    np.testing.assert_allclose(np.linalg.eigvalsh(found.T @ found), held, atol=1e-12)
