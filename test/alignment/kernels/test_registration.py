# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The kernels of the registration against plain numpy."""

import math

import numpy as np

from surfel_mapper.alignment.kernels.registration import (
    cell_keys,
    PLANE,
    SIGMAS_SQ,
    sum_equations,
)
from surfel_mapper.geometry import se3_exp
from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.moments import pack_keys
from test.kernels.modes import both

POSE = se3_exp(np.array([3.0, -2.0, 1.0, 0.2, -0.3, 1.5]))[:3].copy()


@both
def test_cells_outside_of_the_grid_or_invalid_have_no_voxel(call):
    cells = np.array([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0], [0.0, -1e9, 0.0], [0.0, 0.0, np.nan]])
    keys = np.empty(4, np.int64)

    call(cell_keys, cells, np.eye(4)[:3].copy(), (1 << BITS) / 0.5, BITS, keys)

    assert keys.tolist() == [pack_keys(np.zeros((1, 3), int))[0], -1, -1, -1]


def equations(cells, place, planes, width_sq):
    """Return the twin of sum_equations, cell by cell in numpy."""
    hessian, gradient, met, fit = np.zeros((6, 6)), np.zeros(6), 0, 0.0
    for cell, row in zip(cells, place, strict=True):
        if row < 0 or not planes[row, 6] < math.inf:
            continue
        mean, normal, variance, spread = np.split(planes[row], [3, 6, 7])
        lever = POSE[:, :3] @ cell
        step = lever + POSE[:, 3] - mean
        distance = normal @ step
        along = step - distance * normal
        variance = variance[0] + spread[0] * (along @ along)
        weight = (width_sq / (width_sq + distance**2)) ** 2 / variance
        jacobian = np.concatenate([normal, np.cross(lever, normal)])
        hessian += weight * np.outer(jacobian, jacobian)
        gradient += weight * distance * jacobian
        met += 1
        fit += 1.0 / (1.0 + distance**2 / (SIGMAS_SQ * variance))
    return hessian, gradient, met, fit


@both
def test_equations_are_those_of_the_twin(call):
    rng = np.random.default_rng(2)
    cells = rng.uniform(-10.0, 10.0, (50, 3))
    place = rng.integers(-1, 12, 50).astype(np.int32)
    planes = np.empty((12, PLANE))
    normals = rng.normal(size=(12, 3))
    planes[:, :3] = rng.uniform(-10.0, 10.0, (12, 3))
    planes[:, 3:6] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    planes[:, 6:] = rng.uniform(0.01, 0.1, (12, 2))
    planes[4, 6] = math.inf
    hessian, gradient = np.empty((6, 6)), np.empty(6)

    met, fit = call(sum_equations, cells, POSE, place, planes, 4.0, hessian, gradient)

    expected = equations(cells, place, planes, 4.0)
    np.testing.assert_allclose(hessian, expected[0], rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-10, atol=1e-9)
    assert met == expected[2]
    assert math.isclose(fit, expected[3], rel_tol=1e-12)
