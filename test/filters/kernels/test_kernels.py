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

from surfel_mapper.kernels.selection import compact
from surfel_mapper.kernels.voxel_grid import group_points, ROWS
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
    assert len(text.splitlines()) == 20


@both
@pytest.mark.parametrize('kept', [[], [0], [4], [0, 1, 2, 3, 4], [1, 3]])
def test_compact_moves_the_kept_values_together(call, kept):
    values = np.arange(10.0).reshape(2, 5)
    keep = np.zeros(5, np.bool_)
    keep[kept] = True
    out = np.full((2, len(kept)), np.nan)
    call(compact, values, keep, out)
    np.testing.assert_array_equal(out, values[:, kept])


@pytest.mark.parametrize('number', [ROWS - 1, ROWS, ROWS + 1, 9 * ROWS])
def test_the_table_of_voxels_grows_with_them(number):
    # one point a voxel, at random along a line, so that no two follow in one voxel
    order = np.random.default_rng(1).permutation(number).astype(np.float64)
    xyz = np.zeros((3, 2 * number))
    xyz[0] = np.concatenate([order + 0.25, order + 0.75])
    ones, zeros, bits = np.ones(3), np.zeros(3), np.array([31, 1, 1])
    keys, first = np.empty((2, 2 * number), np.int64)
    sums, rows = np.empty((2 * number, 4)), np.empty(2 * number, np.int32)
    found = compiled(group_points, xyz, ones, zeros, zeros, bits, keys, sums, first, rows)
    assert found == number
    np.testing.assert_array_equal(keys[:found], order.astype(np.int64))
    np.testing.assert_array_equal(first[:found], np.arange(number))
    np.testing.assert_array_equal(rows, np.tile(np.arange(number), 2))
    np.testing.assert_array_equal(sums[:found, 0], 2.0 * order + 1.0)
    np.testing.assert_array_equal(sums[:found, 3], 2.0)
