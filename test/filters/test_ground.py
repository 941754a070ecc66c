# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Ground: floors, ramps, walls and tables, seen by a tilted sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from test.filters.examples import filter_of, scan_of

FLOOR, RAMP, WALL, TABLE = range(4)


def pose(tilt_deg=0.0, height_m=0.0):
    """Return the pose of a sensor at a height, tilted about y."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, height_m], [0, 0, 0, 1.0]])


def room(tilt_deg=0.0, height_m=1.6, seed=1):
    """Return a scan of a floor, a ramp of 20 deg, a wall and a table, far from one another."""
    rng = np.random.default_rng(seed)
    sides = rng.uniform(0.0, 1.0, (4, 4000, 2))
    u, v = np.moveaxis(sides, 2, 0)
    zero = np.zeros(4000)
    slope = np.tan(np.radians(20.0))
    surfaces = [
        np.stack([8.0 * u[0], 8.0 * v[0], zero], axis=1),
        np.stack([20.0 + 4.0 * u[1], 4.0 * v[1], 4.0 * slope * u[1]], axis=1),
        np.stack([zero - 5.0, 4.0 * u[2], 4.0 * v[2]], axis=1),
        np.stack([-12.0 + 2.0 * u[3], 2.0 * v[3], zero + 1.02], axis=1),
    ]
    points = np.concatenate(surfaces)
    T_map_sensor = pose(tilt_deg, height_m)
    in_sensor = (points - T_map_sensor[:3, 3]) @ T_map_sensor[:3, :3]
    scan = scan_of(in_sensor.astype(np.float32), surface=np.repeat(range(4), 4000))
    return replace(scan, T_map_sensor=T_map_sensor, T_base_sensor=pose(0.0, height_m))


def shares(scan, **settings):
    """Return the share of the points of each surface that are ground."""
    found = filter_of('ground', **settings).apply(scan)
    is_ground, surface = found.columns['ground'], found.columns['surface']
    return [round(float(is_ground[surface == each].mean()), 2) for each in range(4)]


@pytest.mark.parametrize('tilt_deg', [0.0, 30.0])
def test_level_surfaces_are_ground_however_the_sensor_is_tilted(tilt_deg):
    floor, ramp, wall, table = shares(room(tilt_deg))
    assert (floor > 0.97, ramp, wall, table > 0.9) == (True, 0.0, 0.0, True)


def test_a_ramp_is_ground_where_the_slope_may_be_as_steep():
    assert shares(room(), max_slope_deg=19.0)[RAMP] == 0.0
    assert shares(room(), max_slope_deg=21.0)[RAMP] > 0.95
    assert shares(room(), max_slope_deg=90.0)[WALL] > 0.97


@pytest.mark.parametrize('tilt_deg', [0.0, 30.0])
def test_surfaces_above_the_height_limit_are_no_ground(tilt_deg):
    scan = room(tilt_deg)
    scan = replace(scan, T_base_sensor=scan.T_map_sensor)  # the robot stands on the floor
    floor, _, _, table = shares(scan, max_height_m=0.5)
    assert (floor > 0.97, table) == (True, 0.0)


def test_either_part_can_be_kept():
    scan = room()
    mark = filter_of('ground').apply(scan).columns['ground']
    assert mark.dtype == np.uint8
    ground = filter_of('ground', keep_part='ground').apply(scan)
    rest = filter_of('ground', keep_part='rest').apply(scan)
    np.testing.assert_array_equal(ground.points, scan.points[mark == 1])
    np.testing.assert_array_equal(rest.points, scan.points[mark == 0])
    np.testing.assert_array_equal(rest.columns['surface'], scan.columns['surface'][mark == 0])


def test_up_may_be_that_of_the_robot_or_of_the_sensor():
    scan = room(30.0)
    assert shares(scan, up='sensor')[FLOOR] == 0.0
    assert shares(replace(scan, T_base_sensor=scan.T_map_sensor), up='base')[FLOOR] > 0.97


def test_a_thin_line_of_points_or_too_few_have_no_slope():
    line = np.stack([np.linspace(0.01, 0.49, 50), np.full(50, 0.1), np.zeros(50)], axis=1)
    corner = [[0.1, 0.1, 0.0], [0.4, 0.1, 0.0], [0.1, 0.4, 0.0], [0.4, 0.4, 0.0]]
    for points in (line, corner):
        assert not filter_of('ground').apply(scan_of(points)).columns['ground'].any()
    assert filter_of('ground', min_points=4).apply(scan_of(corner)).columns['ground'].all()


def test_an_unknown_pose_of_the_sensor_is_named():
    scan = room()
    with pytest.raises(FilterError, match="pose of 'sensor' in the fixed frame is not known"):
        filter_of('ground').apply(replace(scan, T_map_sensor=None))
    with pytest.raises(FilterError, match='in the base frame is not known'):
        filter_of('ground', up='base').apply(replace(scan, T_base_sensor=None))
    with pytest.raises(FilterError, match=r'so max_height_m has no origin; set frames\.base_to'):
        filter_of('ground', max_height_m=1.0).apply(replace(scan, T_base_sensor=None))
