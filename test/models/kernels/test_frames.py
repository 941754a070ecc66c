# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Eigenvectors and moments against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.frames import means_and_scatters
from surfel_mapper.models.kernels.frames import eigen_frame, group_moments
from test.kernels.modes import both


def with_spectrum(spectrum, seed=0):
    """Return matrices (N, 3, 3) of eigenvalues (N, 3), turned at random."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(len(spectrum), 3, 3)))[0]
    matrices = (axes * np.asarray(spectrum)[:, None, :]) @ axes.transpose(0, 2, 1)
    return (matrices + matrices.transpose(0, 2, 1)) / 2.0


@both
@pytest.mark.parametrize('axes', [(1.0, 1.0, 1.0), (1.0, 1e-3, 1e-9), (1.0, 1.0, 0.0)])
@pytest.mark.parametrize('scale', [1e-12, 1.0, 1e12])
def test_a_frame_holds_all_eigenvectors_of_one_matrix(call, axes, scale):
    spectrum = np.abs(np.random.default_rng(8).normal(size=(60, 3))) * axes * scale
    matrices = with_spectrum(spectrum, seed=9)
    for matrix in matrices:
        values, vectors = np.empty(3), np.empty((3, 3))
        call(eigen_frame, matrix.copy(), values, vectors)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-12 * values[2])
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose((vectors.T * values) @ vectors, matrix, atol=1e-12 * values[2])
        assert (vectors[range(3), np.abs(vectors).argmax(axis=1)] > 0).all()


@both
def test_moments_of_groups_equal_numpy(call):
    rng = np.random.default_rng(3)
    points, weights = rng.normal(size=(40, 3)) + 1e3, rng.uniform(0.5, 2.0, 40)
    starts, sums = np.array([0, 15, 15, 40]), np.empty((3, 10))
    call(group_moments, points, weights, starts, sums)
    np.testing.assert_allclose(sums[:, 0], [weights[:15].sum(), 0.0, weights[15:].sum()])
    total, means, scatters = means_and_scatters(points, weights, starts)
    assert total[1] == 0.0
    assert not means[1].any()
    for k, rows in ((0, slice(0, 15)), (2, slice(15, 40))):
        mean = np.average(points[rows], axis=0, weights=weights[rows])
        np.testing.assert_allclose(means[k], mean, rtol=1e-13)
        away = points[rows] - mean
        np.testing.assert_allclose(scatters[k], away.T @ (weights[rows, None] * away), atol=1e-9)
