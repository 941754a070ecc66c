# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
sensor_msgs/PointCloud2: messages and serialised bytes to scans, columns to messages.

A message is read by the names of its attributes, so one decoder serves rclpy and bags, and ROS is
not imported. Sizes and fields are checked before a byte is read, with Python integers, which do
not overflow. Columns are strided, read-only views into the message, so unused ones cost nothing.

Coordinates are gathered into one array in Fortran order, as the kernels of the map need them, in
blocks that stay in the cache. Three copies of the whole would take twice as long.

All arrays together are no larger than the message, because fields must not overlap.

``parse_cloud`` reads a serialised message in place: its data is a view of the bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
import logging
import math
from operator import attrgetter
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.cdr import (
    checked_stamp_ns,
    frame_name,
    Header,
    MessageReader,
    MessageWriter,
    read_header,
    write_header,
)
from surfel_mapper.scan import ComputedColumns, LazyPoints, Scan

UINT32, FLOAT32, FLOAT64 = 6, 7, 8

DTYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', UINT32: 'u4', FLOAT32: 'f4', FLOAT64: 'f8'}
"""NumPy dtypes of the datatypes of a PointField."""

MAX_FIELDS = 1024
"""Limit of the number of fields; drivers have some ten, clouds with descriptors some hundred."""

MAX_WARNED = 64
"""Number of warnings about layouts that are kept, to give each once."""

_log = logging.getLogger(__name__)

DATATYPES = {np.dtype(name): datatype for datatype, name in DTYPES.items()}


@dataclass(frozen=True, slots=True)
class Field:
    """A sensor_msgs/PointField: place and type of a column in a point."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudBytes:
    """A PointCloud2 without its header; the attributes are those of the message."""

    height: int
    width: int
    fields: Sequence[Field]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: npt.NDArray[np.uint8]
    is_dense: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawCloud(CloudBytes):
    """A sensor_msgs/PointCloud2; data is a read-only (row_step * height,) uint8 view."""

    header: Header


def to_scan(msg: Any, topic: str = 'points') -> Scan:
    """
    Return the points and columns of a PointCloud2 message.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        From rclpy or rosbags, or any object with these attributes; ``data`` may be any buffer.
    topic : str
        Topic of the message; errors begin with it.

    Returns
    -------
    Scan
        ``points`` is float32 if x, y and z are, else float64. ``columns`` has every other field
        in its own type, (N,) or (N, count), read-only and mostly views into the message. Both are
        decoded when they are first read, so the message must not change before. Fields
        without a name are padding and left out; of fields with the same name the first is taken.
        A cloud without points gives an empty scan without columns.

    Raises
    ------
    CloudFormatError
        If sizes, fields and data do not fit together, x, y or z is missing, or the stamp is
        invalid. Packed points are read whatever ``row_step`` says, and bytes after the points are
        ignored, each with one warning.

    """
    if not hasattr(msg, 'header'):
        raise CloudFormatError(f'{topic}: a {type(msg).__name__}, expected a PointCloud2')
    stamp_ns = checked_stamp_ns(msg.header.stamp, topic)
    frame_id = frame_name(msg.header.frame_id)
    data = checked_data(msg, topic)
    if int(msg.height) * int(msg.width) == 0:
        nothing = np.empty((0, 3), np.float32)
        return Scan(points=nothing, stamp_ns=stamp_ns, frame_id=frame_id, topic=topic)
    fields = checked_fields(msg, topic)
    xyz = tuple(map(partial(checked_coordinate, fields, topic), 'xyz'))
    check_overlap(fields, topic)
    points = Points.of(msg, data)
    lazy: Any = coordinates(points, xyz)
    for name in 'xyz':
        del fields[name]
    return Scan(
        points=lazy,
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        columns=ComputedColumns(fields, partial(column, points, fields), math.prod(points.shape)),
        topic=topic,
        msg=msg,
    )


def bytes_of(msg: Any, topic: str) -> npt.NDArray[np.uint8]:
    """Return the data of a message as uint8; raise CloudFormatError if it is not a buffer."""
    try:
        return np.frombuffer(msg.data, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise CloudFormatError(
            f'{topic}: data is a {type(msg.data).__name__}, expected a buffer of bytes: {error}'
        ) from error


def checked_data(msg: Any, topic: str) -> npt.NDArray[np.uint8]:
    """Return the data of a message; raise CloudFormatError if sizes do not agree."""
    data = bytes_of(msg, topic)
    width, height, point_step = int(msg.width), int(msg.height), int(msg.point_step)
    if point_step == 0 and width * height > 0:
        raise CloudFormatError(f'{topic}: point_step is 0, expected the bytes of one point')
    stated, row_step = int(msg.row_step), row_bytes(msg, len(data))
    size = row_step * height
    if len(data) < size or row_step < width * point_step:
        raise CloudFormatError(
            f'{topic}: {len(data)} bytes of data, expected row_step * height = {stated} * '
            f'{height} = {stated * height}, and at least point_step * width * height = '
            f'{point_step} * {width} * {height} = {point_step * width * height}'
        )
    if row_step != stated:
        warn_of_layout(topic, f'row_step is {stated}, read as point_step * width = {row_step}')
    elif len(data) > size:
        warn_of_layout(topic, f'the {len(data) - size} bytes of data after its points are ignored')
    return data


def row_bytes(msg: Any, num_bytes: int) -> int:
    """
    Return the bytes of a row: ``row_step``, or those of its points if the data is packed.

    Drivers write 0, the width, or the size of all data into the row_step of packed points.
    """
    row_step, height = int(msg.row_step), int(msg.height)
    packed_step = int(msg.point_step) * int(msg.width)
    if packed_step <= row_step and row_step * height <= num_bytes:
        return row_step
    is_packed = num_bytes == packed_step * height or (height == 1 and num_bytes > packed_step)
    return packed_step if is_packed else row_step


@lru_cache(maxsize=MAX_WARNED)
def warn_of_layout(topic: str, problem: str) -> None:
    """Warn once of a cloud that is read though its sizes disagree."""
    _log.warning('%s: %s', topic, problem)


def checked_fields(msg: Any, topic: str) -> dict[str, Field]:
    """
    Return the fields of a message by name; raise CloudFormatError if they do not fit a point.

    A count of 0 is read as 1, as old drivers and bags write it.
    """
    if len(msg.fields) > MAX_FIELDS:
        raise CloudFormatError(f'{topic}: {len(msg.fields)} fields, expected at most {MAX_FIELDS}')
    fields: dict[str, Field] = {}
    for raw in msg.fields:
        field = Field(raw.name, int(raw.offset), int(raw.datatype), int(raw.count) or 1)
        if field.datatype not in DTYPES:
            raise CloudFormatError(
                f'{topic}: field {field.name!r} has datatype {field.datatype}, '
                f'expected one of {min(DTYPES)} to {max(DTYPES)}'
            )
        end = field.offset + field.count * np.dtype(DTYPES[field.datatype]).itemsize
        if end > msg.point_step:
            raise CloudFormatError(
                f'{topic}: field {field.name!r} ends at byte {end} of a point, '
                f'expected at most point_step = {msg.point_step}'
            )
        first = fields.setdefault(field.name, field) if field.name else field
        if field != first and field.name in ('x', 'y', 'z'):
            raise CloudFormatError(f'{topic}: two fields {field.name!r} that differ, expected one')
        if field != first:
            warn_of_layout(topic, f'two fields {field.name!r} that differ, the first is read')
    return fields


def check_overlap(fields: Mapping[str, Field], topic: str) -> None:
    """
    Raise CloudFormatError if fields share bytes of a point.

    Without overlap all columns together are no larger than the message. A 3 MB message with 200
    overlapping fields took 5.7 GB.
    """
    ordered = sorted(fields.values(), key=attrgetter('offset'))
    for lower, field in pairwise(ordered):
        end = lower.offset + lower.count * np.dtype(DTYPES[lower.datatype]).itemsize
        if field.offset < end:
            raise CloudFormatError(
                f'{topic}: field {field.name!r} at byte {field.offset} of a point overlaps field '
                f'{lower.name!r}, which ends at byte {end}'
            )


def checked_coordinate(fields: Mapping[str, Field], topic: str, name: str) -> Field:
    """Return the field x, y or z; raise CloudFormatError if it is missing or not a float."""
    if name not in fields:
        names = ', '.join(fields) or 'none'
        raise CloudFormatError(
            f'{topic}: no field {name} among {names}; is this a PointCloud2 of points?'
        )
    field = fields[name]
    if field.datatype not in (FLOAT32, FLOAT64) or field.count != 1:
        raise CloudFormatError(
            f'{topic}: field {name} has datatype {field.datatype} and count {field.count}, '
            f'expected {FLOAT32} (FLOAT32) or {FLOAT64} (FLOAT64) and 1'
        )
    return field


@dataclass(frozen=True, slots=True)
class Points:
    """The data of a checked message: one axis over all points, or two if rows are padded."""

    data: npt.NDArray[np.uint8]
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    order: str

    @classmethod
    def of(cls, msg: Any, data: npt.NDArray[np.uint8]) -> Points:
        """Return the points of a message whose sizes have been checked."""
        height, width, point_step = int(msg.height), int(msg.width), int(msg.point_step)
        order = '>' if msg.is_bigendian else '<'
        row_step = row_bytes(msg, len(data))
        if height == 1 or row_step == width * point_step:
            return cls(data, (height * width,), (point_step,), order)
        return cls(data, (height, width), (row_step, point_step), order)

    def view(self, field: Field) -> npt.NDArray[Any]:
        """Return a view of a field of every point, (..., count) if its count is over 1."""
        dtype = np.dtype(self.order + DTYPES[field.datatype])
        shape, strides = self.shape, self.strides
        if field.count > 1:
            shape, strides = (*shape, field.count), (*strides, dtype.itemsize)
        items: npt.NDArray[Any] = np.ndarray(shape, dtype, self.data, field.offset, strides)
        return items


def column(points: Points, fields: Mapping[str, Field], name: str) -> npt.NDArray[Any]:
    """
    Return one field of all points, (N,) or (N, count), read-only and in native byte order.

    It is a view, or a copy if the byte order is another or rows are padded.
    """
    field = fields[name]
    values = points.view(field)
    values = values.astype(values.dtype.newbyteorder('='), copy=False)
    values = values.reshape(-1, field.count) if field.count > 1 else values.reshape(-1)
    values.flags.writeable = False
    return values


def coordinates(points: Points, xyz: Sequence[Field]) -> LazyPoints:
    """Return three fields as points that are decoded when they are first read."""
    x, y, z = views = tuple(map(points.view, xyz))
    dtype = np.result_type(*views).newbyteorder('=')
    num_points = math.prod(points.shape)
    is_uniform = x.dtype == y.dtype == z.dtype == dtype and x.ndim == 1
    decode = partial(packed, views, num_points, dtype)
    return LazyPoints(num_points, decode, views if is_uniform else None)


BLOCK = 4096
"""Points gathered at once: their bytes stay in the cache for all three coordinates."""


def packed(
    views: tuple[npt.NDArray[Any], ...], num_points: int, dtype: np.dtype[Any]
) -> npt.NDArray[Any]:
    """Return three views of all points as a new (N, 3) array in Fortran order."""
    points: npt.NDArray[Any] = np.empty((num_points, 3), dtype, order='F')
    if views[0].ndim > 1:
        for axis, values in enumerate(views):
            points[:, axis].reshape(values.shape)[...] = values
        return points
    for start in range(0, num_points, BLOCK):
        rows = slice(start, start + BLOCK)
        for axis, values in enumerate(views):
            points[rows, axis] = values[rows]
    return points


def from_columns(columns: Mapping[str, npt.NDArray[Any]]) -> CloudBytes:
    """
    Return the bytes of a PointCloud2 of one row with a field for every column.

    Parameters
    ----------
    columns : mapping of str to (K,) or (K, C) array
        Of any type of a PointField; C becomes the count of the field. Every field starts at a
        multiple of the size of its type, so that decoders read aligned numbers.

    Raises
    ------
    ValueError
        If there are no columns, or one has no name, another number of rows, or another type.

    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = [values.shape for values in arrays.values()]
    tables = all(len(shape) == 1 or (len(shape) == 2 and shape[1] > 0) for shape in shapes)
    if not tables or not all(arrays) or len({shape[0] for shape in shapes}) != 1:
        raise ValueError(
            f'columns {[*arrays]} of shapes {shapes}, expected names, and (K,) or (K, C) alike'
        )
    for name, values in arrays.items():
        if values.dtype.newbyteorder('=') not in DATATYPES:
            raise ValueError(
                f'column {name}: dtype {values.dtype}, expected one of {[*DTYPES.values()]}'
            )
    formats = [(values.dtype.newbyteorder('<'), values.shape[1:]) for values in arrays.values()]
    layout = np.dtype({'names': [*arrays], 'formats': formats}, align=True)
    points = np.zeros(shapes[0][0], layout)  # zeros, so that the padding is deterministic
    for name, values in arrays.items():
        points[name] = values
    return CloudBytes(
        height=1,
        width=len(points),
        fields=tuple(field_of(name, layout) for name in arrays),
        is_bigendian=False,
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=all(np.isfinite(values).all() for values in arrays.values()),
    )


def cloud_bytes(cloud: CloudBytes, *, stamp_ns: int, frame_id: str) -> bytes:
    """Return the serialised sensor_msgs/PointCloud2 of a cloud."""
    writer = MessageWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.numbers('I', cloud.height, cloud.width, len(cloud.fields))
    for member in cloud.fields:
        writer.string(member.name)
        writer.numbers('I', member.offset)
        writer.numbers('B', member.datatype)
        writer.numbers('I', member.count)
    writer.numbers('?', cloud.is_bigendian)
    writer.numbers('I', cloud.point_step, cloud.row_step)
    writer.sequence(cloud.data, 'u1')
    writer.numbers('?', cloud.is_dense)
    return writer.join()


def field_of(name: str, layout: np.dtype[Any]) -> Field:
    """Return the PointField of one column of a structured dtype."""
    assert layout.fields is not None
    dtype, offset = layout.fields[name][:2]
    count = dtype.shape[0] if dtype.shape else 1
    return Field(name, offset, DATATYPES[dtype.base.newbyteorder('=')], count)


def parse_cloud(raw: bytes | memoryview, *, ros1: bool = False, topic: str = 'points') -> RawCloud:
    """
    Return the PointCloud2 in serialised bytes, without copying its data.

    Parameters
    ----------
    raw : bytes or memoryview
        The message: CDR in either byte order, or as ROS 1 writes it.
    ros1 : bool
        Whether ROS 1 wrote it.
    topic : str
        Named in errors.

    Raises
    ------
    CloudFormatError
        If the bytes are truncated, or are not such a message.

    """
    try:
        reader = MessageReader(raw, ros1=ros1)
        header = read_header(reader)
        height, width, num_fields = reader.numbers('III')
        if num_fields > MAX_FIELDS:
            raise ValueError(f'{num_fields} fields announced, expected at most {MAX_FIELDS}')
        fields = []
        for _ in range(num_fields):
            fields.append(Field(reader.string(), *reader.numbers('IBI')))
        is_bigendian, point_step, row_step = reader.numbers('BII')
        return RawCloud(
            header=header,
            height=height,
            width=width,
            fields=fields,
            is_bigendian=bool(is_bigendian),
            point_step=point_step,
            row_step=row_step,
            data=np.frombuffer(reader.sequence(), np.uint8),
            is_dense=bool(reader.numbers('B')[0]),
        )
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise CloudFormatError(
            f'{topic}: {len(raw)} bytes that are not a whole PointCloud2: {error}'
        ) from error


WORD_BYTES = 4


def append_fields(
    msg: Any, words: npt.NDArray[np.uint32], fields: Sequence[tuple[str, int, int]]
) -> CloudBytes:
    """
    Return a cloud with appended fields of four-byte numbers; the other bytes are unchanged.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        Or any object with its attributes; a message that could be decoded.
    words : (N, W) uint32
        The appended numbers of each point, in native byte order.
    fields : sequence of (str, int, int)
        Name, datatype and count of each appended field.

    Two passes over the bytes for any number of fields: 1.4 ms for 131072 points of 32 bytes.

    """
    height, width, step = int(msg.height), int(msg.width), int(msg.point_step)
    data = np.frombuffer(msg.data, np.uint8)
    points: npt.NDArray[Any] = np.ndarray(
        (height, width), f'V{step}', data, 0, (row_bytes(msg, len(data)), step)
    )
    offset = -(-step // WORD_BYTES) * WORD_BYTES
    added = f'V{words.shape[1] * WORD_BYTES}'
    layout = np.dtype(
        {'names': ['point', 'added'], 'formats': [f'V{step}', added], 'offsets': [0, offset]}
    )
    cloud = np.zeros((height, width), layout)
    cloud['point'] = points
    ordered = np.ascontiguousarray(words, '>u4' if msg.is_bigendian else '<u4')
    cloud['added'] = ordered.view(added).reshape(height, width)
    placed = []
    for name, datatype, count in fields:
        placed.append(Field(name, offset, datatype, count))
        offset += count * WORD_BYTES
    return CloudBytes(
        height=height,
        width=width,
        fields=(*msg.fields, *placed),
        is_bigendian=bool(msg.is_bigendian),
        point_step=layout.itemsize,
        row_step=layout.itemsize * width,
        data=cloud.reshape(-1).view(np.uint8),
        is_dense=bool(msg.is_dense),
    )
