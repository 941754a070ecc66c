# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts on places from the points around their directions, against a twin in plain Python."""

import math

import numpy as np
import pytest

from surfel_mapper.layers.dynamic_objects.free_space import (
    FINEST_DEG,
    LEAST_CELLS,
    look_through,
    NUM_GRIDS,
    SEEN,
    THROUGH,
    UNKNOWN,
)
from test.tsdf.scenes import lidar_rays

MARGIN_M = 0.4


def cell_of(point, step_deg):
    """Return row and column of a direction."""
    x, y, z = map(float, point)
    up, around = math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))
    return int((90.0 - up) // step_deg), int((180.0 - around) // step_deg)


def twin(points, place):
    """Return the verdict on a place, from the cells of each grid in a dictionary."""
    distance, seen = math.dist(place, (0.0, 0.0, 0.0)), False
    for grid in range(NUM_GRIDS):
        step_deg, ranges = FINEST_DEG * 2**grid, {}
        for point in points:
            ranges.setdefault(cell_of(point, step_deg), []).append(math.dist(point, (0, 0, 0)))
        row, column = cell_of(place, step_deg)
        around = [
            (r, (column + c) % round(360 / step_deg)) for r in range(-2, 3) for c in (-1, 0, 1)
        ]
        nearest = {(r, c): min(ranges[row + r, c]) for r, c in around if (row + r, c) in ranges}
        known = sum(abs(r) <= 1 for r, _ in nearest)
        if known >= LEAST_CELLS and min(nearest.values()) > distance + MARGIN_M:
            return THROUGH
        here = min(ranges.get((row, column), [math.inf]))
        seen = seen or abs(here - distance) <= MARGIN_M
    return SEEN if seen else UNKNOWN


def test_verdicts_equal_those_of_the_twin():
    rng = np.random.default_rng(3)
    rays = lidar_rays(16, 90, 30.0).reshape(-1, 3)
    points = rays * np.where(rays[:, :1] > 0.0, 6.0, rng.uniform(3.0, 9.0, (len(rays), 1)))
    points = points[rng.random(len(points)) < 0.8]
    places = rays[::7] * rng.uniform(1.0, 9.0, (len(rays[::7]), 1))
    expected = [twin(points, place) for place in places]
    found = look_through(points, places, MARGIN_M)
    assert {SEEN, UNKNOWN, THROUGH} == set(expected)
    assert np.mean(found == expected) > 0.99  # others are on the border of two directions


@pytest.mark.parametrize(('rows', 'columns'), [(128, 1024), (64, 2048), (16, 900)])
def test_a_place_before_a_wall_is_seen_through_by_any_lidar(rows, columns):
    wall = 8.0 * lidar_rays(rows, columns, 30.0).reshape(-1, 3)
    places = lidar_rays(7, 11, 24.0).reshape(-1, 3)
    for range_m, verdict in ((4.0, THROUGH), (7.9, SEEN), (9.0, UNKNOWN)):
        assert set(look_through(wall, range_m * places, MARGIN_M).tolist()) == {verdict}


def test_nothing_is_known_beside_the_rays_or_without_points():
    wall = 8.0 * lidar_rays(64, 1024, 30.0).reshape(-1, 3)
    beside = np.array([[1.0, 0.0, 3.0], [0.0, 0.0, -2.0]])
    assert look_through(wall, beside, MARGIN_M).tolist() == [UNKNOWN, UNKNOWN]
    assert look_through(np.empty((0, 3)), beside, MARGIN_M).tolist() == [UNKNOWN, UNKNOWN]


def test_a_place_over_ground_at_a_grazing_angle_is_not_seen_through():
    rays = lidar_rays(64, 1024, 30.0).reshape(-1, 3)
    rays = rays[rays[:, 2] < -0.02]
    ground = rays * (-1.5 / rays[:, 2:])
    steps = np.linspace(5.5, 30.0, 200)
    places = np.column_stack([steps, np.zeros(200), np.full(200, -1.4)])
    assert THROUGH not in look_through(ground, places, MARGIN_M)
