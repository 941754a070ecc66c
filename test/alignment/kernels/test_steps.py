# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Steps of Gauss-Newton against LAPACK and against the exponential map."""

import numpy as np
import pytest

from surfel_mapper.alignment.kernels.steps import diagonalise, move_pose, solve_step
from surfel_mapper.geometry import compose, pose_matrix, q_xyzw, se3_exp


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


def test_equations_without_information_give_no_step():
    step, values, vectors, radius = solved(np.zeros((6, 6)), np.ones(6))
    assert not step.any()
    assert not values.any()
    assert np.array_equal(vectors, np.eye(6))
    assert radius == 1.0


@pytest.mark.parametrize('angle', [0.0, 1e-12, 1e-9, 1e-5, 0.3, 3.0, np.pi])
def test_a_pose_is_turned_in_place_and_moved(angle):
    rng = np.random.default_rng(3)
    axis = rng.normal(size=3)
    step = np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])
    pose = se3_exp(rng.normal(size=6))
    turned = compose(se3_exp(np.concatenate([np.zeros(3), step[3:]])), pose)
    expected = pose_matrix(pose[:3, 3] + step[:3], q_xyzw(turned))
    moved = np.empty((4, 4))
    move_pose(pose, step, moved)
    np.testing.assert_allclose(moved, expected, atol=1e-14)


def test_a_thousand_steps_keep_a_rotation_orthonormal():
    rng = np.random.default_rng(4)
    pose, moved = np.eye(4), np.empty((4, 4))
    for _ in range(1000):
        move_pose(pose, rng.normal(size=6), moved)
        pose, moved = moved, pose
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0, abs=1e-14)
