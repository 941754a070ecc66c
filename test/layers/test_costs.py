# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Costs of ground whose slope and steps are known."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import Config, GridConfig
from surfel_mapper.layers.costs.traversability import OBSTACLE, traversability, UNKNOWN
from surfel_mapper.layers.layer import Moment
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper

H = 0.5
LIMITS = GridConfig(size_m=8.0, max_slope_deg=30.0, max_step_m=0.25, clearance_m=2.0)


def ground(height, low=-4.0, high=4.0, step=0.02):
    """Return points of a surface z = height(x, y)."""
    x, y = np.meshgrid(np.arange(low, high, step) + 0.01, np.arange(low, high, step) + 0.01)
    return np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)


def grid_of(*points, limits=LIMITS, center=(0.0, 0.0)):
    surfel_map = SurfelMap(H)
    surfel_map.add(np.concatenate(points))
    return traversability(surfel_map.surfels(5), H, center, limits)


def test_flat_ground_costs_nothing_and_what_was_not_seen_is_unknown():
    grid = grid_of(ground(lambda x, y: 0.1 + 0 * x, low=-1.0, high=1.0))
    assert grid.cost.shape == (16, 16)
    assert grid.cost.dtype == np.int8
    assert grid.resolution_m == H
    np.testing.assert_array_equal(grid.origin, [-4.0, -4.0])
    assert (grid.cost[6:10, 6:10] == 0).all()
    assert (grid.cost == UNKNOWN).sum() == 16 * 16 - 16


@pytest.mark.parametrize('slope_deg', [5.0, 15.0, 29.0])
@pytest.mark.parametrize('heading_deg', [0.0, 30.0, 90.0, 200.0])
def test_a_slope_costs_its_share_of_the_limit_and_is_no_step(slope_deg, heading_deg):
    c, s = np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))
    rise = np.tan(np.radians(slope_deg))
    grid = grid_of(ground(lambda x, y: 0.013 + rise * (c * x + s * y)))
    # a voxel that holds a sliver of the plane knows its slope less well
    inner = grid.cost[1:-1, 1:-1]
    assert np.median(inner) == pytest.approx(100 * slope_deg / 30.0, abs=2)
    assert inner.max() <= 100 * slope_deg / 30.0 + 10


def test_steeper_ground_is_an_obstacle():
    assert (grid_of(ground(lambda x, y: 0.7 * x)).cost == OBSTACLE).all()  # 35 deg


def test_a_step_costs_its_share_on_both_sides_of_it():
    grid = grid_of(ground(lambda x, y: 0.1 + 0.125 * (x > 1.0)))
    assert (grid.cost[:, :9] == 0).all()
    np.testing.assert_allclose(grid.cost[:, 9:11], 50, atol=1)
    assert (grid.cost[:, 11:] == 0).all()


def test_a_kerb_above_the_limit_a_hole_and_a_wall_are_obstacles():
    kerb = grid_of(ground(lambda x, y: 0.1 + 0.3 * (x > 1.0)))
    hole = grid_of(ground(lambda x, y: 0.1 - 0.7 * ((abs(x - 1.25) < 0.25) & (abs(y) < 0.5))))
    flat = ground(lambda x, y: 0.1 + 0 * x)
    upright = ground(lambda y, z: 1.2 + 0 * y, low=0.12, high=1.9)[:, [2, 0, 1]]
    wall = grid_of(flat, upright)
    assert (kerb.cost[:, 9:11] == OBSTACLE).all()
    assert hole.cost[8, 10] == hole.cost[8, 9] == OBSTACLE
    assert (wall.cost[9:11, 10] == OBSTACLE).all()
    assert wall.cost[4, 4] == 0


def test_a_surface_above_the_clearance_is_no_obstacle():
    flat = ground(lambda x, y: 0.1 + 0 * x)
    high, low = (flat + np.array([0.0, 0.0, height]) for height in (2.6, 1.6))
    assert (grid_of(flat, high).cost == 0).all()
    assert (grid_of(flat, low).cost == OBSTACLE).all()


def test_the_grid_is_about_the_place_asked_for_and_on_the_voxels():
    flat = ground(lambda x, y: 0.1 + 0 * x)
    grid = grid_of(flat, center=(2.6, -1.3))
    np.testing.assert_array_equal(grid.origin, [-1.5, -5.5])
    assert (grid.cost[3:, :11] == 0).all()
    assert (grid.cost[:3] == UNKNOWN).all()
    assert (grid.cost[:, 11:] == UNKNOWN).all()


def test_a_grid_is_due_when_the_map_or_the_cell_of_the_sensor_has_changed():
    mapper = Mapper(Config.from_mapping({'pose.source': 'identity', 'grid.rate_hz': 1.0}))
    (topic,) = mapper.layers['grid'].publications()

    def version(x, y, z=0.0):
        pose = np.eye(4)
        pose[:3, 3] = x, y, z
        return topic.version(Moment(T_map_sensor=pose))

    first = version(0.01, -0.01)
    assert version(0.49, -0.49, 9.0) == first
    assert len({first, version(0.51, -0.01), version(-0.01, -0.01), version(0.01, 0.01)}) == 4
    mapper.map.add(np.zeros((1, 3)))
    assert version(0.01, -0.01) != first


@pytest.mark.parametrize(('height_m', 'at_the_edge'), [(0.15, UNKNOWN), (0.75, OBSTACLE)])
def test_only_flat_surfels_tell_a_slope_and_any_tells_a_step(height_m, at_the_edge):
    def height(x, y):
        rough = height_m + 0.06 * (-1.0) ** np.floor(50.0 * x)  # 6 cm off, no plane
        return np.where(x < 0.0, rough, 0.1)

    grid = grid_of(ground(height))

    assert (grid.cost[:, :7] == UNKNOWN).all()
    assert (grid.cost[:, 7] == at_the_edge).all()
    assert (grid.cost[:, 9:] == 0).all()


def test_an_empty_map_is_unknown():
    surfels = SurfelMap(H).surfels()
    assert (traversability(surfels, H, (0.0, 0.0), LIMITS).cost == UNKNOWN).all()
