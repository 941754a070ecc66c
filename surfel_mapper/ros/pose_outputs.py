# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The poses that the node publishes: origin of the map, aligned path, odometry by registration.

An alignment of the window corrects poses in the map: ``~/path`` has the poses of the window's
scans after it, and the transform from the map to the odometry frame goes out with every scan.
That transform is published only if ``align.map_frame`` gives the map a frame of its own, since a
frame has one parent, and the parent of odom may be another node's to publish.

With ``map.origin`` the map has a frame whose origin is somewhere else in the fixed frame. The same
transform states it, and ``~/origin`` too, which needs no tf2_msgs.

With ``pose.source: registration`` the node finds the poses itself. Odometry and its transform go
out with every scan, ``~/track`` once a second. They are in the fixed frame, which never jumps. The
track begins anew if time is set back, or if the map is cleared or replaced.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from nav_msgs.msg import Odometry, Path
import numpy as np
import numpy.typing as npt
from rclpy.node import Node
from std_msgs.msg import Header

from surfel_mapper.errors import CloudFormatError, DependencyError
from surfel_mapper.geometry import q_xyzw, Transform
from surfel_mapper.messages.cdr import frame_name
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.map_origin import has_own_frame
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.ros.base_node import LATCHED
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import fill, pose_message, time_message
from surfel_mapper.ros.pose_inputs import transform_message

MAX_TRACK = 1000
"""Poses that ~/track holds at most, the newest; 100 s at 10 Hz."""

TRACK_PERIOD_NS = 10**9

MIN_INFORMATION = 1e-6
"""Information in 1/m^2 and 1/rad^2 added to each axis: a standard deviation of 1 km at most."""


class TransformPublisher:
    """
    Publishes transforms of one parent on /tf, if tf2_msgs is installed.

    Parameters
    ----------
    node : Node
        The node that publishes.
    setting : str
        The setting that asks for the transform, for the warning.
    parent : str
        The frame on the left of every transform.

    """

    def __init__(self, node: Node, setting: str, parent: str) -> None:
        """Create the publisher, or warn that the transform is not published."""
        self._parent = parent
        self._publisher: Any = None
        try:
            self._message = transform_message()
        except DependencyError as error:
            node.get_logger().warning(
                f'{setting}: the transform from {parent} is not published: {error}'
            )
            return
        self._publisher = node.create_publisher(self._message, '/tf', 100)

    def publish(self, stamp_ns: int, child: str, T_parent_child: Transform) -> None:
        """Publish the pose of a child frame at a time."""
        if self._publisher is None:
            return
        header = Header(stamp=time_message(stamp_ns), frame_id=self._parent)
        message = TransformStamped(header=header, child_frame_id=child)
        fill(message.transform.translation, T_parent_child[:3, 3])
        fill(message.transform.rotation, q_xyzw(T_parent_child))
        self._publisher.publish(self._message(transforms=[message]))


class OriginOutput:
    """
    Publishes the place of the map's origin in the fixed frame, once it is known and if it changes.

    Parameters
    ----------
    node : Node
        The node that publishes.
    mapper : Mapper
        The mapper whose ``map.origin`` is published, if it has one.

    """

    def __init__(self, node: Node, mapper: Mapper) -> None:
        self._mapper = mapper
        self._published: list[float] = []
        self._publisher: Any = None
        if has_own_frame(mapper.config):
            self._publisher = node.create_publisher(PointStamped, '~/origin', LATCHED)
            self.publish(0)

    def publish(self, stamp_ns: int) -> None:
        """Publish the origin, unless it is unknown or published already."""
        origin_m = self._mapper.origin_m
        if origin_m is None or origin_m.tolist() == self._published:
            return
        fixed = self._mapper.config.frames.fixed
        message = PointStamped(header=Header(stamp=time_message(stamp_ns), frame_id=fixed))
        fill(message.point, origin_m)
        self._publisher.publish(message)
        self._published = origin_m.tolist()


class AlignmentOutputs:
    """
    Publishers of the aligned path and of T_map_odom; called in the mapping thread.

    Parameters
    ----------
    node : Node
        The node that publishes.
    mapper : Mapper
        The mapper whose alignments are published.

    """

    def __init__(self, node: Node, mapper: Mapper) -> None:
        self._mapper = mapper
        self._path = node.create_publisher(Path, '~/path', LATCHED)
        self._transform: TransformPublisher | None = None
        if mapper.map_frame != mapper.config.frames.fixed:
            setting = 'align.map_frame' if mapper.config.align.map_frame else 'map.origin'
            self._transform = TransformPublisher(node, setting, mapper.map_frame)

    def publish(self, update: Update) -> None:
        """Publish the path if a scan led to an alignment, and the transform at its stamp."""
        if update.alignment is not None:
            self.publish_path()
        if self._transform is not None:
            fixed = self._mapper.config.frames.fixed
            self._transform.publish(update.stamp_ns, fixed, self._mapper.T_map_fixed)

    def publish_path(self) -> None:
        """Publish the poses of all scans if loops are closed, else of those of the window."""
        loops = self._mapper.loops
        if loops is not None:
            stamps, poses_now = loops.stamps_ns, list(loops.T_map_sensor)
        else:
            stamps = [scan.stamp_ns for scan in self._mapper.window]
            poses_now = [scan.T_map_sensor for scan in self._mapper.window]
        header = Header(stamp=time_message(stamps[-1]), frame_id=self._mapper.map_frame)
        poses = [
            PoseStamped(
                header=Header(stamp=time_message(stamp_ns), frame_id=header.frame_id),
                pose=pose_message(T_map_sensor),
            )
            for stamp_ns, T_map_sensor in zip(stamps, poses_now, strict=True)
        ]
        self._path.publish(Path(header=header, poses=poses))


def registration_outputs(
    node: Node, mapper: Mapper, thread: MappingThread
) -> RegistrationOutputs | None:
    """Return the publishers of registered poses; None unless ``pose.source`` is registration."""
    registered = mapper.registered
    return None if registered is None else RegistrationOutputs(node, mapper, registered, thread)


class RegistrationOutputs:
    """
    Publishers of odometry, track and transform, and the subscription to initialpose.

    Parameters
    ----------
    node : Node
        The node that publishes.
    mapper : Mapper
        Takes the initial pose.
    registered : RegisteredPoses
        The poses found by the mapper.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(
        self, node: Node, mapper: Mapper, registered: RegisteredPoses, thread: MappingThread
    ) -> None:
        self._mapper = mapper
        self._registered = registered
        self._thread = thread
        self._log = node.get_logger()
        self._fixed = mapper.config.frames.fixed
        self._odometry = node.create_publisher(Odometry, '~/odometry', 10)
        self._track = node.create_publisher(Path, '~/track', LATCHED)
        self._poses: deque[PoseStamped] = deque(maxlen=MAX_TRACK)
        self._track_ns = 0
        self._beginning = self._present_beginning
        self._transform: TransformPublisher | None = None
        node.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', self._on_initial_pose, 1
        )
        if mapper.config.registration.publish_tf:
            self._transform = TransformPublisher(node, 'registration.publish_tf', self._fixed)

    def publish(self, update: Update) -> None:
        """Publish the pose of a scan; called in the mapping thread."""
        T_fixed_body = update.T_fixed_body
        if T_fixed_body is None:
            return
        header = Header(stamp=time_message(update.stamp_ns), frame_id=self._fixed)
        if self._odometry.get_subscription_count():
            self._odometry.publish(self._odometry_message(header, update, T_fixed_body))
        if self._transform is not None:
            self._transform.publish(update.stamp_ns, self._registered.body, T_fixed_body)
        if self._beginning != self._present_beginning:
            self._beginning = self._present_beginning
            self._poses.clear()
            self._track_ns = 0  # the latched track is replaced at once
        self._poses.append(PoseStamped(header=header, pose=pose_message(T_fixed_body)))
        if abs(update.stamp_ns - self._track_ns) >= TRACK_PERIOD_NS:
            self._track_ns = update.stamp_ns
            self._track.publish(Path(header=header, poses=list(self._poses)))

    @property
    def _present_beginning(self) -> tuple[int, int]:
        """Return a value that changes if time is set back or the map is cleared."""
        return self._mapper.counters.resets, self._mapper.map.cleared_at

    def _odometry_message(
        self, header: Header, update: Update, T_fixed_body: Transform
    ) -> Odometry:
        """Return pose and velocity of the body as Odometry."""
        message = Odometry(header=header, child_frame_id=self._registered.body)
        message.pose.pose = pose_message(T_fixed_body)
        if update.registration is not None:
            message.pose.covariance = covariance(update.registration.information).ravel()
        fill(message.twist.twist.linear, self._registered.twist[:3])
        fill(message.twist.twist.angular, self._registered.twist[3:])
        return message

    def _on_initial_pose(self, msg: PoseWithCovarianceStamped) -> None:
        """Hand an initial pose to the mapper; called by the executor."""
        self._thread.call(partial(self._start_from, msg))

    def _start_from(self, msg: PoseWithCovarianceStamped) -> None:
        """Continue registration from a given pose; called in the mapping thread."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        xyz, xyzw = (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
        try:
            frame_id = frame_name(msg.header.frame_id)
        except CloudFormatError as error:
            self._thread.refuse_pose(f'initial pose ignored: {error}')
            return
        if self._mapper.start_from(frame_id, xyz, xyzw):
            self._log.info(f'continues from the initial pose ({p.x:.2f}, {p.y:.2f}, {p.z:.2f})')


def covariance(information: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """
    Return the covariance of a pose, (6, 6), translation first.

    Directions without information get a variance of 1e6 m^2 or rad^2 instead of infinity.
    """
    regular = information + MIN_INFORMATION * np.eye(6)
    return np.asarray(np.linalg.inv(regular), np.float64)
