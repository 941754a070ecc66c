# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Outlines and triangles of patches: rings around masks, their direction and their areas."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.kernels.rims import follow_sides, lay_sides, mark_corners
from surfel_mapper.models.outlines import middles, outline, rings, simplified, TOLERANCE, triangles
from test.kernels.modes import both
from test.models.scenes import A, room, sheet, VIEW


def area(ring):
    """Return the signed area within a ring, positive against the clock."""
    after = np.roll(ring, -1, axis=0)
    return 0.5 * (ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum()


def slow_rings(mask):
    """Return the same by a dictionary of the sides that leave each corner."""
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
    """Return one ring from a corner on, taking its sides out of what is left."""
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
    """Return the same, a stretch of the ring at a time."""
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


@pytest.mark.parametrize('seed', range(40))
def test_rings_and_their_corners_that_matter_are_those_of_a_slow_walk(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 15, 2)) < rng.uniform(0.2, 0.9)
    found = rings(mask)
    assert_same(found, slow_rings(mask))
    curved = [rng.uniform(0.0, 5.0, (rng.integers(1, 60), 2)), np.zeros((4, 2))]
    for ring in [*map(middles, found), *curved]:
        assert_same([simplified(ring)], [slow_simplified(ring)])


def assert_same(found, expected):
    assert [part.tolist() for part in found] == [part.tolist() for part in expected]


@both
def test_the_kernels_follow_an_eight_and_leave_out_what_is_straight(call):
    mask = np.array([[1, 1, 0], [0, 0, 1]], bool)
    ways = np.zeros((3, 4), np.uint8)
    assert call(lay_sides, mask, ways) == 10
    corners, ends = np.empty((10, 2)), np.empty(10, np.int64)
    assert call(follow_sides, mask, ways, corners, ends) == 2
    assert ends[:2].tolist() == [6, 10]
    assert not ways.any()
    kept = np.zeros(6, bool)
    call(mark_corners, corners[:6], 0.75, kept)
    assert corners[:6][kept].tolist() == [[0, 0], [1, 0], [1, 2], [0, 2]]


def test_points_on_a_side_of_a_ring_go_and_its_corners_stay():
    side = np.arange(10.0)
    square = np.concatenate(
        [
            np.stack([side, 0 * side], 1),
            np.stack([0 * side + 10, side], 1),
            np.stack([10 - side, 0 * side + 10], 1),
            np.stack([0 * side, 10 - side], 1),
        ]
    )
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
