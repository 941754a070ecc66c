# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Touching patches and height fields against brute force, numpy and analytic surfaces."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.growth import owner_table, sorted_table
from surfel_mapper.models.kernels.joining import (
    height_errors,
    touching_patches,
)
from surfel_mapper.models.thinning import thin
from test.kernels.modes import both

SIZE = 0.1


def scattered(number=400):
    """Return voxels of random points, an owner from -2 to 3 of each, and the table of means."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 1.0, (number, 3)) * [1.0, 0.6, 0.3]
    voxels = thin(points, SIZE).by_voxel()
    owner = rng.integers(-2, 4, number).astype(np.int32)
    return voxels, owner, owner_table(voxels, owner)


@both
def test_touching_patches_equal_brute_force(call):
    voxels, _, table = scattered()
    starts, voxel, _, _ = sorted_table(table, 0, 4)
    index = np.floor(thin(voxels.points, SIZE).means / SIZE).astype(int)
    pairs = np.empty((20, 3), np.int64)
    num = call(touching_patches, starts, voxel, voxels.adjacent, table[3], table[0], pairs)
    owned = [set(table[0][a:b].tolist()) for a, b in zip(table[3], table[3][1:], strict=False)]
    expected = set()
    for k in range(4):
        for other in set(range(4)) - {k}:
            touching = 0
            for v in voxel[starts[k] : starts[k + 1]]:
                near = np.flatnonzero(np.abs(index - index[v]).max(axis=1) <= 1)
                touching += any(other in owned[n] for n in near)
            expected.add((k, other, touching))
    assert {tuple(row) for row in pairs[:num].tolist()} == expected
    assert call(
        touching_patches, starts, voxel, voxels.adjacent, table[3], table[0], pairs[:2]
    ) == (
        num  # pairs that do not fit are counted
    )


@both
def test_height_fields_equal_least_squares(call):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-1.0, 1.0, (2, 200))
    z = 0.02 * x - 0.01 * y + 1e-3 * (x**2 - x * y) + 1e-3 * rng.standard_normal(200)
    points, weights = np.column_stack([x, y, z]), rng.uniform(0.5, 2.0, 200)
    errors, rows = np.empty(3), np.arange(0, 200, 2)
    given = np.column_stack([points, weights])[rows].T.copy()
    call(height_errors, given, 0, 100, np.array([0.0, 0.0, 1.0]), errors)
    x, y, z, weight = x[rows], y[rows], z[rows], weights[rows] / weights[rows].sum()
    for error, degree in zip(errors, (1, 2, 4), strict=True):
        exponents = [(i - j, j) for i in range(degree + 1) for j in range(i + 1)]
        basis = np.stack([x**a * y**b for a, b in exponents], axis=1)
        root = np.sqrt(weight)
        left = z - basis @ np.linalg.lstsq(basis * root[:, None], z * root, rcond=None)[0]
        assert error == pytest.approx(weight @ left**2, rel=2e-3)  # slopes are below 0.03


@both
@pytest.mark.parametrize('turn_deg', [20.0, 60.0])
def test_turn_of_a_cylinder_is_the_angle_between_its_ends(call, turn_deg):
    angle, along = np.meshgrid(
        np.radians(np.linspace(-0.5, 0.5, 60) * turn_deg), np.linspace(0.0, 1.0, 40)
    )
    points = np.stack([np.sin(angle), along, np.cos(angle)], axis=-1).reshape(-1, 3)
    errors, normal = np.empty(3), np.array([0.0, 0.0, 1.0])
    columns = np.vstack([points.T, np.ones(len(points))])
    turn = call(height_errors, columns, 0, len(points), normal, errors)
    assert math.degrees(turn) == pytest.approx(turn_deg, rel=0.05)
    assert errors[1] < 0.01 * errors[0]
    assert errors[2] < 0.02 * errors[1]
