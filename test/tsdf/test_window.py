# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T15: the moving window of blocks, and the blocks that it evicts."""

import numpy as np

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.sensors import LidarModel
from test.tsdf.scenes import image_of, integrator

SENSOR = LidarModel(rows=8, columns=90, vertical_fov_deg=40.0, max_range_m=3.0)
HALF_DIAGONAL_M = np.sqrt(3.0) / 2.0


def filled(**settings):
    """Return a map of blocks of 1 m along x, changed 10 s apart."""
    blocks = BlockMap(TsdfConfig(voxel_size_m=0.25, voxels_per_side=4, **settings))
    for x in range(-5, 6):
        blocks.touch(blocks.place([[x, 0, 0]]), (x + 5) * 10 * 10**9)
    blocks.clear_updated()
    return blocks


def left(blocks):
    return sorted(blocks.index(blocks.rows())[:, 0])


def test_blocks_leave_whose_centre_is_beyond_the_radius():
    blocks = filled(max_radius_m=2.2)
    removed = blocks.evict([0.5, 0.5, 0.5], 0)
    assert left(blocks) == [-2, -1, 0, 1, 2]
    assert sorted(removed.index[:, 0]) == [-5, -4, -3, 3, 4, 5]
    assert (blocks.find(removed.index) == -1).all()
    assert len(blocks.evict([0.5, 0.5, 0.5], 0)) == 0


def test_blocks_leave_that_have_not_changed_for_long():
    blocks = filled(max_age_s=25.0)
    removed = blocks.evict([0.0, 0.0, 0.0], 100 * 10**9)
    assert left(blocks) == [3, 4, 5]
    assert sorted(removed.stamp_ns // 10**9) == list(range(0, 80, 10))


def test_either_limit_removes_and_none_keeps_all():
    blocks = filled(max_radius_m=3.2, max_age_s=25.0)
    blocks.evict([0.5, 0.5, 0.5], 100 * 10**9)
    assert left(blocks) == [3]
    blocks = filled()
    assert len(blocks.evict([1e6, 0.0, 0.0], 2**62)) == 0


def test_blocks_flagged_updated_stay_until_the_flag_is_cleared():
    blocks = filled(max_radius_m=2.2)
    blocks.touch(blocks.find([[5, 0, 0], [-5, 0, 0]]), 0)
    assert sorted(blocks.index(blocks.updated())[:, 0]) == [-5, 5]
    blocks.evict([0.5, 0.5, 0.5], 0)
    assert left(blocks) == [-5, -2, -1, 0, 1, 2, 5]
    blocks.clear_updated()
    assert len(blocks.updated()) == 0
    assert len(blocks.evict([0.5, 0.5, 0.5], 0)) == 2
    assert left(blocks) == [-2, -1, 0, 1, 2]


def drive(max_radius_m):
    """Return the number of blocks added and removed while the sensor stands still."""
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, max_radius_m=max_radius_m)
    added = removed = 0
    T = np.eye(4)
    T[:3, 3] = [0.31, -0.17, 0.05]
    image = image_of(SENSOR, np.full((8, 90), 2.69))
    for number in range(5):
        result = one.integrate(image, T, number)
        one.blocks.clear_updated()
        gone = one.blocks.evict(T[:3, 3], number)
        if number:
            added, removed = added + result.num_added, removed + len(gone)
    return added, removed


def test_blocks_do_not_come_and_go_where_the_radius_holds_all_that_is_seen(caplog):
    assert drive(3.0 + HALF_DIAGONAL_M * 0.8) == (0, 0)
    assert not caplog.records
    added, removed = drive(2.0)
    assert added == removed > 0
    assert [record.message.split(':')[0] for record in caplog.records] == [
        'layers.tsdf.max_radius_m'
    ]


def test_evicted_blocks_inserted_again_are_unchanged():
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, max_radius_m=1.5, color=True)
    one.integrate(image_of(SENSOR, np.full((8, 90), 2.5)), np.eye(4), 7)
    before = one.blocks.copied(one.blocks.rows())
    one.blocks.clear_updated()
    removed = one.blocks.evict([0.0, 0.0, 0.0], 7)
    assert 0 < len(removed) < len(before)
    one.blocks.insert(removed)
    rows = one.blocks.find(before.index)
    assert np.array_equal(one.blocks.field[rows], before.field)
    assert np.array_equal(one.blocks.head[rows, 2], before.stamp_ns)
