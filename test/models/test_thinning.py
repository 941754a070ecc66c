# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Thinning to a point a voxel: means, their order, and labels back to the points."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.fitting import thin

SIZE = 0.02


def cloud(reach, dtype):
    """Return points near and far with repeated ones in a row, and what is not finite."""
    rng = np.random.default_rng(2)
    near = np.repeat(rng.normal(scale=0.3, size=(700, 3)), rng.integers(1, 300, 700), axis=0)
    points = np.concatenate([near, rng.uniform(-reach, reach, (300, 3))]).astype(dtype)
    points[::97] = np.nan
    points[5], points[6, 1] = np.inf, -np.inf
    return points


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('reach', [1.0, 1e4])  # with 1e4 m keys have 60 bits
def test_means_are_those_of_the_points_of_each_voxel_in_their_order(reach, dtype):
    points = cloud(reach, dtype)
    thinned = thin(points, SIZE)
    finite = np.isfinite(points).all(axis=1)
    index = np.floor(points[finite].astype(np.float64) / SIZE)
    voxels, which = np.unique(index[:, ::-1], axis=0, return_inverse=True)
    which = which.ravel()
    counts = np.bincount(which)
    expected = np.zeros((len(voxels), 3))
    np.add.at(expected, which, points[finite])
    np.testing.assert_array_equal(thinned.means, expected / counts[:, None])
    labels = thinned.spread(np.arange(len(voxels), dtype=np.int32))
    np.testing.assert_array_equal(labels[finite], which)
    assert (labels[~finite] == -1).all()


def test_every_other_point_of_an_array_is_thinned_as_a_copy_of_these():
    points = cloud(1.0, np.float32)
    strided, copied = thin(points[::2], SIZE), thin(points[::2].copy(), SIZE)
    np.testing.assert_array_equal(strided.means, copied.means)


@pytest.mark.parametrize('points', [np.empty((0, 3)), np.full((4, 3), np.nan)])
def test_of_no_points_nothing_is_left(points):
    thinned = thin(points, SIZE)
    assert thinned.means.shape == (0, 3)
    assert (thinned.spread(np.empty(0, np.int32)) == [-1] * len(points)).all()
