# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The hash table that groups points by voxel, against a dict."""

import itertools

import numpy as np
import pytest

from surfel_mapper.kernels.grouping import (
    AHEAD,
    build_table,
    CHUNK,
    enlarged_table,
    find_key,
    find_runs,
    hash_shift,
    number_runs,
)
from test.kernels.modes import both


def keys_in_runs(num, num_voxels, seed=0):
    """Return voxel keys (num,) in runs; some are -1, that of points left out."""
    rng = np.random.default_rng(seed)
    voxels = rng.integers(0, 2**62, num_voxels)
    voxels[0] = -1
    return np.repeat(rng.choice(voxels, num), rng.integers(1, 4, num))[:num]


@both
@pytest.mark.parametrize('num_voxels', [1, 2, 40, 400])
def test_runs_get_the_row_of_their_voxel_in_the_order_of_first_use(call, num_voxels):
    keys, table = np.full(901, -7, np.int64), np.full(2048, -1, np.int32)
    starts, run_rows = np.zeros(CHUNK + AHEAD, np.int32), np.empty(CHUNK, np.int32)
    expected: dict[int, int] = {}
    num_rows = 0
    for seed in range(2):  # the second chunk meets voxels of the first
        chunk = keys_in_runs(300, num_voxels, seed=1)[seed:]
        num_runs = find_runs(chunk, len(chunk), starts)
        chunk = np.append(chunk, np.zeros(CHUNK + 1 - len(chunk), np.int64))
        num_rows = call(number_runs, chunk, starts, num_runs, table, keys, num_rows, run_rows)
        groups = [key for key, _ in itertools.groupby(chunk[: 300 - seed].tolist())]
        rows = [expected.setdefault(key, len(expected)) for key in groups]
        np.testing.assert_array_equal(run_rows[:num_runs], rows)
    assert num_rows == len(expected)
    assert keys[1 : num_rows + 1].tolist() == list(expected)


@both
def test_an_enlarged_table_finds_the_same_rows(call):
    keys = np.unique(np.random.default_rng(2).integers(0, 2**62, 500))
    table = np.empty(1024, np.int32)
    call(build_table, keys, table)
    larger = call(enlarged_table, table, keys, len(keys))
    assert len(larger) == 4 * len(table)
    for row, key in enumerate(keys):
        assert call(find_key, key, keys, table, hash_shift(len(table))) == row
        assert call(find_key, key, keys, larger, hash_shift(len(larger))) == row
    for key in keys + 1:
        if key not in keys:
            assert call(find_key, key, keys, larger, hash_shift(len(larger))) == -1
