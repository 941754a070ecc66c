# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Touching patches and height fields against brute force, numpy and analytic surfaces."""

from __future__ import annotations

import numpy as np

from surfel_mapper.models.growth import owner_table, sorted_table
from surfel_mapper.models.kernels.joining import (
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
