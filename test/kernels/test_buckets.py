# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The search of a bucket against Python integers, compiled and interpreted."""

from numba import njit
import numpy as np
import pytest

from surfel_mapper.kernels.buckets import BUCKET, highest_match
from test.kernels.modes import both

HIGHEST = 2**32 - 1


@njit
def search(entries, first, upper):
    return highest_match(entries, first, upper)


def expected(entries, first, upper):
    """Return the highest lower half with an upper half, by Python's integers."""
    halves = [divmod(entry % 2**64, 2**32) for entry in entries[first : first + BUCKET].tolist()]
    return max([low for high, low in halves if high == upper], default=0)


@both
@pytest.mark.parametrize('first', [0, 8, 24])
@pytest.mark.parametrize('upper', [0, 1, 7, 2**31 - 1, 2**31, HIGHEST])
def test_the_highest_match_is_that_of_python(call, first, upper):
    rng = np.random.default_rng(first + upper)
    found = set()
    for _ in range(200):
        highs = rng.choice([0, 1, 7, 2**31 - 1, 2**31, HIGHEST], 4 * BUCKET).astype(np.uint64)
        lows = rng.integers(0, 2**31, 4 * BUCKET).astype(np.uint64)
        entries = (highs << np.uint64(32) | lows).view(np.int64)
        assert call(search, entries, first, upper) == expected(entries, first, upper)
        found.add(expected(entries, first, upper) > 0)
    assert found == {True, False}


@both
@pytest.mark.parametrize('place', range(BUCKET))
def test_every_place_of_the_bucket_is_looked_at_and_no_other(call, place):
    entries = np.zeros(3 * BUCKET, np.int64)
    entries[BUCKET + place] = 5 << 32 | 9
    assert [call(search, entries, first, 5) for first in (0, 8, 16)] == [0, 9, 0]
    assert call(search, entries, BUCKET, 9) == 0


@both
def test_empty_entries_match_a_hash_of_zero_without_a_row(call):
    assert call(search, np.zeros(BUCKET, np.int64), 0, 0) == 0
