# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Small bags for tests, written by rosbags: a sensor that drives past a floor and a wall.

The sensor looks along x, 1 m above a floor at z = 0 in odom, and moves by 0.5 m along x between
scans. Poses come as /tf with /tf_static, as /odom and as /pose, one at the stamp of every scan.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.writer import Writer
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
NUM_SCANS = 6
HEIGHT_M = 0.75
MOUNT_M = (0.0, 0.0, 0.25)

CLOUD = 'sensor_msgs/msg/PointCloud2'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE = 'geometry_msgs/msg/PoseStamped'
TF = 'tf2_msgs/msg/TFMessage'

ROS2 = get_typestore(Stores.ROS2_JAZZY)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', TF))


class Entries(list):
    """Messages to write, made with the classes of one ROS version."""

    def __init__(self, store=ROS2):
        self.store = store
        super().__init__()

    def make(self, type_: str, **values: Any) -> Any:
        return self.store.types[type_](**values)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self.make(
            'builtin_interfaces/msg/Time', sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        extra = {'seq': 7} if self.store is ROS1 else {}
        return self.make('std_msgs/msg/Header', stamp=time, frame_id=frame_id, **extra)

    def cloud(self, topic, stamp_ns, points, frame_id='lidar'):
        columns = np.column_stack([points, np.zeros(len(points))]).astype('<f4')
        names = ('x', 'y', 'z', 'intensity')
        fields = [
            self.make('sensor_msgs/msg/PointField', name=name, offset=4 * i, datatype=7, count=1)
            for i, name in enumerate(names)
        ]
        message = self.make(
            CLOUD,
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * len(points),
            data=np.frombuffer(columns.tobytes(), np.uint8),
            is_dense=True,
        )
        self.append((topic, CLOUD, stamp_ns + 1000, message))

    def vector(self, type_, xyz):
        return self.make(f'geometry_msgs/msg/{type_}', **dict(zip('xyz', xyz, strict=True)))

    def no_turn(self):
        return self.make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)

    def pose(self, xyz):
        return self.make(
            'geometry_msgs/msg/Pose',
            position=self.vector('Point', xyz),
            orientation=self.no_turn(),
        )

    def transform(self, topic, stamp_ns, parent, child, xyz):
        transform = self.make(
            'geometry_msgs/msg/Transform',
            translation=self.vector('Vector3', xyz),
            rotation=self.no_turn(),
        )
        stamped = self.make(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )
        self.append((topic, TF, stamp_ns, self.make(TF, transforms=[stamped])))

    def odometry(self, topic, stamp_ns, xyz):
        zero = self.vector('Vector3', (0.0, 0.0, 0.0))
        pose = self.pose(xyz)
        twist = self.make('geometry_msgs/msg/Twist', linear=zero, angular=zero)
        unknown = {'covariance': np.zeros(36)}
        message = self.make(
            ODOMETRY,
            header=self.header(stamp_ns, 'odom'),
            child_frame_id='base_link',
            pose=self.make('geometry_msgs/msg/PoseWithCovariance', pose=pose, **unknown),
            twist=self.make('geometry_msgs/msg/TwistWithCovariance', twist=twist, **unknown),
        )
        self.append((topic, ODOMETRY, stamp_ns, message))

    def pose_stamped(self, topic, stamp_ns, xyz):
        message = self.make(POSE, header=self.header(stamp_ns, 'odom'), pose=self.pose(xyz))
        self.append((topic, POSE, stamp_ns, message))


def drive(store=ROS2, num_scans: int = NUM_SCANS) -> Entries:
    """Return the messages of the drive, in the order of their record time."""
    entries = Entries(store)
    rng = np.random.default_rng(5)
    floor = rng.uniform((-4.0, -4.0, -1.0), (4.0, 4.0, -1.0), (3000, 3))
    wall = rng.uniform((-4.0, 3.1, -1.0), (4.0, 3.1, 1.0), (1500, 3))
    points = np.concatenate([floor, wall])
    entries.transform('/tf_static', START_NS, 'base_link', 'lidar', MOUNT_M)
    for i in range(num_scans):
        stamp_ns = START_NS + i * PERIOD_NS
        base = (0.5 * i, 0.0, HEIGHT_M)
        entries.transform('/tf', stamp_ns, 'odom', 'base_link', base)
        entries.odometry('/odom', stamp_ns, base)
        entries.pose_stamped('/pose', stamp_ns, base)
        entries.cloud('/points', stamp_ns, points)
    return entries


def write_rosbag2(
    path: Path, entries: Entries, storage: str = 'mcap', compression: str = 'none'
) -> Path:
    """Write a rosbag2 directory; storage is mcap or sqlite3."""
    writer = rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_, record_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=ROS2)
            raw = ROS2.serialize_cdr(message, type_)
            writer.write(connections[topic], record_ns, raw)
    return path


def write_mcap(path: Path, entries: Entries, **options: Any) -> Path:
    """Write an mcap file with the library of the format; a chunk holds one scan of the drive."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, **{'chunk_size': 50_000, **options})
        writer.start('ros2')
        channels: dict[str, int] = {}
        for topic, type_, record_ns, message in entries:
            if topic not in channels:
                schema = writer.register_schema(type_, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            raw = ROS2.serialize_cdr(message, type_)
            writer.add_message(channels[topic], record_ns, raw, record_ns)
        writer.finish()
    return path


def write_ros1(path: Path, entries: Entries, compression: str | None = None) -> Path:
    """Write a ROS 1 bag; compression is None, BZ2 or LZ4."""
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_, record_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=ROS1)
            writer.write(connections[topic], record_ns, ROS1.serialize_ros1(message, type_))
    return path


def cut(path: Path, keep: float) -> None:
    """Cut a file off, as a full disk or a lost connection does."""
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])
