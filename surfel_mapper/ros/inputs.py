# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node subscribes to: clouds, and the poses that ``pose.source`` names.

Callbacks pass messages on to the mapping thread and do nothing else, so that nothing waits in
the middleware: where a queue of messages is full there, the oldest is overwritten and nobody is
told. What the middleware does tell, that messages were lost on the way, is counted.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, DependencyError
from surfel_mapper.io.pose_messages import ODOMETRY, POSE, poses_in, TF
from surfel_mapper.ros.mapping_thread import MappingThread

CLOUDS = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; holds 2 s of a lidar at 10 Hz, should a service take as long."""

POSES = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)

TRANSFORMS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

STATIC_TRANSFORMS = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class Inputs:
    """
    The subscriptions of a node.

    Parameters
    ----------
    node : Node
        Whose subscriptions they are.
    config : Config
        Its ``pose.source`` and ``frames.base``.
    thread : MappingThread
        Takes what comes in.

    Attributes
    ----------
    cloud_topic : str
        The full name of the topic of clouds.
    clouds_lost : int
        Clouds that were published but never came, as far as the middleware knows.

    """

    def __init__(self, node: Node, config: Config, thread: MappingThread) -> None:
        """Prepare; ``subscribe`` subscribes."""
        self.cloud_topic = node.resolve_topic_name('points')
        self.clouds_lost = 0
        self._node = node
        self._config = config
        self._thread = thread
        self._subscriptions: list[Subscription] = []

    def subscribe(self) -> None:
        """
        Subscribe to everything.

        Raises
        ------
        ConfigError
            If a parameter of qos_overrides is refused.
        DependencyError
            If a package of messages is missing.

        """
        source = self._config.pose.source
        on_pose = partial(self._on_pose, source)
        if source == ODOMETRY:
            self._subscribe(Odometry, 'odom', on_pose, POSES)
        elif source == POSE:
            self._subscribe(PoseStamped, 'pose', on_pose, POSES)
        elif source == TF:
            message = transform_message()
            self._subscribe(message, '/tf_static', self._on_static, STATIC_TRANSFORMS)
            self._subscribe(message, '/tf', on_pose, TRANSFORMS)
        lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
        self._subscribe(PointCloud2, 'points', self._on_cloud, CLOUDS, lost)

    def unsubscribe(self) -> None:
        """Take no more messages."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def topics(self) -> list[str]:
        """Return the full names of the topics subscribed to."""
        return [self._node.resolve_topic_name(found.topic) for found in self._subscriptions]

    def loss(self) -> str:
        """Return how many clouds were lost on the way and what to do about it, or nothing."""
        if not self.clouds_lost:
            return ''
        return (
            f'{self.clouds_lost} clouds of {self.cloud_topic} lost on the way: large best-effort '
            'messages need more shared memory than Fast DDS has by default; start their '
            'publisher with the profile fastdds_shm.xml, see README.md'
        )

    def _subscribe(
        self,
        message: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        events: SubscriptionEventCallbacks | None = None,
    ) -> None:
        """Subscribe, with a quality of service that the user may override."""
        try:
            subscription = self._node.create_subscription(
                message,
                topic,
                callback,
                copy.copy(qos),  # rclpy enters the overrides in what it is given
                event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        except (ParameterException, InvalidQosOverridesError, RuntimeError) as error:
            name = self._node.resolve_topic_name(topic)
            raise ConfigError(f'qos_overrides.{name}.subscription: {error}') from error
        self._subscriptions.append(subscription)

    def _on_cloud(self, msg: PointCloud2) -> None:
        self._thread.put_cloud(msg, self.cloud_topic)

    def _on_pose(self, kind: str, msg: Any) -> None:
        self._thread.put_poses(poses_in(kind, msg, self._config.frames.base))

    def _on_static(self, msg: Any) -> None:
        self._thread.put_poses(poses_in(TF, msg, self._config.frames.base), static=True)

    def _on_lost(self, event: QoSMessageLostInfo) -> None:
        self.clouds_lost = event.total_count
        self._node.get_logger().warning(self.loss(), throttle_duration_sec=10.0)


def transform_message() -> Any:
    """
    Return the class tf2_msgs/TFMessage.

    Raises
    ------
    DependencyError
        If it is not installed; says what to install, and what works without.

    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise DependencyError(
            'pose.source tf needs the package tf2_msgs, which is not installed: '
            '`sudo apt install ros-jazzy-tf2-msgs`. PyPI has no such package; with ROS from '
            'there use pose.source odometry or pose, and frames.base_to_sensor'
        ) from error
    return TFMessage
