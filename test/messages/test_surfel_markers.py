# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Discs of surfels have the right place, size, normal and colour; meshes become triangles."""

import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan
from surfel_mapper.messages.markers import (
    ADD,
    DELETE,
    LINE_LIST,
    marker_array,
    TRIANGLE_LIST,
)
from surfel_mapper.messages.surfel_markers import (
    disc_colors,
    disc_radius,
    disc_triangles,
    mesh_marker,
    normal_colors,
    SEGMENTS,
    shades,
    surfel_markers,
)
from surfel_mapper.tsdf.mesh import EMPTY, Mesh
from test.messages.examples import make_surfels

CORNERS = 3 * (SEGMENTS - 2)


def draw(surfels):
    colors = shades(surfels.planarity)
    return surfel_markers(surfels, 0.5, colors, stamp_ns=5, frame_id='odom')


def circle(segments):
    angles = 2.0 * np.pi * np.arange(segments) / segments
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


AXES = np.vstack([np.eye(3), -np.eye(3), [[0.0, -0.0, -1.0]], [[1e-9, 0.0, -1.0]]])


@pytest.mark.parametrize('segments', [3, 4, 8, 13])
def test_triangles_tile_a_regular_polygon_that_faces_along_the_normal(segments):
    normal = np.vstack([AXES, make_surfels(30).normal])
    num = len(normal)
    rng = np.random.default_rng(2)
    position, radius = rng.uniform(-50.0, 50.0, (num, 3)), rng.uniform(0.1, 0.3, num)
    points = disc_triangles(position, normal, radius, circle(segments))

    a, b, c = points.reshape(num, segments - 2, 3, 3).transpose(2, 0, 1, 3)
    offset = points.reshape(num, -1, 3) - position[:, None]
    np.testing.assert_allclose(
        np.linalg.norm(offset, axis=2), np.repeat(radius[:, None], offset.shape[1], 1), atol=1e-13
    )
    np.testing.assert_allclose(np.einsum('kpi,ki->kp', offset, normal), 0.0, atol=1e-13)
    twice_area = np.einsum('kti,ki->kt', np.cross(b - a, c - a), normal)
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
    colors = shades(np.linspace(0.0, 1.0, 101))
    assert colors.dtype == np.float32
    assert ((colors >= 0.0) & (colors <= 1.0)).all()
    assert (colors[:, 3] == 1.0).all()
    luminance = colors[:, :3].astype(float) ** 2.2 @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0.0).all()


def test_normals_have_the_colours_of_their_directions():
    found = normal_colors(np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]]))
    expected = [[1, 0.5, 0.5, 1], [0.5, 0, 0.5, 1], [0.8, 0.5, 0.9, 1]]
    np.testing.assert_allclose(found, expected, atol=1e-7)
    surfels = make_surfels(3)
    np.testing.assert_array_equal(disc_colors('normal', surfels), normal_colors(surfels.normal))
    np.testing.assert_array_equal(disc_colors('planarity', surfels), shades(surfels.planarity))


def test_the_age_of_a_disc_is_that_of_the_newest_scan_that_saw_its_voxel():
    window = SlidingWindow(SurfelMap(1.0))
    places = [[0.5, 1.5], [1.5, 2.5], [2.5]]  # along x, by scan
    for number, along in enumerate(places):
        points = np.array([[x + d, 0.1 * d, 0.3] for x in along for d in (0.0, 0.1, 0.2)])
        moments = window._map.reduce(points)
        window.insert(WindowedScan(moments=moments, stamp_ns=10 * number, T_map_sensor=np.eye(4)))
    surfels = window._map.surfels()
    found = disc_colors('age', surfels, window)
    expected = {0: 0.0, 1: 0.5, 2: 1.0}
    shares = np.array([expected[x] for x in surfels.voxel_index[:, 0].tolist()])
    np.testing.assert_array_equal(found, shades(shares))
    nothing = disc_colors('age', surfels, [])
    np.testing.assert_array_equal(nothing, shades(np.zeros(3)))


def test_discs_and_normals_of_all_surfels_are_drawn():
    surfels = make_surfels(30)
    discs, normals = draw(surfels)
    assert (discs.ns, discs.type, discs.action) == ('discs', TRIANGLE_LIST, ADD)
    assert (normals.ns, normals.type, normals.action) == ('normals', LINE_LIST, ADD)
    assert {m.frame_id for m in (discs, normals)} == {'odom'}
    assert {m.stamp_ns for m in (discs, normals)} == {5}
    corners = discs.points.reshape(30, CORNERS, 3) - surfels.position[:, None]
    radius = disc_radius(surfels.eigenvalues, 0.5)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=2).max(axis=1), radius)
    np.testing.assert_array_equal(
        discs.colors.reshape(30, CORNERS, 4),
        np.repeat(shades(surfels.planarity)[:, None], CORNERS, axis=1),
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


def test_both_markers_are_deleted_if_there_is_nothing_to_draw():
    surfels = make_surfels(2)
    surfels.normal[:] = np.nan
    for empty in (surfels, make_surfels(0)):
        for marker in draw(empty):
            assert marker.action == DELETE
            assert len(marker.points) == len(marker.colors) == 0


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 0, 1]], np.int32)
NO_COLORS = np.empty((0, 3), np.uint8)


def marker_of(colors=NO_COLORS):
    mesh = Mesh(vertices=SQUARE, triangles=TRIANGLES, colors=colors)
    return mesh_marker(mesh, number=7, stamp_ns=5, frame_id='odom')


def test_every_triangle_has_its_three_corners_in_order():
    marker = marker_of()
    assert (marker.type, marker.action, marker.id) == (TRIANGLE_LIST, ADD, 7)
    assert np.array_equal(marker.points, SQUARE[TRIANGLES.ravel()])
    assert marker.colors.shape == (12, 4)
    assert (marker.colors[:, 3] == 1.0).all()


def test_colours_of_vertices_are_those_of_the_corners():
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 102, 204]], np.uint8)
    found = marker_of(colors).colors[:6, :3]
    assert np.allclose(found, colors[TRIANGLES.ravel()[:6]] / 255.0, atol=1e-6)


def test_without_colours_faces_upwards_are_brighter_than_faces_downwards():
    up, _, down, none = marker_of().colors.reshape(4, 3, 4)[:, 0, 0]
    assert 0.3 <= down < none < up <= 1.0


def test_an_empty_mesh_deletes_the_marker():
    marker = mesh_marker(EMPTY, number=7, stamp_ns=5, frame_id='odom')
    assert (marker.action, len(marker.points)) == (DELETE, 0)
