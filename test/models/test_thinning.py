# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Means of voxels and the points of each, against a dictionary of voxels."""

import numpy as np
import pytest

from surfel_mapper.models.thinning import thin

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
    """Keys of the last case have six digits."""
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


def test_parts_divide_voxels_and_make_up_their_means():
    points = cloud(700, np.float64)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    part = np.floor(points[finite] / (EDGE_M / 3)).astype(int)
    order = np.column_stack([np.floor(points[finite] / EDGE_M).astype(int), part])
    rows = {}
    for row, key in zip(finite.tolist(), order.tolist(), strict=True):
        rows.setdefault((*key[2::-1], *key[:2:-1]), []).append(row)
    expected = [rows[key] for key in sorted(rows)]

    parts, whole = thin(points, EDGE_M, 3), thin(points, EDGE_M)
    voxels = parts.whole_voxels()

    assert parts.rows.tolist() == [row for part_rows in expected for row in part_rows]
    assert np.diff(parts.starts).tolist() == [len(part_rows) for part_rows in expected]
    means = [points[part_rows].mean(axis=0) for part_rows in expected]
    np.testing.assert_allclose(voxels.points, means, rtol=1e-14)
    assert voxels.keys.tolist() == whole.keys.tolist()
    assert parts.starts[voxels.starts].tolist() == whole.starts.tolist()
    np.testing.assert_allclose(voxels.means, whole.means, rtol=1e-13)


def test_voxels_that_leave_no_numbers_for_parts_are_not_divided():
    corners = np.array([[0.25] * 3, [2.0**19 - 0.75] * 3])
    assert (thin(corners, 0.5, 3).divisions, thin(corners, 1.0, 3).divisions) == (1, 3)
