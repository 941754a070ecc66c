# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps at which voxels were last seen, while scans enter and leave the window."""

import numpy as np
import pytest

from surfel_mapper.mapping.ages import Ages
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
def test_the_newest_scan_of_each_voxel_is_found_while_the_window_slides(num_drawn):
    made, surfel_map = scans(num=12, num_points=400, seed=1)
    ages = Ages()
    for first in range(0, 8, 2):
        held = made[first : first + 5]
        drawn = surfel_map.surfels(1, num_drawn + first).voxel_index  # the budget moves too
        found = ages.last_seen_ns(drawn, held)
        assert found.tolist() == slow_last_seen_ns(drawn, held)
    assert num_drawn == 0 or (found == -1).any()  # voxels of evicted scans


def test_a_scan_that_loses_voxels_has_not_seen_them():
    made, surfel_map = scans(num=2, num_points=500, seed=2)
    drawn, ages = surfel_map.surfels(1, 200).voxel_index, Ages()
    ages.last_seen_ns(drawn, made)

    half = made[0].moments.select(np.arange(len(made[0].moments)) % 2 == 0)
    made[0] = WindowedScan(moments=half, stamp_ns=made[0].stamp_ns, T_map_sensor=np.eye(4))

    assert ages.last_seen_ns(drawn, made).tolist() == slow_last_seen_ns(drawn, made)


def test_scans_may_come_and_leave_in_any_order():
    made, surfel_map = scans(num=10, num_points=400, seed=3)
    rng, ages = np.random.default_rng(4), Ages()
    for _ in range(30):
        held = [made[k] for k in np.flatnonzero(rng.uniform(size=len(made)) < 0.7)]
        drawn = surfel_map.surfels(1, int(rng.integers(100, 400))).voxel_index
        assert ages.last_seen_ns(drawn, held).tolist() == slow_last_seen_ns(drawn, held)
