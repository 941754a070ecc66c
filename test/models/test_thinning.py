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
