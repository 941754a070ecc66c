# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Projection into camera and lidar images, against float64 trigonometry of numpy.

Angles may be 1 microradian off, that is 4e-4 of the columns and rows used here; a point this near
to the border of the image may be on either side.
"""

import math

import numpy as np
import pytest

from surfel_mapper.kernels.projection import (
    arc_tangent,
    CAMERA,
    LIDAR,
    OUTSIDE,
    project,
    rows_of_table,
)
from test.kernels.modes import both

NO_TABLE = np.zeros(1, np.float32)


def points(num=500):
    xyz = np.random.default_rng(1).normal(0.0, 5.0, (3, num)).astype(np.float32)
    xyz[:, :4] = [[0, 0, 0, 1e-10], [0, 1, 0, 0], [0, 0, 1, 0]]
    return xyz


def projected(call, kind, sensor, elevations=NO_TABLE):
    xyz = points()
    distance, u, v = np.full((3, xyz.shape[1]), np.nan, np.float32)
    sensor = np.array(sensor, np.float32)
    call(project, *xyz, kind, sensor, elevations, distance, u, v)
    np.testing.assert_allclose(distance, np.sqrt((xyz.astype(float) ** 2).sum(axis=0)), rtol=1e-6)
    return xyz.astype(float), u, v


@both
def test_the_arc_tangent_is_within_a_microradian(call):
    for angle in np.linspace(-math.pi, math.pi, 721):
        y, x = np.float32(math.sin(angle)), np.float32(math.cos(angle))
        assert call(arc_tangent, y, x) == pytest.approx(math.atan2(y, x), abs=1e-6)
    assert call(arc_tangent, np.float32(0.0), np.float32(0.0)) == 0.0


@both
def test_a_camera_projects_by_its_focal_lengths(call):
    (x, y, z), u, v = projected(call, CAMERA, [300, 310, 160, 120, 320, 240, 0, 0])
    with np.errstate(all='ignore'):
        expected_u, expected_v = 300 * x / z + 160, 310 * y / z + 120
        inside = (z > 0) & (expected_u >= 0) & (expected_u <= 320)
        inside &= (expected_v >= 0) & (expected_v <= 240)
    assert inside.sum() > 10
    np.testing.assert_array_equal(u != OUTSIDE, inside)
    np.testing.assert_allclose(u[inside], expected_u[inside], atol=1e-3)
    np.testing.assert_allclose(v[inside], expected_v[inside], atol=1e-3)


@both
@pytest.mark.parametrize('is_full_turn', [True, False])
def test_a_lidar_projects_by_azimuth_and_elevation(call, is_full_turn):
    columns = 1024 if is_full_turn else 300
    step, lowest = 2 * math.pi / 1024, (0.0 if is_full_turn else -0.5)
    sensor = [0.3, step, 0.4, 0.8 / 31, columns, 32, 1024, lowest]
    (x, y, z), u, v = projected(call, LIDAR, sensor)
    column = (0.3 - np.arctan2(y, x)) / step
    column = (column - lowest) % 1024 + lowest
    row = (0.4 - np.arctan2(z, np.hypot(x, y))) / (0.8 / 31)
    end = 1024 + lowest if is_full_turn else columns - 0.5
    inside = (row >= -0.5) & (row <= 31.5) & (column < end)
    near = np.minimum.reduce([abs(row + 0.5), abs(row - 31.5), abs(column - end)]) < 1e-2
    assert inside.sum() > 50
    np.testing.assert_array_equal((u != OUTSIDE)[~near], inside[~near])
    both_inside = inside & (u != OUTSIDE)
    turn = abs(u - column)[both_inside]
    assert np.minimum(turn, 1024 - turn).max() < 1e-2
    np.testing.assert_allclose(v[both_inside], row[both_inside], atol=1e-3)


@both
@pytest.mark.parametrize('num_beams', [2, 3, 16, 17, 18, 40])
def test_rows_of_few_and_many_uneven_beams_equal_an_interpolation(call, num_beams):
    rng = np.random.default_rng(num_beams)
    beams = np.cumsum(-rng.uniform(0.002, 0.02, num_beams)).astype(np.float32) + np.float32(0.2)
    beyond = rng.uniform(beams[-1] - 0.01, beams[0] + 0.01, 300).astype(np.float32)
    for part in (beyond, beams, beyond[np.abs(beyond - beams[num_beams // 2]) < 0.01]):
        rows = np.append(part, np.float32(np.nan))
        call(rows_of_table, beams, rows)
        between = np.clip(np.searchsorted(-beams, -part, side='right') - 1, 0, num_beams - 2)
        gap = (beams[between] - beams[between + 1]).astype(float)
        expected = between + (beams[between].astype(float) - part) / gap  # straight on beyond them
        np.testing.assert_allclose(rows[:-1], expected, atol=1e-4)
        assert np.isnan(rows[-1])
