# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T11: the selected blocks, against all blocks and all rays."""

import numpy as np

from surfel_mapper.config import TsdfConfig
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.kernels.integration import OBSERVED
from surfel_mapper.tsdf.selection import BlockSelection
from surfel_mapper.tsdf.sensors import CameraModel
from test.tsdf.scenes import image_of

CAMERA = CameraModel(columns=48, rows=36, fx=40.0, fy=40.0, cx=24.0, cy=18.0, max_range_m=5.0)
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


def test_a_new_block_beside_the_chosen_ones_has_no_voxel_near_a_surface():
    rng, sensor = np.random.default_rng(5), CAMERA
    config = TsdfConfig(**SIZES)
    for _ in range(5):
        T, image = random_pose(rng), random_image(sensor, rng, nearest_m=2.5)
        chosen = {*map(tuple, BlockSelection(config).blocks(image, T).index)}
        one = Integrator(BlockMap(config))
        index = everywhere(T, 5.4, config.block_size_m)
        rows = one.blocks.place(index)
        found = one._fuse(image, T, 0, index, rows)
        near = (abs(one.blocks.distance[rows]) < 0.06) & (one.blocks.weight[rows] > 0)
        assert near.sum() > 100
        share = near.any(axis=1).sum()
        missed = {*map(tuple, index[near.any(axis=1)])} - chosen
        assert (found[:, OBSERVED] > 0).sum() > 100
        assert len(missed) <= 0.02 * share


def test_rays_touch_every_block_of_their_band():
    rng, sensor = np.random.default_rng(7), CAMERA
    config = TsdfConfig(**SIZES, carve_m=0.0)
    for _ in range(5):
        # So far away pixels are more than half a voxel apart, and none is passed over.
        T, image = random_pose(rng), random_image(sensor, rng, nearest_m=2.5)
        chosen = {*map(tuple, BlockSelection(config).blocks(image, T).index)}
        range_m = image.range_m
        rays = sensor.directions.astype(float) @ T[:3, :3].T
        sampled = set()
        for along in np.linspace(-0.3, 0.3, 40):
            at = np.maximum(range_m + along, sensor.min_range_m)[..., None] * rays + T[:3, 3]
            sampled |= {*map(tuple, np.floor(at[range_m > 0] / config.block_size_m).astype(int))}
        assert sampled <= chosen
        assert len(chosen) < 1.2 * len(sampled)


def test_carving_reaches_all_but_corners_of_blocks_along_the_rays():
    sensor = CameraModel(
        columns=512, rows=256, fx=250.0, fy=250.0, cx=256.0, cy=128.0, max_range_m=20.0
    )
    rng = np.random.default_rng(8)
    range_m = np.repeat(np.repeat(rng.uniform(2.0, 19.0, (8, 16)), 32, 0), 32, 1)
    image, T = image_of(sensor, range_m), random_pose(rng)
    config = TsdfConfig(voxel_size_m=0.1, truncation_m=0.3)
    chosen = BlockSelection(config).blocks(image, T).index
    keys = {*map(tuple, chosen)}
    rays = sensor.directions.astype(float) @ T[:3, :3].T
    size, deep, missed = config.block_size_m, 0, 0
    for along in np.linspace(0.0, 1.0, 60):
        at = (0.5 + along * (range_m - 0.5))[..., None] * rays + T[:3, 3]
        block, place = np.divmod(at.reshape(-1, 3), size)
        # Deeper inside than the corners that may be missed.
        inside = (abs(place - size / 2) < size / 4).all(axis=1)
        found = {*map(tuple, block[inside].astype(int))}
        deep += len(found)
        missed += len(found - keys)
    assert deep > 5_000
    assert missed == 0


def test_without_a_measurement_there_is_no_block():
    image = image_of(CAMERA, np.full((36, 48), np.nan))
    found = BlockSelection(TsdfConfig(**SIZES)).blocks(image, np.eye(4))
    assert (found.index.shape, found.near.shape) == ((0, 3), (0,))


def test_blocks_near_the_surface_are_those_of_the_band():
    rng, sensor = np.random.default_rng(9), CAMERA
    config = TsdfConfig(**SIZES, carve_m=20.0)
    selection = BlockSelection(config)  # its marks are used again
    for _ in range(5):
        T, image = random_pose(rng), random_image(sensor, rng, nearest_m=2.5)
        selected = selection.blocks(image, T)
        index, near = selected.index, selected.near
        range_m = image.range_m
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
    image = image_of(CAMERA, np.full((36, 48), np.inf))
    found = BlockSelection(TsdfConfig(**SIZES, carve_m=20.0)).blocks(image, np.eye(4))
    assert len(found.index) > 100
    assert not found.near.any()
    assert BlockSelection(TsdfConfig(**SIZES, carve_m=0.0)).blocks(image, np.eye(4)).near.all()
