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
from surfel_mapper.kernels.quantisation import quantise
from surfel_mapper.mapping.kernels.reduction import (
    add_points,
    add_runs,
    BEYOND,
    look_back,
    NOT_FINITE,
    pack_sums,
    reason,
    reduce_points,
    SUMS,
    TOO_FAR,
    TOO_NEAR,
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
    sums = np.full((num_voxels + 1, SUMS), np.nan)
    chunk_keys, places = np.zeros(CHUNK + 1, np.int64), np.empty((3, CHUNK))
    starts, run_rows = np.zeros(CHUNK + AHEAD, np.int32), np.empty(CHUNK, np.int32)
    return np.full(size, -1, np.int32), keys, sums, chunk_keys, places, starts, run_rows


@both
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('turned', [False, True])
def test_points_are_quantised_as_by_python(call, dtype, turned):
    pose = pose_matrix([3.0, 1e4, -2.0], [0.5, -0.5, 0.1, 0.7]) if turned else np.eye(4)
    points = some_points(300, dtype)
    keys, places = np.empty(CHUNK, np.int64), np.empty((3, CHUNK))

    call(quantise, *points.T.copy(), pose[:3], 65536 / 0.2, ANY_RANGE, keys, places)

    for row, point in enumerate(points.tolist()):
        expected = reference.quantise(point, 0.2, pose)
        if expected is None:
            assert keys[row] == -1
        else:
            voxel, place = expected
            assert keys[row] == pack_keys(np.array([voxel]))[0]
            assert tuple(places[:, row]) == place


@both
def test_points_outside_of_the_range_get_no_key(call):
    points = np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, -3.0], [0.9, 0, 0], [0, -3.1, 0]])
    keys, places = np.empty(CHUNK, np.int64), np.empty((3, CHUNK))
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


@both
@pytest.mark.parametrize('by_point', [False, True])
def test_runs_add_count_sums_and_products_to_their_voxels(call, by_point):
    places = np.random.default_rng(1).integers(-32768, 32768, (3, 17)).astype(np.float64)
    sums = np.zeros((4, SUMS))
    sums[1] = 5.0
    run_rows = np.array([1, 3, 1, 0], np.int32)  # of which three runs count
    if by_point:
        keys = np.repeat([70, 20, 70], [9, 1, 7])
        call(add_points, places, 17, keys, run_rows, sums.ravel())
    else:
        starts = np.array([0, 9, 10, 17, 99], np.int32)
        call(add_runs, places, starts, 3, run_rows, sums.ravel())
    for row, of_row, before in ((1, [*range(9), *range(10, 17)], 5), (3, [9], 0)):
        x, y, z = places[:, of_row].astype(int).tolist()
        products = [
            sum(a * b for a, b in zip(*p, strict=True))
            for p in [(x, x), (x, y), (x, z), (y, y), (y, z), (z, z)]
        ]
        found = [len(of_row), sum(x), sum(y), sum(z), *products]
        assert sums[row].tolist() == [value + before for value in found]
    assert not sums[[0, 2]].any()


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
    assert sums[1 : found + 1].astype(int).tolist() == [row[:10] for row in twin.values()]
    assert sorted(table[table >= 0]) == list(range(found + 1))
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
@pytest.mark.parametrize('wide', [np.int32, np.int64])
def test_sums_are_converted_to_integers(call, wide):
    rows = np.array(list(reference.scan_moments(some_points(200), 0.5, None).values()))
    num = len(rows)
    count, total = np.empty(num, np.int32), np.empty((num, 3), wide)
    product = np.empty((num, 6), np.int64)
    largest = call(pack_sums, rows[:, :10].astype(np.float64), count, total, product)

    assert largest == rows[:, 0].max()
    assert (count == rows[:, 0]).all()
    assert (total == rows[:, 1:4]).all()
    assert (product == rows[:, 4:10]).all()


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
