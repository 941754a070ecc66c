# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""map.png shows a map obliquely and from above, with a key, and states the surfels left out."""

import dataclasses

import numpy as np
from PIL import Image
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.mapping.surfels import concatenated, Surfels
from surfel_mapper.viz.discs import DrawnDiscs, shaded
from surfel_mapper.viz.picture import (
    draw_map,
    ground_lines,
    left_out,
    MapScene,
    square_m,
)

GROUND = np.rint(255.0 * shaded(np.array([0.0, 0.0, 1.0]))) / 255.0
"""Colour of level ground."""


def sheet(height_m, up, planarity, size_m=(20.0, 10.0), centre=(0.0, 0.0)):
    """Return a horizontal sheet of full 0.5 m voxels, its normals up (1) or down (-1)."""
    steps = [np.arange(-half + 0.25, half, 0.5) for half in np.array(size_m) / 2.0]
    x, y = (axis.ravel() for axis in np.meshgrid(*steps))
    position = np.column_stack([x + centre[0], y + centre[1], np.full(x.size, height_m)])
    num = len(position)
    return Surfels(
        position=position,
        normal=np.tile([0.0, 0.0, up], (num, 1)),
        planarity=np.full(num, planarity),
        curvature=np.zeros(num),
        eigenvalues=np.tile([0.0, 0.25 / 12.0, 0.25 / 12.0], (num, 1)),
        num_points=np.full(num, 9),
        voxel_index=np.floor(position / 0.5).astype(np.int32),
        quality=(np.zeros(num), np.full(num, 0.01), np.full(num, 0.5 / 3.0**0.5)),
        num_scans=np.ones(num, np.int64),
        size=np.full(num, 0.5),
    )


def drawn(tmp_path, surfels, **options):
    draw_map(surfels, tmp_path / 'map.png', **options)
    return np.asarray(Image.open(tmp_path / 'map.png').convert('RGB')) / 255.0


def num_pixels(image, colour):
    return int((np.abs(image - colour).max(axis=2) < 0.02).sum())


def scene_of(*sheets, trajectory=None):
    return MapScene.of(DrawnDiscs.of(concatenated(sheets)), trajectory)


def test_a_ceiling_does_not_hide_the_floor(tmp_path):
    floor, ceiling = sheet(0.0, 1.0, 1.0), sheet(5.0, -1.0, 0.0)
    image = drawn(tmp_path, concatenated([floor, ceiling]))

    assert num_pixels(image, GROUND) == num_pixels(drawn(tmp_path, floor), GROUND) > 100_000


def test_a_lamp_below_the_ceiling_is_cut_away_with_it():
    lamp = sheet(4.95, 1.0, 1.0, size_m=(1.0, 1.0))
    scene = scene_of(sheet(0.0, 1.0, 1.0), sheet(5.0, -1.0, 1.0), lamp)

    assert scene.hidden == 800 + 4
    assert scene.discs.position[:, 2].max() == 0.0
    text = left_out(scene, scene.oblique(), scene.plan(800))
    assert text.startswith('Drawn as 1,604 surfels, ')
    assert ', 804 of the ceiling, above 4.9 m, ' in text


def test_level_ground_is_of_one_colour_whatever_its_planarity(tmp_path):
    sheets = sheet(0.0, 1.0, 1.0)
    stripes = np.arange(len(sheets)) % 2.0
    image = drawn(tmp_path, dataclasses.replace(sheets, planarity=stripes))

    assert np.array_equal(image, drawn(tmp_path, sheets))
    assert num_pixels(image, GROUND) > 100_000


def test_light_is_that_of_the_level_frame(tmp_path):
    """The ground of a camera, y down, has the colour of ground."""
    R = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    level = sheet(0.0, 1.0, 1.0)
    camera = dataclasses.replace(level, position=level.position @ R.T, normal=level.normal @ R.T)

    assert num_pixels(drawn(tmp_path, camera), GROUND) > 100_000


def test_the_plan_has_the_longer_side_upwards_and_is_no_mirror_image():
    for size_m in ((40.0, 10.0), (10.0, 40.0)):
        scene = scene_of(sheet(0.0, 1.0, 1.0, size_m=size_m))
        camera = scene.plan(800)
        longer = np.eye(3)[int(size_m[1] > size_m[0])]
        np.testing.assert_allclose(camera.R_view_map[1], longer, atol=1e-12)
        assert np.linalg.det(camera.R_view_map) == pytest.approx(1.0)
        assert camera.contains(scene.discs.position).all()
        assert camera.height > 1.8 * camera.width


def test_the_plan_has_the_coordinates_of_the_fixed_frame(tmp_path):
    """The same picture, of larger numbers, far from zero."""
    floor = sheet(0.0, 1.0, 1.0)
    near, far = (
        drawn(tmp_path, floor, origin_m=origin) for origin in (np.zeros(3), [5e5, 5.4e6, 300.0])
    )
    assert far.shape[1] > near.shape[1]  # room for seven digits
    oblique = slice(None), slice(0, 1200)
    np.testing.assert_array_equal(near[oblique][:500], far[oblique][:500])


def test_most_of_a_picture_is_the_map_although_a_few_surfels_are_far(tmp_path):
    near = sheet(0.0, 1.0, 1.0)
    far = sheet(0.0, 1.0, 1.0, size_m=(0.5, 0.5), centre=(5000.0, 300.0))

    scene = scene_of(near, far)
    oblique, plan = scene.oblique(), scene.plan(700)

    outside = scene.left_out(oblique)
    assert scene.left_out(plan) == 1 <= outside < 0.05 * len(near)
    assert f': {outside} on the left, 1 on the right' in left_out(scene, oblique, plan)
    image = drawn(tmp_path, concatenated([near, far]))
    assert num_pixels(image, GROUND) > 0.25 * image[..., 0].size


def test_a_trajectory_beyond_the_map_is_in_view_or_the_note_says_so():
    floor = sheet(0.0, 1.0, 1.0)
    for end_m, is_whole in ((8.0, True), (12.0, True), (500.0, False)):
        way = np.column_stack([np.linspace(0.0, end_m, 9), np.zeros(9), np.ones(9)])
        scene = scene_of(floor, trajectory=way)
        oblique, plan = scene.oblique(), scene.plan(700)
        assert plan.contains(way).all() == is_whole
        assert ('part of the trajectory' in left_out(scene, oblique, plan)) == (not is_whole)


def test_the_trajectory_is_drawn_with_its_start_and_end(tmp_path):
    path = np.column_stack([np.linspace(-8.0, 8.0, 50), np.zeros(50), np.full(50, 1.0)])

    images = [drawn(tmp_path, sheet(0.0, 1.0, 1.0), trajectory=t) for t in (None, path)]

    red, green = (
        [(np.abs(i - np.array(colour) / 255.0).max(axis=2) < 0.02).sum() for i in images]
        for colour in ((214, 39, 40), (44, 160, 44))
    )
    assert red[0] == green[0] == 0
    assert red[1] > 2000
    assert green[1] > 200


def test_squares_of_the_ground_lie_on_it_and_behind_all_that_stands_on_it():
    scene = scene_of(sheet(0.0, 1.0, 1.0), sheet(3.0, 1.0, 1.0, size_m=(4.0, 4.0)))
    camera = scene.oblique()
    x, y = np.meshgrid(square_m(camera) * np.arange(-2.0, 2.1, 0.5), [0.25, 1.75])
    corners = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    at = (camera.projected(corners) - camera.limits[0]) * camera.px_per_m
    rows, columns = camera.height - 1 - at[:, 1].astype(int), at[:, 0].astype(int)

    on_floor = -corners @ camera.R_view_map[2]
    for in_front_m, is_seen in ((0.0, True), (1.0, False)):
        depth = np.full((camera.height, camera.width), np.inf, np.float32)
        depth[rows, columns] = on_floor - in_front_m
        strength = ground_lines(scene, camera, depth)[rows, columns]
        on_line = np.isclose(corners[:, 0] / square_m(camera) % 1.0, 0.0)
        assert ((strength > 0.1) == (on_line & is_seen)).all()


def test_surfels_without_a_normal_are_left_out(tmp_path):
    odd = sheet(1.0, 1.0, np.nan)
    odd.normal[:] = np.nan

    image = drawn(tmp_path, concatenated([sheet(0.0, 1.0, 1.0), odd]))

    assert num_pixels(image, GROUND) > 10_000


@pytest.mark.parametrize('num', [0, 1])
def test_a_map_of_few_surfels_is_a_picture(tmp_path, num):
    few = sheet(0.0, 1.0, 1.0).select(np.arange(num))

    assert drawn(tmp_path, few, trajectory=np.zeros((num, 3))).min() < 0.5


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(FileFormatError, match='nowhere'):
        draw_map(sheet(0.0, 1.0, 1.0), tmp_path / 'nowhere' / 'map.png')
