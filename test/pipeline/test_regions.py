# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Regions: points inside, by hand and by independent tests; refused regions."""

import numpy as np
import pytest

from surfel_mapper.pipeline.regions import Ball, Box, MAX_CORNERS, Prism

POINTS = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))


def test_a_box_contains_what_is_between_its_faces_and_on_them():
    points = np.array([[0.0, 0, 0], [1, 2, 3], [0.5, 1, 1], [1.1, 1, 1], [0.5, -0.1, 1]])
    inside = Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)).contains(points)
    assert inside.tolist() == [True, True, True, False, False]


def test_a_ball_contains_what_is_within_its_radius():
    distances = np.linalg.norm(POINTS - [0.5, 0.0, -0.5], axis=1)
    assert np.array_equal(Ball((0.5, 0.0, -0.5), 1.2).contains(POINTS), distances <= 1.2)


def in_polygon(corners, points):
    from matplotlib.path import Path  # seconds to import

    return Path([*corners, corners[0]], closed=True).contains_points(points[:, :2])


@pytest.mark.parametrize(
    'corners',
    [
        ((-1.0, -1.0), (1.5, -0.5), (0.3, 1.7)),
        ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 0.1), (-1.0, 1.0)),
        ((0.0, -1.0), (1.0, -1.0), (1.0, 0.0), (0.0, 0.0)),
    ],
)
@pytest.mark.parametrize('turned', [1, -1])
def test_a_prism_contains_what_is_in_its_polygon_at_any_height(corners, turned):
    expected = in_polygon(corners, POINTS)
    assert np.array_equal(Prism(corners[::turned]).contains(POINTS), expected)
    assert expected.any()


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), 'expected low below high'),
        (lambda: Ball((0.0, 0.0, 0.0), 0.0), 'radius 0.0 m .* positive'),
        (lambda: Ball((0.0, np.inf, 0.0), 1.0), 'expected finite'),
        (lambda: Ball((0.0, 0.0, 0.0), np.nan), 'radius nan'),
        (lambda: Prism(((0.0, 0.0), (1.0, 1.0))), 'of 2 corners, expected 3 to 1000'),
        (
            lambda: Prism(((0.0, 0.0), (1.0, np.nan), (1.0, 0.0))),
            r'corner 1 of the polygon: .*expected finite',
        ),
    ],
)
def test_an_invalid_region_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_points_in_polygons_agree_with_matplotlib():
    rng = np.random.default_rng(5)
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, MAX_CORNERS))
    radii = rng.uniform(5.0, 10.0, MAX_CORNERS)
    corners = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    points = rng.uniform(-12.0, 12.0, (300, 3))
    prism = Prism(tuple(map(tuple, corners.tolist())))

    expected = in_polygon(corners, points)
    assert np.array_equal(prism.contains(points), expected)

    rows = points.copy()
    rows[:, 1] = np.round(rows[:, 1])
    assert np.array_equal(prism.contains(rows), in_polygon(corners, rows))


@pytest.mark.parametrize('seed', range(30))
def test_points_in_polygons_whose_edges_cross_agree_with_a_test_of_every_edge(seed):
    """All coordinates are on a coarse grid, so that corners and edges lie in rows of points."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(-3, 4, (int(rng.integers(3, 12)), 2)).astype(float)
    points = np.stack(np.meshgrid(*[np.arange(-4, 5) / 1.0] * 3), axis=-1).reshape(-1, 3)
    points[::3, 0] += 0.5
    points[5] = np.nan

    odd = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(np.roll(corners, 1, axis=0), corners, strict=True):
        for number, (x, y, _) in enumerate(points):
            if (y0 <= y) != (y1 <= y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                odd[number] = not odd[number]
    inside = Prism(tuple(map(tuple, corners.tolist()))).contains(points)
    assert np.array_equal(inside, odd)


def test_a_polygon_without_points_in_its_box_contains_none():
    prism = Prism(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    assert not prism.contains(POINTS + 100.0).any()
    assert prism.contains(np.empty((0, 3))).shape == (0,)
