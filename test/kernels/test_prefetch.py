# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Prefetching changes no value, compiled and interpreted, and compiled emits its instruction."""

from numba import njit
import numpy as np
import pytest

from surfel_mapper.kernels.prefetch import prefetch


def total_of(values, ahead):
    total = values[0] * 0
    for row in range(len(values)):
        prefetch(values, row + ahead)
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
    assert 'llvm.prefetch' in code
