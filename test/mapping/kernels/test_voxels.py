# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels that add moments to a map and subtract them, against dicts of Python integers.

The table has room for some voxels only, so that adding also stops half-way.
"""

import numpy as np
import pytest

from surfel_mapper.kernels import hashing
from surfel_mapper.kernels.layout import EMPTIED, KEY, ROW
from surfel_mapper.mapping.kernels.voxels import (
    add_moments,
    add_sums,
    find_rows,
    remove_moments,
)
from surfel_mapper.mapping.moments import pack_keys, unpack_keys
from test import reference
from test.kernels.modes import both
from test.mapping.kernels.packed_rows import unpacked


def without_sums(moments):
    """Return moments in the types of scans, sums of positions and views zero."""
    key, count, _, product, _ = moments
    zeros = np.zeros((len(key), 3), np.int32), np.zeros((len(key), 3), np.int16)
    return key, count.astype(np.uint32), zeros[0], product, zeros[1]


class Memory:
    """Rows and hash table of a map, of fixed size, and the kernels at work on them."""

    def __init__(self, call, num_rows):
        self.call = call
        self.rows = np.full(
            (num_rows, ROW), 99, np.int64
        )  # the content of unused rows is irrelevant
        self.stamps = np.full(num_rows, 99, np.uint32)
        segments = 4
        self.table = (
            np.zeros(1, np.int32),
            np.zeros(segments * hashing.SEGMENT, np.int64),
            np.zeros(segments, np.int32),
            np.zeros(segments, np.int8),
        )
        self.state = np.zeros(hashing.STATE, np.int64)
        self.state[hashing.FREE_ROW] = -1
        self.state[hashing.NEXT_SEGMENT] = 1

    def add(self, moments, version, start=0):
        """Return the number of rows done, and the changed rows."""
        changed = np.full(len(moments[0]), -1, np.int32)
        done = self.call(
            add_moments,
            *(without_sums(moments), self.rows, self.stamps, self.table, self.state),
            *(2 * version, start, changed),
        )
        added = slice(start, done)
        self.add_sums(changed[added], 1, moments[2][added], moments[4][added])
        return done, changed[start:done].tolist()

    def find(self, keys):
        found = np.full(len(keys), -9, np.int32)
        self.call(find_rows, keys, self.rows, self.table, self.state, found)
        return found

    def remove(self, moments, version, min_points=1, hints=None):
        """Return the first voxel that does not hold its moments, and the fallen voxels."""
        fallen = np.full((len(moments[0]), 3), -1, np.int32)
        rows = self.find(moments[0])
        found = rows.copy() if hints is None else hints
        self.add_sums(rows, -1, moments[2], moments[4])
        missing, num = self.call(
            remove_moments,
            *(without_sums(moments), self.rows, self.stamps, self.table, self.state),
            *(2 * version, found, min_points, fallen),
        )
        if missing >= 0:
            self.add_sums(rows, 1, moments[2], moments[4])
        if missing < 0:
            empty = [unpacked(row)[0] == 0 for row in self.rows[found]]
            np.testing.assert_array_equal(
                self.stamps[found], 2 * version + EMPTIED * np.array(empty)
            )
        return missing, list(map(tuple, fallen[:num].tolist()))

    def add_sums(self, rows, sign, total, view):
        self.call(add_sums, self.rows, rows, sign, total, view)

    def content(self):
        """Return the content of the table as a dict."""
        entries = self.table[1][self.table[1] != 0]
        rows = (entries & 0xFFFFFFFF) - 1
        voxels = map(tuple, unpack_keys(self.rows[rows, KEY]).tolist())
        return dict(zip(voxels, map(unpacked, self.rows[rows]), strict=True))


def arrays_of(twin):
    """Return moments as the kernels take them."""
    rows = np.array(list(twin.values()), np.int64).reshape(-1, 13)
    keys = pack_keys(np.array(list(twin), np.int64).reshape(-1, 3))
    return (
        keys,
        rows[:, 0].copy(),
        rows[:, 1:4].copy(),
        rows[:, 4:10].copy(),
        rows[:, 10:].copy(),
    )


def some_moments(seed, num_points=120, spread_m=1.5):
    rng = np.random.default_rng(seed)
    return reference.scan_moments(
        rng.uniform(-spread_m, spread_m, (num_points, 3)), 0.5, rng.uniform(-9.0, 9.0, 3)
    )


@both
def test_moments_are_added_and_subtracted_as_integers(call):
    memory, expected = Memory(call, 1000), {}
    twins = [some_moments(seed) for seed in range(6)]
    for version, twin in enumerate(twins, 1):
        done, changed = memory.add(arrays_of(twin), version)
        reference.add_moments(expected, twin)
        assert done == len(twin)
        assert sorted(changed) == sorted(memory.find(arrays_of(twin)[0]).tolist())
        assert (memory.stamps[changed] == 2 * version).all()
        assert memory.content() == expected
    assert memory.state[hashing.POINTS] == 6 * 120
    assert memory.state[hashing.VOXELS] == len(expected)

    for version, twin in enumerate(twins[::-1], 7):
        before = set(expected)
        missing, fallen = memory.remove(arrays_of(twin), version)
        assert missing == -1
        reference.add_moments(expected, twin, -1)
        assert sorted(fallen) == sorted(before - set(expected))
        assert memory.content() == expected
        assert memory.state[hashing.VOXELS] == len(expected)
    assert memory.state[hashing.POINTS] == 0


@both
@pytest.mark.parametrize('column', range(13))
def test_a_failed_removal_names_the_voxel_and_changes_nothing(call, column):
    memory = Memory(call, 200)
    twin, other = some_moments(4), some_moments(5)
    memory.add(arrays_of(twin), 1)
    memory.add(arrays_of({v: other[v] for v in list(other)[::2] if v not in twin}), 2)
    voxel = list(twin)[7]
    one_off = {v: list(row) for v, row in twin.items()}
    one_off[voxel][column] += 1
    absent = {(50, 50, 50): [1] * 13}
    rows, stamps, state = memory.rows.copy(), memory.stamps.copy(), memory.state.copy()
    assert memory.remove(arrays_of(one_off), 3) == (7, [])
    assert memory.remove(arrays_of({**dict(list(twin.items())[:4]), **absent}), 3) == (4, [])
    np.testing.assert_array_equal(memory.rows, rows)
    np.testing.assert_array_equal(memory.stamps, stamps)
    np.testing.assert_array_equal(memory.state, state)


@both
def test_wrong_hints_of_rows_are_replaced_by_a_look_up(call):
    memory, twin, gone = Memory(call, 400), some_moments(6), some_moments(7)
    memory.add(arrays_of(gone), 1)
    memory.add(arrays_of(twin), 2)
    memory.remove(arrays_of({v: row for v, row in gone.items() if v not in twin}), 3)
    expected = {v: list(row) for v, row in memory.content().items()}
    hints = memory.find(arrays_of(twin)[0])
    hints[::4] = -1
    hints[1::4] = 399  # never used
    hints[2::4] = memory.state[hashing.FREE_ROW]  # emptied
    hints[3::8] = hints[7]  # another voxel's
    memory.stamps = np.concatenate([memory.stamps, memory.stamps])  # as if rows could not grow
    hints[5::9] = len(memory.rows) + 50
    assert memory.remove(arrays_of(twin), 4, hints=hints)[0] == -1
    reference.add_moments(expected, twin, -1)
    assert memory.content() == expected
