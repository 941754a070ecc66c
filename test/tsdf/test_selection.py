# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T11: the selected blocks, against all blocks and all rays."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.kernels.integration import OBSERVED
from surfel_mapper.tsdf.selection import BlockSelection
from surfel_mapper.tsdf.sensors import CameraModel, LidarModel
from test.tsdf.scenes import image_of

SENSORS = {
    'camera': CameraModel(
        columns=48, rows=36, fx=40.0, fy=40.0, cx=24.0, cy=18.0, max_range_m=5.0
    ),
    'lidar': LidarModel(rows=16, columns=90, vertical_fov_deg=50.0, max_range_m=5.0),
}
SIZES = dict(voxel_size_m=0.125, truncation_m=0.3, voxels_per_side=4)


def random_pose(rng):
    q = rng.standard_normal(4)
    return pose_matrix(rng.uniform(-20.0, 20.0, 3), q / np.linalg.norm(q))


def random_image(sensor, rng, nearest_m=0.5):
    range_m = rng.uniform(nearest_m, 4.9, (sensor.rows, sensor.columns))
    range_m[rng.random(range_m.shape) < 0.1] = np.nan
    return image_of(sensor, range_m)


def everywhere(T, reach_m, size_m):
    """Return all blocks of a cube about a pose."""
    middle, half = np.floor(T[:3, 3] / size_m).astype(int), int(reach_m / size_m) + 2
    return middle + np.indices(3 * [2 * half + 1]).reshape(3, -1).T - half


@pytest.mark.parametrize('sensor', SENSORS)
def test_the_view_holds_every_block_with_a_voxel_observed(sensor):
    rng, sensor = np.random.default_rng(5), SENSORS[sensor]
    config = TsdfConfig(**SIZES, allocation='frustum')
    for _ in range(20):
        T, image = random_pose(rng), random_image(sensor, rng)
        chosen = {*map(tuple, BlockSelection(config).blocks(image, T).index)}
        one = Integrator(BlockMap(config))
        index = everywhere(T, 5.4, config.block_size_m)
        rows = one.blocks.place(index)
        none = np.full(len(one.blocks.head), -1), np.zeros((0, 64, 3), np.float32)
        found, _ = one._fuse(image, T, 0, index, rows, none)
        observed = found[:, OBSERVED]
        assert (observed > 0).sum() > 100
        assert {*map(tuple, index[observed > 0])} <= chosen
        touched = BlockSelection(TsdfConfig(**SIZES)).blocks(image, T).index
        assert {*map(tuple, touched)} <= chosen


@pytest.mark.parametrize('sensor', SENSORS)
def test_blocks_of_both_ways_hold_the_same(sensor):
    rng, sensor = np.random.default_rng(6), SENSORS[sensor]
    T, image = random_pose(rng), random_image(sensor, rng)
    maps = {}
    for allocation in ('band', 'frustum'):
        one = Integrator(BlockMap(TsdfConfig(**SIZES, allocation=allocation)))
        one.integrate(image, T)
        maps[allocation] = one.blocks
    band, frustum = maps.values()
    rows = band.rows()
    other = frustum.find(band.index(rows))
    assert len(rows) > 100
    assert (other >= 0).all()
    assert np.array_equal(band.field[rows], frustum.field[other])


@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('extra_m', [0.0, 0.4])
def test_rays_touch_every_block_of_their_band(sensor, extra_m):
    rng, sensor = np.random.default_rng(7), SENSORS[sensor]
    config = TsdfConfig(**SIZES, carve=False, extra_distance_m=extra_m)
    for _ in range(5):
        # So far away pixels are more than half a voxel apart, and none is passed over.
        T, image = random_pose(rng), random_image(sensor, rng, nearest_m=2.5)
        chosen = {*map(tuple, BlockSelection(config).blocks(image, T).index)}
        range_m = image.range_m[:, : sensor.columns]
        rays = sensor.directions.astype(float) @ T[:3, :3].T
        sampled = set()
        for along in np.linspace(-0.3, 0.3 + extra_m, 40):
            at = np.maximum(range_m + along, sensor.min_range_m)[..., None] * rays + T[:3, 3]
            sampled |= {*map(tuple, np.floor(at[range_m > 0] / config.block_size_m).astype(int))}
        assert sampled <= chosen
        assert len(chosen) < 1.2 * len(sampled)


def test_through_a_dense_image_rays_are_thinned_but_no_voxel_of_the_surface_is_lost():
    sensor = CameraModel(columns=320, rows=240, fx=260.0, fy=260.0, cx=160.0, cy=120.0)
    row, column = np.indices((240, 320))
    image = image_of(sensor, 2.0 + 0.3 * np.sin(column / 30.0) + 0.2 * np.cos(row / 20.0))
    counts = {}
    for allocation in ('band', 'frustum'):
        one = Integrator(
            BlockMap(
                TsdfConfig(
                    voxel_size_m=0.04, truncation_m=0.12, carve=False, allocation=allocation
                )
            )
        )
        one.integrate(image, np.eye(4))
        rows = one.blocks.rows()
        near = (abs(one.blocks.distance[rows]) < 0.04) & (one.blocks.weight[rows] > 0)
        counts[allocation] = near.sum()
    assert counts['band'] == counts['frustum'] > 4000


def test_without_a_measurement_there_is_no_block():
    for allocation in ('band', 'frustum'):
        image = image_of(SENSORS['lidar'], np.full((16, 90), np.nan))
        config = TsdfConfig(**SIZES, allocation=allocation)
        found = BlockSelection(config).blocks(image, np.eye(4))
        assert (found.index.shape, found.near.shape, found.thin.shape) == ((0, 3), (0,), (0, 3))


@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('allocation', ['band', 'frustum'])
def test_blocks_near_the_surface_are_those_of_the_band(sensor, allocation):
    rng, sensor = np.random.default_rng(9), SENSORS[sensor]
    config = TsdfConfig(**SIZES, carve=True, allocation=allocation)
    selection = BlockSelection(config)  # its marks are used again
    for _ in range(5):
        T, image = random_pose(rng), random_image(sensor, rng, nearest_m=2.5)
        selected = selection.blocks(image, T)
        index, near = selected.index, selected.near
        range_m = image.range_m[:, : sensor.columns]
        rays = sensor.directions.astype(float) @ T[:3, :3].T
        sampled = set()
        for along in np.linspace(-0.3, 0.3, 40):
            at = (range_m + along)[..., None] * rays + T[:3, 3]
            sampled |= {*map(tuple, np.floor(at[range_m > 0] / config.block_size_m).astype(int))}
        found = {*map(tuple, index[near])}
        assert sampled <= found
        assert len(found) < 1.2 * len(sampled)
        assert len(found) < 0.95 * len(index)


def test_clearing_pixels_have_no_blocks_near_a_surface():
    image = image_of(SENSORS['camera'], np.full((36, 48), np.inf))
    found = BlockSelection(TsdfConfig(**SIZES, carve=True)).blocks(image, np.eye(4))
    assert len(found.index) > 100
    assert not found.near.any()
    assert BlockSelection(TsdfConfig(**SIZES, carve=False)).blocks(image, np.eye(4)).near.all()
