# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The sums over the pairs of an edge against numpy, and the motions derived from them."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment.angles import transforms
from surfel_mapper.alignment.edge_terms import weighted_terms
from surfel_mapper.alignment.kernels import edges

PAIR_MOMENTS = [edges.pair_moments, edges.pair_moments.py_func]


def pairs_of(rng, dtype=np.float64, num=50, offset=0.0):
    source, target = (rng.uniform(-5.0, 5.0, (20, 3)) + offset for _ in range(2))
    rows = rng.integers(0, 20, (num, 2)).astype(np.int32)
    return source.astype(dtype), target.astype(dtype), rows


def spread_weights(rng, num):
    root = rng.normal(size=(num, 3, 3))
    return root @ root.swapaxes(1, 2)


@pytest.mark.parametrize('kernel', PAIR_MOMENTS)
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('offset', [0.0, 1000.0])
def test_means_and_second_moments_are_those_of_numpy(kernel, dtype, offset):
    source, target, rows = pairs_of(np.random.default_rng(1), dtype, offset=offset)
    source[3] = np.nan
    found = np.empty(edges.NUM_MOMENTS)

    kernel(source, target, rows, found)

    a, b = source[rows[:, 0]].astype(float), target[rows[:, 1]].astype(float)
    finite = np.isfinite(a).all(axis=1)
    a, b = a[finite], b[finite]
    da, db = a - a.mean(axis=0), b - b.mean(axis=0)
    upper = np.triu_indices(3)
    expected = [
        len(a),
        *a.mean(axis=0),
        *b.mean(axis=0),
        *(da.T @ da)[upper],
        *(db.T @ db)[upper],
        *(da.T @ db).ravel(),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-8)


def test_weighted_terms_are_those_of_points_near_the_origin_if_they_are_far_away():
    rng = np.random.default_rng(5)
    source, target, rows = pairs_of(rng)
    target[rows[:, 1]] = source[rows[:, 0]] + rng.normal(scale=0.01, size=(len(rows), 3))
    weights = spread_weights(rng, len(rows))
    far = np.tile(np.eye(4), (2, 1, 1))
    far[:, :3, 3] = [450e3, 5.4e6, 300.0]  # as in UTM
    T = transforms(rng.uniform(-0.01, 0.01, (2, 6)))
    found = []
    for apart, frame in ((0.0, np.zeros((2, 4, 4)) + np.eye(4)), (far[0, :3, 3], far)):
        moments = np.empty(edges.NUM_WEIGHTED)
        edges.weighted_moments(source + apart, target + apart, rows, weights, moments)
        at = frame @ T @ np.linalg.inv(frame)
        found.append(weighted_terms(moments[None], at[:1], at[1:]))

    (near, near_rms), (distant, distant_rms) = found
    np.testing.assert_allclose(distant.motion, near.motion, atol=1e-6)
    np.testing.assert_allclose(distant.center, near.center + far[:1, :3, 3], atol=1e-4)
    np.testing.assert_allclose(distant.information, near.information, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(distant_rms, near_rms, atol=1e-7)
