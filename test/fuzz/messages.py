# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Harnesses of messages: clouds, images, poses, and a mapper that receives them."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, SurfelMapperError
from surfel_mapper.messages.compressed_image import unpacked
from surfel_mapper.messages.images import camera_in, CameraImage, depth_scan
from surfel_mapper.messages.pointcloud2 import Field, parse_cloud, to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.fuzz.source import Source

START_NS = 1_700_000_000_000_000_000


def cloud_bytes(data: bytes) -> None:
    """Read a cloud as ROS 1 or 2 serialises it, and its points."""
    with contextlib.suppress(SurfelMapperError):
        read(to_scan(parse_cloud(data[1:], ros1=bool(data[:1] > b'\x7f'))))


def cloud_message(data: bytes) -> None:
    """Read the points of a message with generated members."""
    source = Source(data)
    fields = [
        Field(
            source.pick(('x', 'y', 'z', '', 'intensity', 'x\0')) if source.chance(4) else name,
            unsigned(source) if source.chance(4) else 4 * place,
            source.below(12) if source.chance(4) else 7,
            unsigned(source) if source.chance(4) else 1,
        )
        for place, name in enumerate('xyz' + 'i' * source.below(4))
    ]
    height, width, point_step = source.pick(((1, 5, 16), (5, 1, 16), (2, 3, 20), (1, 0, 0)))
    row_step = point_step * width
    if source.chance(2):
        height, width, point_step, row_step = (
            unsigned(source) if source.chance(3) else value
            for value in (height, width, point_step, row_step)
        )
    size = unsigned(source) % 4096 if source.chance(4) else row_step * height % 65536
    message = SimpleNamespace(
        header=header(source),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=source.chance(2),
        point_step=point_step,
        row_step=row_step,
        data=source.bytes(size),
    )
    with contextlib.suppress(SurfelMapperError):
        read(to_scan(message))


def depth_image(data: bytes) -> None:
    """Read a depth image and the calibration of its camera, with generated members."""
    source = Source(data)
    width, height = source.below(9), source.below(9)
    roi = SimpleNamespace(
        **{
            name: unsigned(source) if source.chance(8) else 0
            for name in ('width', 'height', 'x_offset', 'y_offset')
        }
    )
    matrix = [source.real() if source.chance(4) else 1.0 for _ in range(12)]
    info = SimpleNamespace(
        p=matrix if source.chance(2) else matrix[: source.below(12)],
        k=matrix[:9],
        roi=roi,
        binning_x=source.below(3),
        binning_y=source.below(3),
        width=width,
        height=unsigned(source) if source.chance(4) else height,
    )
    encoding = source.pick(('16UC1', '32FC1', 'mono16', 'rgb8', ''))
    step = unsigned(source) if source.chance(4) else width * (4 if encoding == '32FC1' else 2)
    image = SimpleNamespace(
        header=header(source),
        encoding=encoding,
        height=height,
        width=width,
        step=step,
        is_bigendian=source.below(2),
        data=source.bytes(step * height % 4096),
    )
    with contextlib.suppress(SurfelMapperError):
        read(depth_scan(CameraImage(image, camera_in(info))))


def packed_image(data: bytes) -> None:
    """Read a compressed image; the first byte selects the format."""
    ways = (
        ('16UC1; compressedDepth png', True),
        ('32FC1; compressedDepth png', True),
        ('rgb8; jpeg compressed', False),
        ('png', True),
    )
    format_, exact = ways[data[0] % 4 if data else 0]
    message = SimpleNamespace(header=None, format=format_, data=data[1:])
    with contextlib.suppress(CloudFormatError):
        unpacked(message, '/image', exact=exact).data.tobytes()


def drive(data: bytes) -> None:
    """Map generated scans and poses; every scan must be counted."""
    source = Source(data)
    mapper = Mapper(
        Config.from_mapping(
            {
                'pose.source': source.pick(('odometry', 'tf', 'identity')),
                'window.max_scans': source.pick((2, 3, 1)),
                'map.voxel_size_m': source.pick((0.5, 0.001, 1000.0)),
                'frames.base': 'lidar',
            }
        )
    )
    mapper._pipeline.drops.warn = lambda cause, message: None  # thousands say nothing here
    stamp_ns = START_NS
    for _ in range(2 + source.below(12)):
        step_ns = source.number() * source.pick((1, 10**6, 10**9)) if source.chance(3) else 10**8
        stamp_ns = min(max(stamp_ns + step_ns, 0), 2**62)
        if source.below(3):
            add_pose(mapper, source, stamp_ns)
        if source.below(3):
            scan = scan_of(source, stamp_ns)
            with contextlib.suppress(SurfelMapperError):
                mapper.add_scan(scan)
        for update in mapper.insert_ready():
            assert np.isfinite(update.changed.position).all()
    mapper.finish()
    counters = mapper.counters
    gone = counters.mapped + counters.gated + sum(counters.dropped.values())
    assert counters.received == gone, counters.summary()['scans']
    anew = mapper.map.copy()
    for scan in mapper.window:
        anew.remove(scan.moments)
    assert len(anew) == 0


def add_pose(mapper: Mapper, source: Source, stamp_ns: int) -> None:
    """Give a mapper a pose, sometimes an invalid one."""
    xyz = [source.real() if source.chance(6) else float(source.below(9)) for _ in range(3)]
    turn = [0.0, 0.0, 0.0, 1.0]
    if source.chance(4):
        turn = [source.real() for _ in range(4)]
    parent = source.text() if source.chance(5) else 'odom'
    child = source.text() if source.chance(5) else 'lidar'
    mapper.add_pose(parent, child, stamp_ns, xyz, turn, static=source.chance(6))


def scan_of(source: Source, stamp_ns: int) -> Scan:
    """Return a scan of a few points, some of them not finite."""
    dtype = source.pick((np.float32, np.float64))
    points = np.frombuffer(source.bytes(24 * 3), '<f8').reshape(-1, 3).copy()
    if source.below(4):
        points = np.arange(24.0).reshape(-1, 3)
        points[0, 0] = source.real()
    with np.errstate(over='ignore', invalid='ignore'):
        points = points.astype(dtype)
    frame_id = source.text() if source.chance(6) else 'lidar'
    return Scan(points=points, stamp_ns=stamp_ns, frame_id=frame_id)


def unsigned(source: Source) -> int:
    """Return a number that a uint32 of a message may have."""
    return source.number() % 2**32


def header(source: Source) -> SimpleNamespace:
    """Return the header of a message, sometimes with an invalid stamp."""
    stamp = SimpleNamespace(
        sec=source.number() if source.chance(8) else 1, nanosec=unsigned(source)
    )
    return SimpleNamespace(stamp=stamp, frame_id=source.text())


def read(scan: Scan) -> None:
    """Touch every byte of a scan."""
    for values in (scan.points, *scan.columns.values()):
        np.ascontiguousarray(values).tobytes()
