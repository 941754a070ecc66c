# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels of filters run without the compiler as they do with it, to the bit.

Results are tested with the filters.
"""

from __future__ import annotations

from test.kernels.modes import printed_alike

SHORT_CHAINS = """
import hashlib
import numpy as np
from surfel_mapper.filters.chain import Chain
from test.filters.examples import random_scan

CHAINS = [
    [{'voxel_grid': {'size_x_m': 0.5, 'size_y_m': 0.5, 'size_z_m': 0.5}}],
    [{'VoxelGridDataPointsFilter': {'useCentroid': 0}}],
    ['range_limit'],
    ['body_box'],
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
