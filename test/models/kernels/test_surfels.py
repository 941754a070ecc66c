# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Classes, links and groups of surfels against numpy, scipy and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.kernels.surfel_classes import (
    classify,
    classify_sparse,
    FLAT,
    ROUGH,
    YOUNG,
)
from test.kernels.modes import both

PAIRS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
SIZE_M = 0.5


def blobs(number, seed):
    """Return clouds of points of random shapes, some flat, some lines."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        scale = rng.choice([0.1, 0.01, 0.001], 3)
        found.append((rng.normal(size=(rng.integers(4, 60), 3)) * scale) @ turn.T + 7.0)
    return found


def packed(clouds):
    covariances = np.array([np.cov(cloud.T) for cloud in clouds])
    counts = np.array([len(cloud) for cloud in clouds])
    means = np.array([cloud.mean(axis=0) for cloud in clouds])
    return counts, means, covariances[:, PAIRS[0], PAIRS[1]], covariances


@both
def test_classes_and_axes_equal_the_eigen_decomposition(call):
    clouds = blobs(60, 1)
    counts, _, six, full = packed(clouds)
    values, vectors = np.linalg.eigh(full)
    normals = np.ascontiguousarray(vectors[:, :, 0])
    kind, axes = np.zeros(60, np.uint8), np.zeros((60, 2, 3))
    rows, variance = np.arange(60, dtype=np.int32), 1e-4
    call(classify, rows, counts, normals, six, (10.0, variance, SIZE_M), kind, axes)
    is_flat = (values[:, 0] < variance) & (values[:, 1] > 0.04 * values[:, 2])
    expected = np.where(counts < 10, YOUNG, np.where(is_flat, FLAT, ROUGH))
    assert kind.tolist() == expected.tolist()
    assert len({*kind.tolist()}) == 3
    for row in range(60):
        lengths = np.minimum(np.sqrt(3.0 * values[row, :0:-1]), SIZE_M * math.sqrt(0.5))
        along = axes[row] / lengths[:, None]
        expected = vectors[row, :, :0:-1].T
        assert np.abs((along * expected).sum(axis=1)) == pytest.approx([1.0, 1.0], abs=1e-6)
        assert np.linalg.norm(along, axis=1) == pytest.approx([1.0, 1.0], abs=1e-6)


@both
def test_sparse_voxels_are_flat_on_the_plane_of_all_points_around(call):
    rng = np.random.default_rng(14)
    table = np.array([[1, 2, -1], [0, 2, -1], [0, 1, 3], [2, -1, -1]], np.int32)
    tilt = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [-0.1, 0.0, 1.0]])
    clouds = [
        (rng.uniform(0.0, 0.4, (6, 3)) * [1, 1, 1e-3] + [0.5 * k, 0.0, 0.0]) @ tilt.T
        for k in range(4)
    ]
    clouds[3][:, 2] += 0.2  # off the plane of the others
    counts, means, six, full = packed(clouds)
    values, vectors = np.linalg.eigh(full)
    normals = np.ascontiguousarray(vectors[:, :, 0]) * np.sign(vectors[:, 2:, 0])
    own = np.full(4, YOUNG, np.uint8)
    kind, normal = np.zeros(4, np.uint8), np.empty((4, 3))
    rows, alone = np.arange(4, dtype=np.int32), (counts, means, normals, six, values)
    rules = (15.0, 1e-4, SIZE_M)
    call(classify_sparse, rows, table, own, alone, rules, kind, normal)
    assert kind.tolist() == [FLAT, FLAT, YOUNG, YOUNG]
    pooled = np.concatenate(clouds[:3])
    expected = np.linalg.eigh(np.cov(pooled.T))[1][:, 0]
    np.testing.assert_allclose(normal[0], expected * np.sign(expected[2]), atol=1e-9)
    np.testing.assert_array_equal(normal[3], normals[3])

    own[1] = FLAT  # beside it they may get a host instead
    call(classify_sparse, rows, table, own, alone, rules, kind, normal)
    assert kind.tolist() == [YOUNG, FLAT, YOUNG, YOUNG]
