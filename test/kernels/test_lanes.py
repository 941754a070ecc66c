# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Sums in lanes against Python integers."""

from numba import njit
import numpy as np
import pytest

from surfel_mapper.kernels.lanes import (
    FULL,
    load_sums,
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
