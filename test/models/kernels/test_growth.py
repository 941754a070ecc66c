# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Voxel neighbours against brute force."""

from __future__ import annotations

import numpy as np
import pytest

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
