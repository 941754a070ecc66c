# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfels drawn: discs where, as large and turned as they should be, colours, lines, limits."""

import numpy as np
import pytest

from surfel_mapper.io.cdr import ADD, DELETE, LINE_LIST, marker_array, TRIANGLE_LIST
from surfel_mapper.io.markers import (
    disc_radius,
    disc_triangles,
    planarity_colors,
    SEGMENTS,
    surfel_markers,
    tangents,
    thinned,
)
from test.io.examples import make_surfels

CORNERS = 3 * (SEGMENTS - 2)


def draw(surfels, **settings):
    return surfel_markers(surfels, 0.5, stamp_ns=5, frame_id='odom', **settings)


AXES = np.vstack([np.eye(3), -np.eye(3), [[0.0, -0.0, -1.0]], [[1e-9, 0.0, -1.0]]])


def test_tangents_make_a_right_handed_frame_with_any_normal():
    normal = np.vstack([AXES, make_surfels(1000).normal])
    u, v = tangents(normal)
    for frame in np.stack([u, v, normal], axis=1):
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize('segments', [3, 4, 8, 13])
def test_triangles_tile_a_regular_polygon_that_faces_along_the_normal(segments):
    surfels = make_surfels(50)
    radius = np.random.default_rng(2).uniform(0.1, 0.3, 50)
    points = disc_triangles(surfels.position, surfels.normal, radius, segments)
    assert points.shape == (50 * (segments - 2) * 3, 3)

    a, b, c = points.reshape(50, segments - 2, 3, 3).transpose(2, 0, 1, 3)
    offset = points.reshape(50, -1, 3) - surfels.position[:, None]
    np.testing.assert_allclose(
        np.linalg.norm(offset, axis=2), np.repeat(radius[:, None], offset.shape[1], 1), atol=1e-13
    )
    np.testing.assert_allclose(np.einsum('kpi,ki->kp', offset, surfels.normal), 0.0, atol=1e-13)
    twice_area = np.einsum('kti,ki->kt', np.cross(b - a, c - a), surfels.normal)
    assert (twice_area > 0.0).all()  # counter-clockwise
    polygon = 0.5 * segments * radius**2 * np.sin(2.0 * np.pi / segments)
    np.testing.assert_allclose(0.5 * twice_area.sum(axis=1), polygon)


def test_the_discs_of_full_voxels_touch():
    n = 200_000
    side = np.random.default_rng(1).uniform(0.0, 0.5, (n, 2))  # a plane across a 0.5 m voxel
    eigenvalues = np.array([[0.0, *np.sort(np.var(side, axis=0))]])
    assert disc_radius(eigenvalues, 0.5)[0] == pytest.approx(0.25, rel=0.01)


def test_radius_is_bounded_by_the_voxel_and_never_nan():
    eigenvalues = np.array([[0.0, 0.0, 9.0], [-1e-20, -1e-20, -1e-20], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(disc_radius(eigenvalues, 0.5), [0.5 / np.sqrt(2.0), 0.0, 0.0])


def test_colours_run_from_dark_to_bright():
    colors = planarity_colors(np.linspace(0.0, 1.0, 101))
    assert colors.dtype == np.float32
    assert ((colors >= 0.0) & (colors <= 1.0)).all()
    assert (colors[:, 3] == 1.0).all()
    luminance = colors[:, :3].astype(float) ** 2.2 @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0.0).all()


def test_discs_and_normals_of_all_surfels_are_drawn():
    surfels = make_surfels(30)
    discs, normals = draw(surfels)
    assert (discs.ns, discs.type, discs.action) == ('discs', TRIANGLE_LIST, ADD)
    assert (normals.ns, normals.type, normals.action) == ('normals', LINE_LIST, ADD)
    assert {m.frame_id for m in (discs, normals)} == {'odom'}
    assert {m.stamp_ns for m in (discs, normals)} == {5}
    radius = disc_radius(surfels.eigenvalues, 0.5)
    np.testing.assert_array_equal(
        discs.points, disc_triangles(surfels.position, surfels.normal, radius, SEGMENTS)
    )
    colors = discs.colors.reshape(30, CORNERS, 4)
    np.testing.assert_array_equal(
        colors, np.repeat(planarity_colors(surfels.planarity)[:, None], CORNERS, axis=1)
    )
    start, end = normals.points.reshape(30, 2, 3).transpose(1, 0, 2)
    np.testing.assert_array_equal(start, surfels.position)
    np.testing.assert_allclose(end - start, 0.25 * surfels.normal, atol=1e-13)


def test_surfels_without_a_normal_are_left_out():
    surfels = make_surfels(3)
    surfels.normal[1] = np.nan
    surfels.planarity[1] = np.nan
    expected = draw(surfels.select(np.array([0, 2])))
    assert marker_array(draw(surfels)) == marker_array(expected)


def test_where_nothing_is_to_be_drawn_both_markers_are_deleted():
    surfels = make_surfels(2)
    surfels.normal[:] = np.nan
    for empty in (surfels, make_surfels(0)):
        for marker in draw(empty):
            assert marker.action == DELETE
            assert len(marker.points) == len(marker.colors) == 0


def test_no_more_surfels_are_drawn_than_asked_for():
    surfels = make_surfels(100)
    for number in (1, 99, 100, 101):
        discs, normals = draw(surfels, max_markers=number)
        drawn = min(number, 100)
        assert len(discs.points) == drawn * CORNERS
        assert len(normals.points) == drawn * 2


def test_voxels_stay_chosen_while_the_map_grows_and_whatever_their_order():
    grid = np.stack(np.meshgrid(*[np.arange(-15, 15)] * 3), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(1)
    voxels = rng.permutation(grid.astype(np.int32))
    small = {tuple(v) for v in voxels[:20_000][thinned(voxels[:20_000], 5000)]}
    large = {tuple(v) for v in voxels[thinned(voxels, 5000)]}
    shuffled = rng.permutation(voxels)
    assert {tuple(v) for v in shuffled[thinned(shuffled, 5000)]} == large
    assert len(small & large) / 5000 == pytest.approx(20_000 / 27_000, abs=0.02)


def test_voxels_are_chosen_evenly_in_space():
    grid = np.stack(np.meshgrid(*[np.arange(-20, 20)] * 3), axis=-1).reshape(-1, 3)
    chosen = grid[thinned(grid.astype(np.int32), 8000)]
    blocks = np.unique((chosen + 20) // 10, axis=0, return_counts=True)[1]  # 64 of 1000 voxels
    expected = 8000 / 64
    # binomial: 10.5 is the standard deviation of a block, 5 of them are not met by chance
    assert np.abs(blocks - expected).max() < 5 * 10.5
    assert len(blocks) == 64
    assert np.ptp(np.bincount(chosen[:, 2] + 20)) < 12 * np.sqrt(8000 / 40)
