# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Hashed blocks are found after any growth, zero when reused, and not found when removed.

T15: the moving window of blocks, and the blocks that it evicts.
"""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import MapLimitError
from surfel_mapper.layers.distance_field import DistanceField
from surfel_mapper.memory import machine_bytes
from surfel_mapper.tsdf.blocks import BlockMap


def every_channel(**settings):
    channels = dict(color=True, semantics='single')
    return BlockMap(TsdfConfig(voxels_per_side=2, **channels, **settings))


def indices(count, seed=1, size=40):
    """Return ``count`` different block indices in random order."""
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(size**3)[:count]
    return np.stack(np.unravel_index(numbers, (size, size, size)), axis=1) - size // 2


def test_blocks_are_found_after_any_growth_and_removal():
    blocks, index = every_channel(), indices(20_000)
    expected = dict(zip(map(tuple, index), blocks.place(index), strict=True))
    assert len(set(expected.values())) == len(index) == blocks.num_blocks

    blocks.remove(blocks.find(index[::3]))
    again = indices(5000, seed=2)
    blocks.place(again)

    for part in index[::3]:
        expected.pop(tuple(part))
    survivors = np.array(list(expected))
    assert np.array_equal(blocks.find(survivors), list(expected.values()))
    assert (blocks.find(again) >= 0).all()
    union = {*expected, *map(tuple, again)}
    assert blocks.num_blocks == len(union) == len(blocks.rows())
    assert {*map(tuple, blocks.index(blocks.rows()))} == union
    assert blocks.find([[100, 0, 0], [1 << 30, 0, 0]]).tolist() == [-1, -1]


def test_reused_row_is_zero():
    blocks = every_channel()
    rows = blocks.place(indices(300))
    for array in (blocks.field, blocks.color, blocks.votes):
        array[rows] = 7
    blocks.remove(rows[:200])
    fresh = blocks.place(indices(200, seed=3) + 1000)
    assert {*fresh} == {*rows[:200]}
    for array in (blocks.field, blocks.color, blocks.votes):
        assert not array[fresh].any()
        assert (array[rows[200:]] == 7).all()


def test_removed_blocks_can_be_inserted_again():
    blocks, rng = every_channel(), np.random.default_rng(4)
    index = indices(50)
    rows = blocks.place(index)
    blocks.touch(rows, 123)
    blocks.field[rows] = rng.random((50, 2, 8))
    blocks.color[rows] = rng.random((50, 4, 8))
    blocks.votes[rows] = rng.random((50, 2, 8))
    before = blocks.copied(rows)
    blocks.remove(rows)
    assert blocks.num_blocks == 0

    other = every_channel()
    other.insert(before)
    after = other.copied(other.find(index))
    for name in ('index', 'stamp_ns', 'field', 'color', 'votes'):
        assert np.array_equal(getattr(after, name), getattr(before, name)), name
    assert len(other.changed_since(0)) == 50


def test_changed_since_lists_changes_after_any_version():
    blocks = every_channel()
    rows = blocks.place(indices(10))
    assert len(blocks.changed_since(0)) == 0  # placed, not changed
    blocks.touch(rows[:6], 1)
    seen = blocks.version
    blocks.touch(rows[4:8], 2)
    assert np.array_equal(blocks.changed_since(0), np.sort(rows[:8]))
    assert np.array_equal(blocks.changed_since(seen), np.sort(rows[4:8]))
    assert blocks.drop_new(rows) == 2
    assert np.array_equal(blocks.rows(), np.sort(rows[:8]))


def test_index_beyond_20_bits_is_refused():
    blocks = every_channel()
    with pytest.raises(MapLimitError, match='local frame'):
        blocks.place([[0, 0, 0], [0, 1 << 20, 0]])
    assert blocks.num_blocks == 0


def filled_along_x(**settings):
    """Return a map of blocks of 1 m along x, changed 10 s apart."""
    blocks = BlockMap(TsdfConfig(voxel_size_m=0.25, voxels_per_side=4, **settings))
    for x in range(-5, 6):
        blocks.touch(blocks.place([[x, 0, 0]]), (x + 5) * 10 * 10**9)
    return blocks


def left_along_x(blocks):
    return sorted(blocks.index(blocks.rows())[:, 0])


def test_blocks_leave_whose_centre_is_beyond_the_radius():
    blocks = filled_along_x(max_radius_m=2.2)
    blocks.evict([0.5, 0.5, 0.5])
    assert left_along_x(blocks) == [-2, -1, 0, 1, 2]
    assert (blocks.find([[-3, 0, 0], [3, 0, 0]]) == -1).all()


def test_beyond_the_limit_the_farthest_blocks_leave(caplog):
    blocks = filled_along_x()  # -5 to 5
    blocks.max_bytes = 10 * blocks.block_bytes
    scan = np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 20, 0]])
    fit = blocks.admit(scan, [0.5, 0.5, 0.5])
    assert fit.tolist() == [True, True, True, False]
    blocks.place(scan[fit])
    assert left_along_x(blocks) == sorted([*range(-3, 4), 0, 0])
    assert blocks.num_evicted == 5  # and one of the scan was not added
    assert [record.message.split(':')[0] for record in caplog.records] == ['layers.tsdf']
    assert blocks.num_blocks * blocks.block_bytes <= blocks.max_bytes


def test_within_the_limit_all_blocks_stay():
    blocks = filled_along_x()
    for max_bytes in (0, 12 * blocks.block_bytes):
        blocks.max_bytes = max_bytes
        assert blocks.admit(np.array([[0, 9, 0]]), np.zeros(3)).all()
        assert len(blocks.rows()) == 11
    assert blocks.num_evicted == 0


def test_a_map_is_limited_to_half_of_the_memory_of_the_machine():
    assert filled_along_x().max_bytes == machine_bytes() // 2
    assert DistanceField().blocks.max_bytes == machine_bytes() // 2
