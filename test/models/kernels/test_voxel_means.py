# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Means of voxels and labels of their points, against a dictionary of voxels."""

import numpy as np
import pytest

from surfel_mapper.models.kernels.voxel_means import (
    average_runs,
    finite_ends,
    label_points,
    row_bits,
    sorted_runs,
    voxel_keys,
    voxel_runs,
)
from test.kernels.modes import both

EDGE_M = 0.5
BITS = np.array([6, 5, 7])


def cloud(number, dtype):
    """Return points in runs of neighbours, some not finite."""
    rng = np.random.default_rng(number)
    points = np.cumsum(rng.normal(scale=0.2, size=(number, 3)), axis=0) % [20.0, 10.0, 40.0]
    points[rng.random(number) < 0.05] = [np.nan, 1.0, np.inf]
    return (points - [3.0, 4.0, 5.0]).astype(dtype)


def rows_by_voxel(points):
    """Return the rows of the finite points of each voxel, voxels ordered by z, y, x."""
    found = {}
    for row, point in enumerate(points.astype(np.float64)):
        if np.isfinite(point).all():
            found.setdefault(tuple(np.floor(point / EDGE_M).astype(int)[::-1]), []).append(row)
    return dict(sorted(found.items()))


def runs_of(call, points):
    base = np.floor(np.nanmin(np.where(np.isfinite(points), points, np.nan), axis=0) / EDGE_M)
    keys, to_key = np.empty(len(points), np.int64), call(row_bits, len(points))
    call(voxel_keys, points, np.full(3, EDGE_M), np.zeros(3), base, BITS, keys)
    runs = keys[: call(voxel_runs, keys, to_key)]
    return call(sorted_runs, runs, int(BITS.sum()), to_key), to_key


@both
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('number', [1, 129, 700])
def test_means_and_labels_are_those_of_a_dictionary(call, number, dtype):
    points = cloud(number, dtype)
    points[0] = 1.0
    expected = rows_by_voxel(points)
    runs, to_key = runs_of(call, points)

    means = np.empty((len(runs), 3))
    assert call(average_runs, points, runs, to_key, means) == len(expected)
    labels = np.arange(len(expected), dtype=np.int32) * 3 + 1
    found = np.full(number, -7, np.int32)
    call(label_points, runs, to_key, labels, found)

    for voxel, rows in enumerate(expected.values()):
        total = np.zeros(3)
        for row in rows:  # in the order of the points, so that the last bit is equal
            total = total + points[row].astype(np.float64)
        assert means[voxel].tolist() == (total / len(rows)).tolist()
        assert (found[rows] == 3 * voxel + 1).all()
    assert (found == -7).sum() == number - sum(map(len, expected.values()))


@both
def test_the_box_of_the_finite_points_is_found(call):
    points, ends = cloud(300, np.float32), np.empty((2, 3))
    assert call(finite_ends, points, ends)
    finite = points[np.isfinite(points).all(axis=1)]
    assert ends.tolist() == [finite.min(axis=0).tolist(), finite.max(axis=0).tolist()]
    assert not call(finite_ends, np.full((3, 3), np.nan, np.float32), ends)
