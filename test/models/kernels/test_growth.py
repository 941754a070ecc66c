# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Voxel neighbours, noise and region growing against brute force and known scenes."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.cloud_noise import (
    estimate_noise,
)
from surfel_mapper.models.thinning import thin

SIZE = 0.1


def by_voxel(points, size=SIZE):
    thinned = thin(points, size)
    return thinned, thinned.by_voxel()


@pytest.mark.parametrize(
    'extent',
    [
        (1.0, 0.3, 0.6),
        (1.0, 0.1, 1.0),
        (0.1, 1.0, 1.0),
        (1.0, 0.2, 1.0),
        (0.2, 1.0, 1.0),
        (0.1, 0.1, 9.0),
        (0.2, 0.1, 5.0),
    ],
)  # walls and poles one or two voxels thick
def test_neighbours_equal_brute_force(extent):
    points = np.random.default_rng(2).uniform(0.0, 1.0, (150, 3)) * extent
    thinned, voxels = by_voxel(points)
    index = np.floor(thinned.means / SIZE).astype(int)
    first, rows = voxels.adjacent
    for i in range(len(index)):
        near = np.abs(index - index[i]).max(axis=1) == 1
        assert sorted(rows[first[i] : first[i + 1]].tolist()) == np.flatnonzero(near).tolist()


def test_noise_grows_with_the_square_of_the_range():
    rng, parts = np.random.default_rng(7), []
    for far in (1.0, 2.0, 3.0, 4.0):
        xy = rng.uniform(-0.6, 0.6, (40_000, 2))
        z = far + 1.5e-3 * far**2 * rng.standard_normal(len(xy))
        parts.append(np.column_stack([xy, z]))
    points = np.concatenate(parts)
    thinned, voxels = by_voxel(points, 0.06)
    core = np.ones(len(thinned.means), bool)
    n0, n2 = estimate_noise(voxels, thinned.means, core, 0.06, np.zeros(3))
    for far in (2.0, 3.0, 4.0):
        assert n0 + n2 * far**2 == pytest.approx(1.5e-3 * far**2, rel=0.4)
