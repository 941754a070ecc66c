# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Packing of the moments of a voxel into a row, against Python's integers."""

import numpy as np
import pytest

from surfel_mapper.kernels.layout import HALF, MAX_MAP_COUNT, ROW, VIEW_SCALE
from surfel_mapper.mapping.kernels.rows import (
    read_counts,
    read_rows,
    write_rows,
)
from test.kernels.modes import both
from test.mapping.kernels.packed_rows import slab_of

LARGEST = MAX_MAP_COUNT * HALF
SEEN = MAX_MAP_COUNT * VIEW_SCALE
EXTREMES = [
    [MAX_MAP_COUNT, *[-LARGEST] * 3, *[LARGEST * HALF] * 6, SEEN, SEEN, SEEN],
    [MAX_MAP_COUNT, *[LARGEST - MAX_MAP_COUNT] * 3, *[-LARGEST * (HALF - 1)] * 6, *[-SEEN] * 3],
    [2**16 - 1, -1, 0, 1, *range(6), -1, -1, -1],
    [2**16, 2**40, -(2**40), -1, *range(6), 2**16, -(2**16), 2**32],
    [1, *range(3), *range(6), 0, 0, -(2**32)],
]
"""Moments: the sums of most points at a corner of the voxel, and pieces of all ones or zeros."""


def random_moments(num):
    rng = np.random.default_rng(1)
    scale = 2.0 ** rng.uniform(0, 44, (num, 12))
    sums = (rng.uniform(-1.0, 1.0, (num, 12)) * scale).astype(np.int64)
    return np.column_stack([rng.integers(1, MAX_MAP_COUNT, num), sums])


def arrays_of(keys, moments):
    parts = np.split(np.array(moments, np.int64), [1, 4, 10], axis=1)
    return np.array(keys, np.int64), parts[0].ravel(), *parts[1:]


@both
@pytest.mark.parametrize('moments', [EXTREMES, random_moments(50)])
def test_moments_written_to_rows_are_read_again(call, moments):
    keys = np.random.default_rng(2).integers(0, 2**63 - 1, len(moments))
    expected = arrays_of(keys, moments)
    rows = np.full((len(moments), ROW), 77, np.int64)
    call(write_rows, expected, rows)
    np.testing.assert_array_equal(rows, slab_of(keys, moments))

    order = np.arange(len(moments))[::-1].astype(np.int32)
    found = tuple(np.empty_like(values) for values in expected)
    call(read_rows, rows, order, found)
    for values, wanted in zip(found, expected, strict=True):
        np.testing.assert_array_equal(values, wanted[::-1])

    counts = np.full(len(moments) + 1, -9)
    call(read_counts, rows, np.append(order, np.int32(-1)), counts)
    assert counts.tolist() == [*expected[1][::-1].tolist(), 0]
