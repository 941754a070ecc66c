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

from surfel_mapper.filters.kernels.smallest import keep_least, VECTORS
from surfel_mapper.filters.kernels.voxel_grid import group_points, ROWS
from surfel_mapper.kernels.grouping import CHUNK
from surfel_mapper.kernels.lanes import FLOATS
from test.kernels.modes import both, compiled, printed_alike

SHORT_CHAINS = """
import hashlib
import numpy as np
from surfel_mapper.filters.chain import Chain
from test.filters.examples import random_scan

CHAINS = [
    [{'voxel_grid': {'size_x_m': 0.5, 'size_y_m': 0.5, 'size_z_m': 0.5}}],
    [{'VoxelGridDataPointsFilter': {'useCentroid': 0}}],
    ['range_limit'],
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
    assert len(text.splitlines()) == 24


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
