# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Meshes as markers: corners in order, colours as seen or by slope."""

import numpy as np

from surfel_mapper.messages.cdr import ADD, DELETE, marker_array, marker_bytes, TRIANGLE_LIST
from surfel_mapper.messages.mesh_marker import mesh_marker
from surfel_mapper.tsdf.mesh import EMPTY, Mesh

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 0, 1]], np.int32)
NO_COLORS = np.empty((0, 3), np.uint8)


def marker_of(colors=NO_COLORS):
    mesh = Mesh(vertices=SQUARE, triangles=TRIANGLES, colors=colors)
    return mesh_marker(mesh, stamp_ns=5, frame_id='odom')


def test_every_triangle_has_its_three_corners_in_order():
    marker = marker_of()
    assert (marker.type, marker.action, marker.frame_id) == (TRIANGLE_LIST, ADD, 'odom')
    assert np.array_equal(marker.points, SQUARE[TRIANGLES.ravel()])
    assert marker.colors.shape == (12, 4)
    assert (marker.colors[:, 3] == 1.0).all()


def test_colours_of_vertices_are_those_of_the_corners():
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 102, 204]], np.uint8)
    found = marker_of(colors).colors[:6, :3]
    assert np.allclose(found, colors[TRIANGLES.ravel()[:6]] / 255.0, atol=1e-6)


def test_without_colours_what_looks_up_is_brighter_than_what_looks_down():
    up, _, down, none = marker_of().colors.reshape(4, 3, 4)[:, 0, 0]
    assert 0.3 <= down < none < up <= 1.0


def test_a_mesh_of_nothing_deletes_what_was_drawn():
    marker = mesh_marker(EMPTY, stamp_ns=5, frame_id='odom')
    assert (marker.action, len(marker.points)) == (DELETE, 0)


def test_a_marker_alone_is_written_as_in_an_array_of_one():
    marker = marker_of()
    header, number = b'\x00\x01\x00\x00', b'\x01\x00\x00\x00'
    alone = marker_bytes(marker)
    # four bytes on, what is aligned to eight moves: compared where nothing is, up to the pose
    assert alone[:4] == header
    assert marker_array([marker])[:8] == header + number
    assert alone[4:24] == marker_array([marker])[8:28]
    assert len(alone) <= len(marker_array([marker]))
