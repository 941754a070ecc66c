# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node subscribes to: clouds or depth images, and the poses that ``pose.source`` names.

Callbacks pass messages on to the mapping thread and do nothing else, so that nothing waits in
the middleware: where a queue of messages is full there, the oldest is overwritten and nobody is
told. What the middleware does tell, that messages were lost on the way, is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import copy
from functools import partial
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from surfel_mapper.config import Config
from surfel_mapper.depth import SceneImage
from surfel_mapper.errors import CloudFormatError, ConfigError, DependencyError
from surfel_mapper.io.depth_image import (
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
    warm_up,
)
from surfel_mapper.io.pose_messages import ODOMETRY, POSE, poses_in, TF
from surfel_mapper.io.scene_image import SceneImages
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.scan import Scan

DEFAULT_TOPICS = {'cloud': 'points', 'depth': 'depth/image'}
"""Where clouds or images come in unless ``input.topics`` says so."""

CLOUDS = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; holds 2 s of a lidar at 10 Hz, should a service take as long."""

POSES = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)

TRANSFORMS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

STATIC_TRANSFORMS = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
"""What a user may set of a subscription, in ``qos_overrides``."""

LARGE_BYTES = 500_000
"""Messages from here on do not fit into the shared memory that Fast DDS has by default."""


class Inputs:
    """
    The subscriptions of a node.

    Parameters
    ----------
    node : Node
        Whose subscriptions they are.
    config : Config
        Its stages input, pose and frames.
    thread : MappingThread
        Takes what comes in.

    Attributes
    ----------
    cloud_topics : list of str
        The full names of the topics of clouds, or of depth images.
    lost : dict of str to int
        Clouds that were published but never came, by topic, as far as the middleware knows.

    """

    def __init__(self, node: Node, config: Config, thread: MappingThread) -> None:
        """Prepare; ``subscribe`` subscribes."""
        names = config.input.topics or (DEFAULT_TOPICS[config.input.kind],)
        self.cloud_topics: list[str] = [node.resolve_topic_name(name) for name in names]
        self.lost: dict[str, int] = {}
        self._heard_s = dict.fromkeys(self.cloud_topics, time.monotonic())
        self._images = DepthImages()
        self._scenes = SceneImages(config)
        self._largest_bytes = 0
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
        self._heard_s = dict.fromkeys(self.cloud_topics, time.monotonic())
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
        if source in (ODOMETRY, POSE, 'registration') and not self._config.frames.base_to_sensor:
            self._subscribe_static()
        if self._config.input.kind == 'depth':
            warm_up()
        for topic in self.cloud_topics:
            self._subscribe_clouds(topic)
        for kind, name in self._config.tsdf.image_topics.items():
            self._subscribe_images(kind, self._node.resolve_topic_name(name))

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
        if not self.lost:
            return ''
        which = ', '.join(f'{number} of {topic}' for topic, number in self.lost.items())
        if 0 < self._largest_bytes <= LARGE_BYTES:
            remedy = 'they come faster than they are taken; is the machine overloaded?'
        else:
            remedy = (
                'best-effort messages above 0.5 MB need more shared memory than Fast DDS has by '
                'default; start their publisher with the profile fastdds_shm.xml, see '
                'docs/inputs.md'
            )
        return f'clouds lost on the way ({which}): {remedy}'

    @property
    def most_silent(self) -> tuple[str, float]:
        """The topic that was not heard of for longest, and when it was last, by time.monotonic."""
        return min(self._heard_s.items(), key=lambda item: item[1])

    @property
    def clouds_lost(self) -> int:
        """How many clouds were lost on all topics."""
        return sum(self.lost.values())

    def _subscribe_clouds(self, topic: str) -> None:
        """Subscribe to one sensor."""
        lost = SubscriptionEventCallbacks(message_lost=partial(self._on_lost, topic))
        if self._config.input.kind == 'cloud':
            self._subscribe(PointCloud2, topic, partial(self._on_cloud, topic), CLOUDS, lost)
            return
        self._subscribe(
            CameraInfo, camera_info_topic(topic), partial(self._on_camera_info, topic), CLOUDS
        )
        self._subscribe(Image, topic, partial(self._on_image, topic), CLOUDS, lost)

    def _subscribe_images(self, kind: str, topic: str) -> None:
        """Subscribe to images of colours or labels, and to the calibration where needed."""
        if self._scenes.needs_cameras:
            on_info = partial(self._on_scene, partial(self._scenes.add_info, kind, topic))
            self._subscribe(CameraInfo, camera_info_topic(topic), on_info, CLOUDS)
        on_image = partial(self._on_scene, partial(self._scenes.add_image, kind, topic))
        self._subscribe(Image, topic, on_image, CLOUDS)

    def _on_scene(self, take: Callable[[Any], list[SceneImage]], msg: Any) -> None:
        try:
            for image in take(msg):
                self._thread.put_image(image)
        except CloudFormatError as error:
            self._node.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _subscribe_static(self) -> None:
        """Subscribe to how sensors are mounted, which odometry does not say."""
        try:
            message = transform_message()
        except DependencyError:
            self._node.get_logger().warning(
                'tf2_msgs is not installed, so /tf_static is not read: clouds have to be in '
                f'{self._config.frames.base}, or set frames.base_to_sensor'
            )
            return
        self._subscribe(message, '/tf_static', self._on_static, STATIC_TRANSFORMS)

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
                qos_overriding_options=QoSOverridingOptions(policy_kinds=OVERRIDABLE),
            )
        except (ParameterException, InvalidQosOverridesError, RuntimeError) as error:
            name = self._node.resolve_topic_name(topic)
            raise ConfigError(f'qos_overrides.{name}.subscription: {error}') from error
        self._subscriptions.append(subscription)

    def _on_cloud(self, topic: str, msg: PointCloud2) -> None:
        self._hear(topic, msg)
        self._thread.put_cloud(msg, topic)

    def _hear(self, topic: str, msg: Any) -> None:
        """Remember that a topic lives, and how large its messages are."""
        self._heard_s[topic] = time.monotonic()
        self._largest_bytes = max(self._largest_bytes, len(msg.data))

    def _on_image(self, topic: str, msg: Image) -> None:
        self._hear(topic, msg)
        self._put_images(topic, self._images.add_image(topic, msg))

    def _on_camera_info(self, topic: str, msg: CameraInfo) -> None:
        try:
            self._put_images(topic, self._images.add_info(topic, msg))
        except CloudFormatError as error:
            self._node.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _put_images(self, topic: str, images: Iterable[CameraImage]) -> None:
        for image in images:
            self._thread.put_cloud(image.msg, topic, partial(decode_image, image))

    def _on_pose(self, kind: str, msg: Any) -> None:
        self._thread.put_poses(poses_in(kind, msg, self._config.frames.base))

    def _on_static(self, msg: Any) -> None:
        self._thread.put_poses(poses_in(TF, msg, self._config.frames.base), static=True)

    def _on_lost(self, topic: str, event: QoSMessageLostInfo) -> None:
        self.lost[topic] = event.total_count
        self._node.get_logger().warning(self.loss(), throttle_duration_sec=10.0)


def decode_image(image: CameraImage, _: Image, topic: str) -> Scan:
    """Return the scan of an image, as the mapping thread asks for it."""
    return depth_scan(image, topic)


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
