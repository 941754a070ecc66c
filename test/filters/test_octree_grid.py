# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""OctreeGrid against a tree that is really built, and in cases known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.filters.grids import leaves, LEVELS, spread
from test.filters.examples import filter_of, random_scan, scan_of

NAME = 'OctreeGridDataPointsFilter'


def slow_leaves(points, max_points, max_size):
    """Return the leaves as sets of rows, by cutting cubes one after another."""
    low, high = points.min(axis=0), points.max(axis=0)
    edge = (high - low).max()
    corner = 0.5 * (low + high) - 0.5 * edge
    corner[low == high] = low[low == high]
    open_, found = [(corner, edge, np.arange(len(points)))], []
    while open_:
        corner, edge, rows = open_.pop()
        if len(rows) <= max_points or edge <= max_size:
            found.append(frozenset(rows.tolist()))
            continue
        upper = points[rows] >= corner + 0.5 * edge
        for which in np.unique(upper, axis=0):
            inside = rows[(upper == which).all(axis=1)]
            open_.append((corner + 0.5 * edge * which, 0.5 * edge, inside))
    return set(found)


@pytest.mark.parametrize(
    ('max_points', 'max_size'), [(1, 0.0), (5, 0.0), (1, 0.3), (40, 0.6), (1, 9.0), (1000, 0.0)]
)
@pytest.mark.parametrize('flat', [False, True])
def test_leaves_are_those_of_a_tree(max_points, max_size, flat):
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (600, 3))
    points[:, 2] *= 0.0 if flat else 0.2
    rows, number = leaves(points, max_points, max_size)
    found = {frozenset(np.flatnonzero(rows == leaf).tolist()) for leaf in range(number)}
    assert found == slow_leaves(points, max_points, max_size)
    _, first = np.unique(rows, return_index=True)
    assert (np.diff(first) > 0).all()  # numbered as they first appear


def test_paths_take_a_bit_of_every_axis_in_turn():
    values = np.array([0, 1, 0b101, 2**LEVELS - 1])
    expected = [int('0' + '00'.join(f'{v:b}'), 2) for v in values]
    assert spread(values).tolist() == expected


SQUARE = [[0.0, 0, 0], [0.2, 0, 0], [0.1, 0.25, 0], [4.0, 4.0, 0], [0.1, 0.1, 0], [0.0, 4.0, 0]]
"""Four points in the lowest cube of an edge of 1, and two alone."""


def sampled(method, **columns):
    scan = scan_of(SQUARE, row=range(6), **columns)
    return filter_of(NAME, maxSizeByNode=1.0, samplingMethod=method).apply(scan)


def test_the_first_point_stands_for_its_leaf():
    assert sampled(0).columns['row'].tolist() == [0, 3, 5]


def test_a_random_point_stands_for_its_leaf_and_any_may():
    found = {
        filter_of(NAME, maxSizeByNode=1.0, samplingMethod=1, seed=seed)
        .apply(scan_of(SQUARE, row=range(6)))
        .columns['row'][0]
        for seed in range(60)
    }
    assert found == {0, 1, 2, 4}


def test_the_mean_stands_for_its_leaf_with_averaged_columns():
    found = sampled(2, intensity=[1.0, 2.0, 3.0, 9.0, 6.0, 7.0], label=[5, 6, 7, 8, 9, 10])
    np.testing.assert_allclose(found.points, [[0.1, 0.0875, 0], [4.0, 4.0, 0], [0.0, 4.0, 0]])
    assert found.columns['intensity'].tolist() == [3.0, 9.0, 7.0]
    assert found.columns['label'].tolist() == [5, 8, 10]


def test_the_point_nearest_the_mean_stands_for_its_leaf():
    assert sampled(3).columns['row'].tolist() == [4, 3, 5]


def test_by_default_every_place_keeps_one_point():
    scan = random_scan(200)
    twice = scan.select(np.concatenate([np.arange(200), np.arange(200)]))
    found = filter_of(NAME).apply(twice)
    np.testing.assert_array_equal(found.points, scan.points)


@pytest.mark.parametrize('method', range(4))
def test_points_nearer_than_paths_can_tell_stay_together(method):
    near = np.nextafter(np.float64(1.0), 2.0)
    scan = scan_of([[1.0, 0, 0], [near, 0, 0], [-1.0, 0, 0]])
    assert len(filter_of(NAME, samplingMethod=method).apply(scan)) == 2


def test_a_leaf_is_no_larger_than_asked():
    scan = random_scan(3000)
    found = filter_of('octree_grid', max_size_m=0.5, sampling_method=2).apply(scan)
    edge = 8.0 / 2 ** np.ceil(np.log2(8.0 / 0.5))
    # as many as the occupied cubes of that edge, give or take those of the moved grid
    cubes = {tuple(cell) for cell in np.floor(scan.points / edge)}
    assert 0.8 < len(found) / len(cubes) < 1.2
