# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Outlines and triangles of patches: rings around masks, direction, areas, even-odd rule."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.outlines import (
    areas,
    bridged,
    midpoints,
    outline,
    rings,
    simplified,
    TOLERANCE,
    triangles,
    triangulated,
)
from test.models.scenes import A, room, sheet, VIEW


def area(ring):
    """Return the signed area within a ring, positive against the clock."""
    after = np.roll(ring, -1, axis=0)
    return 0.5 * (ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum()


def slow_rings(mask):
    """Return the rings by a dictionary of the sides that leave each corner."""
    padded = np.pad(mask, 1)
    inner = padded[1:-1, 1:-1]
    after = {}
    # a square's side towards an empty neighbour, from its first corner to its last
    for empty, first, last in (
        (~padded[1:-1, :-2], (0, 0), (1, 0)),
        (~padded[2:, 1:-1], (1, 0), (1, 1)),
        (~padded[1:-1, 2:], (1, 1), (0, 1)),
        (~padded[:-2, 1:-1], (0, 1), (0, 0)),
    ):
        for x, y in np.argwhere(inner & empty).tolist():
            start = (x + first[0], y + first[1])
            after.setdefault(start, []).append((x + last[0], y + last[1]))
    found = []
    while after:
        found.append(np.array(followed(after, next(iter(after))), np.float64))
    return found


def followed(after, start):
    """Return one ring from a corner on, and remove its sides."""
    ring, at, before = [start], start, start
    while True:
        ways = after[at]
        ahead = (at[0] - before[0], at[1] - before[1])
        left = (at[0] - ahead[1], at[1] + ahead[0])
        step = left if len(ways) > 1 and left in ways else ways[0]
        ways.remove(step)
        if not ways:
            del after[at]
        if step == start:
            return ring
        ring.append(step)
        at, before = step, at


def slow_simplified(ring):
    """Return the simplified ring, one stretch at a time."""
    far = int(np.argmax(((ring - ring[0]) ** 2).sum(axis=1)))
    closed = np.concatenate([ring, ring[:1]])
    kept = np.zeros(len(closed), bool)
    kept[[0, far]] = True
    waiting = [(0, far), (far, len(ring))]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        a, b = closed[first], closed[last]
        along, inner = b - a, closed[first + 1 : last] - a
        length = np.hypot(*along)
        across = np.abs(along[0] * inner[:, 1] - along[1] * inner[:, 0])
        away = across / length if length > 0.0 else np.hypot(*inner.T)
        worst = int(np.argmax(away))
        if away[worst] > TOLERANCE:
            middle = first + 1 + worst
            kept[middle] = True
            waiting += [(first, middle), (middle, last)]
    chosen = ring[kept[:-1]]
    return chosen if len(chosen) >= 3 else ring


@pytest.mark.parametrize('seed', range(40))
def test_rings_and_simplification_equal_the_slow_twins(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 15, 2)) < rng.uniform(0.2, 0.9)
    found = rings(mask)
    assert_same(found, slow_rings(mask))
    curved = [rng.uniform(0.0, 5.0, (rng.integers(1, 60), 2)), np.zeros((4, 2))]
    for ring in [*map(midpoints, found), *curved]:
        assert_same([simplified(ring)], [slow_simplified(ring)])


def assert_same(found, expected):
    assert [part.tolist() for part in found] == [part.tolist() for part in expected]


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
    """Return the number of sides of rings that a ray to the right of each point crosses."""
    found = np.zeros(len(points), int)
    for ring in around:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            x = x0 + (points[:, 1] - y0) / (y1 - y0) * (x1 - x0)
            found += ((y0 <= points[:, 1]) != (y1 <= points[:, 1])) & (x > points[:, 0])
    return found


def num_covering(points, triangles):
    """Return the number of triangles that contain each point."""
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
def test_area_of_triangles_equals_the_enclosed_area_less_holes(around, expected):
    assert areas(triangulated(around)).sum() == pytest.approx(expected, rel=1e-12)
    assert (areas(triangulated(around)) > 0.0).all()


@pytest.mark.parametrize('seed', range(5))
def test_points_lie_in_one_triangle_if_inside_and_in_none_outside(seed):
    around = [star(40, seed), 0.25 * star(15, seed + 50), 3.0 * polygon(7, 1.0)[::-1]]
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (2000, 2))
    found = num_covering(points, triangulated(around))
    assert np.array_equal(found, crossings(points, around) % 2)
    assert set(found) == {0, 1}


def test_empty_and_degenerate_rings_give_no_triangles():
    assert triangulated([]).shape == (0, 3, 2)
    assert triangulated([np.array([[0.0, 0], [1, 0], [2, 0]])]).shape == (0, 3, 2)
    assert bridged([]).shape == (0, 3)


def test_bridged_ring_encloses_the_same_area_and_points():
    around = [polygon(30, 3.0), polygon(9, 1.0, (1.0, 0.4))[::-1], polygon(5, 0.5, (-9.0, 0.0))]
    whole = bridged(around)
    assert area(whole) == pytest.approx(sum(area(ring) for ring in around), rel=1e-12)
    assert len(whole) == 30 + 9 + 5 + 4  # there and back: two corners more for each ring bridged
    points = np.random.default_rng(3).uniform(-4.0, 4.0, (3000, 2))
    assert np.array_equal(crossings(points, [whole]) % 2, crossings(points, around) % 2)
