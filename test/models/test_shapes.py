# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Shapes of primitives: areas, boxes and ellipsoids against the true scene."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.multi_model import Gaussians
from surfel_mapper.models.shapes import (
    ellipsoid_corners,
    ellipsoid_frames,
    shape_of,
    Shapes,
    SIGMAS,
)
from test.models.live_scenes import of_points
from test.models.scenes import A, room, sheet, VIEW
from test.models.test_outlines import area

TILT = (0.3, -0.5, 0.8)


@pytest.fixture(scope='module')
def frame():
    """A tilted square frame: 2 m wide with a square hole of 1 m."""
    cloud = sheet(2.0, 2.0, A / 2)
    cloud = cloud[np.abs(cloud[:, :2]).max(axis=1) > 0.5]
    z = np.array(TILT) / np.linalg.norm(TILT)
    x = np.cross([0, 1.0, 0], z) / np.linalg.norm(np.cross([0, 1.0, 0], z))
    R = np.stack([x, np.cross(z, x), z])
    (plane,) = fit(cloud @ R + [5.0, 1.0, 2.0], ModelsConfig(voxel_size_m=A), (5, 1, 9)).planes
    return plane, R


def test_triangles_of_a_plane_with_a_hole_have_its_area(frame):
    shape = shape_of(frame[0])
    # no point is outside: cells are cut half a voxel beyond them, along 4 * 2 m + 4 * 1 m of rim
    assert 3.0 < shape.area_m2 < 3.0 + 12.0 * A
    local = [frame[0].to_local(ring)[:, :2] for ring in shape.rings]
    assert shape.area_m2 == pytest.approx(sum(area(ring) for ring in local), rel=1e-9)
    a, b = (shape.corners[:, k] - shape.corners[:, 0] for k in (1, 2))
    cross = np.cross(a, b)
    assert 0.5 * np.linalg.norm(cross, axis=1).sum() == pytest.approx(shape.area_m2)
    assert (cross @ frame[0].normal > 0.0).all()
    assert len(shape.rings) == 2
    assert not shape.is_curved


def test_no_triangle_of_a_plane_is_in_its_hole_or_beyond_its_rim(frame):
    shape, R = shape_of(frame[0]), frame[1]
    middles = (shape.corners.mean(axis=1) - [5.0, 1.0, 2.0]) @ R.T
    corners = (shape.corners.reshape(-1, 3) - [5.0, 1.0, 2.0]) @ R.T
    assert np.abs(middles[:, :2]).max(axis=1).min() > 0.5 - 2 * A
    assert np.abs(corners[:, :2]).max() < 1.0 + 2 * A
    assert np.abs(corners[:, 2]).max() < 1e-3 + A / 10


def test_box_of_a_plane_encloses_it(frame):
    shape = shape_of(frame[0])
    assert shape.centre == pytest.approx([5.0, 1.0, 2.0], abs=A)
    length_x, length_y, thickness = shape.high - shape.low
    assert thickness == 0.0
    # the frame of a square may be turned within its plane: its box is no larger than its diagonal
    assert min(length_x, length_y) > 2.0 - A
    assert max(length_x, length_y) < 2.0 * 2**0.5 + 4 * A


def test_small_board_on_the_edges_of_large_voxels_has_a_shape():
    board = sheet(0.04, 0.04, 0.002, centre=(0.0, 0.0, 0.5), sigma=5e-4)
    _, models = of_points(board, voxel_size_m=1.0)
    (plane,) = models.model.planes
    shape = shape_of(plane)
    reach = 0.02 + 0.25 * 1.0 + 2.0 / 255
    assert 0.04**2 < shape.area_m2 < (2.0 * reach) ** 2
    assert np.abs(shape.centre - [0.0, 0.0, 0.5]).max() < reach


def test_shapes_of_surfaces_are_curved():
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    for surface in model.surfaces:
        shape = shape_of(surface)
        flat = surface.grid.area_m2(4)
        assert shape.is_curved
        assert 0.95 < shape.area_m2 / flat < 2.5  # folds of more than 60 degrees are cut
        local = surface.to_local(shape.corners.reshape(-1, 3))
        assert local[:, 2] == pytest.approx(surface.heights(local[:, :2]), abs=1e-9)


def test_shapes_are_recomputed_for_new_versions_only():
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    shapes, versions = Shapes(), {patch.id: 1 for patch in model.patches}
    before = shapes.of(model, versions)
    after = shapes.of(model, {**versions, 2: 2})
    assert [shape.patch.id for shape in after] == [patch.id for patch in model.patches]
    assert [a is b for a, b in zip(before, after, strict=True)] == [
        patch.id != 2 for patch in model.patches
    ]


def gaussians(*covariances):
    number = len(covariances)
    return Gaussians(
        id=np.arange(number),
        num_points=np.full(number, 9),
        mean=np.arange(3.0 * number).reshape(-1, 3),
        covariance=np.array(covariances, float).reshape(-1, 3, 3),
    )


def test_corners_of_an_ellipsoid_are_two_sigma_from_its_mean():
    rng = np.random.default_rng(6)
    factor = rng.normal(size=(4, 3, 3))
    found = gaussians(*(factor @ np.swapaxes(factor, 1, 2)))
    corners = ellipsoid_corners(found) - found.mean[:, None]
    for covariance, offsets in zip(found.covariance, corners, strict=True):
        mahalanobis = np.einsum('ni,ij,nj->n', offsets, np.linalg.inv(covariance), offsets)
        assert np.sqrt(mahalanobis) == pytest.approx(np.full(12, SIGMAS))


def test_axes_of_an_ellipsoid_are_those_of_its_covariance():
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    R, half = ellipsoid_frames(gaussians(turn @ np.diag([4.0, 0.25, 1.0]) @ turn.T))
    assert half[0] == pytest.approx([2 * 0.5, 2 * 1.0, 2 * 2.0])
    assert np.abs(R[0].T @ turn) == pytest.approx(np.eye(3)[[1, 2, 0]], abs=1e-12)
    assert np.linalg.det(R[0]) == pytest.approx(1.0)


def test_degenerate_gaussians_have_ellipsoids():
    found = ellipsoid_corners(gaussians(np.zeros((3, 3)), np.diag([0.0, 0.0, 4.0])))
    assert np.array_equal(found[0], np.tile([0.0, 1.0, 2.0], (12, 1)))
    # the corners of the icosahedron nearest to an axis are 0.851 of it away from the middle
    along = found[1] - [3.0, 4.0, 5.0]
    assert np.abs(along[..., :2]).max() == 0.0
    assert 0.85 * 2 * SIGMAS < np.abs(along[..., 2]).max() <= 2 * SIGMAS
    assert ellipsoid_corners(gaussians()).shape == (0, 12, 3)
