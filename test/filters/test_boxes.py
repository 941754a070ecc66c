# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""SamplingSurfaceNormal and Ellipsoids: boxes and the points sampled from them."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.boxes import cut_into_boxes
from surfel_mapper.filters.kernels.boxes import cut
from test.filters.examples import filter_of, random_scan, scan_of

SAMPLING, ELLIPSOIDS = 'sampling_surface_normal', 'ellipsoids'

BOTH = pytest.mark.parametrize('name', [SAMPLING, ELLIPSOIDS])


def cloud(number=1000, seed=1):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (number, 3))


def clusters(centres, number=6, size=0.01, seed=3):
    """Return tight groups of points about some places, mixed."""
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(-size, size, (number, len(centres), 3))
    return (np.asarray(centres) + offsets).reshape(-1, 3)


def slow_boxes(points, most):
    """Return the boxes as sets of rows, each cut with a full sort."""
    waiting = [(np.arange(len(points)), points.min(axis=0), points.max(axis=0))]
    found = set()
    while waiting:
        rows, low, high = waiting.pop()
        if len(rows) <= most:
            found.add(frozenset(rows.tolist()))
            continue
        axis = (high - low).argmax()
        rows = rows[np.lexsort((rows, points[rows, axis]))]
        middle = len(rows) - len(rows) // 2
        between = np.where(np.arange(3) == axis, points[rows[middle], axis], np.nan)
        waiting.append((rows[:middle], low, np.where(np.isnan(between), high, between)))
        waiting.append((rows[middle:], np.where(np.isnan(between), low, between), high))
    return found


@pytest.mark.parametrize('most', [3, 10, 60])
@pytest.mark.parametrize('steps', [1e-9, 0.25])  # with ties, and without
@pytest.mark.parametrize('compiled', [True, False])
def test_boxes_are_those_of_a_slow_twin(most, steps, compiled):
    points = np.round(cloud(700) / steps) * steps
    rows, order = np.empty(700, np.int64), np.arange(700)
    with np.errstate(over='ignore'):  # chance wraps on purpose
        number = (cut if compiled else cut.py_func)(points, most, order, rows)
    found = {frozenset(np.flatnonzero(rows == box).tolist()) for box in range(number)}
    assert found == slow_boxes(points, most)


def test_points_at_one_place_are_cut_as_well():
    rows, number = cut_into_boxes(np.zeros((100, 3)), 7)
    assert np.bincount(rows).max() <= 7
    assert number == 16


@BOTH
def test_chance_keeps_the_share_with_columns_and_order_and_adds_the_normals_of_boxes(name):
    scan = random_scan(5000)
    found = filter_of(name, ratio=0.3, knn=10).apply(scan)
    assert abs(len(found) - 1500) < 5.0 * (5000 * 0.3 * 0.7) ** 0.5
    rows = np.searchsorted(scan.columns['times'], found.columns['times'])
    np.testing.assert_array_equal(found.points, scan.points[rows])
    np.testing.assert_array_equal(found.columns['intensity'], scan.columns['intensity'][rows])
    np.testing.assert_allclose(np.linalg.norm(found.columns['normals'], axis=1), 1.0, atol=1e-6)


@BOTH
def test_on_a_plane_the_normals_are_its_own(name):
    points = cloud() * [1.0, 1.0, 0.0]
    found = filter_of(name, samplingMethod=1, keepEigenValues=1).apply(scan_of(points))
    number = cut_into_boxes(points, 7)[1]
    assert len(found) == number
    np.testing.assert_allclose(found.columns['normals'], [[0.0, 0.0, 1.0]] * number, atol=1e-7)
    assert np.abs(found.columns['eigValues'][:, 0]).max() < 1e-15


@BOTH
def test_one_point_for_each_box_is_the_mean_in_order_of_first_points(name):
    centres = [[0.0, 0, 0], [15.0, 0, 0], [5.0, 0, 0], [10.0, 0, 0]]
    points = clusters(centres)
    scan = scan_of(points, intensity=np.arange(24.0), label=np.arange(24) % 4)
    found = filter_of(name, knn=6, samplingMethod=1).apply(scan)
    expected = [points[i::4].mean(axis=0) for i in range(4)]
    np.testing.assert_allclose(found.points, expected, atol=1e-12)
    assert found.columns['intensity'].tolist() == [10.0, 11.0, 12.0, 13.0]
    assert found.columns['label'].tolist() == [0, 1, 2, 3]
    first = filter_of(name, knn=6, samplingMethod=1, averageExistingDescriptors=0).apply(scan)
    assert first.columns['intensity'].tolist() == [0.0, 1.0, 2.0, 3.0]


@BOTH
@pytest.mark.parametrize('method', [0, 1])
def test_boxes_that_extend_too_far_are_dropped(name, method):
    points = np.concatenate([clusters([[0.0, 0, 0]]), clusters([[9.0, 0, 0]], size=1.0)])
    found = filter_of(name, knn=6, samplingMethod=method, maxBoxDim=0.1, ratio=0.9999999).apply(
        scan_of(points)
    )
    assert len(found) == (6, 1)[method]
    assert np.abs(found.points).max() < 0.1


@BOTH
def test_densities_are_points_over_the_ball_around_a_box(name):
    points = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    found = filter_of(name, samplingMethod=1, keepDensities=1).apply(scan_of(points))
    assert found.columns['densities'].tolist() == [pytest.approx(4 / (4 / 3 * np.pi))]


@BOTH
@pytest.mark.parametrize('method', [0, 1])
def test_points_that_are_not_finite_are_in_no_box(name, method):
    points = cloud(50)
    scan = scan_of([*points, [np.nan, 0, 0]])
    found = filter_of(name, samplingMethod=method).apply(scan)
    expected = filter_of(name, samplingMethod=method).apply(scan_of(points))
    np.testing.assert_array_equal(found.points, expected.points)


# ---- Ellipsoids alone


def described(points, **settings):
    flags = dict.fromkeys(('keepMeans', 'keepCovariances', 'keepWeights', 'keepShapes'), 1)
    return filter_of(ELLIPSOIDS, samplingMethod=1, **flags, **settings).apply(scan_of(points))


def test_an_ellipsoid_has_mean_covariance_weight_and_shape():
    points = clusters([[1.0, 2.0, 3.0]], number=5)
    found = described(points, keepIndices=1).columns
    np.testing.assert_allclose(found['means'], [points.mean(axis=0)])
    np.testing.assert_allclose(found['covariance'].reshape(3, 3), np.cov(points.T))
    assert found['weights'].tolist() == found['numOfNN'].tolist() == [5.0]
    e0, e1, e2 = np.linalg.eigvalsh(np.cov(points.T))
    total = e0 + e1 + e2
    np.testing.assert_allclose(
        found['shapes'], [[2 * (e1 - e0) / total, (e2 - e1) / total, 3 * e0 / total]]
    )
    assert sorted(found['pointIds'][0]) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(
        np.column_stack([found[f'point{axis}'][0] for axis in 'XYZ']), points[found['pointIds'][0]]
    )


def test_rows_of_fewer_points_are_filled_up():
    found = described(cloud(9), knn=7, keepIndices=1).columns
    assert found['pointIds'].shape == (2, 7)
    assert sorted(found['pointIds'][found['pointIds'] >= 0]) == list(range(9))
    np.testing.assert_array_equal(np.isnan(found['pointX']), found['pointIds'] < 0)


def test_only_planar_boxes_stay_if_configured():
    line = np.linspace(0.0, 1.0, 5)[:, None] * [1.0, 0.0, 0.0]
    square = 10.0 + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]])
    points = np.concatenate([line, square])
    assert len(described(points, knn=5)) == 2
    found = described(points, knn=5, minPlanarity=0.9)
    np.testing.assert_allclose(found.points, [square.mean(axis=0)])


@pytest.mark.parametrize(
    'times', [np.arange(12, dtype=np.uint32), 10**18 + np.arange(12), np.arange(12.0)]
)
def test_boxes_that_last_too_long_are_dropped(times):
    points = clusters([[0.0, 0, 0], [5.0, 0, 0]])
    times = np.concatenate([times[0::2], times[1::2] * 1]).reshape(2, 6)
    times[1, -1] += 50
    scan = scan_of(points, time=times.T.ravel())
    found = filter_of(ELLIPSOIDS, knn=6, samplingMethod=1, maxTimeWindow=20).apply(scan)
    assert len(found) == 1
    assert abs(found.points[0, 0]) < 0.1


def test_without_times_their_limit_cannot_be_kept():
    with pytest.raises(FilterError, match='needs the times of the points'):
        filter_of(ELLIPSOIDS, maxTimeWindow=1).apply(scan_of(cloud(5)))
