# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Range images of surfaces with known equations, and the zero level of the field."""

import numpy as np

from surfel_mapper.config import TsdfConfig
from surfel_mapper.config.layers import LEAST_WEIGHT
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.range_image import from_ranges
from surfel_mapper.tsdf.sensors import CameraModel

VGA = CameraModel(columns=640, rows=480, fx=525.0, fy=525.0, cx=320.0, cy=240.0)
SMALL = CameraModel(columns=80, rows=60, fx=65.0, fy=65.0, cx=40.0, cy=30.0)
WIDE = CameraModel(columns=160, rows=120, fx=60.0, fy=60.0, cx=80.0, cy=60.0, max_range_m=30.0)


def lidar_rays(rows, columns, fov_deg):
    """Return unit vectors of a spinning lidar, (rows, columns, 3), from 180 deg on clockwise."""
    up = np.deg2rad(np.linspace(fov_deg / 2.0, -fov_deg / 2.0, rows))[:, None]
    around = np.pi - 2.0 * np.pi * np.arange(columns) / columns
    level = np.cos(up)
    z = np.broadcast_to(np.sin(up), (rows, columns))
    return np.stack([level * np.cos(around), level * np.sin(around), z], -1).astype(np.float32)


def plane(sensor, angle_deg, depth_m=2.0):
    """Return the ranges of a plane through (0, 0, depth), turned about y by an angle."""
    normal = np.array([np.sin(np.deg2rad(angle_deg)), 0.0, np.cos(np.deg2rad(angle_deg))])
    with np.errstate(divide='ignore'):
        range_m = depth_m * normal[2] / (sensor.directions.astype(float) @ normal)
    return np.where(range_m > 0, range_m, np.nan), normal


def sphere(sensor, centre, radius_m):
    """Return the ranges of a sphere seen from outside, nan beside it."""
    b = sensor.directions.astype(float) @ np.asarray(centre, float)
    under_root = b * b - np.dot(centre, centre) + radius_m**2
    with np.errstate(invalid='ignore'):
        return b - np.sqrt(under_root)


def integrator(**settings):
    """Return an integrator into an empty map."""
    return Integrator(BlockMap(TsdfConfig(**settings)))


def fused(image, T=None, **settings):
    """Return the blocks after one image."""
    one = integrator(**settings)
    one.integrate(image, np.eye(4) if T is None else T)
    return one.blocks


def voxels(blocks):
    """Return centres (K, 3), distances (K,) and weights (K,) of all voxels observed."""
    rows, config = blocks.rows(), blocks.config
    m = config.voxels_per_side
    local = np.indices((m, m, m)).reshape(3, -1)[::-1].T
    index = blocks.index(rows)[:, None] * m + local
    weights = blocks.weight[rows]
    seen = weights > 0
    return (index[seen] + 0.5) * config.voxel_size_m, blocks.distance[rows][seen], weights[seen]


def zero_crossings(blocks):
    """
    Return the zeros of the field on the edges of cubes whose corners are all observed, (K, 3) m.

    These are the vertices of marching cubes, found in a dense array without any of its tables.
    """
    config = blocks.config
    rows, m = blocks.rows(), config.voxels_per_side
    index = blocks.index(rows)
    low = index.min(axis=0)
    shape = (index.max(axis=0) - low + 1) * m
    D, W = np.zeros(shape), np.zeros(shape)
    for row, block in zip(rows, (index - low) * m, strict=True):
        part = tuple(slice(b, b + m) for b in block)
        D[part] = blocks.distance[row].reshape(m, m, m).T
        W[part] = blocks.weight[row].reshape(m, m, m).T
    least = np.float32(LEAST_WEIGHT)  # as weights are
    seen = least <= W
    cube = np.ones(np.array(shape) - 1, bool)
    for corner in np.ndindex(2, 2, 2):
        cube &= seen[tuple(slice(c, c + n) for c, n in zip(corner, cube.shape, strict=True))]
    found = []
    for axis in range(3):
        edge = np.zeros(shape, bool)  # of an edge from a voxel along the axis: in some cube?
        others = [a for a in range(3) if a != axis]
        for corner in np.ndindex(2, 2):
            place = [slice(None, n) for n in cube.shape]
            for a, c in zip(others, corner, strict=True):
                place[a] = slice(c, c + cube.shape[a])
            edge[tuple(place)] |= cube
        D0, D1 = D, np.roll(D, -1, axis)
        crosses = edge & ((D0 < 0) != (D1 < 0))
        at = np.argwhere(crosses).astype(float)
        at[:, axis] += D0[crosses] / (D0[crosses] - D1[crosses])
        found.append((at + 0.5 + low * m) * config.voxel_size_m)
    return np.concatenate(found)


def image_of(sensor, range_m):
    """Return the range image of ranges in the pixels of a sensor; nan: unknown, inf: free."""
    return from_ranges(sensor, np.asarray(range_m, np.float32))
