# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Spatial queries against a linear search over all surfels."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap

VOXEL_M = 0.5


@pytest.fixture(scope='module')
def index():
    rng = np.random.default_rng(4)
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(rng.normal(0.0, 2.0, (6000, 3)), origin=(0.0, 0.0, 9.0))
    return surfel_map.index(min_points=2)


@pytest.fixture(scope='module')
def points():
    rng = np.random.default_rng(5)
    return np.concatenate([rng.normal(0.0, 2.5, (300, 3)), [[0.5, -0.5, 1.0], [90.0, 0, 0]]])


def distances(index, point):
    return np.sqrt(((index.surfels.position - point) ** 2).sum(axis=1))


def test_at_gives_the_surfel_of_the_voxel_that_holds_the_point(index, points):
    voxel_index = index.surfels.voxel_index.tolist()
    for point, row in zip(points, index.at(points), strict=True):
        expected = np.floor(point / VOXEL_M).astype(int).tolist()
        assert (voxel_index[row] == expected) if row >= 0 else (expected not in voxel_index)
    assert (index.at(points) >= 0).sum() > 100


@pytest.mark.parametrize('radius_m', [0.0, 0.3, 0.5, 1.7])
def test_nearest_is_nearest_of_all(index, points, radius_m):
    rows, found_m = index.nearest(points, radius_m)
    for point, row, distance_m in zip(points, rows, found_m, strict=True):
        every = distances(index, point)
        if every.min() > radius_m:
            assert (row, distance_m) == (-1, np.inf)
        else:
            assert row == every.argmin()
            assert distance_m == pytest.approx(every.min(), abs=1e-12)


def test_a_coarser_level_uses_its_own_voxels(points):
    rng = np.random.default_rng(7)
    fine = SurfelMap(VOXEL_M)
    fine.add(rng.normal(0.0, 2.0, (2000, 3)))
    index = fine.coarsen(1).index()
    rows = index.at(points)
    expected = np.floor(points / 1.0).astype(int)[rows >= 0]
    np.testing.assert_array_equal(index.surfels.voxel_index[rows[rows >= 0]], expected)
    assert (rows >= 0).sum() > 100


def test_an_empty_map_finds_nothing():
    index = SurfelMap(VOXEL_M).index()
    assert index.at([[0.0, 0.0, 0.0]]).tolist() == [-1]
    assert index.nearest([[0.0, 0.0, 0.0]], 1.0)[0].tolist() == [-1]


def test_invalid_points_have_no_surfel(index):
    nowhere = [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, 1e30]]
    assert index.at(nowhere).tolist() == [-1, -1, -1]
    assert index.nearest(nowhere, 1.0)[0].tolist() == [-1, -1, -1]


def test_invalid_queries_are_refused(index):
    with pytest.raises(ValueError, match=r'points: shape \(3,\)'):
        index.at([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match='max_distance_m: nan'):
        index.nearest([[0.0, 0.0, 0.0]], float('nan'))
    with pytest.raises(ValueError, match=r'max_distance_m: -5\.0, expected zero or more'):
        index.nearest([[0.0, 0.0, 0.0]], -5.0)
