# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
visualization_msgs/Marker, MarkerArray and polygons as bytes, from arrays.

A marker of a surfel map has hundreds of thousands of vertices; as Python objects they take
seconds, as the bytes of two arrays a millisecond. So the message is never made: its serialised
form is, which rclpy publishes as it is.

The form is CDR as DDS uses it (little endian, version 1): members in the order of the message
definition without names, every number at a multiple of its size, counted from the byte after
the four that say so; strings and sequences begin with their length, strings end with a zero.
A sequence without elements needs no padding for the elements it does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

LITTLE_ENDIAN_CDR = b'\x00\x01\x00\x00'

LINE_LIST = 5
TEXT_VIEW_FACING = 9
TRIANGLE_LIST = 11
ADD = 0
DELETE = 2
DELETE_ALL = 3

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

NS_PER_S = 10**9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marker:
    """
    A visualization_msgs/Marker; members that it lacks are zero or empty in the message.

    Attributes
    ----------
    ns, id : str, int
        What a viewer knows the marker by: the next of the same name replaces it.
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
        Red, green, blue, opacity in [0, 1]; of all points, where they have no colours.
    points : (P, 3) float64, m
        Corners of triangles, or ends of lines.
    colors : (P, 4) float32
        One of every point, or none.
    text : str
        Of a TEXT_VIEW_FACING.

    Raises
    ------
    ValueError
        If the points or the colours are of another shape.

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

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f'points: shape {self.points.shape}, expected (P, 3)')
        if self.colors.shape not in ((0, 4), (len(self.points), 4)):
            raise ValueError(
                f'colors: shape {self.colors.shape}, expected (0, 4) or ({len(self.points)}, 4)'
            )


class Writer:
    """Collects the members of a message, each aligned, and joins them once."""

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = []
        self._size = 0

    def numbers(self, code: str, *values: float) -> None:
        """Write numbers of one type, a format character of struct, each aligned to its size."""
        self.append(struct.pack(f'<{len(values)}{code}', *values), struct.calcsize(code))

    def string(self, text: str) -> None:
        """Write a string: its length with the closing zero, its UTF-8, the zero."""
        content = text.encode() + b'\0'
        self.numbers('I', len(content))
        self.append(content, 1)

    def sequence(self, values: npt.NDArray[Any], dtype: str) -> None:
        """Write a sequence of structures, one a row, whose members are all of one type."""
        self.numbers('I', len(values))
        if values.size:
            content = np.ascontiguousarray(values, dtype)
            self.append(content.reshape(-1).view(np.uint8).data, content.itemsize)

    def append(self, content: bytes | memoryview, alignment: int) -> None:
        """Write what is serialised, at a multiple of so many bytes."""
        padding = bytes(-self._size % alignment)
        self._parts += [padding, content]
        self._size += len(padding) + len(content)

    def content(self) -> bytes:
        """Return what is written."""
        return b''.join(self._parts)

    def join(self) -> bytes:
        """Return the message with the header that says how it is written."""
        return b''.join([LITTLE_ENDIAN_CDR, *self._parts])


def marker_array(markers: Sequence[Marker]) -> bytes:
    """
    Return the serialised visualization_msgs/MarkerArray of some markers.

    Raises
    ------
    struct.error
        If a stamp is beyond what a message holds (year 2038), or an id.

    """
    writer = Writer()
    writer.numbers('I', len(markers))
    for marker in markers:
        write_marker(writer, marker)
    return writer.join()


def marker_bytes(marker: Marker) -> bytes:
    """Return the serialised visualization_msgs/Marker; raises as marker_array does."""
    writer = Writer()
    write_marker(writer, marker)
    return writer.join()


def polygon_instance(
    ring: npt.NDArray[np.float64], number: int, *, stamp_ns: int, frame_id: str
) -> bytes:
    """Return the serialised geometry_msgs/PolygonInstanceStamped of a ring (M, 3), m."""
    writer = Writer()
    write_header(writer, stamp_ns, frame_id)
    writer.sequence(ring, '<f4')
    writer.numbers('q', number)
    return writer.join()


def write_header(writer: Writer, stamp_ns: int, frame_id: str) -> None:
    """Write the members of a std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    writer.numbers('i', seconds)
    writer.numbers('I', nanoseconds)
    writer.string(frame_id)


def write_marker(writer: Writer, marker: Marker) -> None:
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
    writer = Writer()
    writer.string('')  # texture_resource
    writer.numbers('I', 0, 0)  # texture.header.stamp
    writer.string('')  # texture.header.frame_id
    writer.string('')  # texture.format
    writer.numbers('I', 0)  # texture.data
    writer.numbers('I', 0)  # uv_coordinates
    return writer.content()


def no_mesh() -> bytes:
    """Return the members of a marker from mesh_resource on, all empty."""
    writer = Writer()
    writer.string('')  # mesh_resource
    writer.string('')  # mesh_file.filename
    writer.numbers('I', 0)  # mesh_file.data
    writer.numbers('B', 0)  # mesh_use_embedded_materials
    return writer.content()


NO_TEXTURE, NO_MESH = no_texture(), no_mesh()
"""What is the same in every marker; numbers in it are at multiples of 4."""
