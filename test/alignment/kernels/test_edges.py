# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The sums over the pairs of an edge against numpy, and the motions derived from them."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment.angles import transforms
from surfel_mapper.alignment.edge_terms import edge_sums, weighted_terms
from surfel_mapper.alignment.kernels import edges

PAIR_MOMENTS = [edges.pair_moments, edges.pair_moments.py_func]
WEIGHTED_MOMENTS = [edges.weighted_moments, edges.weighted_moments.py_func]
FIT_RESIDUAL = [edges.fit_residual, edges.fit_residual.py_func]


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


@pytest.mark.parametrize('kernel', PAIR_MOMENTS + WEIGHTED_MOMENTS)
def test_no_pairs_give_zero_sums(kernel):
    rows = np.empty((0, 2), np.int32)
    weights = [np.empty((0, 3, 3))] if kernel in WEIGHTED_MOMENTS else []
    found = np.full(edges.NUM_WEIGHTED if weights else edges.NUM_MOMENTS, np.nan)

    kernel(np.eye(3), np.eye(3), rows, *weights, found)

    np.testing.assert_array_equal(found, 0.0)


@pytest.mark.parametrize('kernel', WEIGHTED_MOMENTS)
def test_weighted_sums_give_the_squared_gap_at_any_pose(kernel):
    rng = np.random.default_rng(2)
    source, target, rows = pairs_of(rng)
    target[4] = np.inf
    weights = spread_weights(rng, len(rows))
    found = np.empty(edges.NUM_WEIGHTED)

    kernel(source, target, rows, weights, found)

    T = transforms(rng.uniform(-2.0, 2.0, (2, 6)))
    _, rms = weighted_terms(found[None], T[:1], T[1:])
    relative = np.linalg.inv(T[1]) @ T[0]
    finite = rows[:, 1] != 4
    gap = (source[rows[:, 0]] @ relative[:3, :3].T + relative[:3, 3] - target[rows[:, 1]])[finite]
    total = np.trace(weights[finite], axis1=1, axis2=2).sum()
    expected = np.einsum('ki,kij,kj->', gap, weights[finite], gap) / total
    np.testing.assert_allclose(rms**2, expected, rtol=1e-10)


def test_weighted_motion_is_the_weighted_least_squares_of_the_gaps():
    rng = np.random.default_rng(3)
    source, target, rows = pairs_of(rng)
    weights = spread_weights(rng, len(rows))
    found = np.empty(edges.NUM_WEIGHTED)
    edges.weighted_moments(source, target, rows, weights, found)
    T = transforms(rng.uniform(-2.0, 2.0, (2, 6)))

    terms, _ = weighted_terms(found[None], T[:1], T[1:])

    R = T[1, :3, :3]
    a = source[rows[:, 0]] @ T[0, :3, :3].T + T[0, :3, 3]
    z = a - (target[rows[:, 1]] @ R.T + T[1, :3, 3])
    arm = a - terms.center[0]
    M = np.zeros((len(rows), 3, 6))
    M[:, :, :3] = np.eye(3)
    for axis in range(3):
        M[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    W = R @ weights @ R.T
    matrix = np.einsum('kia,kij,kjb->ab', M, W, M)
    right = np.einsum('kia,kij,kj->a', M, W, z)
    np.testing.assert_allclose(terms.motion[0], np.linalg.solve(matrix, right), rtol=1e-4)
    rest = z - np.einsum('kia,a->ki', M, terms.motion[0])
    variance = max(np.einsum('ki,kij,kj->', rest, W, rest) / (len(rows) - 6), 1.0)
    np.testing.assert_allclose(terms.information[0], matrix / variance, rtol=1e-4, atol=1e-6)


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


@pytest.mark.parametrize('kernel', FIT_RESIDUAL)
def test_the_residual_of_a_motion_is_summed_pair_by_pair(kernel):
    rng = np.random.default_rng(4)
    source, target, rows = pairs_of(rng)
    source[2] = np.nan
    T = transforms(rng.uniform(-2.0, 2.0, (2, 6)))
    center, motion = rng.normal(size=3), rng.normal(size=6)

    found = kernel(source, target, rows, T[0], T[1], center, motion)

    a = source[rows[:, 0]] @ T[0, :3, :3].T + T[0, :3, 3]
    b = target[rows[:, 1]] @ T[1, :3, :3].T + T[1, :3, 3]
    rest = a - b - motion[:3] - np.cross(motion[3:], 0.5 * (a + b) - center)
    np.testing.assert_allclose(found, np.nansum(rest**2), rtol=1e-12)


def test_sums_at_a_pose_are_those_of_the_moved_pairs():
    rng = np.random.default_rng(5)
    source, target, rows = pairs_of(rng)
    moments = np.empty((1, edges.NUM_MOMENTS))
    edges.pair_moments(source, target, rows, moments[0])
    T = transforms(rng.uniform(-2.0, 2.0, (2, 6)))

    sums = edge_sums(moments, T[:1], T[1:])

    a = source[rows[:, 0]] @ T[0, :3, :3].T + T[0, :3, 3]
    b = target[rows[:, 1]] @ T[1, :3, :3].T + T[1, :3, 3]
    c, z = 0.5 * (a + b), a - b
    dc, dz = c - c.mean(axis=0), z - z.mean(axis=0)
    inertia = (dc**2).sum() * np.eye(3) - dc.T @ dc
    np.testing.assert_allclose(sums.center[0], c.mean(axis=0))
    np.testing.assert_allclose(sums.gap[0], z.mean(axis=0))
    np.testing.assert_allclose(sums.inertia[0], inertia, rtol=1e-9)
    np.testing.assert_allclose(sums.turn[0], np.cross(dc, dz).sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(sums.gap_sq[0], (dz**2).sum(), rtol=1e-9)
    np.testing.assert_allclose(sums.rms[0] ** 2, (z**2).sum(axis=1).mean(), rtol=1e-9)
