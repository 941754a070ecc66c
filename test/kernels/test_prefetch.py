# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Prefetching changes no value, compiled and interpreted, and compiled emits its instruction."""

import re

from numba import njit
import numpy as np
import pytest

from surfel_mapper.kernels.prefetch import prefetch, prefetch_early, prefetch_to_write


def total_of(values, ahead):
    total = values[0] * 0
    for row in range(len(values)):
        prefetch(values, row + ahead)
        prefetch_early(values, row + ahead)
        prefetch_to_write(values, row + ahead)
        total += values[row]
    return total


@pytest.mark.parametrize('dtype', [np.int64, np.float32])
def test_sums_with_prefetching_are_those_of_numpy(dtype):
    values = np.arange(1000).astype(dtype)
    before = values.copy()
    summed = njit(total_of)
    for ahead in (0, 16, 10**6):  # the last is far beyond the end: a hint, not an access
        assert summed(values, ahead) == total_of(values, ahead) == values.sum()
    assert np.array_equal(values, before)
    (code,) = summed.inspect_llvm().values()
    calls = re.findall(r'call void @.*llvm.prefetch.*, i32 (\d), i32 (\d), i32 (\d)\)', code)
    kinds = {tuple(map(int, each)) for each in calls}  # written or read, level of the cache, data
    assert kinds == {(0, 3, 1), (0, 2, 1), (1, 3, 1)}
