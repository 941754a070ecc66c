# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Steps of Gauss-Newton against LAPACK."""

import numpy as np
import pytest

from surfel_mapper.alignment.kernels.steps import diagonalise, solve_step


def information(rng, rank=6):
    """Return normal equations of some measurements, with rotations of another unit."""
    rows = rng.normal(size=(rank, 6)) * [1.0, 2.0, 3.0, 40.0, 5.0, 60.0]
    return rows.T @ rows


def solved(hessian, gradient, least=1e-9):
    step, values, vectors = np.empty(6), np.empty(6), np.empty((6, 6))
    radius = solve_step(hessian, gradient, least, step, values, vectors)
    return step, values, vectors, radius


@pytest.mark.parametrize('seed', range(20))
def test_eigenvalues_and_vectors_are_those_of_lapack(seed):
    rng = np.random.default_rng(seed)
    expected = information(rng, rank=1 + seed % 7)
    matrix, vectors = expected.copy(), np.eye(6)
    diagonalise(matrix, vectors)
    trace = np.trace(expected)
    found = np.sort(np.diag(matrix))
    np.testing.assert_allclose(found, np.linalg.eigvalsh(expected), atol=1e-14 * trace)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(6), atol=1e-14)
    again = vectors.T @ np.diag(np.diag(matrix)) @ vectors
    np.testing.assert_allclose(again, expected, atol=1e-13 * trace)


@pytest.mark.parametrize('seed', range(10))
def test_a_step_solves_the_equations_in_the_determined_directions(seed):
    rng = np.random.default_rng(seed)
    hessian = information(rng, rank=4 if seed % 2 else 8)
    gradient = hessian @ rng.normal(size=6) * 0.01
    step, values, vectors, radius = solved(hessian, gradient)
    weight = np.trace(hessian[:3, :3])
    assert radius == pytest.approx(np.sqrt(np.trace(hessian[3:, 3:]) / weight))
    scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
    scaled = hessian / (weight * np.outer(scale, scale))
    np.testing.assert_allclose(values, np.linalg.eigvalsh(scaled), atol=1e-14)
    assert (values < 1e-9).sum() == (2 if seed % 2 else 0)
    np.testing.assert_allclose(hessian @ step, -gradient, atol=1e-9 * np.abs(gradient).max())
    np.testing.assert_allclose(vectors[values < 1e-9] @ (step * scale), 0.0, atol=1e-9)
