# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T16 for lidars: no seam, ground at grazing angles, no fat points."""

import numpy as np
import pytest

from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.sensors import LidarModel
from test.tsdf.scenes import fused, image_of, plane, sphere, VGA, voxels, zero_crossings

OS = LidarModel(rows=64, columns=1024, vertical_fov_deg=60.0, max_range_m=30.0)
SIZES = dict(voxel_size_m=0.2, truncation_m=0.6)


def cylinder(sensor, radius_m):
    """Return the ranges of a round wall about the sensor."""
    level = np.linalg.norm(sensor.directions[:, :, :2].astype(float), axis=2)
    return radius_m / level


def ground(sensor, height_m):
    """Return the ranges of the ground below the sensor, nan above the horizon."""
    down = -sensor.directions[:, :, 2].astype(float)
    range_m = np.where(down > 1e-3, height_m / np.maximum(down, 1e-3), np.nan)
    return np.where(range_m < 25.0, range_m, np.nan)


@pytest.mark.parametrize('first_azimuth_deg', [180.0, 37.0])
def test_a_round_wall_has_no_gap_at_the_seam(first_azimuth_deg):
    sensor = LidarModel(
        rows=64, columns=1024, vertical_fov_deg=60.0, first_azimuth_deg=first_azimuth_deg
    )
    mesher = Mesher(fused(image_of(sensor, cylinder(sensor, 4.0)), **SIZES))
    mesher.update()
    mesh = mesher.mesh()
    sides = np.sort(np.concatenate([mesh.triangles[:, [a, a - 1]] for a in range(3)]), axis=1)
    sides, count = np.unique(sides, axis=0, return_counts=True)
    open_ends = mesh.vertices[sides[count == 1].ravel()]
    assert len(mesh) > 5000
    assert count.max() == 2
    # The wall is seen up to 4 m tan(30 deg) = 2.3 m; it ends there and nowhere else.
    assert abs(open_ends[:, 2]).min() > 1.8
    azimuth = np.sort(np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]))
    assert np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi)).max() < 2 * 0.2 / 4.0
    error = abs(np.linalg.norm(mesh.vertices[:, :2], axis=1) - 4.0)
    assert error.max() < 0.1 * 0.2


def test_the_cosine_is_that_of_the_angle_to_the_plane():
    for angle in (0.0, 30.0, 60.0):
        range_m, normal = plane(VGA, angle)
        image = image_of(VGA, range_m).with_cosines(0.05)
        expected = abs(VGA.directions.astype(float) @ normal)
        inside = (image.range_m > 0) & (image.range_m < 5.0) & (expected > 0.4)
        inside[:20] = inside[-20:] = inside[:, :20] = inside[:, -20:] = False
        assert inside.sum() > 10_000
        assert np.percentile(abs(image.cosine - expected)[inside], 99) < 0.01
        assert image.cosine.min() >= 0.35 - 1e-6


def test_beyond_the_edge_of_a_thing_no_slope_is_seen():
    range_m = np.full((480, 640), 4.0)
    range_m[:, 300:310] = 2.0  # a pole
    cosine = image_of(VGA, range_m).with_cosines(0.05).cosine
    assert cosine[:, 295:315].min() > 0.9
    alone = np.full((480, 640), np.nan)
    alone[200, 300] = 2.0
    assert (image_of(VGA, alone).with_cosines(0.05).cosine == 1.0).all()


def test_with_cosines_distances_are_those_to_the_plane():
    for angle in (0.0, 45.0, 60.0):
        range_m, normal = plane(VGA, angle)
        sizes = dict(voxel_size_m=0.05, truncation_m=0.15, carve=False)
        points, D, _ = voxels(fused(image_of(VGA, range_m), **sizes, distance='to_plane'))
        truth = 2.0 * normal[2] - points @ normal
        u = VGA.fx * points[:, 0] / points[:, 2]
        inside = (abs(u) < 100) & (abs(truth) < 0.14)
        assert inside.sum() > 500
        assert np.percentile(abs(D - truth)[inside], 95) < 0.01, angle


def test_along_rays_the_ground_has_holes_that_cosines_close():
    image = image_of(OS, ground(OS, 1.53))
    near = {}
    for distance in ('along_ray', 'to_plane'):
        vertices = zero_crossings(fused(image, **SIZES, distance=distance, carve=False))
        away = np.linalg.norm(vertices[:, :2], axis=1)
        vertices = vertices[(away > 4.0) & (away < 9.0)]
        assert abs(vertices[:, 2] + 1.53).max() < 0.1
        near[distance] = len(np.unique(np.floor(vertices[:, :2] / 0.2), axis=0))
    area = np.pi * (9.0**2 - 4.0**2) / 0.2**2
    assert near['to_plane'] > 0.97 * area
    assert near['along_ray'] < 0.9 * area


def test_a_point_does_not_paint_voxels_far_from_its_ray():
    sensor = LidarModel(rows=16, columns=90, vertical_fov_deg=30.0)  # 4 deg from column to column
    ball = image_of(sensor, sphere(sensor, [10.0, 0.0, 0.0], 1.0))
    counts = {}
    for offset in (0.0, 0.5):
        points, _, _ = voxels(
            fused(ball, **SIZES, max_ray_offset_voxels=offset, interpolation='nearest')
        )
        rays = sensor.directions[ball.range_m[:, :-1] > 0].astype(float)
        off = np.linalg.norm(np.cross(points[:, None], rays[None]), axis=2).min(axis=1)
        counts[offset] = len(points)
        if offset:
            assert off.max() < 0.5 * 0.2 * 1.02
    assert counts[0.0] > 2 * counts[0.5] > 0
