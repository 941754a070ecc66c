# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Eigenvectors and moments against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.kernels.frames import eigen_frame
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
        call(eigen_frame, matrix, values, vectors)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-12 * values[2])
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose((vectors.T * values) @ vectors, matrix, atol=1e-12 * values[2])
        assert (vectors[range(3), np.abs(vectors).argmax(axis=1)] > 0).all()
