# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Neighbours, surface normals and outliers: against brute force and clouds known by formula."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.filters.neighbours import search_tree, visit_neighbours
from surfel_mapper.filters.shapes import as_matrices, eigen, Moments, PAIRS, shares
from test.filters.examples import filter_of, kept, random_scan, scan_of


def all_neighbours(points, number, *limits, threads=1):
    tree = search_tree(points)
    ids = np.full((len(points), number), -7)
    distances = np.full((len(points), number), np.nan)

    def gather(part, near, squared):
        assert (ids[part] == -7).all()  # no point is visited twice
        ids[part], distances[part] = tree.rows(near, none=len(points)), np.sqrt(squared)

    visit_neighbours(gather, tree, number, *limits, ordered=True, threads=threads)
    return tree.by_row(ids), tree.by_row(distances)


def cloud(number=400, seed=1):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (number, 3))


@pytest.mark.parametrize('number', [1, 7, 400])
def test_neighbours_are_the_nearest_and_begin_with_the_point_itself(number):
    points = cloud()
    ids, distances = all_neighbours(points, number)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.testing.assert_array_equal(ids[:, 0], np.arange(400))
    np.testing.assert_array_equal(ids, np.argsort(apart, axis=1)[:, :number])
    np.testing.assert_allclose(distances, np.sort(apart, axis=1)[:, :number], atol=1e-15)


def test_points_beyond_the_limit_are_no_neighbours_and_one_at_it_is():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]])
    ids, distances = all_neighbours(points, 3, 1.0)
    assert ids.tolist() == [[0, 1, 3], [1, 0, 3], [2, 3, 3]]
    assert distances[2].tolist() == [0.0, np.inf, np.inf]


def uneven_cloud():
    """Return points as hard for the search as those of scans: rings, crowds and stray points."""
    rng = np.random.default_rng(7)
    turn = np.linspace(0.0, 2.0 * np.pi, 2000)
    rings = [
        np.stack([r * np.cos(turn), r * np.sin(turn), np.full(2000, h)], axis=1)
        for r, h in ((2.0, -1.5), (3.0, -1.5), (40.0, 2.0))
    ]
    places = np.repeat(rng.normal(size=(30, 3)), 20, axis=0)
    lattice = np.stack(np.meshgrid(*3 * [np.arange(8.0)]), axis=-1).reshape(-1, 3)
    dense = 1e-3 * rng.normal(size=(1000, 3)) + [7.0, 7.0, 0.0]
    stray = rng.uniform(-500.0, 500.0, (100, 3))
    cloud = np.concatenate([*rings, places, lattice, dense, stray])
    return cloud[rng.permutation(len(cloud))]


@pytest.mark.parametrize(
    ('number', 'limit'), [(2, np.inf), (10, np.inf), (40, np.inf), (10, 0.05)]
)
def test_distances_equal_those_of_scipy_on_rings_crowds_and_stray_points(number, limit):
    points = uneven_cloud()
    ids, distances = all_neighbours(points, number, limit)
    expected, _ = cKDTree(points).query(points, number, distance_upper_bound=limit)
    np.testing.assert_allclose(distances, expected, rtol=1e-14)
    found = ids < len(points)
    np.testing.assert_array_equal(found, np.isfinite(distances))
    apart = np.linalg.norm(points[np.minimum(ids, len(points) - 1)] - points[:, None], axis=2)
    np.testing.assert_allclose(apart[found], distances[found], rtol=1e-14)
    assert all(len(set(row[row < len(points)])) == (row < len(points)).sum() for row in ids)


@pytest.mark.parametrize(
    'name', ['statistical_outliers', 'radius_outliers', 'surface_normal', 'saliency']
)
def test_threads_make_no_difference_to_filters(name):
    scan = random_scan(6000)
    one, two = (filter_of(name, threads=threads).apply(scan) for threads in (1, 2))
    np.testing.assert_array_equal(one.points, two.points)
    assert set(one.columns) == set(two.columns)
    for column in one.columns:
        np.testing.assert_array_equal(one.columns[column], two.columns[column])


def test_moments_are_those_of_numpy():
    points = cloud(60)
    rows = np.arange(60) % 7
    by_group = Moments.of_groups(points, rows, 7)
    tree = search_tree(points)
    near = np.flatnonzero(rows[tree.order] == 3)[None].astype(np.int32)
    by_places = Moments.of_neighbours(tree, near)
    inside = points[rows == 3]
    expected = np.cov(inside.T)
    for found, i in ((by_group, 3), (by_places, 0)):
        np.testing.assert_allclose(found.mean[i], inside.mean(axis=0), atol=1e-15)
        np.testing.assert_allclose(as_matrices(found.covariance)[i], expected, atol=1e-15)
        radius = np.linalg.norm(inside - inside.mean(axis=0), axis=1).max()
        assert found.radius[i] == pytest.approx(radius)
        assert found.density[i] == pytest.approx(len(inside) / (4 / 3 * np.pi * radius**3))


@pytest.mark.parametrize('scale', [1e-200, 1.0, 1e150])
def test_eigenvalues_and_eigenvectors_rebuild_the_matrix(scale):
    factors = np.random.default_rng(0).normal(size=(300, 3, 3))
    matrices = factors @ factors.transpose(0, 2, 1)
    matrices[:4], matrices[4:6], matrices[6:8] = np.eye(3), np.diag([1, 1, 0]), np.diag([0, 0, 2])
    matrices *= scale
    values, vectors = eigen(np.stack([matrices[:, i, j] for i, j in PAIRS]))
    alone = eigen(np.stack([matrices[:, i, j] for i, j in PAIRS]), smallest_only=True)
    np.testing.assert_array_equal(alone[0], values)
    np.testing.assert_array_equal(alone[1], vectors[:, :1])
    assert (np.diff(values, axis=1) >= 0.0).all()
    rebuilt = np.einsum('mi,mij,mik->mjk', values / scale, vectors, vectors)
    np.testing.assert_allclose(rebuilt, matrices / scale, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        np.einsum('mij,mkj->mik', vectors, vectors), np.tile(np.eye(3), (300, 1, 1)), atol=1e-14
    )
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=2)[..., None], axis=2)
    assert (largest > 0.0).all()


def test_the_shares_of_plane_line_and_ball():
    values = np.array([[0.0, 1.0, 1.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(shares(values), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])


# ---- SurfaceNormal


def plane(number=500, seed=2):
    """Return points on the plane x + 2 y + 2 z = 3."""
    normal = np.array([1.0, 2.0, 2.0]) / 3.0
    u = np.array([2.0, -1.0, 0.0]) / 5**0.5
    sides = np.random.default_rng(seed).uniform(-2.0, 2.0, (number, 2))
    return normal + sides @ np.stack([u, np.cross(normal, u)]), normal


def test_on_a_plane_every_normal_is_that_of_the_plane():
    points, normal = plane()
    found = filter_of('SurfaceNormalDataPointsFilter', knn=8, keepEigenValues=1).apply(
        scan_of(points)
    )
    np.testing.assert_allclose(found.columns['normals'], np.tile(normal, (500, 1)), atol=1e-7)
    assert np.abs(found.columns['eigValues'][:, 0]).max() < 1e-14
    np.testing.assert_array_equal(found.points, points)


def test_further_columns_of_neighbours_are_added_on_request():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 2.0, 0], [10.0, 0, 0]])
    found = (
        filter_of(
            'SurfaceNormalDataPointsFilter',
            knn=3,
            keepNormals=0,
            keepDensities=1,
            keepEigenVectors=1,
            keepMatchedIds=1,
            keepMeanDist=1,
        )
        .apply(scan_of(points))
        .columns
    )
    assert set(found) == {'densities', 'eigVectors', 'matchedIds', 'meanDists'}
    assert found['matchedIds'][0].tolist() == [0, 1, 2]
    mean = points[:3].mean(axis=0)
    assert found['meanDists'][0] == pytest.approx(np.linalg.norm(mean))
    radius = np.linalg.norm(points[2] - mean)
    assert found['densities'][0] == pytest.approx(3 / (4 / 3 * np.pi * radius**3))
    np.testing.assert_allclose(found['eigVectors'][0, :3], [0.0, 0.0, 1.0], atol=1e-12)


def test_neighbours_beyond_the_distance_do_not_count():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.0, 0], [50.0, 0, 0]])
    found = (
        filter_of('SurfaceNormalDataPointsFilter', knn=4, maxDist=2, keepMatchedIds=1)
        .apply(scan_of(points))
        .columns
    )
    assert found['matchedIds'].tolist()[3] == [3, -1, -1, -1]
    assert np.isnan(found['normals'][3]).all()  # one point has no normal
    np.testing.assert_allclose(found['normals'][0], [0.0, 0.0, 1.0], atol=1e-12)


def test_smoothed_normals_are_means_of_their_neighbours_and_of_unit_length():
    rng = np.random.default_rng(6)
    points, normal = plane(2000)
    noisy = points + 0.03 * rng.normal(size=(2000, 1)) * normal
    raw, smooth = (
        filter_of('SurfaceNormalDataPointsFilter', knn=12, smoothNormals=flag)
        .apply(scan_of(noisy))
        .columns['normals']
        for flag in (0, 1)
    )
    np.testing.assert_allclose(np.linalg.norm(smooth, axis=1), 1.0)
    off = [np.degrees(np.arccos(np.minimum(np.abs(n @ normal), 1.0))) for n in (raw, smooth)]
    assert np.median(off[1]) < 0.6 * np.median(off[0])


# ---- outliers


def test_statistical_outliers_go_by_mean_and_deviation_of_the_distances():
    points = np.concatenate([cloud(), [[30.0, 0.0, 0.0], [0.0, -40.0, 0.0]]])
    assert kept('statistical_outliers', points) == list(range(400))
    apart = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:6]
    mean = apart.mean(axis=1)
    rows = np.flatnonzero(mean <= mean.mean() + 0.05 * mean.std(ddof=1))
    assert kept('statistical_outliers', points, num_neighbours=5, std_ratio=0.05) == rows.tolist()
    assert kept('statistical_outliers', points, std_ratio='inf') == list(range(402))


def test_radius_outliers_have_too_few_others_around():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [2.5, 0, 0], [9.0, 0, 0]])
    assert kept('radius_outliers', points, radius_m=1.0, min_neighbours=1) == [0, 1, 2, 3]
    assert kept('radius_outliers', points, radius_m=1.0, min_neighbours=2) == [1, 2]
    assert kept('radius_outliers', points, radius_m=1.0, min_neighbours=0) == [0, 1, 2, 3, 4]
    assert kept('radius_outliers', points, radius_m=99.0, min_neighbours=5) == []


def test_a_point_at_the_place_of_another_has_a_neighbour_at_distance_0():
    points = [[1.0, 1.0, 1.0]] * 3 + [[2.0, 2.0, 2.0]]
    assert kept('radius_outliers', points, radius_m=0.0) == [0, 1, 2]
