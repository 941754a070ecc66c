# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A rendered image shows discs where geometry says, closed, if they face the viewer."""

import math

import numpy as np
import pytest

from surfel_mapper.viz.discs import BEYOND_CELL, DrawnDiscs
from surfel_mapper.viz.rendering import (
    Camera,
    CLOSING,
    direction,
    fitted,
    hollow_shade,
    rendered,
    round_length,
)
from test.viz.test_picture import sheet

RED, BLUE = np.array([[200, 0, 0], [0, 0, 200]], np.uint8)
DOWN = np.eye(3)


def disc(place, normal=(0.0, 0.0, 1.0), radius_m=1.0):
    return DrawnDiscs(np.array([place], float), np.array([normal], float), np.array([radius_m]))


def joined(*discs):
    columns = ('position', 'normal', 'radius_m')
    return DrawnDiscs(*(np.concatenate([getattr(d, c) for d in discs]) for c in columns))


def test_axes_of_a_view_are_a_rotation_with_the_viewer_where_the_angles_say():
    for yaw in np.radians([0.0, 30.0, 200.0]):
        R = direction(yaw, np.radians(40.0))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert R[2, 2] == pytest.approx(np.sin(np.radians(40.0)))
        assert np.arctan2(R[2, 1], R[2, 0]) % (2.0 * np.pi) == pytest.approx(yaw)
    np.testing.assert_allclose(direction(-np.pi / 2.0, np.pi / 2.0), np.eye(3), atol=1e-12)


def test_a_disc_covers_its_circle_at_its_depth():
    camera = Camera(DOWN, np.zeros(2), 80, 60, 10.0)

    image, depth = rendered(camera, disc((1.0, 0.5, 3.0), radius_m=1.0), RED[None])

    assert image[..., 3].sum() == pytest.approx(np.pi * (10.0 * (1.0 + CLOSING)) ** 2, rel=0.02)
    rows, columns = np.nonzero(image[..., 3] == 1.0)
    assert (rows.mean(), columns.mean()) == pytest.approx((29.5 - 5.0, 39.5 + 10.0), abs=0.5)
    assert (depth[rows, columns] == -3.0).all()
    np.testing.assert_allclose(image[25, 50, :3], RED / 255.0, atol=0.01)


def test_the_nearer_disc_hides_the_other_in_any_order():
    camera = Camera(DOWN, np.zeros(2), 40, 40, 10.0)
    for order in ([0, 1], [1, 0]):
        both = joined(disc((0, 0, 0)), disc((0, 0, 2))).select(order)
        image, _ = rendered(camera, both, np.stack([RED, BLUE])[order])
        np.testing.assert_allclose(image[20, 20, :3], BLUE / 255.0, atol=0.01)


def test_discs_that_face_away_are_left_out():
    camera = Camera(DOWN, np.zeros(2), 40, 40, 10.0)
    image, depth = rendered(camera, disc((0, 0, 2), normal=(0, 0, -1.0)), RED[None])
    assert image[..., 3].max() == 0.0
    assert np.isinf(depth).all()


@pytest.mark.parametrize('pitch_deg', [90.0, 42.0, 20.0])
def test_a_floor_of_full_voxels_has_no_gaps_and_the_depth_of_its_plane(pitch_deg):
    floor = DrawnDiscs.of(sheet(0.0, 1.0, 1.0, size_m=(20.0, 20.0)))
    R = direction(0.6, np.radians(pitch_deg))
    camera = fitted(R, np.full(2, -3.0), np.full(2, 3.0), 200, 200)

    image, depth = rendered(camera, floor, np.tile(RED, (len(floor), 1)))

    assert image[..., 3].min() == 1.0
    up = np.linspace(*(side[1] for side in camera.limits), 401)[::-1][:-1:2] * np.ones((200, 1))
    expected = up.T * R[1, 2] / R[2, 2]  # of z = 0
    np.testing.assert_allclose(depth, expected, atol=0.05)
    assert np.ptp(image[..., :3].reshape(-1, 3), axis=0).max() < 0.01  # no seams, no shade


def test_an_eye_sees_a_disc_as_large_as_its_distance_says():
    for distance in (4.0, 8.0):
        eye = np.array([0.0, 0.0, distance])
        camera = Camera(DOWN, np.zeros(2), 100, 100, 100.0, eye)
        image, depth = rendered(camera, disc((0, 0, 0), radius_m=1.0), RED[None])
        radius_px = (1.0 + CLOSING) * 100.0 / distance
        assert image[..., 3].sum() == pytest.approx(np.pi * radius_px**2, rel=0.03)
        assert depth[50, 50] == pytest.approx(distance)


def test_an_eye_sees_a_wall_closed_and_not_what_lies_behind_it():
    eye = np.array([0.0, 0.0, 2.0])
    camera = Camera(direction(0.3, 0.2), np.zeros(2), 100, 60, 60.0, eye)
    floor = DrawnDiscs.of(sheet(0.0, 1.0, 1.0, size_m=(60.0, 60.0)))
    behind = disc(eye + 3.0 * camera.R_view_map[2], normal=-camera.R_view_map[2])
    image, depth = rendered(camera, joined(floor, behind), np.tile(RED, (len(floor) + 1, 1)))
    near = np.isfinite(depth) & (depth < 10.0)
    assert image[near, 3].min() == 1.0
    assert near[-1].all()
    assert np.isfinite(rendered(camera, behind, RED[None])[1]).sum() == 0


@pytest.mark.parametrize('eye_m', [None, np.array([0.0, 0.0, 40.0])])
def test_a_disc_ends_one_voxel_beyond_its_cell(eye_m):
    scale = 10.0 if eye_m is None else 400.0
    camera = Camera(DOWN, np.zeros(2), 200, 200, scale, eye_m)
    large, small = disc((1.0, 2.0, 0.0), radius_m=8.0), disc((7.8, 7.8, 0.0), radius_m=0.01)
    shown = joined(large, small)
    shown = DrawnDiscs(
        shown.position, shown.normal, shown.radius_m, {'size': np.array([4.0, 0.5])}
    )

    image, _ = rendered(camera, shown, np.stack([RED, RED]))

    rows, columns = np.nonzero(image[:, :, 3] == 1.0)
    beyond_m = BEYOND_CELL * 0.5
    for low, high in (
        (columns.min() - 100, columns.max() - 99),
        (99 - rows.max(), 100 - rows.min()),
    ):
        assert (low / 10.0, high / 10.0) == pytest.approx((-beyond_m, 4.0 + beyond_m), abs=0.11)


def test_discs_of_unknown_cells_are_whole():
    camera, whole = Camera(DOWN, np.zeros(2), 80, 80, 10.0), disc((0.1, 0.1, 0.0), radius_m=2.0)
    unknown = DrawnDiscs(
        whole.position, whole.normal, whole.radius_m, {'size': np.array([np.nan])}
    )
    images = [rendered(camera, discs, RED[None])[0] for discs in (whole, unknown)]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize('slope', [0.0, 0.3, 2.0])
def test_a_plane_is_not_shaded_whatever_its_slope(slope):
    rows, columns = np.mgrid[:24, :31]
    depth = (5.0 + 0.1 * slope * (rows + columns)).astype(np.float32)
    np.testing.assert_allclose(hollow_shade(depth, 0.1), 1.0)


def test_a_valley_is_darker_than_its_sides_and_a_ridge_is_not():
    across = np.abs(np.arange(31) - 15) * 0.1
    # two units for pairs across the valley, of which each step has three of four
    dark = math.exp(-1.5 * 9 * (2.0 - 0.25) / 12.0)
    for sign, expected in ((-1.0, max(dark, 0.4)), (1.0, 1.0)):
        depth = np.tile(5.0 + sign * across, (24, 1)).astype(np.float32)
        assert hollow_shade(depth, 0.1)[12, 15] == pytest.approx(expected, rel=1e-4)


def test_shades_are_those_of_the_angle_at_any_distance_from_an_eye():
    near = np.tile(1.0 - 0.05 * np.abs(np.arange(31) - 15), (24, 1)).astype(np.float32)
    first, second = (hollow_shade(factor * near, 0.05 * factor * near) for factor in (1.0, 3.0))
    np.testing.assert_allclose(second, first, rtol=1e-5)
    assert first.min() < 0.75


def test_pixels_without_a_disc_shade_none():
    depth = np.full((9, 9), np.inf, np.float32)
    depth[4, 4] = 3.0
    np.testing.assert_array_equal(hollow_shade(depth, 0.1), 1.0)


def test_no_discs_are_an_empty_image():
    none = disc((0, 0, 0)).select(slice(0))
    image, _ = rendered(Camera(DOWN, np.zeros(2), 8, 6, 1.0), none, np.empty((0, 3), np.uint8))
    assert image.shape == (6, 8, 4)
    assert not image.any()


def test_round_lengths_are_at_most_the_given_one():
    lengths = [0.013, 0.1, 0.3, 1.0, 4.9, 5.0, 77.0, 1999.0]
    expected = [0.01, 0.1, 0.2, 1.0, 2.0, 5.0, 50.0, 1000.0]
    assert [round_length(length) for length in lengths] == pytest.approx(expected)
