# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Sums in lanes and the search of eight words against Python integers."""

from numba import njit
import numpy as np
import pytest

from surfel_mapper.kernels.lanes import (
    FULL,
    highest_match,
    load_sums,
    place_of_half,
    plus_place,
    store_sums,
    sum_unless,
    WIDEST,
    WORDS,
)
from surfel_mapper.kernels.layout import COUNT_BITS, HIGH_BITS
from test.kernels.modes import both

HIGHEST = 65535
"""The highest place."""


@njit
def add_at(words, at, places, only_the_last):
    sums = load_sums(words, at)
    for i in range(len(places)):
        place = (1 << 48) | (places[i, 2] << 32) | (places[i, 1] << 16) | places[i, 0]
        others = plus_place(load_sums(words, np.uint64(0)), place)
        sums = sum_unless(only_the_last, sums, others)
    store_sums(words, at, sums)


def expected(places):
    """Return the eight words of places, by Python's integers."""
    x, y, z = (list(map(int, column)) for column in places.T)
    pairs = (x, x), (x, y), (x, z), (y, y), (y, z), (z, z)
    products = [sum(a * b for a, b in zip(*pair, strict=True)) for pair in pairs]
    first, second = (len(x) << COUNT_BITS) + sum(x), (sum(z) << HIGH_BITS) + sum(y)
    # as the bits of signed words
    return [(word + 2**63) % 2**64 - 2**63 for word in (first, second, *products)]


@both
@pytest.mark.parametrize('at', [8, 13, 24])
def test_places_are_added_to_the_words_from_an_index_on(call, at):
    places = np.random.default_rng(3).integers(0, 1 + HIGHEST, (40, 3))
    words = np.arange(40) ** 3
    words[:WORDS] = 0
    before = words.copy()
    call(add_at, words, np.uint64(at), places, False)
    after = before.copy()
    after[at : at + WORDS] += expected(places)
    assert words.tolist() == after.tolist()


@pytest.mark.parametrize('corner', [(0, 0, 0), (HIGHEST, 0, HIGHEST), (HIGHEST,) * 3])
def test_words_hold_the_sums_of_a_full_voxel_and_the_count_of_the_widest(corner):
    words = np.zeros(2 * WORDS, np.int64)
    places = np.array([corner] * FULL)
    add_at(words, np.uint64(WORDS), places, False)
    assert words[WORDS:].tolist() == expected(places)
    x, _, z = corner
    assert words[WORDS] & ((1 << COUNT_BITS) - 1) == FULL * x
    assert words[WORDS + 1] >> HIGH_BITS & ((1 << HIGH_BITS) - 1) == FULL * z
    for _ in range((WIDEST - FULL) // FULL):
        add_at(words, np.uint64(WORDS), places, False)
    add_at(words, np.uint64(WORDS), places[: (WIDEST - FULL) % FULL], False)
    assert words[WORDS] >> COUNT_BITS == WIDEST


@njit
def search(entries, first, upper):
    return highest_match(entries, first, upper)


def highest_lower_half(entries, first, upper):
    """Return the highest lower half with an upper half, by Python's integers."""
    halves = [divmod(entry % 2**64, 2**32) for entry in entries[first : first + WORDS].tolist()]
    return max([low for high, low in halves if high == upper], default=0)


@both
@pytest.mark.parametrize('first', [0, 8, 24])
@pytest.mark.parametrize('upper', [0, 1, 7, 2**31 - 1, 2**31, 2**32 - 1])
def test_the_highest_match_is_that_of_python(call, first, upper):
    rng = np.random.default_rng(first + upper)
    found = set()
    for _ in range(200):
        highs = rng.choice([0, 1, 7, 2**31 - 1, 2**31, 2**32 - 1], 4 * WORDS).astype(np.uint64)
        lows = rng.integers(0, 2**31, 4 * WORDS).astype(np.uint64)
        entries = (highs << np.uint64(32) | lows).view(np.int64)
        assert call(search, entries, first, upper) == highest_lower_half(entries, first, upper)
        found.add(highest_lower_half(entries, first, upper) > 0)
    assert found == {True, False}


@njit
def locate(entries, first, lower):
    return place_of_half(entries, first, lower)


@both
@pytest.mark.parametrize('lower', [0, 1, 2**31, 2**32 - 1])
def test_the_first_word_with_a_lower_half_is_found(call, lower):
    rng = np.random.default_rng(lower)
    found = set()
    for _ in range(200):
        lows = rng.choice([0, 1, 5, 9, 2**31, 2**32 - 1], 3 * WORDS).astype(np.uint64)
        highs = rng.integers(0, 2**32, 3 * WORDS).astype(np.uint64)
        entries = (highs << np.uint64(32) | lows).view(np.int64)
        place = call(locate, entries, WORDS, lower)
        assert place == [*lows[WORDS : 2 * WORDS].tolist(), lower].index(lower)
        found.add(int(place))
    assert found > {0, WORDS}
