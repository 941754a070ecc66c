# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels that reduce a scan, one by one, against Python integers.

Whole reductions are compared in test/mapping/test_moments.py.
"""

import itertools

import numpy as np
import pytest

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.kernels.grouping import AHEAD, CHUNK, find_runs, hash_shift, home
from surfel_mapper.kernels.lanes import WORDS
from surfel_mapper.kernels.layout import HALF
from surfel_mapper.kernels.quantisation import quantise
from surfel_mapper.mapping.kernels.reduction import (
    add_places,
    BEYOND,
    look_back,
    NOT_FINITE,
    reason,
    reduce_points,
    TOO_FAR,
    TOO_NEAR,
    unpack_sums,
)
from surfel_mapper.mapping.moments import pack_keys, unpack_keys
from test import reference
from test.kernels.modes import both

IDENTITY = np.eye(4)[:3]
ANY_RANGE = np.array([0.0, np.inf])
AS_THEY_ARE = (IDENTITY, 131072.0, ANY_RANGE)  # half a metre, no pose, no limit


def some_points(num, dtype=np.float64, seed=0):
    """Return points (N, 3) in runs of a voxel, some not finite, some on faces and lattice."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.0, 2.0, (num, 3))
    points = np.repeat(points, rng.integers(1, 6, num), axis=0)[:num]
    points += rng.normal(scale=0.05, size=points.shape)
    points[::7] = np.round(points[::7] * 2.0) / 2.0
    points[::11] = np.round(points[::11] * 131072.0) / 131072.0
    points[::13] *= -0.0
    points[::17, 1] = np.nan
    points[::19, 2] = -np.inf
    points[::23, 0] = 1e30
    return points.astype(dtype)


def scratch_for(num_voxels):
    size = 1 << (2 * num_voxels - 1).bit_length()
    keys = np.full(num_voxels + 2, -7, np.int64)
    sums = np.full((num_voxels + 2, WORDS), -9, np.int64)
    chunk_keys, places = np.zeros(CHUNK + 1, np.int64), np.empty(CHUNK, np.int64)
    starts, run_rows = np.zeros(CHUNK + AHEAD, np.int32), np.empty(CHUNK, np.int32)
    return np.full(size, -1, np.int32), keys, sums, chunk_keys, places, starts, run_rows


@both
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('turned', [False, True])
def test_points_are_quantised_as_by_python(call, dtype, turned):
    pose = pose_matrix([3.0, 1e4, -2.0], [0.5, -0.5, 0.1, 0.7]) if turned else np.eye(4)
    points = some_points(300, dtype)
    keys, places = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int64)

    call(quantise, *points.T.copy(), pose[:3], 65536 / 0.2, ANY_RANGE, keys, places)

    for row, point in enumerate(points.tolist()):
        expected = reference.quantise(point, 0.2, pose)
        if expected is None:
            assert keys[row] == -1
        else:
            voxel, place = expected
            assert keys[row] == pack_keys(np.array([voxel]))[0]
            x, y, z = (coordinate + HALF for coordinate in place)
            assert places[row] == 2**48 + z * 2**32 + y * 2**16 + x


@both
@pytest.mark.parametrize('axis', [0, 1, 2])
def test_points_enter_up_to_the_last_voxel_and_no_farther(call, axis):
    # in voxels of 0.5 m; beyond 2^35 a sum with BASE leaves the range of 53 bits
    last, beyond = 2.0**20 - 2.0**-16, [2.0**k for k in (20, 21, 34, 35, 36, 37, 52, 1000)]
    values = [last, -(2.0**20), -(2.0**20) - 2.0**-16, -np.inf, np.inf, np.nan]
    values += [sign * value for value in beyond for sign in (1, -1)]
    points = np.full((len(values), 3), 0.1)
    points[:, axis] = values
    points[:, axis] *= 0.5
    keys, places = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int64)
    with np.errstate(all='ignore'):
        call(quantise, *points.T.copy(), IDENTITY, 131072.0, ANY_RANGE, keys, places)
    enters = (keys[: len(values)] >= 0).tolist()
    assert enters == [-(2**20) <= value < 2**20 for value in values]
    assert [keys[row] >> (42 - 21 * axis) & 0x1FFFFF for row in (0, 1)] == [0x1FFFFF, 0]
    assert places[0] >> 16 * axis & 65535 == 65535


@both
def test_points_outside_of_the_range_get_no_key(call):
    points = np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, -3.0], [0.9, 0, 0], [0, -3.1, 0]])
    keys, places = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int64)
    limits = np.array([1.0, 9.0])
    call(quantise, *points.T.copy(), IDENTITY, 131072.0, limits, keys, places)
    assert (keys[:5] >= 0).tolist() == [True, True, True, False, False]


@both
@pytest.mark.parametrize('keys', [[5], [5, 5, 5], [1, 2, 3], [1, 1, -1, -1, 2, 2, 1], [-1], []])
def test_runs_are_those_of_groupby(call, keys):
    starts = np.full(CHUNK + 1, -9, np.int32)
    num = call(find_runs, np.array(keys + [5] * 3, np.int64), len(keys), starts)
    lengths = [len(list(group)) for _, group in itertools.groupby(keys)]
    assert num == len(lengths)
    assert np.diff(starts[: num + 1]).tolist() == lengths
    assert starts[num] == len(keys)


def packed(places):
    """Return places (3, C) as quantise writes them, (C,) int64."""
    x, y, z = places
    return 2**48 + z * 2**32 + y * 2**16 + x


def unpacked(call, sums):
    """Return rows of count, sums and products of the places about the centre."""
    num = len(sums)
    count, total = np.empty(num, np.int32), np.empty((num, 3), np.int32)
    product = np.empty((num, 6), np.int64)
    largest = call(unpack_sums, sums, count, total, product)
    assert largest == count.max(initial=0)
    return np.column_stack([count, total, product]).tolist()


@both
@pytest.mark.parametrize('lengths', [(9, 1, 7), (1, 1, 15), (17,)])
def test_runs_add_count_sums_and_products_to_their_voxels(call, lengths):
    places = np.random.default_rng(1).integers(0, 65536, (3, 17))
    rows, voxels = [1, 3, 1][: len(lengths)], [70, 20, 70][: len(lengths)]
    keys = np.append(np.repeat(voxels, lengths), -9)
    sums = np.zeros((6, WORDS), np.int64)
    run_rows = np.array([*rows, 4, 4], np.int32)  # those at the end do not count
    for _ in range(2):  # the second time on top of the first
        call(add_places, packed(places), 17, keys, run_rows, sums.ravel(), tuple(np.ones((3, 20))))
    found = unpacked(call, sums)
    for row, voxel in ((1, 70), (3, 20)):
        of_row = np.flatnonzero(keys == voxel)
        x, y, z = (places[:, of_row].astype(int) - HALF).tolist()
        pairs = (x, x), (x, y), (x, z), (y, y), (y, z), (z, z)
        products = [sum(a * b for a, b in zip(*pair, strict=True)) for pair in pairs]
        once = [len(of_row), sum(x), sum(y), sum(z), *products]
        assert found[row] == [2 * value for value in once]
    assert not sums[[0, 2, 4, 5]].any()


@both
@pytest.mark.parametrize('num', [0, 1, 50, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 5])
def test_a_scan_is_summed_by_voxel_in_the_order_of_first_appearance(call, num):
    points = some_points(num)
    scratch = scratch_for(max(2 * num, 1))
    table, keys, sums = scratch[:3]
    left_out = np.full(4, -1, np.int64)

    found = call(reduce_points, points.T.copy(), *AS_THEY_ARE, scratch, left_out)

    twin = reference.scan_moments(points, 0.5)
    assert list(map(tuple, unpack_keys(keys[2 : found + 2]).tolist())) == list(twin)
    assert unpacked(call, sums[1 : found + 1]) == [row[:10] for row in twin.values()]
    assert (table == -1).all()
    finite = np.isfinite(points).all(axis=1)
    assert left_out[NOT_FINITE] == (~finite).sum()
    assert left_out.sum() == num - sum(row[0] for row in twin.values())


@both
@pytest.mark.parametrize('room', [1, 8, 60])
def test_a_scan_that_does_not_fit_leaves_the_table_clean(call, room):
    scratch = scratch_for(room)
    left_out = np.zeros(4, np.int64)
    points = np.random.default_rng(2).uniform(-9.0, 9.0, (3, 3 * CHUNK))
    points[:, : CHUNK + 9] = 0.1  # the first chunk fits
    asked = (points, *AS_THEY_ARE, scratch, left_out)
    assert call(reduce_points, *asked) == -1
    assert (scratch[0] == -1).all()


@both
def test_hashes_stay_within_the_table(call):
    keys = np.random.default_rng(4).integers(0, 2**63 - 1, 200)
    for bits in (1, 4, 12, 20, 31):
        shift = call(hash_shift, 1 << bits)
        assert shift == 64 - bits
        places = [call(home, key, shift) for key in keys]
        assert min(places) >= 0
        assert max(places) < 1 << bits


@both
@pytest.mark.parametrize(
    ('point', 'cause'),
    [
        ([np.nan, 0.0, 0.0], NOT_FINITE),
        ([0.0, np.inf, 0.0], NOT_FINITE),
        ([0.0, 0.5, 0.0], TOO_NEAR),
        ([0.0, 0.0, -6.0], TOO_FAR),
        ([1e200, 0.0, 0.0], TOO_FAR),
        ([2.0, 2.0, 2.0], BEYOND),
    ],
)
def test_every_point_left_out_has_one_cause(call, point, cause):
    assert call(reason, *np.array(point), np.array([1.0, 25.0])) == cause


@both
@pytest.mark.parametrize('origin', [[3.0, -40.0, 2.0], [0.25, 0.25, 0.25], None])
def test_views_point_from_voxels_to_the_sensor(call, origin):
    points = np.random.default_rng(4).uniform(-20.0, 20.0, (CHUNK + 100, 3))
    twin = reference.scan_moments(points, 0.5, origin)
    rows, keys = np.array(list(twin.values())), pack_keys(np.array(list(twin)))
    assert len(keys) > CHUNK
    view = np.empty((len(keys), 3), np.int16)
    seen_from = np.full(3, np.nan) if origin is None else np.array(origin)
    call(look_back, keys, seen_from, 0.5, view)

    assert (view * rows[:, :1] == rows[:, 10:]).all()
