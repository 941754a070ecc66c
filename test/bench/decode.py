# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Serialised PointCloud2 of 4 MiB to arrays, in the layouts of lidar drivers, beside numpy.

``median_ms`` is the processor time from the bytes to a scan, all checks included; its columns are
views. ``numpy_ms`` copies the coordinates alone out of a structured array, in turns with ours.
Every message is copied before, as the middleware does that hands it over. ``encode_ms`` is the
time from those arrays back to a cloud of aligned fields.
"""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.messages.pointcloud2 import (
    cloud_bytes,
    CloudBytes,
    DATATYPES,
    Field,
    from_columns,
    parse_cloud,
    to_scan,
)
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row

SIZE = 4 << 20

XYZ = ('x f4 0', 'y f4 4', 'z f4 8')

LAYOUTS: dict[str, tuple[int, tuple[str, ...]]] = {
    'Ouster': (
        48,
        (
            'intensity f4 16',
            't u4 20',
            'reflectivity u2 24',
            'ring u2 26',
            'ambient u2 28',
            'range u4 32',
        ),
    ),
    'Velodyne': (22, ('intensity f4 12', 'ring u2 16', 'time f4 18')),
    'Velodyne, PCL': (32, ('intensity f4 16', 'ring u2 20', 'time f4 24')),
    'Hesai': (26, ('intensity f4 12', 'ring u2 16', 'timestamp f8 18')),
    'Livox': (26, ('intensity f4 12', 'tag u1 16', 'line u1 17', 'timestamp f8 18')),
    'RoboSense': (26, ('intensity f4 12', 'ring u2 16', 'timestamp f8 18')),
    'RoboSense, XYZI': (16, ('intensity f4 12',)),
    'Nebula': (
        32,
        (
            'intensity u1 12',
            'return_type u1 13',
            'channel u2 14',
            'azimuth f4 16',
            'elevation f4 20',
            'distance f4 24',
            'time_stamp u4 28',
        ),
    ),
}
"""Bytes of a point and fields behind x y z, as the ROS drivers of these makers publish them."""

ROWS = {'Ouster': 128, 'RoboSense': 128}
"""Rows of organised clouds; others have one."""

REPEATS = 200


def run(options: Options) -> list[Row]:
    """Return a row for every layout."""
    keep_freed_memory()  # as node and replay do
    with one_core():
        return [layout_row(name, *LAYOUTS[name]) for name in LAYOUTS]


def layout_row(name: str, step: int, more: tuple[str, ...]) -> Row:
    """Return the times of one layout."""
    height = ROWS.get(name, 1)
    width = SIZE // step // height
    fields = [field_of(text) for text in (*XYZ, *more)]
    raw = message(fields, step, height, width)
    layout = np.dtype(
        {'names': ['x', 'y', 'z'], 'formats': 3 * ['f4'], 'offsets': [0, 4, 8], 'itemsize': step}
    )
    start = len(raw) - 1 - height * width * step  # before is_dense

    def by_numpy(raw: bytes) -> npt.NDArray[np.float32]:
        points = np.frombuffer(raw, layout, height * width, start)
        packed = np.empty((len(points), 3), np.float32, order='F')
        for axis, column in enumerate('xyz'):
            packed[:, axis] = points[column]
        return packed

    def by_us(raw: bytes) -> npt.NDArray[np.float32]:
        return to_scan(parse_cloud(raw)).points

    scan = to_scan(parse_cloud(raw))
    columns = {**dict(zip('xyz', scan.points.T, strict=True)), **scan.columns}

    def encode(_: bytes) -> CloudBytes:
        return from_columns(columns)

    if not np.array_equal(by_us(raw), by_numpy(raw)):
        raise RuntimeError(f'{name}: numpy reads other coordinates')
    ours_ms, numpy_ms = [], []
    for _ in range(REPEATS):
        ours_ms.append(timed(by_us, raw))
        numpy_ms.append(timed(by_numpy, raw))
    return {
        'driver': name,
        'B_point': step,
        'fields': len(fields),
        'points': height * width,
        'median_ms': float(np.median(ours_ms)),
        'p10_ms': float(np.percentile(ours_ms, 10)),
        'asked_ms': 0.5,
        'numpy_ms': float(np.median(numpy_ms)),
        'encode_ms': float(np.median([timed(encode, raw) for _ in range(REPEATS)])),
    }


def timed(work: Callable[[bytes], object], raw: bytes) -> float:
    """Return the processor time of some work on a message that just came in, ms."""
    raw = bytes(bytearray(raw))
    start = process_time()
    work(raw)
    return (process_time() - start) * 1e3


def field_of(text: str) -> Field:
    """Return a field from its name, type and offset."""
    name, dtype, offset = text.split()
    return Field(name, int(offset), DATATYPES[np.dtype(dtype)], 1)


def message(fields: list[Field], step: int, height: int, width: int) -> bytes:
    """Return a serialised cloud with random coordinates."""
    rng = np.random.default_rng(0)
    data = np.zeros(height * width * step, np.uint8)
    for field in fields[:3]:
        column = np.ndarray((height * width,), np.float32, data, field.offset, (step,))
        column[:] = rng.normal(0.0, 20.0, len(column))
    cloud = CloudBytes(
        height=height,
        width=width,
        fields=tuple(fields),
        is_bigendian=False,
        point_step=step,
        row_step=width * step,
        data=data,
        is_dense=True,
    )
    return cloud_bytes(cloud, stamp_ns=1, frame_id='lidar')
