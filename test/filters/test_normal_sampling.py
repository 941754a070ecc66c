# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""NormalSpace and CovarianceSampling: what they hold of the directions that a scan has."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.kernels.sampling import choose
from surfel_mapper.filters.sampling import buckets, resistance
from test.filters.examples import filter_of, random_scan, scan_of

SPACE, COVARIANCE = 'NormalSpaceDataPointsFilter', 'CovarianceSamplingDataPointsFilter'

BOTH = pytest.mark.parametrize('name', [SPACE, COVARIANCE])


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


@BOTH
def test_so_many_points_stay_in_their_order_with_their_columns(name):
    scan = random_scan(2000)
    found = filter_of(name, nbSample=300).apply(scan)
    rows = np.searchsorted(scan.columns['times'], found.columns['times'])
    assert len(found) == 300
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(found.points, scan.points[rows])
    np.testing.assert_array_equal(found.columns['rgb'], scan.columns['rgb'][rows])


@BOTH
def test_a_scan_of_fewer_points_stays_as_it_is(name):
    scan = random_scan(300)
    assert filter_of(name, nbSample=300).apply(scan) is scan


@BOTH
def test_points_without_a_normal_are_not_chosen(name):
    normals = np.tile([0.0, 0.0, 1.0], (10, 1))
    normals[3:] = np.nan
    points = np.random.default_rng(0).normal(size=(10, 3))
    found = filter_of(name, nbSample=5).apply(scan_of(points, normals=normals, row=range(10)))
    assert found.columns['row'].tolist() == [0, 1, 2]


@BOTH
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


@pytest.mark.parametrize('step', [0.04908738521, 0.09817477042, 0.5, 3.14159265359])
def test_buckets_are_about_equally_large(step):
    normals = np.random.default_rng(9).normal(size=(400_000, 3))
    rows = buckets(normals, step)
    found, counts = np.unique(rows, return_counts=True)
    area = 4.0 * np.pi * counts / len(normals)
    assert found.min() == 0
    if step < 1.0:  # away from the poles, where a band has but few parts
        large = counts > 50
        assert abs(np.median(area[large]) / step**2 - 1.0) < 0.1
    poles = buckets(np.array([[0.0, 0, 1], [0.0, 0, -1], [0.0, 0, 0], [-1.0, -0.0, 0]]), step)
    assert (poles >= 0).all()
    assert poles[0] == poles[2] == 0


def test_chance_follows_the_seed():
    scan = random_scan(3000)
    one, two = (filter_of(SPACE, nbSample=100, seed=s).apply(scan).points for s in (1, 2))
    assert not np.array_equal(one, two)


def stability(points, normals):
    """Return the eigenvalues of what resists motions over the largest, ascending."""
    arms = points - points.mean(axis=0)
    arms /= np.linalg.norm(arms, axis=1).mean()
    forces = np.hstack([np.cross(arms, normals), normals])
    values = np.linalg.eigvalsh(forces.T @ forces)
    return values / values[-1]


def test_a_sample_resists_all_motions_that_the_scan_resists_better_than_chance_does():
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


def slow_choose(resists, number):
    held, chosen = np.zeros(6), []
    for _ in range(number):
        left = np.setdiff1d(np.arange(len(resists)), chosen)
        motion = held.argmin()
        best = left[np.abs(resists[left, motion]).argmax()]
        chosen.append(best)
        held += resists[best] ** 2
    return set(chosen)


@pytest.mark.parametrize('number', [0, 1, 30, 60])
@pytest.mark.parametrize('call', [choose, choose.py_func])
def test_the_kernel_chooses_what_its_slow_twin_chooses(number, call):
    resists = np.random.default_rng(2).normal(size=(60, 6))
    order = np.ascontiguousarray(np.argsort(-np.abs(resists), axis=0, kind='stable').T)
    chosen = np.zeros(60, np.bool_)
    call(resists, order, number, chosen)
    assert set(np.flatnonzero(chosen)) == slow_choose(resists, number)
