# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Selection of surfels and rows, against linear searches in Python."""

import numpy as np
import pytest

from surfel_mapper.kernels.grouping import build_table
from surfel_mapper.kernels.layout import BITS, KEY
from surfel_mapper.mapping.kernels.queries import (
    best_around,
    keys_in_box,
    keys_within,
    mark_seen,
    mix_keys,
    rows_at,
    rows_changed_after,
    rows_changed_at,
    rows_held,
)
from surfel_mapper.mapping.moments import pack_keys, unpack_keys
from test.kernels.modes import both
from test.mapping.kernels.packed_rows import slab_of

GOLDEN, WORD = 0x9E3779B97F4A7C15, 2**64


def table_of(keys):
    table = np.empty(1 << max(2 * len(keys) - 1, 1).bit_length(), np.int32)
    build_table(keys, table)
    return table


def mixed_of(key):
    """Return the mixed key, in Python's integers."""
    mixed = key * GOLDEN % WORD
    mixed ^= mixed >> 29
    mixed = mixed * GOLDEN % WORD
    mixed ^= mixed >> 29
    return mixed * GOLDEN % WORD


@pytest.fixture(scope='module')
def surfels():
    """Return keys (K,), positions (K, 3) and planarity (K,), some nan, of voxels of 1 m."""
    rng = np.random.default_rng(1)
    index = np.unique(rng.integers(-4, 4, (150, 3)), axis=0)
    planarity = rng.uniform(0.0, 1.0, len(index)).round(1)  # ties
    planarity[::9] = np.nan
    return pack_keys(index), index + rng.uniform(0.0, 1.0, index.shape), planarity


def slab(num=200):
    """Return rows of which some are empty, their counts, versions and stamps."""
    rng = np.random.default_rng(2)
    keys = pack_keys(rng.permutation(np.stack([np.arange(num) - 90] * 3, axis=1)))
    count, version = rng.integers(0, 5, num), rng.integers(1, 6, num)
    stamps = (2 * version + (count == 0)).astype(np.uint32)
    return slab_of(keys, [[n, *range(12)] for n in count]), count, version, stamps


@both
def test_points_find_the_row_of_their_voxel(call, surfels):
    keys, positions, _ = surfels
    points = np.concatenate([positions, [[np.nan, 0, 0], [1e9, 0, 0], [0, -np.inf, 0]]])
    points = np.concatenate([points, np.floor(positions), np.floor(positions) - 1e-9])
    rows = np.empty(len(points), np.int64)
    call(rows_at, points, float(1 << BITS), BITS, keys, table_of(keys), rows)
    row_of = {tuple(v): k for k, v in enumerate(unpack_keys(keys).tolist())}
    with np.errstate(invalid='ignore'):
        lattice = np.floor(points * 2.0**BITS)
        expected = [
            row_of.get(tuple((p // 2**BITS).tolist()), -1) if np.isfinite(p).all() else -1
            for p in lattice
        ]
    np.testing.assert_array_equal(rows, expected)


@both
@pytest.mark.parametrize('by_planarity', [False, True])
@pytest.mark.parametrize('radius', [0.0, 0.8, 2.3])
def test_the_best_surfels_around_a_point_are_those_of_a_linear_search(
    call, surfels, by_planarity, radius
):
    keys, positions, planarity = surfels
    points = np.random.default_rng(3).uniform(-4.5, 4.5, (40, 3))
    points = np.concatenate([points, positions[:3], [[np.nan, 0.0, 0.0]]])
    ranks = -planarity if by_planarity else np.empty(0)
    found = np.empty((len(points), 4), np.int64)
    call(best_around, points, radius, 1.0, positions, ranks, keys, table_of(keys), found)
    for point, rows in zip(points, found, strict=True):
        distance_sq = ((positions - point) ** 2).sum(axis=1)
        order = [
            (ranks[k] if by_planarity else distance_sq[k], k)
            for k in np.flatnonzero(distance_sq <= radius * radius)
            if not (by_planarity and np.isnan(ranks[k]))
        ]
        best = [k for _, k in sorted(order)][:4]
        assert rows.tolist() == best + [-1] * (4 - len(best))


@both
def test_occupied_voxels_in_a_box_are_listed(call):
    (rows, count, _, _), used = slab(), 150
    low, high = np.array([-20, -90, -15]), np.array([30, 25, 90])
    index = unpack_keys(rows[:used, KEY])
    inside = ((index >= low) & (index <= high)).all(axis=1) & (count[:used] > 0)
    np.testing.assert_array_equal(
        call(keys_in_box, rows, used, low, high), rows[:used, KEY][inside]
    )


@both
@pytest.mark.parametrize('min_points', [0, 1, 2, 3])
def test_changed_rows_are_those_of_the_version(call, min_points):
    rows, count, version, stamps = slab()
    changed = np.random.default_rng(4).permutation(200)[:120].astype(np.int32)
    held = count >= min_points
    at = changed[(version[changed] == 3) & held[changed]]
    found = call(rows_changed_at, rows, stamps, changed, 2 * 3, min_points)
    np.testing.assert_array_equal(found, at)
    for since in (0, 3, 5, 7):
        after = np.flatnonzero((version > since) & held)
        found = call(rows_changed_after, rows, stamps, 160, 2 * 5, 5 - since, min_points)
        np.testing.assert_array_equal(found, after[after < 160])
    assert len(call(rows_changed_after, rows, stamps, 0, 2 * 5, 5, min_points)) == 0


@both
def test_changes_are_found_across_the_end_of_the_stamps(call):
    rows, count, version, _ = slab()
    version += 2**31 - 4  # the last of 1 to 5 becomes 1
    stamps = (2 * (version % 2**31) + (count == 0)).astype(np.uint32)
    for since in range(6):
        found = call(rows_changed_after, rows, stamps, 200, 2 * 1, 5 - since, 0)
        np.testing.assert_array_equal(found, np.flatnonzero(version > 2**31 - 4 + since))


@both
def test_rows_of_enough_points_are_listed_with_their_mixed_keys(call):
    rows, count, _, _ = slab()
    chosen, mixed = np.empty(200, np.int32), np.empty(200, np.uint64)
    num = call(rows_held, rows, 180, 2, chosen, mixed)
    expected = np.flatnonzero(count[:180] >= 2)
    np.testing.assert_array_equal(chosen[:num], expected)
    assert mixed[:num].tolist() == [mixed_of(int(k)) for k in rows[expected, KEY]]


@both
def test_keys_within_a_limit_are_listed_and_mark_their_surfels(call):
    rng = np.random.default_rng(5)
    all_keys = rng.permutation(pack_keys(rng.integers(-99, 99, (400, 3))))
    mixed = np.empty(400, np.uint64)
    call(mix_keys, all_keys, mixed)
    assert mixed.tolist() == [mixed_of(key) for key in all_keys.tolist()]

    limit = np.sort(mixed)[200]
    within = np.empty(400, np.int64)
    num = call(keys_within, all_keys, limit, within)
    np.testing.assert_array_equal(within[:num], all_keys[mixed <= limit])

    keys = np.ascontiguousarray(all_keys[mixed <= limit][::2])
    marks = np.full(len(keys), -1)
    marks[::3] = 7
    seen, left = all_keys[100:300], np.empty(200, np.int64)
    num_marked, num_left = call(mark_seen, seen, limit, keys, table_of(keys), marks, 9, left)
    was_marked = set(keys[::3].tolist())
    newly = [key for key in keys.tolist() if key in seen and key not in was_marked]
    assert num_marked == len(newly)
    expected = [7 if k in was_marked else (9 if k in newly else -1) for k in keys.tolist()]
    assert marks.tolist() == expected
    assert left[:num_left].tolist() == [key for key in seen.tolist() if key not in was_marked]
