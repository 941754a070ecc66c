# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes where it finds poses itself, and where it is told to begin.

Odometry and transform go out with every scan, the track once a second. They are those of the
fixed frame, which never jumps; an alignment of the window moves the map above it.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import numpy.typing as npt
from rclpy.node import Node
from std_msgs.msg import Header

from surfel_mapper.errors import DependencyError
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.ros.alignment import fill, pose_message
from surfel_mapper.ros.inputs import transform_message
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.publishing import LATCHED

MAX_TRACK = 1000
"""The track holds the poses of so many scans, the newest."""

TRACK_EVERY_NS = 10**9

UNKNOWN = 1e-6
"""Information, 1/m^2 and 1/rad^2, that stands for none: a standard deviation of 1 km."""


def registration_outputs(
    node: Node, mapper: Mapper, thread: MappingThread
) -> RegistrationOutputs | None:
    """Return what publishes the poses that a mapper finds; None where it finds none itself."""
    registered = mapper.registered
    return None if registered is None else RegistrationOutputs(node, mapper, registered, thread)


class RegistrationOutputs:
    """
    Publishers of odometry, track and transform, and the subscription of the initial pose.

    Parameters
    ----------
    node : Node
        Whose they are.
    mapper : Mapper
        Its configuration, and what takes an initial pose.
    registered : RegisteredPoses
        Of the mapper.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(
        self, node: Node, mapper: Mapper, registered: RegisteredPoses, thread: MappingThread
    ) -> None:
        """Make the publishers; say so where there can be no transform."""
        self._mapper = mapper
        self._registered = registered
        self._thread = thread
        self._log = node.get_logger()
        self._odometry = node.create_publisher(Odometry, '~/odometry', 10)
        self._track = node.create_publisher(Path, '~/track', LATCHED)
        self._transforms: Any = None
        self._poses: deque[PoseStamped] = deque(maxlen=MAX_TRACK)
        self._track_ns = 0
        node.create_subscription(
            PoseWithCovarianceStamped, '/initialpose', self._on_initial_pose, 1
        )
        if not mapper.config.registration.publish_tf:
            return
        try:
            self._message = transform_message()
        except DependencyError as error:
            self._log.warning(
                'registration.publish_tf: the transform from '
                f'{mapper.config.frames.fixed} is not published, ~/odometry is: {error}'
            )
            return
        self._transforms = node.create_publisher(self._message, '/tf', 100)

    def publish(self, update: Update) -> None:
        """Publish where a scan was found; called in the mapping thread."""
        header = Header(
            stamp=time_message(update.stamp_ns), frame_id=self._mapper.config.frames.fixed
        )
        if self._odometry.get_subscription_count():
            self._odometry.publish(self._odometry_message(header, update))
        if self._transforms is not None:
            self._transforms.publish(self._message(transforms=[self._transform(header)]))
        pose = pose_message(self._registered.T_fixed_body)
        self._poses.append(PoseStamped(header=header, pose=pose))
        if abs(update.stamp_ns - self._track_ns) >= TRACK_EVERY_NS:
            self._track_ns = update.stamp_ns
            self._track.publish(Path(header=header, poses=list(self._poses)))

    def _odometry_message(self, header: Header, update: Update) -> Odometry:
        """Return pose and velocity of what is followed."""
        message = Odometry(header=header, child_frame_id=self._registered.body)
        message.pose.pose = pose_message(self._registered.T_fixed_body)
        if update.registration is not None:
            message.pose.covariance = covariance(update.registration.information).ravel()
        fill(message.twist.twist.linear, self._registered.twist[:3])
        fill(message.twist.twist.angular, self._registered.twist[3:])
        return message

    def _transform(self, header: Header) -> TransformStamped:
        """Return where what is followed is in the fixed frame."""
        message = TransformStamped(header=header, child_frame_id=self._registered.body)
        fill(message.transform.translation, self._registered.T_fixed_body[:3, 3])
        fill(message.transform.rotation, q_xyzw(self._registered.T_fixed_body))
        return message

    def _on_initial_pose(self, msg: PoseWithCovarianceStamped) -> None:
        """Have the mapper go on from a pose that somebody states; called by the executor."""
        self._thread.call(partial(self._start_from, msg))

    def _start_from(self, msg: PoseWithCovarianceStamped) -> None:
        """Go on from a pose, and say so; called in the mapping thread."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        xyz, xyzw = (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
        if self._mapper.start_from(msg.header.frame_id, xyz, xyzw):
            self._log.info(f'goes on from the initial pose at ({p.x:.2f}, {p.y:.2f}, {p.z:.2f})')


def covariance(information: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the covariance, (6, 6), of position and turn; huge where nothing is known."""
    return np.asarray(np.linalg.inv(information + UNKNOWN * np.eye(6)), np.float64)
