# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The view of a map is level on its ground, below its ceiling, and without outliers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.framing import (
    best_direction,
    ceiling_m,
    ground_m,
    levelled,
    mass_box,
    upright,
)
from test.viz.test_picture import sheet
from test.viz.test_rendering import disc, joined


def room(height_m=3.0):
    """Return a floor and a ceiling, and walls that face the middle."""
    floor, ceiling = sheet(0.0, 1.0, 1.0), sheet(height_m, -1.0, 1.0)
    walls = [
        disc((x, y, z), normal=(-np.sign(x), 0.0, 0.0), radius_m=0.3)
        for x in (-10.0, 10.0)
        for y in np.arange(-5.0, 5.0, 0.5)
        for z in np.arange(0.5, height_m, 0.5)
    ]
    return joined(DrawnDiscs.of(floor), DrawnDiscs.of(ceiling), *walls)


def turned(discs, R):
    return DrawnDiscs(discs.position @ R.T, discs.normal @ R.T, discs.radius_m)


@pytest.mark.parametrize('tilt_deg', [0.0, 3.0, 25.0])
def test_a_tilted_map_is_upright_to_the_tilt(tilt_deg):
    R_tilted = Rotation.from_euler('yx', [tilt_deg, 0.5 * tilt_deg], degrees=True).as_matrix()

    R = upright(turned(room(), R_tilted))

    np.testing.assert_allclose(R @ R_tilted @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[0, 0] > 0.8  # x is kept


def test_the_ground_of_a_camera_is_where_its_y_points():
    R_camera = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    wide = joined(*(room() for _ in range(1)))
    keep = wide.normal[:, 2] > -0.5  # a camera below a ceiling sees it seldom
    R = upright(turned(wide.select(keep), R_camera))
    np.testing.assert_allclose(R @ R_camera @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-9)


def test_only_maps_in_the_frame_of_a_camera_are_levelled():
    floor = DrawnDiscs.of(sheet(0.0, 1.0, 1.0))
    np.testing.assert_array_equal(levelled(floor), np.eye(3))
    R_tilted = Rotation.from_euler('x', 20.0, degrees=True).as_matrix()
    tilted = replace(floor, normal=floor.normal @ R_tilted.T)
    np.testing.assert_array_equal(levelled(tilted), np.eye(3))
    R_camera = Rotation.from_euler('x', 80.0, degrees=True).as_matrix()  # pitched by 10 deg
    camera = replace(floor, normal=floor.normal @ R_camera.T)
    np.testing.assert_allclose(levelled(camera)[2], R_camera[:, 2], atol=1e-9)


def test_a_map_without_ground_stays_as_it_is():
    wall = disc((0.0, 0.0, 0.0), normal=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(upright(wall), np.eye(3))
    np.testing.assert_allclose(upright(wall.select(slice(0))), np.eye(3))


def test_a_ceiling_is_cut_and_a_floor_seen_from_below_is_not():
    assert ceiling_m(room(), 1.5) == pytest.approx(2.9)
    assert ceiling_m(room(), 5.0) == np.inf  # the sensor was above
    street = DrawnDiscs.of(sheet(0.0, 1.0, 1.0))
    assert ceiling_m(street, 1.5) == np.inf
    sign = disc((0.0, 0.0, 4.0), normal=(0.0, 0.0, -1.0))
    assert ceiling_m(joined(street, sign), 1.5) == np.inf
    balconies = DrawnDiscs.of(sheet(4.0, -1.0, 1.0, centre=(15.0, 0.0)))  # over a quarter
    assert ceiling_m(joined(street, balconies), 1.5) == np.inf


def test_the_ground_is_the_lower_level_surface():
    table = DrawnDiscs.of(sheet(0.8, 1.0, 1.0, size_m=(2.0, 1.0)))
    assert ground_m(joined(room(), table)) == pytest.approx(0.0)
    assert ground_m(room().select(slice(0))) == 0.0


def test_sparse_outliers_do_not_enlarge_the_box():
    rng = np.random.default_rng(1)
    near = rng.uniform([-10.0, -5.0], [10.0, 5.0], (2000, 2))
    far = np.concatenate([rng.uniform(-300.0, 300.0, (60, 2)), [[5000.0, -900.0]]])

    low, high = mass_box(np.concatenate([near, far]), np.ones(2061))

    np.testing.assert_allclose([low, high], [[-10.0, -5.0], [10.0, 5.0]], atol=8.0)
    inside = ((near >= low) & (near <= high)).all(axis=1)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(mass_box(near, np.ones(2000)), [[-10, -5], [10, 5]], atol=0.5)


def test_one_point_and_none_have_a_box():
    for points in (np.empty((0, 2)), np.array([[3.0, 4.0]])):
        low, high = mass_box(points, np.ones(len(points)))
        assert (high > low).all()


def test_a_wall_is_looked_at_from_its_front():
    wall = joined(
        *(
            disc((0.0, y, z), normal=(1.0, 0.0, 0.0), radius_m=0.3)
            for y in np.arange(0.0, 20.0, 0.5)
            for z in np.arange(0.0, 4.0, 0.5)
        )
    )
    R = best_direction(wall, 0.5, 0.9)
    assert R[2, 0] > 0.5
    assert R[2, 2] == pytest.approx(np.sin(np.radians(42.0)))
