# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Depth images to points: against the projection of known points; refused images."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.sensors.depth import depth_points, PinholeCamera

CAMERA = PinholeCamera(width=40, height=30, fx=35.0, fy=36.0, cx=19.2, cy=14.7)


def projected(points, camera):
    """Return column, row and depth of points in the optical frame, by the pinhole equations."""
    x, y, z = np.asarray(points, np.float64).T
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z


def test_points_project_back_onto_their_pixels():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 9.0, (30, 40)).astype(np.float32)
    points = depth_points(depth, CAMERA)
    assert points.dtype == np.float32
    assert points.flags.f_contiguous
    column, row, z = projected(points, CAMERA)
    rows, columns = np.divmod(np.arange(1200), 40)
    np.testing.assert_allclose(column, columns, atol=1e-4)
    np.testing.assert_allclose(row, rows, atol=1e-4)
    np.testing.assert_array_equal(z, depth.ravel())


def test_millimetres_and_metres_give_the_same_points():
    depth_mm = np.random.default_rng(2).integers(300, 9000, (30, 40)).astype(np.uint16)
    depth_m = (depth_mm / 1000).astype(np.float32)
    np.testing.assert_allclose(
        depth_points(depth_mm, CAMERA), depth_points(depth_m, CAMERA), rtol=2e-7
    )


@pytest.mark.parametrize('nothing', [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_pixels_without_depth_give_no_point(nothing):
    depth = np.full((30, 40), 2.0, np.float32)
    depth[3:5, 7] = nothing
    points = depth_points(depth, CAMERA)
    assert len(points) == 1198
    assert (points[:, 2] == 2.0).all()
    assert len(depth_points(np.full((30, 40), nothing, np.float32), CAMERA)) == 0


def test_the_largest_number_of_millimetres_is_no_depth():
    depth = np.full((30, 40), 2000, np.uint16)
    depth[4, 5:8] = 65535, 65534, 0
    points = depth_points(depth, CAMERA)
    assert len(points) == 1198
    assert points[:, 2].max() == np.float32(65.534)


def test_any_layout_of_the_image_will_do():
    depth = np.random.default_rng(3).uniform(1, 2, (30, 40)).astype(np.float32)
    expected = depth_points(depth, CAMERA)
    wide = np.zeros((30, 64), np.float32)
    wide[:, :40] = depth
    frozen = np.asfortranarray(depth)
    frozen.flags.writeable = False
    for other in (wide[:, :40], frozen):
        np.testing.assert_array_equal(depth_points(other, CAMERA), expected)


def test_an_image_of_another_size_or_type_is_refused():
    with pytest.raises(ValueError, match=r'shape \(40, 30\), expected \(30, 40\)'):
        depth_points(np.ones((40, 30), np.float32), CAMERA)
    with pytest.raises(ValueError, match='type float64, expected uint16 or float32'):
        depth_points(np.ones((30, 40)), CAMERA)


@pytest.mark.parametrize(
    'wrong', [{'fx': 0.0}, {'fy': -1.0}, {'width': 0}, {'cx': np.nan}, {'fx': np.inf}]
)
def test_invalid_cameras_are_refused(wrong):
    right = {'width': 4, 'height': 3, 'fx': 1.0, 'fy': 1.0, 'cx': 1.0, 'cy': 1.0}
    with pytest.raises(ValueError, match='is it calibrated'):
        PinholeCamera(**{**right, **wrong})
