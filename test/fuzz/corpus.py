# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Seeds of the search: small well-formed inputs."""

from __future__ import annotations

from collections.abc import Callable
import io
from pathlib import Path
import struct
import tempfile

import numpy as np

from surfel_mapper.config import Config, TsdfConfig
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import save_map
from surfel_mapper.files.tsdf_state import save_tsdf
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from test.bags import recorded

NUM_POINTS = 7


def written(write: Callable[[Path], object], name: str) -> bytes:
    """Return the bytes that a function writes to a file."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, name)
        found = write(path)
        path = found if isinstance(found, Path) else path
        return path.read_bytes()


def noise() -> list[bytes]:
    """Return bytes for harnesses that derive choices from them."""
    rng = np.random.default_rng(3)
    return [b'', *(rng.bytes(size) for size in (40, 200, 600))]


def packed_images() -> list[bytes]:
    """Return small images as PNG and JPEG, after a byte for the format."""
    from PIL import Image

    depth = np.arange(12, dtype=np.uint16).reshape(3, 4) * 900
    color = np.random.default_rng(4).integers(0, 256, (8, 8, 3)).astype(np.uint8)
    header = np.int32(0).tobytes() + np.array([1e4, -900.0], np.float32).tobytes()
    ways = (
        (0, header, depth, 'PNG'),
        (1, header, depth, 'PNG'),
        (2, b'', color, 'JPEG'),
        (2, b'', color, 'PNG'),
        (3, b'', color[..., 0].copy(), 'PNG'),
    )
    found = []
    for way, before, pixels, kind in ways:
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, kind)
        found.append(bytes([way]) + before + file.getvalue())
    return found


def small_drive(store=recorded.ROS2) -> recorded.Entries:
    """Return the messages of a drive with few points."""
    entries = recorded.Entries(store)
    points = np.random.default_rng(5).uniform(-4.0, 4.0, (NUM_POINTS, 3))
    entries.transform('/tf_static', recorded.START_NS, 'base_link', 'lidar', recorded.MOUNT_M)
    for i in range(2):
        stamp_ns = recorded.START_NS + i * recorded.PERIOD_NS
        entries.odometry('/odom', stamp_ns, (0.5 * i, 0.0, 0.0))
        entries.cloud('/points', stamp_ns, points)
    return entries


def clouds() -> list[bytes]:
    """Return clouds serialised for ROS 2 and ROS 1, after a byte for the version."""
    found = []
    for store, first in ((recorded.ROS2, b'\0'), (recorded.ROS1, b'\xff')):
        message = next(m for _, type_, _, m in small_drive(store) if type_ == recorded.CLOUD)
        serialise = store.serialize_cdr if first == b'\0' else store.serialize_ros1
        found.append(first + bytes(serialise(message, recorded.CLOUD)))
    return found


def rosbag2(storage: str) -> list[bytes]:
    """Return bags of ROS 2, messages as they are and packed."""

    def write(compression: str) -> Callable[[Path], Path]:
        def to(path: Path) -> Path:
            directory = recorded.write_rosbag2(path, small_drive(), storage, compression)
            return next(f for f in directory.iterdir() if f.suffix in ('.mcap', '.db3'))

        return to

    return [written(write(compression), 'bag') for compression in ('none', 'message')]


def mcap() -> list[bytes]:
    """Return mcap files with every packing and without chunks, and one that is cut off."""
    from mcap.writer import CompressionType, Writer

    def write(**options) -> Callable[[Path], None]:
        def to(path: Path) -> None:
            with open(path, 'wb') as file:
                writer = Writer(file, chunk_size=2048, **options)
                writer.start('ros2', '')
                channels = {}
                for topic, type_, record_ns, message in small_drive():
                    if topic not in channels:
                        schema = writer.register_schema(type_, 'ros2msg', b'')
                        channels[topic] = writer.register_channel(topic, 'cdr', schema)
                    raw = bytes(recorded.ROS2.serialize_cdr(message, type_))
                    writer.add_message(channels[topic], record_ns, raw, record_ns)
                writer.finish()

        return to

    packed = [write(compression=kind) for kind in CompressionType]
    files = [written(to, 'a.mcap') for to in (*packed, write(use_chunking=False))]
    return [*rosbag2('mcap'), *files, files[0][: len(files[0]) // 2]]


def sqlite() -> list[bytes]:
    """Return sqlite3 bags, and one that is cut off."""
    files = rosbag2('sqlite3')
    return [*files, files[0][: len(files[0]) - 4096]]


def ros1() -> list[bytes]:
    """Return bags of ROS 1 with every packing, and one that is cut off."""

    def write(packing: str | None) -> Callable[[Path], Path]:
        return lambda path: recorded.write_ros1(path, small_drive(recorded.ROS1), packing)

    files = [written(write(packing), 'a.bag') for packing in (None, 'BZ2', 'LZ4')]
    return [*files, files[0][: len(files[0]) // 2]]


def metadata() -> list[bytes]:
    """Return the metadata.yaml of a bag."""

    def write(path: Path) -> Path:
        return recorded.write_rosbag2(path, small_drive()) / 'metadata.yaml'

    return [written(write, 'bag')]


def packed() -> list[bytes]:
    """Return bytes that zstd packed."""
    from surfel_mapper.bags.compression import import_zstd

    return [import_zstd().compress(content) for content in (b'', b'abc' * 99, bytes(200_000))]


def columns() -> dict[str, np.ndarray]:
    """Return a few points with further columns."""
    rng = np.random.default_rng(1)
    xyz = {name: rng.normal(size=NUM_POINTS).astype(np.float32) for name in 'xyz'}
    return {**xyz, 'ring': np.arange(NUM_POINTS, dtype=np.uint16), 'time': rng.uniform(size=7)}


def points_ply() -> list[bytes]:
    """Return PLY files, binary and text."""
    text = (
        b'ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n'
        b'property double z\nproperty uchar red\nend_header\n1 2 3 4\n5 nan 1e3 9\n'
    )
    return [written(lambda path: ply.write_points(path, columns()), 'a.ply'), text]


def points_pcd() -> list[bytes]:
    """Return PCD files in every encoding."""
    head = (
        b'VERSION 0.7\nFIELDS x y z _ n\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 3 2\n'
        b'WIDTH 1\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA '
    )
    literal = b'\x16' + bytes(range(23))  # an LZF literal: 23 bytes uncompressed
    packed = struct.pack('<II', len(literal), 23) + literal
    return [
        written(lambda path: pcd.write_points(path, columns()), 'a.pcd'),
        head + b'ascii\n1 2 3 0 0 0 5 6\n',
        head + b'binary_compressed\n' + packed,
    ]


def points_raw() -> list[bytes]:
    """Return bare numbers."""
    return [np.arange(40, dtype='<f4').tobytes()]


def small_map() -> tuple[SurfelMap, list[WindowedScan]]:
    """Return a map of one scan, and its window."""
    surfel_map = SurfelMap(0.5)
    points = np.random.default_rng(3).uniform(-1.0, 1.0, (30, 3))
    moments = surfel_map.add(points, origin=np.zeros(3))
    return surfel_map, [WindowedScan(moments=moments, stamp_ns=1, T_map_sensor=np.eye(4))]


def parquet() -> list[bytes]:
    """Return a map in Parquet."""
    from surfel_mapper.files.parquet import write_map

    return [written(lambda path: write_map(path, small_map()[0]), 'a.parquet')]


def state_bytes() -> list[bytes]:
    """Return a saved map."""
    return [written(lambda path: save_map(path, *small_map()), 'a.npz')]


def tsdf() -> bytes:
    """Return a saved TSDF of a wall."""
    from test.tsdf.scenes import image_of, SMALL

    blocks = BlockMap(TsdfConfig())
    Integrator(blocks).integrate(image_of(SMALL, np.full((60, 80), 1.0)), np.eye(4), 123)
    rows = blocks.rows()
    assert len(rows)
    return written(lambda path: save_tsdf(path, blocks), 'a.npz')


def trajectory() -> list[bytes]:
    """Return poses in every format."""
    return [
        b'# stamp x y z qx qy qz qw\n1.5 0 0 0 0 0 0 1\n1.6 1 2 3 0 0 0.6 0.8\n',
        b'1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n',
        b'#timestamp [ns],p_x,p_y,p_z,qx,qy,qz,qw\n1000,0,0,0,0,0,0,1\n2000,0,0,0,0,0,0,1\n',
        b'stamp_s,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n',
    ]


def shown() -> list[bytes]:
    """Return triangles as OBJ, STL and glTF, after a byte for the kind."""
    obj = b'v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n'
    stl = bytes(80) + struct.pack('<I', 1) + np.arange(12, dtype='<f4').tobytes() + bytes(2)
    glb = struct.pack('<4sIII4s', b'glTF', 2, 24, 4, b'JSON') + b'{}  '
    return [b'\0' + obj, b'\1' + stl, b'\2' + glb]


def settings() -> list[bytes]:
    """Return files of settings, with and without the keys of ROS."""
    lines = [f'  {k}: {v!r}' for k, v in list(Config().to_mapping().items())[:20]]
    return [
        b'map: {voxel_size_m: 0.5}\nwindow: {max_scans: 7}\n',
        ('/**:\n ros__parameters:\n' + '\n'.join(lines)).replace('()', '[]').encode(),
        b'a: &a {x: 1}\nb: *a\n<<: *a\n? [1]\n: 2\ndate: 2001-01-01\nnumber: 0b11\n',
    ]


def chain() -> list[bytes]:
    """Return chains of filters."""
    return [
        b'- RemoveNaNDataPointsFilter\n- VoxelGridDataPointsFilter:\n    vSizeX: 0.5\n',
        b'- range_limit: {min_m: 0.5}\n- MaxDistDataPointsFilter: {maxDist: 3, dim: -1}\n',
        b'- RandomSamplingDataPointsFilter: {prob: 0.5}\n'
        b'- SurfaceNormalDataPointsFilter: {knn: 5}\n',
        b'- &a {BoundingBoxDataPointsFilter: {xMin: -1}}\n- *a\n',
    ]


def map_url() -> list[bytes]:
    """Return names, some of which lead elsewhere."""
    names = ('map', 'a/b.npz', '../x', '/etc/passwd', 'file:///x', 'file:%2e%2e/x', 'out/x')
    return [*(name.encode() for name in names), b'deep/etc/x', b'loop', b'a\0b', b'\xff', b'//h/p']
