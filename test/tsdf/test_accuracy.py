# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T1 to T4, T10: distances and zero levels of images against surfaces with known equations."""

import numpy as np
import pytest

from surfel_mapper.tsdf.sensors import CameraModel
from test.tsdf.scenes import fused, image_of, plane, sphere, VGA, voxels, zero_crossings

ANGLES = (0.0, 45.0, 70.0)


def interior(sensor, points):
    """
    Return a mask of the points in the middle of the view of a camera.

    60 pixels are 6.5 deg: towards the edges of the image rays meet the plane at other angles.
    """
    u = sensor.fx * points[:, 0] / points[:, 2] + sensor.cx
    v = sensor.fy * points[:, 1] / points[:, 2] + sensor.cy
    return (abs(u - 320) < 60) & (abs(v - 240) < 60)


@pytest.mark.parametrize(
    ('max_difference_m', 'bounds'),
    [(0.2, (1e-4, 1e-4, 1e-4)), (-1.0, (0.002, 0.008, 0.015))],
    ids=['adaptive', 'nearest'],
)
def test_distances_to_a_plane_are_those_along_the_rays(max_difference_m, bounds, monkeypatch):
    monkeypatch.setattr('surfel_mapper.tsdf.integrator.MAX_DIFFERENCE_M', max_difference_m)
    for angle, bound in zip(ANGLES, bounds, strict=True):
        range_m, normal = plane(VGA, angle)
        sizes = dict(voxel_size_m=0.05, truncation_m=0.15)
        blocks = fused(image_of(VGA, range_m), **sizes)
        points, D, _ = voxels(blocks)
        d = np.linalg.norm(points, axis=1)
        truth = 2.0 * normal[2] / (points @ normal) * d - d
        inside = interior(VGA, points) & (abs(truth) < 0.14)
        error = abs(D - truth)[inside]
        assert inside.sum() > 50
        found = np.percentile(error, 99) if max_difference_m > 0.0 else error.max()
        assert found <= bound, angle


def off_plane(blocks, normal):
    """Return the vertices in the middle of the view, and their plane distances, voxels."""
    vertices = zero_crossings(blocks)
    vertices = vertices[interior(VGA, vertices)]
    return vertices, abs(vertices @ normal - 2.0 * normal[2]) / 0.05


def test_the_zero_level_of_a_plane_lies_on_it():
    for angle, bound in zip(ANGLES, (0.005, 0.006, 0.0005 + 0.0166), strict=True):
        range_m, normal = plane(VGA, angle)
        blocks = fused(image_of(VGA, range_m), voxel_size_m=0.05, truncation_m=0.15)
        vertices, error = off_plane(blocks, normal)
        assert len(vertices) > 20
        assert error.max() <= bound, angle
        assert error.mean() <= 0.012, angle


def test_at_70_deg_the_error_is_that_of_straight_edges_through_exact_distances():
    # Along an edge of length h across the rays, the distance along the ray, s = R - d, has
    # s'' / s' = 2 x / d^2 - 2 n_x / D where it is 0, D = 2 m cos 70 deg being the plane's distance
    # from the sensor. The straight line between the ends crosses 0 up to h^2 / 8 |s'' / s'| off,
    # n_x of it across the plane: 0.0164 voxels in the middle of the view, and no less for any
    # sensor or interpolation. The images add less than a thousandth of a voxel.
    range_m, normal = plane(VGA, 70.0)
    blocks = fused(image_of(VGA, range_m), voxel_size_m=0.05, truncation_m=0.15)
    vertices, error = off_plane(blocks, normal)
    d_sq = np.sum(vertices**2, axis=1)
    bend = 2.0 * vertices[:, 0] / d_sq - 2.0 * normal[0] / (2.0 * normal[2])
    bound = 0.05**2 / 8.0 * abs(bend) * normal[0] / 0.05
    assert np.median(bound) == pytest.approx(0.0164, abs=2e-4)
    assert (error <= 1.03 * bound + 0.001).all()  # 3 % for the third derivative

    points, _, _ = voxels(blocks)
    d = np.linalg.norm(points, axis=1)
    exact = np.clip(2.0 * normal[2] / (points @ normal) * d - d, -0.15, 0.15)
    rows = blocks.rows()
    distance = blocks.distance[rows]
    distance[blocks.weight[rows] > 0.0] = exact
    blocks.distance[rows] = distance
    by_exact, least = off_plane(blocks, normal)
    assert 0.0163 < least.max() < 0.0167
    assert abs(by_exact - vertices).max() <= 0.001 * 0.05


def test_the_zero_level_of_a_ball_lies_on_it_and_not_behind_its_silhouette():
    centre = np.array([0.0, 0.0, 2.0])
    blocks = fused(image_of(VGA, sphere(VGA, centre, 0.5)), voxel_size_m=0.05, truncation_m=0.15)
    vertices = zero_crossings(blocks)
    error = abs(np.linalg.norm(vertices - centre, axis=1) - 0.5)
    assert len(vertices) > 400
    assert error.mean() <= 0.03 * 0.05
    assert np.percentile(error, 95) <= 0.08 * 0.05
    # The silhouette is seen where rays touch: at (4 - 0.25) / 2 m depth.
    assert vertices[:, 2].max() <= (4.0 - 0.25) / 2.0 + 0.05


def test_a_surface_of_one_range_has_a_zero_level():
    sensor = CameraModel(columns=200, rows=150, fx=160.0, fy=160.0, cx=100.0, cy=75.0)
    blocks = fused(
        image_of(sensor, np.full((sensor.rows, sensor.columns), 2.0)),
        voxel_size_m=0.1,
        truncation_m=0.3,
    )
    vertices = zero_crossings(blocks)
    assert len(vertices) > 200
    assert abs(np.linalg.norm(vertices, axis=1) - 2.0).max() < 0.005


def test_no_false_surface_joins_a_near_and_a_far_wall_unless_all_is_mixed(monkeypatch):
    row, column = np.indices((480, 640))  # a slanted edge, so that voxels lie about it anyhow
    depth = np.where(column + 0.37 * row < 400, 1.0, 3.0)
    curtain = {}
    for max_difference_m in (0.2, 1e9):
        monkeypatch.setattr('surfel_mapper.tsdf.integrator.MAX_DIFFERENCE_M', max_difference_m)
        blocks = fused(
            image_of(VGA, depth * VGA.ray_length),
            voxel_size_m=0.02,
            truncation_m=0.1,
        )
        points, D, _ = voxels(blocks)
        # Surface between the walls: 1 + tau < z + s < 3 - tau.
        z = points[:, 2] * (1.0 + D / np.linalg.norm(points, axis=1))
        curtain[max_difference_m] = ((abs(D) < 0.09) & (z > 1.1) & (z < 2.9)).sum()
    assert curtain[0.2] == 0
    assert curtain[1e9] > 0


def test_far_from_the_origin_distances_are_as_exact():
    T = np.eye(4)
    T[:3, 3] = [1e5, -1e5, 3e4]  # whole voxels of 1/16 m
    range_m, _ = plane(VGA, 30.0)
    sizes = dict(voxel_size_m=0.0625, truncation_m=0.1875)
    here, there = fused(image_of(VGA, range_m), **sizes), fused(image_of(VGA, range_m), T, **sizes)
    found = here.index(here.rows()) + (T[:3, 3] / here.config.block_size_m).astype(int)
    rows = there.find(found)
    assert (rows >= 0).all()
    assert len(rows) == there.num_blocks
    assert abs(there.distance[rows] - here.distance[here.rows()]).max() < 1e-4
