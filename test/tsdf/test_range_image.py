# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T8, T9, T16: content of pixels, projection of points, interpolation between pixels."""

from dataclasses import replace
import math

import numpy as np
import pytest

from surfel_mapper.errors import CloudFormatError, ConfigError
from surfel_mapper.tsdf.kernels.projection import OUTSIDE, project
from surfel_mapper.tsdf.range_image import from_depth
from surfel_mapper.tsdf.sensors import CameraModel
from test.tsdf import twin
from test.tsdf.scenes import SMALL


def projected(sensor, points):
    p = np.ascontiguousarray(np.asarray(points, np.float32).T)
    out = np.empty((3, p.shape[1]), np.float32)
    project(p[0], p[1], p[2], sensor.projection, out[0], out[1], out[2])
    return out[1], out[2]


def test_every_pixel_falls_onto_itself():
    sensor = SMALL
    points = 3.0 * sensor.directions.reshape(-1, 3)
    u, v = projected(sensor, points)
    row, column = np.indices((sensor.rows, sensor.columns)).reshape(2, -1)
    seen = u > OUTSIDE
    assert seen.mean() > 0.99
    np.testing.assert_allclose(u[seen], column[seen], atol=2e-3)
    np.testing.assert_allclose(v[seen], row[seen], atol=2e-3)


def test_points_fall_where_the_equations_say():
    sensor = SMALL
    points = np.random.default_rng(1).standard_normal((5000, 3)) * [3.0, 3.0, 1.5]
    points[:5] = [[0, 0, 0], [0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, 0, 0]]
    u, v = projected(sensor, points)
    expected_u, expected_v = twin.place_in_image(sensor, points)
    clear = np.arange(5000) >= 5  # of the poles and the seam
    seen = ~np.isnan(expected_u)
    assert ((u > OUTSIDE) != seen)[clear].sum() <= 5  # on the very border
    both = seen & (u > OUTSIDE) & clear
    assert both.sum() > 100
    np.testing.assert_allclose(u[both], expected_u[both], atol=2e-3)
    np.testing.assert_allclose(v[both], expected_v[both], atol=2e-3)


def test_depths_become_ranges_and_say_what_they_know():
    depth = np.full((60, 80), 2.0, np.float32)
    depth[0, :7] = [np.nan, np.inf, -np.inf, 0.0, -1.0, 0.05, 9.0]
    image = from_depth(SMALL, depth)
    assert image.range_m[0, [0, 2, 3, 4, 5]].tolist() == [0.0] * 5
    assert (image.range_m[0, [1, 6]] > 1000.0).all()
    assert image.largest_m == SMALL.max_range_m
    assert np.count_nonzero(image.range_m) == 60 * 80 - 5
    expected = 2.0 * np.sqrt(((0 - 40) / 65) ** 2 + ((59 - 30) / 65) ** 2 + 1)
    assert image.range_m[59, 0] == pytest.approx(expected, rel=1e-6)


def test_65535_mm_is_no_depth_and_no_free_space():
    depth = np.full((60, 80), 2000, np.uint16)
    depth[0, :2] = [65535, 0]
    image = from_depth(SMALL, depth)
    assert image.range_m[0, :2].tolist() == [0.0, 0.0]
    assert np.count_nonzero(image.range_m) == 60 * 80 - 2


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: from_depth(SMALL, np.zeros((80, 60), np.float32)), r'\(80, 60\), expected'),
        (lambda: from_depth(SMALL, np.zeros((60, 80), np.int32)), 'int32, expected float32'),
        (lambda: blank().with_images(color=np.zeros((60, 81, 3), np.uint8)), 'color: '),
        (lambda: blank().with_images(color=np.zeros((60, 80, 3))), 'float64, expected uint8'),
        (lambda: blank().with_images(label=np.full((60, 80), 1 << 24)), 'label: '),
        (lambda: blank().with_images(mask=np.zeros((60,))), 'mask: '),
    ],
)
def test_images_of_other_sizes_and_types_are_refused(make, message):
    with pytest.raises(CloudFormatError, match=message):
        make()


def blank():
    return from_depth(SMALL, np.zeros((60, 80), np.float32))


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: CameraModel(columns=0, rows=2, fx=1, fy=1, cx=1, cy=1), 'columns: 0'),
        (lambda: CameraModel(columns=4, rows=2, fx=0, fy=1, cx=1, cy=1), 'fx: 0'),
        (lambda: CameraModel(columns=4, rows=2, fx=1, fy=1, cx=5, cy=1), 'cx: 5'),
        (lambda: CameraModel(columns=4, rows=2, fx=1, fy=1, cx=1, cy=3), 'cy: 3'),
        (lambda: replace(SMALL, max_range_m=math.inf), 'max_range_m: inf, expected .*, finite'),
        (lambda: replace(SMALL, min_range_m=0.0), 'min_range_m: 0'),
        (lambda: replace(SMALL, min_range_m=9.0), 'max_range_m: 8'),
    ],
)
def test_sensors_that_cannot_be_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
