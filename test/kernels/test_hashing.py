# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The hash table of a map compared with a dict, and its invariants after every change.

A small owner of the table stands in for VoxelTable: it makes room by the plainest means. Its
keys are chosen to collide as well: many of one segment, many of one bucket.
"""

import numpy as np
import pytest

from surfel_mapper.kernels.hashing import (
    BUCKET,
    DEPTH,
    find_row,
    FULLEST,
    hash_key,
    insert_entry,
    is_full,
    NEXT_SEGMENT,
    remove_entry,
    SEGMENT,
    split_segment,
    STATE,
)
from surfel_mapper.kernels.layout import KEY, ROW
from test.kernels.modes import both, compiled


class Owner:
    """A table with a fixed number of segments, whose directory doubles on request."""

    def __init__(self, call, num_rows, num_segments):
        self.call = call
        self.rows = np.zeros((num_rows, ROW), np.int64)
        self.directory = np.zeros(1, np.int32)
        self.buckets = np.zeros(num_segments * SEGMENT, np.int64)
        self.held = np.zeros(num_segments, np.int32)
        self.local_depth = np.zeros(num_segments, np.int8)
        self.state = np.zeros(STATE, np.int64)
        self.state[NEXT_SEGMENT] = 1
        self.entries = np.empty(SEGMENT, np.int64)
        self.expected = {}

    @property
    def table(self):
        return self.directory, self.buckets, self.held, self.local_depth

    def find(self, key):
        return self.call(find_row, np.int64(key), self.rows, self.table, self.state[DEPTH])

    def insert(self, key, row):
        hashed = self.call(hash_key, np.int64(key))
        while self.call(is_full, hashed, self.directory, self.held, self.state[DEPTH]):
            if not self.call(split_segment, hashed, self.table, self.state, self.entries):
                assert self.state[NEXT_SEGMENT] < len(self.held), 'the test has too few segments'
                self.directory = np.repeat(self.directory, 2)
                self.state[DEPTH] += 1
        self.rows[row, KEY] = key
        self.call(insert_entry, hashed, row, *self.table[:3], self.state[DEPTH])
        self.expected[key] = row

    def remove(self, key):
        row = self.expected.pop(key)
        hashed = self.call(hash_key, np.int64(key))
        self.call(remove_entry, hashed, row, *self.table[:3], self.state[DEPTH])
        return row

    def check(self):
        """Check the invariants of the table: a search reaches every entry."""
        depth, num_segments = int(self.state[DEPTH]), int(self.state[NEXT_SEGMENT])
        assert len(self.directory) == 2**depth
        buckets = self.buckets.reshape(-1, SEGMENT)
        assert not buckets[num_segments:].any()
        seen = {}
        for segment in range(num_segments):
            (prefixes,) = np.nonzero(self.directory == segment)
            bits = int(self.local_depth[segment])
            assert len(prefixes) == 2 ** (depth - bits)  # and they are neighbours:
            assert len(set((prefixes >> (depth - bits)).tolist())) == 1
            full = buckets[segment] != 0
            assert full.sum() == self.held[segment] <= FULLEST
            for place in np.flatnonzero(full).tolist():
                entry = int(buckets[segment][place]) & (2**64 - 1)
                hashed, row = entry >> 32, (entry & 0xFFFFFFFF) - 1
                key = int(self.rows[row, KEY])
                assert hashed == compiled(hash_key, np.int64(key))
                assert self.directory[hashed >> (32 - depth)] == segment
                home = hashed % SEGMENT // BUCKET * BUCKET
                way = np.arange(home, home + (place - home) % SEGMENT) % SEGMENT
                assert full[way].all()  # no gap between home and place
                seen[key] = row
        assert seen == self.expected


def colliding_keys(num, rng):
    """Return distinct keys, a third of them with the same lowest bits of the hash."""
    keys = rng.integers(0, 2**63 - 1, 60 * num)
    with np.errstate(over='ignore'):
        mixed = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(32)
        mixed *= np.uint64(0xD6E8FEB86659FD93)
    low = (mixed >> np.uint64(32)) % np.uint64(SEGMENT)
    crowded = keys[(low >= 505) | (low < 3)][: num // 3]  # across the end of a segment
    return rng.permutation(np.unique(np.concatenate([crowded, keys[: num - len(crowded)]])))


@both
def test_rows_are_inserted_and_removed_as_in_a_dict(call):
    rng = np.random.default_rng(1)
    many = call is compiled
    owner = Owner(call, 9_000 if many else 900, 64 if many else 8)
    keys = colliding_keys(len(owner.rows), rng).tolist()
    free = list(range(len(owner.rows)))
    for step in range(3):
        absent = [key for key in keys if key not in owner.expected]
        for key in absent:
            assert owner.find(key) == -1
            owner.insert(key, free.pop())
        owner.check()
        held = list(owner.expected)
        for key in rng.permutation(held)[: len(held) * (step + 1) // 3].tolist():
            assert owner.find(key) == owner.expected[key]
            free.append(owner.remove(key))
            assert owner.find(key) == -1
        owner.check()
        for key in keys:
            assert owner.find(key) == owner.expected.get(key, -1)
    assert owner.expected == {}
    assert not owner.held.any()


@both
@pytest.mark.parametrize('key', [0, 1, 2**63 - 1, 2**42, (2**20 << 42) + (2**20 << 21) + 2**20])
def test_hashes_are_the_same_compiled_and_interpreted_and_have_32_bits(call, key):
    hashed = int(call(hash_key, np.int64(key)))
    mixed = key * 0x9E3779B97F4A7C15 % 2**64
    mixed = (mixed ^ (mixed >> 32)) * 0xD6E8FEB86659FD93 % 2**64
    assert hashed == mixed >> 32
