# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The sums over the pairs of an edge against numpy, and the motions derived from them."""

from __future__ import annotations

import numpy as np

from surfel_mapper.alignment.angles import transforms
from surfel_mapper.alignment.edge_terms import weighted_terms
from surfel_mapper.alignment.kernels import edges


def pairs_of(rng, dtype=np.float64, num=50, offset=0.0):
    source, target = (rng.uniform(-5.0, 5.0, (20, 3)) + offset for _ in range(2))
    rows = rng.integers(0, 20, (num, 2)).astype(np.int32)
    return source.astype(dtype), target.astype(dtype), rows


def spread_weights(rng, num):
    root = rng.normal(size=(num, 3, 3))
    return root @ root.swapaxes(1, 2)


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
