# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node subscribes to: clouds or depth images, and the poses that ``pose.source`` names.

Callbacks pass messages on to the mapping thread and do nothing else, so that nothing waits in
the middleware: where a queue of messages is full there, the oldest is overwritten and nobody is
told. What the middleware does tell, that messages were lost on the way, is counted. Clouds and
poses are taken as bytes and read in place: rclpy makes objects of them in ten times the time,
and passes over those that it cannot read in silence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, DependencyError, PoseError
from surfel_mapper.messages.compressed_image import is_packed
from surfel_mapper.messages.images import (
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
    SceneImages,
    warm_up,
)
from surfel_mapper.messages.pointcloud2 import parse_cloud
from surfel_mapper.messages.poses import ODOMETRY, POSE, raw_poses, TF
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.subscription_executor import SubscriptionExecutor
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import SceneImage

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

STATIC_TOPIC = '/tf_static'

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
    on_failure : callable
        Called in the thread that takes messages with an error that nobody foresaw.

    Attributes
    ----------
    cloud_topics : list of str
        The full names of the topics of clouds, or of depth images.
    lost : dict of str to int
        Clouds that were published but never came, by topic, as far as the middleware knows.

    """

    def __init__(
        self,
        node: Node,
        config: Config,
        thread: MappingThread,
        on_failure: Callable[[BaseException], None],
    ) -> None:
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
        self._subscriptions = SubscriptionExecutor(node, on_failure)

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
        if source == ODOMETRY:
            self._subscribe_poses(Odometry, 'odom', POSES)
        elif source == POSE:
            self._subscribe_poses(PoseStamped, 'pose', POSES)
        elif source == TF:
            message = transform_message()
            self._subscribe_poses(message, STATIC_TOPIC, STATIC_TRANSFORMS)
            self._subscribe_poses(message, '/tf', TRANSFORMS)
        if source in (ODOMETRY, POSE, 'registration') and not self._config.frames.base_to_sensor:
            self._subscribe_static()
        if self._config.input.kind == 'depth':
            warm_up()
        for topic in self.cloud_topics:
            self._subscribe_clouds(topic)
        for kind, name in self._config.tsdf.image_topics.items():
            self._subscribe_images(kind, self._node.resolve_topic_name(name))
        self._subscriptions.start()

    def unsubscribe(self) -> None:
        """Take no more messages."""
        self._subscriptions.stop()

    def topics(self) -> list[str]:
        """Return the full names of the topics subscribed to."""
        return self._subscriptions.topics()

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
        subscribe = partial(self._subscriptions.subscribe, qos=CLOUDS)
        if self._config.input.kind == 'cloud':
            on_cloud = partial(self._on_cloud, topic)
            subscribe(PointCloud2, topic, on_cloud, events=lost, raw=True)
            return
        subscribe(CameraInfo, camera_info_topic(topic), partial(self._on_camera_info, topic))
        subscribe(image_message(topic), topic, partial(self._on_image, topic), events=lost)

    def _subscribe_images(self, kind: str, topic: str) -> None:
        """Subscribe to images of colours or labels, and to the calibration where needed."""
        subscribe = partial(self._subscriptions.subscribe, qos=CLOUDS)
        if self._scenes.needs_cameras:
            on_info = partial(self._on_scene, partial(self._scenes.add_info, kind, topic))
            subscribe(CameraInfo, camera_info_topic(topic), on_info)
        on_image = partial(self._on_scene, partial(self._scenes.add_image, kind, topic))
        subscribe(image_message(topic), topic, on_image)

    def _on_scene(self, take: Callable[[Any], list[SceneImage]], msg: Any) -> None:
        try:
            for image in take(msg):
                self._thread.put_image(image)
        except CloudFormatError as error:
            self._thread.refuse_image(str(error))

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
        self._subscribe_poses(message, STATIC_TOPIC, STATIC_TRANSFORMS)

    def _subscribe_poses(self, message: Any, topic: str, qos: QoSProfile) -> None:
        """Subscribe to poses or transforms."""
        kind = TF if qos in (TRANSFORMS, STATIC_TRANSFORMS) else self._config.pose.source
        on_pose = partial(self._on_pose, kind, topic)
        self._subscriptions.subscribe(message, topic, on_pose, qos, eager=True, raw=True)

    def _on_cloud(self, topic: str, raw: bytes) -> None:
        self._hear(topic, len(raw))
        try:
            self._thread.put_cloud(parse_cloud(raw, topic=topic), topic)
        except CloudFormatError as error:
            self._thread.refuse_cloud(topic, str(error))

    def _hear(self, topic: str, num_bytes: int) -> None:
        """Remember that a topic lives, and how large its messages are."""
        self._heard_s[topic] = time.monotonic()
        self._largest_bytes = max(self._largest_bytes, num_bytes)

    def _on_image(self, topic: str, msg: Image | CompressedImage) -> None:
        self._hear(topic, len(msg.data))
        self._put_images(topic, self._images.add_image(topic, msg))

    def _on_camera_info(self, topic: str, msg: CameraInfo) -> None:
        try:
            self._put_images(topic, self._images.add_info(topic, msg))
        except CloudFormatError as error:
            self._node.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _put_images(self, topic: str, images: Iterable[CameraImage]) -> None:
        for image in images:
            self._thread.put_cloud(image.msg, topic, partial(decode_image, image))

    def _on_pose(self, kind: str, topic: str, raw: bytes) -> None:
        try:
            poses = raw_poses(kind, raw, self._config.frames.base, topic)
        except PoseError as error:
            self._thread.refuse_pose(str(error))
        else:
            self._thread.put_poses(poses, static=topic == STATIC_TOPIC)

    def _on_lost(self, topic: str, event: QoSMessageLostInfo) -> None:
        self.lost[topic] = event.total_count
        self._node.get_logger().warning(self.loss(), throttle_duration_sec=10.0)


def image_message(topic: str) -> Any:
    """Return the class of the images of a topic: packed ones have a name that says so."""
    return CompressedImage if is_packed(topic) else Image


def decode_image(image: CameraImage, _: Any, topic: str) -> Scan:
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
