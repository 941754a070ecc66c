# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Discs are painted at the place and size that a pinhole camera gives them."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.viz.discs import SPREAD
from surfel_mapper.viz.perspective import Camera, SKY, WIDER

RED, GREEN = (255, 0, 0), (0, 255, 0)


def camera(**settings):
    """Return a camera at the origin, which looks along x without haze."""
    place, target = np.zeros(3), np.array([1.0, 0.0, 0.0])
    given = {'width': 201, 'height': 101, 'focal_px': 100.0, 'haze_m': 1e6, **settings}
    return Camera(place=place, target=target, **given)


def covered(image):
    """Return rows and columns of the painted pixels."""
    return np.nonzero(np.abs(image - np.array(SKY, np.float32)).max(axis=2) > 100.0)


@pytest.mark.parametrize(
    ('place', 'column', 'row'),
    [((10.0, 0.0, 0.0), 100, 50), ((10.0, 5.0, 0.0), 50, 50), ((20.0, -4.0, 2.0), 120, 40)],
)
def test_a_ball_is_where_the_camera_sees_it(place, column, row):
    view = camera()
    image = view.image()
    view.paint_points(image, [place], 1.0, RED)
    rows, columns = covered(image)
    assert (columns.mean(), rows.mean()) == pytest.approx((column, row), abs=0.2)
    assert len(rows) == pytest.approx(np.pi * (100.0 / place[0]) ** 2, rel=0.08)


def test_near_discs_hide_far_ones_in_any_order():
    view = camera()
    for points in ([(10.0, 0.0, 0.0), (30.0, 0.0, 0.0)], [(30.0, 0.0, 0.0), (10.0, 0.0, 0.0)]):
        image = view.image()
        view.paint_points(image, [points[0]], 0.5, RED)
        both = view.image()
        view._paint(
            both,
            np.array(points),
            np.array([0.5, 0.5]),
            np.array([RED if x == 10.0 else GREEN for x, _, _ in points], float),
            None,
        )
        np.testing.assert_allclose(both[50, 100], RED, atol=0.5)


def test_surfels_are_as_wide_as_the_wall_and_those_that_face_away_are_not_drawn():
    rng = np.random.default_rng(0)
    wall = rng.uniform([10.0, -2.0, -1.0], [10.01, 2.0, 1.0], (20_000, 3))
    towards, away = SurfelMap(0.5), SurfelMap(0.5)
    towards.add(wall, origin=[0.0, 0.0, 0.0])
    away.add(wall, origin=[20.0, 0.0, 0.0])
    view = camera()
    image = view.image()
    view.paint_surfels(image, away.surfels(5))
    assert len(covered(image)[0]) == 0
    view.paint_surfels(image, towards.surfels(5))
    painted = np.nonzero(np.abs(image - np.array(SKY, np.float32)).max(axis=2) > 30.0)
    across = SPREAD * WIDER * 0.5  # m, of a disc in the middle of its voxel; 10 px a metre
    assert np.ptp(painted[1]) == pytest.approx(10.0 * (3.5 + across), abs=1.5)
    assert np.ptp(painted[0]) == pytest.approx(10.0 * (1.5 + across), abs=1.5)


def test_nothing_nearer_or_beyond_the_haze_is_drawn():
    view = camera(haze_m=50.0)
    image = view.image()
    view.paint_points(image, [(1.0, 0.0, 0.0), (60.0, 0.0, 0.0), (-5.0, 0.0, 0.0)], 0.5, RED)
    np.testing.assert_array_equal(image, view.image())
