# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Triangles that fill rings, and rings joined to one: their areas, and what is inside."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.filling import areas, filled, joined
from surfel_mapper.models.kernels.filling import fill_rings
from surfel_mapper.models.outlines import rings
from test.kernels.modes import both
from test.models.test_outlines import area

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
HOLE = np.array([[1.0, 1], [1, 3], [3, 3], [3, 1]])


def polygon(num, radius, middle=(0.0, 0.0), turn=0.0):
    angles = turn + 2 * np.pi * np.arange(num) / num
    return middle + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def star(num, seed):
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, num))
    return rng.uniform(0.3, 1.0, num)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)


def crossings(points, around):
    """Return how many sides of rings a ray to the right of each point crosses, one by one."""
    found = np.zeros(len(points), int)
    for ring in around:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            x = x0 + (points[:, 1] - y0) / (y1 - y0) * (x1 - x0)
            found += ((y0 <= points[:, 1]) != (y1 <= points[:, 1])) & (x > points[:, 0])
    return found


def num_covering(points, triangles):
    """Return in how many triangles each point is."""
    found = np.zeros(len(points), int)
    for a, b, c in triangles:
        sides = ((a, b), (b, c), (c, a))
        found += np.all([area_of(p, q, points) > 0 for p, q in sides], axis=0)
    return found


def area_of(p, q, points):
    return (q[0] - p[0]) * (points[:, 1] - p[1]) - (q[1] - p[1]) * (points[:, 0] - p[0])


@pytest.mark.parametrize(
    ('around', 'expected'),
    [
        ([SQUARE], 16.0),
        ([SQUARE, HOLE], 12.0),
        ([SQUARE[::-1], HOLE], 12.0),
        ([SQUARE, HOLE, 0.25 * HOLE + 1.75], 12.25),  # an island in the hole
        ([SQUARE, np.array([9.0, 2.0]) + HOLE], 20.0),
        (
            [polygon(100, 2.0), polygon(50, 1.0, (0.3, 0.2), 0.1)],
            0.5 * (100 * 4 * math.sin(2 * math.pi / 100) - 50 * math.sin(2 * math.pi / 50)),
        ),
    ],
)
def test_the_area_of_the_triangles_is_that_of_what_is_enclosed_without_its_holes(around, expected):
    assert areas(filled(around)).sum() == pytest.approx(expected, rel=1e-12)
    assert (areas(filled(around)) > 0.0).all()


@pytest.mark.parametrize('seed', range(5))
def test_a_point_is_in_one_triangle_if_rings_enclose_it_and_else_in_none(seed):
    around = [star(40, seed), 0.25 * star(15, seed + 50), 3.0 * polygon(7, 1.0)[::-1]]
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (2000, 2))
    found = num_covering(points, filled(around))
    assert np.array_equal(found, crossings(points, around) % 2)
    assert set(found) == {0, 1}


def test_rings_of_any_mask_are_filled_with_what_it_covers():
    rng = np.random.default_rng(4)
    for _ in range(30):
        mask = rng.random((8, 6)) < 0.6
        assert areas(filled(rings(mask))).sum() == pytest.approx(mask.sum(), rel=1e-12)


@both
def test_the_kernel_cuts_off_no_corner_and_begins_anew_where_sides_begin(call):
    arrow = np.array([[0.0, 0], [4, 0], [4, 4], [2, 1], [0, 3]])
    corners, ends = np.concatenate([arrow, HOLE[::-1] + 9.0]), np.array([5, 9])
    found = call(fill_rings, corners, ends)
    assert np.array_equal(found, filled([arrow, HOLE[::-1] + 9.0]))
    assert sorted(areas(found)) == [2.0, 2.0, 2.0, 2.0, 2.0, 3.0]


def test_a_rectangle_is_two_triangles_whatever_corners_lie_on_its_sides_elsewhere():
    ladder = [np.array([[9.0, y], [10, y], [10, y + 0.3], [9, y + 0.3]]) for y in (0.1, 1.2, 2.5)]
    assert len(filled([SQUARE])) == 2
    assert len(filled([SQUARE, *ladder])) == 8


def test_nothing_is_filled_with_nothing():
    assert filled([]).shape == (0, 3, 2)
    assert filled([np.array([[0.0, 0], [1, 0], [2, 0]])]).shape == (0, 3, 2)
    assert joined([]).shape == (0, 3)


def test_rings_joined_enclose_the_same_area_and_the_same_points():
    around = [polygon(30, 3.0), polygon(9, 1.0, (1.0, 0.4))[::-1], polygon(5, 0.5, (-9.0, 0.0))]
    whole = joined(around)
    assert area(whole) == pytest.approx(sum(area(ring) for ring in around), rel=1e-12)
    assert len(whole) == 30 + 9 + 5 + 4  # there and back: two corners more for each ring joined
    points = np.random.default_rng(3).uniform(-4.0, 4.0, (3000, 2))
    assert np.array_equal(crossings(points, [whole]) % 2, crossings(points, around) % 2)
