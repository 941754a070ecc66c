# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Means of voxels and the points of each, against a dictionary of voxels."""

import numpy as np
import pytest

from surfel_mapper.models.kernels.voxel_means import average_voxels, finite_ends, voxel_keys
from surfel_mapper.models.thinning import thin
from test.kernels.modes import both

EDGE_M = 0.5


def cloud(number, dtype, spread_m=0.0):
    """Return points in runs of neighbours, some not finite."""
    rng = np.random.default_rng(number)
    points = np.cumsum(rng.normal(scale=0.2, size=(number, 3)), axis=0) % [20.0, 10.0, 40.0]
    points += spread_m * rng.integers(0, 2, (number, 1))
    points[rng.random(number) < 0.05] = [np.nan, 1.0, np.inf]
    points[0] = 1.0
    return (points - [3.0, 4.0, 5.0]).astype(dtype)


def rows_by_voxel(points):
    """Return the rows of the finite points of each voxel, voxels ordered by z, y, x."""
    rows = {}
    for row, point in enumerate(points.astype(np.float64)):
        if np.isfinite(point).all():
            rows.setdefault(tuple(np.floor(point / EDGE_M).astype(int)[::-1]), []).append(row)
    return dict(sorted(rows.items()))


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize(('number', 'spread_m'), [(1, 0.0), (129, 0.0), (700, 0.0), (700, 4e5)])
def test_means_and_rows_are_those_of_a_dictionary(number, dtype, spread_m):
    """The last case has keys that leave no room for the rows of points."""
    points = cloud(number, dtype, spread_m)
    expected = rows_by_voxel(points)

    thinned = thin(points, EDGE_M)

    means = [points[rows].astype(np.float64).mean(axis=0) for rows in expected.values()]
    np.testing.assert_allclose(thinned.means, means, rtol=1e-14)
    assert thinned.rows.tolist() == [row for rows in expected.values() for row in rows]
    assert np.diff(thinned.starts).tolist() == [len(rows) for rows in expected.values()]
    assert (np.diff(thinned.keys) > 0).all()
    labels = np.arange(len(expected), dtype=np.int32)
    by_point = np.full(number, -1)
    for label, rows in enumerate(expected.values()):
        by_point[rows] = label
    assert thinned.point_labels(labels).tolist() == by_point.tolist()


@pytest.mark.parametrize('points', [np.empty((0, 3)), np.full((4, 3), np.nan, np.float32)])
def test_no_finite_point_gives_no_voxel(points):
    thinned = thin(points, EDGE_M)
    assert (len(thinned.means), len(thinned.rows), thinned.starts.tolist()) == (0, 0, [0])


@both
def test_kernels_agree_with_numpy_on_two_voxels(call):
    points = np.array([[0.9, 0.1, 0.1], [np.inf, 0.0, 0.0], [0.1, 0.1, 0.1], [0.7, 0.3, 0.1]])
    ends = np.empty((2, 3))
    assert call(finite_ends, points, ends) == 3
    assert ends.tolist() == [[0.1, 0.1, 0.1], [0.9, 0.3, 0.1]]
    keys, rows = np.empty(3, np.int64), np.empty(3, np.int64)
    axes = np.stack([np.full(3, EDGE_M), np.zeros(3), np.zeros(3)])
    call(voxel_keys, points, (axes, np.array([1, 0, 0])), keys, rows)
    assert (keys.tolist(), rows.tolist()) == ([1, 0, 1], [0, 2, 3])

    ordered = np.sort(keys << 3 | rows)
    outputs = np.empty(3, np.int32), np.empty(4, np.int64), keys, np.empty((3, 3))
    assert call(average_voxels, points, ordered, 3, *outputs) == 2
    assert outputs[0].tolist() == [2, 0, 3]
    assert outputs[1][:3].tolist() == [0, 1, 3]
    np.testing.assert_allclose(outputs[3][:2], [[0.1, 0.1, 0.1], [0.8, 0.2, 0.1]])
