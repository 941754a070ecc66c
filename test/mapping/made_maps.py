# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans, maps and moments for the tests of SurfelMap."""

import numpy as np
import pytest

from surfel_mapper.mapping.moments import pack_keys, ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap


def scans_at(offset_m, num=6, num_points=400, seed=1):
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(scale=2.0, size=(num_points, 3)) + offset_m, rng.normal(size=3) + offset_m)
        for _ in range(num)
    ]


def map_of(scans, voxel_size_m=0.5):
    surfel_map = SurfelMap(voxel_size_m)
    for points, origin in scans:
        surfel_map.add(points, origin)
    return surfel_map


def made_up(voxels, counts, places=((0, 0, 0),), voxel_size_m=0.5):
    """Return moments of count points in each voxel, spread evenly over some places in it."""
    q = np.array(places, np.int64)
    share = np.array(counts, np.int64) // len(q)
    i, j = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
    return ScanMoments(
        voxel_size_m=voxel_size_m,
        key=pack_keys(np.array(voxels)),
        count=share * len(q),
        total=share[:, None] * q.sum(axis=0),
        product=share[:, None] * (q[:, i] * q[:, j]).sum(axis=0),
        view=np.zeros((len(voxels), 3), np.int64),
    )


def assert_unchanged_by(surfel_map, error, match, operation, *arguments):
    before, size, version = surfel_map.digest(), surfel_map.nbytes, surfel_map.version
    with pytest.raises(error, match=match):
        operation(*arguments)
    assert surfel_map.digest() == before
    assert surfel_map.nbytes == size
    assert len(surfel_map.surfels_changed(since=version)) == 0
