# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels of filters run without the compiler as they do with it, and at their edges.

Results are tested with the filters; here, compiled and interpreted runs agree to the bit, and the
table of voxels grows.
"""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.filters.kernels.boxes import cut
from surfel_mapper.filters.kernels.limits import (
    BOTH,
    EITHER,
    in_field_of_view,
    in_wedge,
    outside_box,
    sum_squares,
)
from surfel_mapper.filters.kernels.sampling import choose
from surfel_mapper.filters.kernels.shapes import group_moments, neighbour_moments
from surfel_mapper.filters.kernels.smallest import keep_least, VECTORS
from surfel_mapper.filters.kernels.voxel_grid import group_points, ROWS
from surfel_mapper.filters.shapes import PAIRS
from surfel_mapper.kernels.grouping import CHUNK
from surfel_mapper.kernels.lanes import FLOATS
from surfel_mapper.kernels.selection import compact
from test.kernels.modes import both, compiled, printed_alike

SHORT_CHAINS = """
import hashlib
import numpy as np
from surfel_mapper.filters.chain import Chain
from test.filters.examples import random_scan

CHAINS = [
    [{'voxel_grid': {'size_x_m': 0.5, 'size_y_m': 0.5, 'size_z_m': 0.5}}],
    [{'VoxelGridDataPointsFilter': {'useCentroid': 0}}],
    ['body_box', {'field_of_view': {'azimuth_min_deg': -100, 'azimuth_max_deg': 100}}],
    [{'field_of_view': {'elevation_max_deg': 10, 'azimuth_min_deg': 0, 'azimuth_max_deg': 90}}],
    [{'angle_limit': {'phi_min_deg': -30, 'phi_max_deg': 90, 'theta_max_deg': 91}}],
    [{'angle_limit': {'phi_min_deg': 20, 'theta_min_deg': 89, 'remove_inside': 0}}],
    [{'saliency': {'num_neighbours': 12, 'sigma': 1.0}}],
    [{'spectral_decomposition': {'num_neighbours': 12, 'sigma': 1.0}}],
    ['sampling_surface_normal', {'surface_normal': {'smooth_normals': 1}}],
    [{'covariance_sampling': {'num_points': 50}}, 'ground'],
    [{'surface_normal': {'num_neighbours': 30}}, 'radius_outliers', 'statistical_outliers'],
]
for chain in CHAINS:
    for dtype in (np.float32, np.float64):
        found = Chain.from_list(chain).apply(random_scan(200, dtype=dtype))
        columns = b''.join(found.columns[name].tobytes() for name in sorted(found.columns))
        bits = found.points.tobytes() + columns
        print(len(found), hashlib.sha256(bits).hexdigest())
"""


def test_filters_give_the_same_to_the_bit_without_the_compiler():
    text = printed_alike(SHORT_CHAINS)
    assert len(text.splitlines()) == 22


@both
@pytest.mark.parametrize('kept', [[], [0], [4], [0, 1, 2, 3, 4], [1, 3]])
def test_compact_moves_the_kept_values_together(call, kept):
    values = np.arange(15.0).reshape(3, 5)
    keep = np.zeros(5, np.bool_)
    keep[kept] = True
    out = np.full((3, len(kept)), np.nan)
    call(compact, values, keep, out)
    np.testing.assert_array_equal(out, values[:, kept])


@both
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_squared_distances_are_those_of_numpy_in_the_type_of_the_points(call, dtype):
    xyz = np.random.default_rng(4).normal(scale=30.0, size=(3, 50)).astype(dtype)
    xyz[:, 0], xyz[1, 1], xyz[2, 2], xyz[0, 3] = 0.0, np.nan, np.inf, np.finfo(dtype).max
    found = np.empty(50, dtype)
    with np.errstate(over='ignore'):
        call(sum_squares, xyz, found)
        expected = xyz[0] ** 2 + xyz[1] ** 2 + xyz[2] ** 2
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize('number', [ROWS - 1, ROWS, ROWS + 1, 9 * ROWS])
def test_the_table_of_voxels_grows_with_them(number):
    # one point a voxel, at random along a line, so that no two follow in one voxel
    order = np.random.default_rng(1).permutation(number).astype(np.float64)
    xyz = np.zeros((3, 2 * number))
    xyz[0] = np.concatenate([order + 0.25, order + 0.75])
    ones, zeros, bits = np.ones(3), np.zeros(3), np.array([31, 1, 1])
    keys, first = np.empty((2, 2 * number + 2), np.int64)
    sums, rows = np.empty((2 * number + 1, 4)), np.empty(2 * number, np.int32)
    found = compiled(group_points, xyz, ones, zeros, zeros, bits, keys, sums, first, rows)
    assert found == number
    np.testing.assert_array_equal(keys[1 : found + 1], order.astype(np.int64))
    np.testing.assert_array_equal(first[:found], np.arange(number))
    np.testing.assert_array_equal(rows, np.tile(np.arange(number), 2))
    np.testing.assert_array_equal(sums[:found, 0], 2.0 * order + 1.0)
    np.testing.assert_array_equal(sums[:found, 3], 2.0)


@both
def test_points_alone_in_their_voxels_are_the_first_ones(call):
    number = CHUNK + 3  # arrays as long as there are voxels, over two chunks
    xyz = np.zeros((3, number))
    xyz[0] = np.arange(number) + 0.5
    ones, zeros, bits = np.ones(3), np.zeros(3), np.array([12, 1, 1])
    keys, first = np.empty((2, number + 2), np.int64)
    sums, rows = np.empty((number + 1, 4)), np.empty(0, np.int32)
    assert call(group_points, xyz, ones, zeros, zeros, bits, keys, sums, first, rows) == number
    np.testing.assert_array_equal(first[:number], np.arange(number))
    np.testing.assert_array_equal(sums[:number, 0], xyz[0])


@both
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_outside_box_tests_every_point_in_the_frame_of_the_box(call, dtype):
    rng = np.random.default_rng(1)
    points = rng.uniform(-2.0, 2.0, (200, 3)).astype(dtype)
    points[5, 1] = np.nan
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.column_stack([rotation, [0.1, -0.3, 0.2]])
    low, high = np.array([-1.0, -0.5, -1.5]), np.array([0.5, 1.0, 1.0])
    found = np.empty(200, np.int8)
    call(outside_box, np.asfortranarray(points).T, pose, low, high, found)
    for point, outside in zip(points.astype(np.float64), found, strict=True):
        x = rotation @ point + pose[:, 3]
        assert outside == (-1 if np.isnan(x).any() else not ((low < x) & (x < high)).all())


@both
@pytest.mark.parametrize(('start', 'end'), [(-30.0, 60.0), (100.0, 350.0), (-180.0, 180.0)])
def test_in_field_of_view_equals_the_test_of_angles(call, start, end):
    points = np.random.default_rng(2).normal(size=(300, 3))
    points[:2] = [[0.0, 0.0, 0.0], [np.inf, 1.0, 1.0]]
    low, high = -20.0, 50.0
    edges = np.array([f(np.radians(a)) for a in (start, end) for f in (np.cos, np.sin)])
    edges = np.append(edges, np.tan(np.radians([low, high])))
    seen = np.empty(300, np.bool_)
    has_azimuth, is_wide = end - start < 360.0, end - start > 180.0
    call(in_field_of_view, points.T.copy(), edges, has_azimuth, is_wide, True, True, seen)
    x, y, z = points[2:].T
    turn = (np.degrees(np.arctan2(y, x)) - start) % 360.0
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    expected = (turn <= end - start) & (low <= elevation) & (elevation <= high)
    np.testing.assert_array_equal(seen, np.append([False, False], expected))


@both
@pytest.mark.parametrize('want_all', [True, False])
def test_in_wedge_equals_the_test_of_angles(call, want_all):
    points = np.random.default_rng(3).normal(size=(300, 3))
    points[0] = 0.0
    limits = np.array([-40.0, 75.0, 30.0, 120.0])
    kinds = np.array([EITHER, EITHER, BOTH, BOTH])  # phi above a negative, below a positive limit
    found = np.empty(300, np.bool_)
    call(in_wedge, points.T.copy(), np.cos(np.radians(limits)), kinds, want_all, found)
    x, y, z = points[1:].T
    phi, theta = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(np.hypot(x, y), z))
    tests = [phi > limits[0], phi < limits[1], theta > limits[2], theta < limits[3]]
    expected = np.all(tests, axis=0) if want_all else np.any(tests, axis=0)
    np.testing.assert_array_equal(found, np.append(False, expected))


@both
@pytest.mark.parametrize('number', [1, 2, 7, 100])
def test_cut_gives_boxes_of_halves_that_no_cut_separates_wrongly(call, number):
    points = np.random.default_rng(4).integers(0, 6, (number, 3)).astype(np.float64)
    order, rows = np.arange(number), np.empty(number, np.int64)
    boxes = call(cut, points, 5, order, rows)

    def slow(members, low, high):
        if len(members) <= 5:
            return [frozenset(members)]
        axis = int(np.argmax(high - low))
        members = sorted(members, key=lambda row: (points[row, axis], row))
        left = len(members) - len(members) // 2
        at = points[members[left], axis]
        below, above = high.copy(), low.copy()
        below[axis] = above[axis] = at
        return slow(members[:left], low, below) + slow(members[left:], above, high)

    expected = slow(list(range(number)), points.min(axis=0), points.max(axis=0))
    assert boxes == len(expected)
    assert {frozenset(np.flatnonzero(rows == box)) for box in range(boxes)} == set(expected)
    assert sorted(order) == list(range(number))


def numpy_moments(points):
    centred = points - points.mean(axis=0)
    matrix = centred.T @ centred / max(len(points) - 1, 1)
    return points.mean(axis=0), [matrix[i, j] for i, j in PAIRS], np.linalg.norm(centred, axis=1)


@both
def test_moments_of_groups_equal_numpy(call):
    rng = np.random.default_rng(5)
    points, rows = rng.normal(size=(60, 3)), np.append(np.arange(7), rng.integers(0, 7, 53))
    count, mean = np.zeros(8, np.int64), np.zeros((8, 3))
    covariance, radius = np.zeros((6, 8)), np.zeros(8)
    points, rows = np.append(points, [[1.0, 2.0, 3.0]], axis=0), np.append(rows, 7)
    call(group_moments, points, rows, count, mean, covariance, radius)
    for group in range(8):
        expected = numpy_moments(points[rows == group])
        assert count[group] == np.count_nonzero(rows == group)
        np.testing.assert_allclose(mean[group], expected[0], atol=1e-12)
        np.testing.assert_allclose(covariance[:, group], expected[1], atol=1e-12)
        np.testing.assert_allclose(radius[group], expected[2].max(), atol=1e-12)


@both
def test_moments_of_neighbours_equal_numpy(call):
    rng = np.random.default_rng(6)
    points = rng.normal(size=(40, 3))
    ids = rng.permuted(np.tile(np.arange(40, dtype=np.int32), (10, 1)), axis=1)[:, :6]
    ids[3, 2:], ids[4, 1:] = 40, 40
    count, mean = np.empty(10, np.int64), np.empty((10, 3))
    covariance, radius = np.empty((6, 10)), np.empty(10)
    call(neighbour_moments, *points.T.copy(), ids, count, mean, covariance, radius)
    assert count.tolist() == [6, 6, 6, 2, 1, 6, 6, 6, 6, 6]
    for row, near in enumerate(ids):
        expected = numpy_moments(points[near[near < 40]])
        np.testing.assert_allclose(mean[row], expected[0], atol=1e-12)
        np.testing.assert_allclose(covariance[:, row], expected[1], atol=1e-12)
        np.testing.assert_allclose(radius[row], expected[2].max(), atol=1e-12)


def even_squares(rng, number):
    return rng.uniform(size=number)


def equal_squares(rng, number):
    return np.repeat(rng.uniform(size=4), -(-number // 4))[:number]


def crowded_squares(rng, number):
    return rng.uniform(size=number) ** 40


@both
@pytest.mark.parametrize('draw', [even_squares, equal_squares, crowded_squares])
@pytest.mark.parametrize(('number', 'k'), [(2, 1), (20, 10), (25, 24), (54, 30), (96, 1)])
def test_the_smallest_squares_are_kept_with_their_places(call, draw, number, k):
    rng = np.random.default_rng(number)
    given = draw(rng, number)
    for high in (np.inf, given.max()):
        squares = np.full(-(-number // VECTORS) * VECTORS, np.nan)
        squares[:number] = given
        found = np.arange(len(squares), dtype=np.int32)
        floats = np.empty(FLOATS, np.float32)
        bound = call(keep_least, squares, found, np.uint64(number), np.uint64(k), high, floats)
        assert bound == np.sort(given)[k - 1]
        np.testing.assert_array_equal(np.sort(squares[:k]), np.sort(given)[:k])
        np.testing.assert_array_equal(squares[:k], given[found[:k]])
        assert len(set(found[:k])) == k


@both
def test_choose_takes_the_point_for_the_motion_constrained_least(call):
    resists = np.array([[3.0, 0.0], [2.0, 1.0], [0.0, 0.5], [0.1, 2.0]])
    by_motion = np.ascontiguousarray(np.argsort(-np.abs(resists), axis=0).T)
    for number, expected in ((1, [0]), (2, [0, 3]), (3, [0, 1, 3]), (4, [0, 1, 2, 3])):
        chosen = np.zeros(4, np.bool_)
        call(choose, resists, by_motion, number, chosen)
        assert np.flatnonzero(chosen).tolist() == expected
