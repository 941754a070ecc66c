# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Outlines and triangles of patches: rings around masks, their direction and their areas."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config.models import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.outlines import outline, rings, simplified, triangles
from test.models.scenes import A, room, sheet, VIEW


def area(ring):
    """Return the signed area within a ring, positive against the clock."""
    after = np.roll(ring, -1, axis=0)
    return 0.5 * (ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum()


def test_a_square_is_one_ring_against_the_clock():
    (ring,) = rings(np.ones((1, 1), bool))
    assert area(ring) == 1.0
    assert {tuple(corner) for corner in ring} == {(0, 0), (1, 0), (1, 1), (0, 1)}


def test_a_hole_is_a_ring_of_its_own_with_the_clock():
    mask = np.ones((5, 4), bool)
    mask[2, 1:3] = False
    assert sorted(area(ring) for ring in rings(mask)) == [-2.0, 20.0]


@pytest.mark.parametrize('flip', [False, True])
def test_squares_that_touch_at_a_corner_are_two_rings(flip):
    mask = np.eye(2, dtype=bool)
    assert [area(ring) for ring in rings(mask[::-1] if flip else mask)] == [1.0, 1.0]


def test_the_rings_of_any_mask_enclose_what_is_covered():
    rng = np.random.default_rng(9)
    for _ in range(50):
        mask = rng.random((7, 9)) < 0.6
        assert sum(area(ring) for ring in rings(mask)) == mask.sum()
    assert rings(np.zeros((3, 3), bool)) == []


def test_points_on_a_side_of_a_ring_go_and_its_corners_stay():
    side = np.arange(10.0)
    square = np.concatenate([
        np.stack([side, 0 * side], 1), np.stack([0 * side + 10, side], 1),
        np.stack([10 - side, 0 * side + 10], 1), np.stack([0 * side, 10 - side], 1),
    ])  # fmt: skip
    assert area(simplified(square)) == 100.0
    assert len(simplified(square)) == 4


def test_outlines_and_triangles_of_a_plane_with_a_hole_have_its_area_and_direction():
    cloud = sheet(2.0, 2.0, A / 2)
    cloud = cloud[np.abs(cloud[:, :2]).max(axis=1) > 0.5]
    (plane,) = fit(cloud, ModelsConfig(voxel_size_m=A), (0, 0, 5)).planes
    found = outline(plane)
    areas = sorted(area(ring[:, :2]) for ring in found)
    assert len(areas) == 2
    assert areas[0] < 0.0 < areas[1]
    assert sum(areas) == pytest.approx(3.0, abs=0.3)
    assert max(np.abs(ring[:, 2]).max() for ring in found) < 1e-9
    vertices, faces = triangles(plane)
    sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    cross = np.cross(sides[:, 0], sides[:, 1])
    assert (cross[:, 2] > 0.0).all()
    assert 0.5 * cross[:, 2].sum() == pytest.approx(sum(areas), abs=0.1)


def test_triangles_of_surfaces_face_along_their_normals():
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    assert model.surfaces
    for surface in model.surfaces:
        vertices, faces = triangles(surface)
        sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
        assert (np.cross(sides[:, 0], sides[:, 1]) @ surface.normal > 0.0).all()
