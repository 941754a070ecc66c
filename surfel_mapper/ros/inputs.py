# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The inputs of the node: clouds or depth images, and poses (pose_inputs.py).

Callbacks only pass messages on to the mapping thread, so that none waits in the middleware, whose
full queues overwrite the oldest message silently. Losses that the middleware does report are
counted. Clouds and poses are taken as serialized bytes and parsed in place: rclpy needs ten times
as long to build objects of them, and silently skips messages that it cannot deserialize.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
import time
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, ConfigError
from surfel_mapper.messages.cdr import frame_name, Stamp, stamp_ns
from surfel_mapper.messages.compressed_image import is_packed
from surfel_mapper.messages.images import (
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
    SceneImages,
)
from surfel_mapper.messages.pointcloud2 import parse_cloud, RawCloud, to_scan
from surfel_mapper.poses import SourceChoice
from surfel_mapper.ros.base_node import BaseNode
from surfel_mapper.ros.clock_watch import ClockWatch
from surfel_mapper.ros.context import PROFILE
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.pose_inputs import PoseInputs
from surfel_mapper.ros.publishers import full_name
from surfel_mapper.ros.subscription_executor import SubscriptionExecutor
from surfel_mapper.ros.topic_search import TopicSearch
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import SceneImage

DEFAULT_TOPICS = {'cloud': 'points', 'depth': 'depth/image'}
"""Topics of clouds or depth images if ``input.topics`` is empty."""

CLOUDS = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)
"""Holds 2 s of a lidar at 10 Hz. Here and below, best effort if a publisher offers no more."""

CHECK_S = 0.25
"""Period in which the graph is looked at, while a source of poses or the clouds are missing, s."""

SEARCH_S = 5.0
"""Time without a publisher of ``points`` before the only other topic of clouds is read, s."""

LARGE_BYTES = 500_000
"""Larger messages do not fit into the default shared memory of Fast DDS, 512 KiB."""


class Inputs:
    """
    The subscriptions of a node.

    Parameters
    ----------
    node : BaseNode
        The node that subscribes.
    config : Config
        Its stages input, pose and frames are used.
    thread : MappingThread
        Takes the messages.
    on_failure : callable
        Called in the thread of the subscriptions with an unexpected error.
    on_choice : callable
        Called with the source that ``pose.source: auto`` takes; see PoseInputs.

    Attributes
    ----------
    poses : PoseInputs
        The subscriptions to poses.
    subscriptions : SubscriptionExecutor
        All subscriptions, and their thread.
    clocks : ClockWatch
        Compares the clocks of clouds and poses.
    cloud_topics : list of str
        The full names of the topics of clouds, or of depth images.
    lost : dict of str to int
        Clouds lost on the way, by topic, as far as the middleware reports them; of all
        subscriptions so far. The mapping thread reads it, so that it is replaced to add a topic.

    Raises
    ------
    ConfigError
        If a setting names an invalid topic, or two of ``input.topics`` are the same.
    DependencyError
        If ``pose.source`` is tf and tf2_msgs is not installed.

    """

    def __init__(
        self,
        node: BaseNode,
        config: Config,
        thread: MappingThread,
        on_failure: Callable[[BaseException], None],
        on_choice: Callable[[SourceChoice], object] = lambda choice: None,
    ) -> None:
        subscriptions = SubscriptionExecutor(node, on_failure)
        self.clocks = ClockWatch(
            config.input,
            node.get_logger().warning,
            lambda: node.get_clock().now().nanoseconds,
        )
        self.poses = PoseInputs(node, config, thread, subscriptions, self.clocks, on_choice)
        self.cloud_topics = cloud_topics(node, config)
        self._image_topics = {
            kind: resolved(node, f'layers.tsdf.{kind}_topic', name)
            for kind, name in config.image_topics.items()
        }
        self.lost = dict.fromkeys(self.cloud_topics, 0)
        self._received_s = dict.fromkeys(self.cloud_topics, time.monotonic())
        self._largest_bytes = dict.fromkeys(self.cloud_topics, 0)
        self._images = DepthImages()
        self._scenes = SceneImages(config)
        self._node = node
        self._config = config
        self._thread = thread
        self.subscriptions = subscriptions
        self._search: TopicSearch | None = None
        if config.input.kind == 'cloud' and not config.input.topics:
            self._search = TopicSearch(node, DEFAULT_TOPICS['cloud'], PointCloud2)
        self._warned_of = ''
        self._start_s = self._checked_s = time.monotonic()

    def subscribe(self) -> None:
        """
        Subscribe to all topics.

        Raises
        ------
        ConfigError
            If a parameter of qos_overrides is refused.

        """
        self._received_s = dict.fromkeys(self.cloud_topics, time.monotonic())
        self.poses.subscribe()
        for topic in self.cloud_topics:
            self._subscribe_clouds(topic)
        for kind, topic in self._image_topics.items():
            self._subscribe_images(kind, topic)
        self._start_s = time.monotonic()
        self.subscriptions.on_turn = self._on_turn
        self.subscriptions.start()

    def loss(self) -> str:
        """Return the number of lost clouds and the remedy, as text; empty if none was lost."""
        return '; '.join(self._loss_of(topic) for topic, number in self.lost.items() if number)

    def _loss_of(self, topic: str) -> str:
        size = self._largest_bytes[topic]
        text = f'clouds lost on the way ({self.lost[topic]} of {topic}'
        text += f', up to {size / 1e6:.1f} MB each)' if size else ', none arrived)'
        senders = self.subscriptions.publishers(topic)
        weak = sorted(
            full_name(info)
            for info in senders
            if info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        )
        if 0 < size <= LARGE_BYTES:
            return f'{text}: they arrive faster than they are taken; is the machine overloaded?'
        remedy = f'put in front of its command: FASTRTPS_DEFAULT_PROFILES_FILE={PROFILE}'
        if senders and not weak:
            if self.subscriptions.reliabilities().get(topic) == 'best effort':
                return f'{text}: their publisher is reliable, but qos_overrides says best_effort'
            return (
                f'{text}: their publisher is reliable, but Fast DDS repeats parts of messages '
                f'above 0.5 MB, at times too late. If this goes on, {remedy}'
            )
        return (
            f'{text}: {", ".join(weak) or "their publisher"} publishes best effort, and Fast DDS '
            f'loses such messages above 0.5 MB. Make it publish reliable, or {remedy}'
        )

    @property
    def most_silent(self) -> tuple[str, float]:
        """The cloud topic without messages for longest; time of the last, by time.monotonic."""
        return min(self._received_s.items(), key=lambda item: item[1])

    @property
    def clouds_lost(self) -> int:
        """Number of clouds lost on all topics."""
        return sum(self.lost.values())

    @property
    def alternatives(self) -> str:
        """The topics of clouds that could be read instead of the default one; empty if none."""
        search = self._search
        has_any = search is not None and (search.alternatives or search.convertible)
        return search.missing if search is not None and has_any else ''

    def _on_turn(self) -> None:
        """Look for poses and clouds until there are some; called by the subscriptions."""
        if time.monotonic() - self._checked_s < CHECK_S:
            return
        self._checked_s = time.monotonic()
        self.poses.check()
        if self._search is not None:
            self._find_clouds(self._search)
        if self._search is None and not self.poses.is_looking:
            self.subscriptions.on_turn = None

    def _find_clouds(self, search: TopicSearch) -> None:
        """Read the only topic of clouds, if the default one has no publisher for a while."""
        search.look()
        if search.has_publisher:
            self._search = None
        elif time.monotonic() - self._start_s < SEARCH_S:
            return
        elif search.only_alternative:
            self._node.get_logger().warning(
                f'no publisher of {search.topic}; the only topic of clouds is read instead, as '
                f'with {search.argument(search.only_alternative)}'
            )
            self._read_instead(search.topic, search.only_alternative)
            self._search = None
        elif self.alternatives and self.alternatives != self._warned_of:
            self._warned_of = self.alternatives
            self._node.get_logger().warning(f'no clouds: {search.missing}')

    def _read_instead(self, topic: str, alternative: str) -> None:
        """Read the clouds of another topic; the counts of both are kept."""
        self.subscriptions.unsubscribe(topic)
        self.lost = {**self.lost, alternative: 0}
        self._largest_bytes = {**self._largest_bytes, alternative: 0}
        self._received_s = {alternative: time.monotonic()}
        self.cloud_topics = [alternative]
        self._subscribe_clouds(alternative)

    def _subscribe_clouds(self, topic: str) -> None:
        """Subscribe to the clouds or images of one sensor."""
        on_lost = partial(self._on_lost, topic, self.lost[topic])
        subscribe = partial(self.subscriptions.subscribe, qos=CLOUDS)
        if self._config.input.kind == 'cloud':
            on_cloud = partial(self._on_cloud, topic)
            subscribe(PointCloud2, topic, on_cloud, on_lost=on_lost, raw=True)
            return
        subscribe(CameraInfo, camera_info_topic(topic), partial(self._on_camera_info, topic))
        subscribe(image_message(topic), topic, partial(self._on_image, topic), on_lost=on_lost)

    def _subscribe_images(self, kind: str, topic: str) -> None:
        """Subscribe to images of colours or labels, and to the calibration if needed."""
        subscribe = partial(self.subscriptions.subscribe, qos=CLOUDS)
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

    def _on_cloud(self, topic: str, raw: bytes) -> None:
        self._note_received(topic, len(raw))
        try:
            self._put_cloud(self._stamped(parse_cloud(raw, topic=topic), topic), topic)
        except CloudFormatError as error:
            self._thread.refuse_cloud(topic, str(error))

    def _stamped(self, msg: Any, topic: str) -> Any:
        """Return a cloud or image with the time of its arrival if its stamp is 0, not set."""
        if stamp_ns(msg.header):
            return msg
        arrival_ns = self.clocks.arrival_ns(topic)
        if isinstance(msg, RawCloud):
            stamp = Stamp(*divmod(arrival_ns, 10**9))
            return replace(msg, header=msg.header._replace(stamp=stamp))
        msg.header.stamp = time_message(arrival_ns)
        return msg

    def _note_received(self, topic: str, num_bytes: int) -> None:
        """Record the time and the size of a message."""
        self._received_s[topic] = time.monotonic()
        self._largest_bytes[topic] = max(self._largest_bytes[topic], num_bytes)

    def _on_image(self, topic: str, msg: Image | CompressedImage) -> None:
        self._note_received(topic, len(msg.data))
        self._put_images(topic, self._images.add_image(topic, self._stamped(msg, topic)))

    def _on_camera_info(self, topic: str, msg: CameraInfo) -> None:
        try:
            self._put_images(topic, self._images.add_info(topic, msg))
        except CloudFormatError as error:
            self._node.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _put_images(self, topic: str, images: Iterable[CameraImage]) -> None:
        for image in images:
            self._put_cloud(image.msg, topic, partial(decode_image, image))

    def _put_cloud(
        self, msg: Any, topic: str, decode: Callable[[Any, str], Scan] = to_scan
    ) -> None:
        """Queue a cloud or depth image; its frame takes part in the choice of the poses."""
        self.clocks.note_cloud(topic, stamp_ns(msg.header))
        self._thread.put_cloud(msg, topic, decode)
        if self.poses.is_choosing:
            with suppress(CloudFormatError):  # counted when it is decoded
                self.poses.note_cloud(frame_name(msg.header.frame_id))

    def _on_lost(self, topic: str, previous: int, number: int) -> None:
        """Take the number that a subscription has lost, after the losses of earlier ones."""
        self.lost[topic] = previous + number
        self._node.get_logger().warning(self.loss(), throttle_duration_sec=10.0)


def cloud_topics(node: BaseNode, config: Config) -> list[str]:
    """Return the full names of the topics of clouds or depth images; raise if two are the same."""
    configured = config.input.topics
    names = configured or (DEFAULT_TOPICS[config.input.kind],)
    topics = [resolved(node, 'input.topics', name) for name in names]
    if len(set(topics)) < len(topics):  # the configuration compares them as they are written
        raise ConfigError(f'input.topics: {configured} are {topics}, expected names that differ')
    return topics


def resolved(node: BaseNode, setting: str, name: str) -> str:
    """Return the full name of a topic, or raise ConfigError if a setting gives an invalid one."""
    try:
        return str(node.resolve_topic_name(name))
    except rclpy_implementation.RCLError as error:
        reason = str(error).partition(', at /')[0]  # without the line of the source of rcl
        raise ConfigError(f'{setting}: {name!r} is no name of a topic: {reason}') from error


def image_message(topic: str) -> Any:
    """Return the message class of an image topic, by its name."""
    return CompressedImage if is_packed(topic) else Image


def decode_image(image: CameraImage, _: Any, topic: str) -> Scan:
    """Return the scan of an image; a decoder for ``MappingThread.put_cloud``."""
    return depth_scan(image, topic)
