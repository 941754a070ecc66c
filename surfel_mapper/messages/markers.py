# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
visualization_msgs/Marker, MarkerArray and polygons, serialised from arrays.

A marker of a surfel map has hundreds of thousands of vertices, so the message object is never
built: its bytes are, which rclpy publishes as they are. surfel_markers.py and model_messages.py
fill the markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from surfel_mapper.messages.cdr import MessageWriter, write_header

LINE_LIST = 5
TEXT_VIEW_FACING = 9
TRIANGLE_LIST = 11
ADD = 0
DELETE = 2
DELETE_ALL = 3

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marker:
    """
    A visualization_msgs/Marker; its further members are zero or empty in the message.

    Attributes
    ----------
    ns, id : str, int
        Identity of the marker: the next one of the same namespace and id replaces it.
    type, action : int
        TRIANGLE_LIST, LINE_LIST or TEXT_VIEW_FACING; ADD, DELETE or DELETE_ALL.
    frame_id, stamp_ns : str, int
        Coordinate frame of the points, and time in nanoseconds.
    pose : 7 floats
        Of the points in the frame: x y z in m, then qx qy qz qw.
    scale : 3 floats
        A factor for triangles; for lines the first is their width, for text the last its height,
        in m.
    color : 4 floats
        Red, green, blue, opacity in [0, 1]; used if the points have no colours of their own.
    points : (P, 3) float64, m
        Corners of triangles, or ends of lines.
    colors : (P, 4) float32
        One for each point, or empty.
    text : str
        Of a TEXT_VIEW_FACING.

    """

    ns: str
    id: int
    type: int
    action: int
    frame_id: str
    stamp_ns: int
    pose: Sequence[float] = IDENTITY
    scale: Sequence[float] = (1.0, 1.0, 1.0)
    color: Sequence[float] = (1.0, 1.0, 1.0, 1.0)
    points: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 4), np.float32))
    text: str = ''


def marker_array(markers: Sequence[Marker]) -> bytes:
    """
    Return the serialised visualization_msgs/MarkerArray of some markers.

    Raises
    ------
    struct.error
        If a stamp (from the year 2038 on) or an id does not fit into 32 bits.

    """
    writer = MessageWriter()
    writer.numbers('I', len(markers))
    for marker in markers:
        write_marker(writer, marker)
    return writer.join()


def marker_bytes(marker: Marker) -> bytes:
    """Return the serialised visualization_msgs/Marker; raises as marker_array does."""
    writer = MessageWriter()
    write_marker(writer, marker)
    return writer.join()


def polygon_instance(
    ring: npt.NDArray[np.float64], number: int, *, stamp_ns: int, frame_id: str
) -> bytes:
    """Return the serialised geometry_msgs/PolygonInstanceStamped of a ring (M, 3), m."""
    writer = MessageWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.sequence(ring, '<f4')
    writer.numbers('q', number)
    return writer.join()


def write_marker(writer: MessageWriter, marker: Marker) -> None:
    """Write the members of a visualization_msgs/Marker of Jazzy, in its order."""
    write_header(writer, marker.stamp_ns, marker.frame_id)
    writer.string(marker.ns)
    writer.numbers('i', marker.id, marker.type, marker.action)
    writer.numbers('d', *marker.pose, *marker.scale)
    writer.numbers('f', *marker.color)
    writer.numbers('I', 0, 0)  # lifetime: stays until replaced
    writer.numbers('B', 0)  # frame_locked
    writer.sequence(marker.points, '<f8')
    writer.sequence(marker.colors, '<f4')
    writer.append(NO_TEXTURE, 4)
    writer.string(marker.text)
    writer.append(NO_MESH, 4)


def no_texture() -> bytes:
    """Return the members of a marker from texture_resource to uv_coordinates, all empty."""
    writer = MessageWriter()
    writer.string('')  # texture_resource
    writer.numbers('I', 0, 0)  # texture.header.stamp
    writer.string('')  # texture.header.frame_id
    writer.string('')  # texture.format
    writer.numbers('I', 0)  # texture.data
    writer.numbers('I', 0)  # uv_coordinates
    return writer.content()


def no_mesh() -> bytes:
    """Return the members of a marker from mesh_resource on, all empty."""
    writer = MessageWriter()
    writer.string('')  # mesh_resource
    writer.string('')  # mesh_file.filename
    writer.numbers('I', 0)  # mesh_file.data
    writer.numbers('B', 0)  # mesh_use_embedded_materials
    return writer.content()


NO_TEXTURE, NO_MESH = no_texture(), no_mesh()
"""Members that are the same in every marker; numbers in them are at multiples of 4."""
