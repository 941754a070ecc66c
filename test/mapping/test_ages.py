# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps at which the scans of a window last observed voxels."""

import math

import numpy as np
import pytest

from surfel_mapper.mapping.ages import ages_s, last_seen_ns
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan


def scans(num, num_points, seed):
    """Return scans of random points, not in the order of their stamps, and the map of all."""
    rng = np.random.default_rng(seed)
    surfel_map, made = SurfelMap(voxel_size_m=0.5), []
    for stamp_ns in rng.permutation(num).tolist():
        moments = surfel_map.add(rng.uniform(-4.0, 4.0, (num_points, 3)))
        made.append(WindowedScan(moments=moments, stamp_ns=stamp_ns, T_map_sensor=np.eye(4)))
    return made, surfel_map


def slow_last_seen_ns(voxel_index, held):
    """Return the twin: look every voxel up in every scan."""
    seen = [(scan.stamp_ns, {*map(tuple, scan.moments.voxel_index.tolist())}) for scan in held]
    return [
        max((stamp_ns for stamp_ns, voxels in seen if tuple(index) in voxels), default=-1)
        for index in voxel_index.tolist()
    ]


@pytest.mark.parametrize('num_drawn', [0, 1, 300, 10_000])
def test_the_newest_scan_of_each_voxel_decides_in_any_order(num_drawn):
    made, surfel_map = scans(num=12, num_points=400, seed=1)
    drawn = surfel_map.surfels(1, num_drawn).voxel_index
    for window in (made, made[4:9], []):
        seen_ns = last_seen_ns(drawn, window)
        assert seen_ns.tolist() == slow_last_seen_ns(drawn, window)
    assert (ages_s(seen_ns, 1).tolist(), seen_ns.tolist()) == (
        pytest.approx([math.nan] * len(drawn), nan_ok=True),
        [-1] * len(drawn),
    )
