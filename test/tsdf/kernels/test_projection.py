# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Projection into camera images, against float64 arithmetic of numpy."""

import numpy as np

from surfel_mapper.tsdf.kernels.projection import OUTSIDE, project
from test.kernels.modes import both


def points(num=500):
    xyz = np.random.default_rng(1).normal(0.0, 5.0, (3, num)).astype(np.float32)
    xyz[:, :4] = [[0, 0, 0, 1e-10], [0, 1, 0, 0], [0, 0, 1, 0]]
    return xyz


@both
def test_a_camera_projects_by_its_focal_lengths(call):
    xyz = points()
    distance, u, v = np.full((3, xyz.shape[1]), np.nan, np.float32)
    camera = np.array([300, 310, 160, 120, 320, 240], np.float32)
    call(project, *xyz, camera, distance, u, v)
    np.testing.assert_allclose(distance, np.sqrt((xyz.astype(float) ** 2).sum(axis=0)), rtol=1e-6)
    x, y, z = xyz.astype(float)
    with np.errstate(all='ignore'):
        expected_u, expected_v = 300 * x / z + 160, 310 * y / z + 120
        inside = (z > 0) & (expected_u >= 0) & (expected_u <= 320)
        inside &= (expected_v >= 0) & (expected_v <= 240)
    assert inside.sum() > 10
    np.testing.assert_array_equal(u != OUTSIDE, inside)
    np.testing.assert_allclose(u[inside], expected_u[inside], atol=1e-3)
    np.testing.assert_allclose(v[inside], expected_v[inside], atol=1e-3)
