# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects thinner than a voxel stay in the mesh of a lidar's range images."""

import numpy as np
import pytest

from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.sensors import LidarModel
from test.bench.mesh_error import distances_to_mesh
from test.tsdf.scenes import image_of, integrator

LIDAR = LidarModel(rows=32, columns=1024, vertical_fov_deg=30.0, max_range_m=40.0)
VOXEL_M = 0.2
SIZES = dict(voxel_size_m=VOXEL_M, truncation_m=0.6, max_range_m=40.0, threads=1)
BEYOND_M = 20.0


def ranges(at, radius_m, start=(0.0, 0.0)):
    """Return the ranges of vertical poles before a round wall, and which pixels are on a pole."""
    level = np.hypot(LIDAR.directions[..., 0], LIDAR.directions[..., 1]).astype(float)
    x, y = (LIDAR.directions[..., axis] / level for axis in (0, 1))
    nearest = np.full(level.shape, BEYOND_M)
    for place in np.asarray(at, float) - start:
        along = x * place[0] + y * place[1]
        aside_sq = place @ place - along**2
        depth = along - np.sqrt(np.maximum(radius_m**2 - aside_sq, 0.0))
        nearest = np.where((aside_sq < radius_m**2) & (along > 0.0), depth, nearest)
    return nearest / level, nearest < BEYOND_M


POLES = [(4.0, 0.1), (-5.0, 0.0), (0.3, 6.0), (3.0, -7.0), (-6.0, -6.0)]
"""The second is where the last column neighbours the first."""


@pytest.mark.parametrize('carve', [False, True])
@pytest.mark.parametrize('radius_m', [0.03, 0.05, 0.1])
def test_the_mesh_goes_through_the_points_of_thin_poles(radius_m, carve):
    one, points = integrator(**SIZES, carve=carve), []
    for number in range(6):
        T = np.eye(4)
        T[0, 3] = 0.2 * number
        range_m, on_pole = ranges(POLES, radius_m, T[:2, 3])
        one.integrate(image_of(LIDAR, range_m), T, number * 10**8)
        found = LIDAR.directions[on_pole] * range_m[on_pole, None] + T[:3, 3]
        points.append(found)
    points = np.concatenate(points).astype(float)
    for place in POLES:  # every pole was seen
        assert (np.hypot(*(points[:, :2] - place).T) < 2 * radius_m).sum() > 50
    mesher = Mesher(one.blocks)
    mesher.update()
    mesh = mesher.mesh()
    far = distances_to_mesh(points, mesh.vertices.astype(float)[mesh.triangles], VOXEL_M)
    assert (far <= 1.5 * VOXEL_M).mean() >= 0.95


def test_only_narrow_runs_before_farther_ones_are_thin():
    range_m = np.full((LIDAR.rows, LIDAR.columns), 10.0)
    step = 10.0 * 2.0 * np.pi / LIDAR.columns  # 6 cm between columns at 10 m
    range_m[:, 100:103] = 5.0  # 9 cm wide at 5 m
    range_m[:, 200:240] = 5.0  # 1.2 m
    range_m[:, 300:303] = 15.0  # a gap
    range_m[:, 400:403], range_m[:, 403:460] = 5.0, 4.0  # beside something nearer
    range_m[:, 500:503], range_m[:, 503:] = 5.0, np.nan
    range_m[:, [0, 1, -1]] = 5.0  # across the seam
    thin = image_of(LIDAR, range_m).thin(0.2, 3.5 * step / 2.0)
    columns = np.flatnonzero(thin.all(axis=0))
    assert columns.tolist() == [0, 1, 100, 101, 102, 500, 501, 502, LIDAR.columns - 1]
    assert thin.any(axis=0).sum() == len(columns)


def test_thin_objects_of_dynamic_labels_leave_no_surface():
    range_m, on_pole = ranges(POLES, 0.05)
    solid = {}
    for dynamic in ([], [7.0]):
        one = integrator(**SIZES, dynamic_labels=dynamic)
        image = image_of(LIDAR, range_m).with_images(label=np.where(on_pole, 7, -1))
        one.integrate(image, np.eye(4))
        row = one.blocks.find(np.floor(np.array([4.0, 0.1, 0.0]) / 1.6).astype(int))
        known = one.blocks.weight[row] > 0.0
        solid[len(dynamic)] = (known & (one.blocks.distance[row] < 0.3)).sum()
    assert solid[0] > 20
    assert solid[1] == 0


@pytest.mark.parametrize('pixel', [(16, 100), (3, 700), (30, 0)])
def test_voxels_about_a_thin_point_have_their_distance_along_its_ray(pixel):
    range_m = np.full((LIDAR.rows, LIDAR.columns), BEYOND_M)
    range_m[pixel] = 7.3
    one = integrator(**SIZES, carve=True)
    T = np.eye(4)
    T[:3, 3] = (31.37, -12.21, 1.83)
    one.integrate(image_of(LIDAR, range_m), T)
    ray = LIDAR.directions[pixel].astype(float)
    expected = {}
    for step in (-1.0, -0.5, 0.0, 0.5, 1.0):
        sample = T[:3, 3] / VOXEL_M + (7.3 / VOXEL_M + step) * ray
        for corner in np.ndindex(2, 2, 2):
            voxel = np.floor(sample - 0.5).astype(int) + corner
            offset = (voxel + 0.5) * VOXEL_M - T[:3, 3]
            along = offset @ ray
            if np.linalg.norm(offset - along * ray) <= 0.87 * VOXEL_M:
                expected[tuple(voxel)] = 7.3 - along
    assert len(expected) > 6
    for voxel, signed in expected.items():
        row = one.blocks.find(np.array(voxel) >> 3)
        x, y, z = np.array(voxel) & 7
        number = x + 8 * (y + 8 * z)
        assert one.blocks.weight[row, number] > 0.0
        assert one.blocks.distance[row, number] == pytest.approx(signed, abs=2e-5)
