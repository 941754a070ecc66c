# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of all layers that are switched on.

A layer describes its topics (layers/layer.py); they are published here, at their rates or when
the layer has followed a scan. Messages are made in the mapping thread, between two scans, and for
a large layer in steps, each between two scans. Large ones are made in the background, by threads
of low priority: the mapping thread copies their input, and scans are mapped meanwhile. The next
ones wait until those before are published, so a slow reader gets fewer, and none twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from functools import partial
from importlib import import_module
from typing import Any

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.timer import Timer

from surfel_mapper.config import Config
from surfel_mapper.layers import Layer, Moment, Publication
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.ros.base_node import result_of, steady_timer
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.threads import yield_to_others

GRID = 'nav_msgs/msg/OccupancyGrid'
"""Topics of this type also have a service: ``~/get_grid`` returns the grid of ``~/grid``."""

PATIENCE = Duration(seconds=1.0)
"""Time for readers to take a message before the next one of the same set."""


class LayerOutputs:
    """
    The publishers of all layers of a mapper.

    Parameters
    ----------
    node : Node
        Node that owns the publishers.
    mapper : Mapper
        Mapper that owns the layers.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(self, node: Node, mapper: Mapper, thread: MappingThread) -> None:
        self._node = node
        self._mapper = mapper
        self._moment = Moment()
        self._timers: list[Timer] = []
        self._topics = [
            LayerTopic(node, layer, publication, thread, self._current)
            for layer in mapper.layers.values()
            for publication in layer.publications()
        ]

    def publish_update(self, update: Update) -> None:
        """Publish the topics of layers that followed a scan; called in the mapping thread."""
        self._moment = Moment(
            stamp_ns=update.stamp_ns, frame_id=update.frame_id, T_map_sensor=update.T_map_sensor
        )
        for topic in self._topics:
            if topic.layer.name in update.layers and not topic.has_rate:
                with self._mapper.guarded(f'publishing of layer {topic.layer.name}'):
                    topic.publish_if_read()

    def expire(self) -> None:
        """Publish all topics again, now or at their next time; called in the mapping thread."""
        for topic in self._topics:
            topic.expire()
            if not topic.has_rate:
                with self._mapper.guarded(f'publishing of layer {topic.layer.name}'):
                    topic.publish_if_read()

    def start_timers(self, config: Config) -> None:
        """Publish at the rates of these settings; called in the executor's thread."""
        for topic in self._topics:
            rate_hz = topic.rate_hz(config)
            if rate_hz:
                self._timers.append(steady_timer(self._node, rate_hz, topic.post_if_due))

    def stop_timers(self) -> None:
        """Stop publishing at rates."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers.clear()

    def close(self) -> None:
        """End the threads that publish; called after the end of the mapping thread."""
        for topic in self._topics:
            topic.close()

    def _current(self) -> Moment:
        """Return stamp, frame and place of the newest scan; before the first, of an empty map."""
        return self._moment if self._moment.frame_id else Moment(frame_id=self._mapper.map_frame)


class LayerTopic:
    """
    The publisher of one topic of a layer.

    Parameters
    ----------
    node : Node
        Node that owns the publisher.
    layer : Layer
        Layer that makes the messages.
    publication : Publication
        Its description of the topic.
    thread : MappingThread
        The thread that owns the layer.
    now : callable
        Returns the Moment of the messages.

    """

    def __init__(
        self,
        node: Node,
        layer: Layer,
        publication: Publication,
        thread: MappingThread,
        current: Callable[[], Moment],
    ) -> None:
        self.layer = layer
        self._node = node
        self._publication = publication
        self._thread = thread
        self._current = current
        self._published: object = None
        self._background: ThreadPoolExecutor | None = None
        if publication.in_background:
            self._background = ThreadPoolExecutor(1, 'publishing', initializer=yield_to_others)
        self._pending: Future[None] | None = None
        self._is_closed = False
        is_told = not self.has_rate or publication.all_messages is not None
        matched = self._on_matched if is_told else None
        self._publisher = node.create_publisher(
            message_class(publication.type_name),
            publication.topic,
            qos_of(publication),
            event_callbacks=PublisherEventCallbacks(matched=matched),
        )
        if publication.type_name == GRID:
            name = publication.topic.replace('~/', '~/get_', 1)
            group = ReentrantCallbackGroup()  # it waits for the mapping thread
            node.create_service(GetMap, name, self._on_get_map, callback_group=group)

    @property
    def has_rate(self) -> bool:
        """Whether the topic is published at a rate, not after scans."""
        return self._publication.rate_hz is not None

    def rate_hz(self, config: Config) -> float:
        """Return the rate for a configuration, Hz; 0: never."""
        rate_hz = self._publication.rate_hz
        return rate_hz(config) if rate_hz is not None else 0.0

    async def _on_get_map(self, _: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        """Answer with the present grid; with an empty one if the node is about to end."""
        try:
            grid = await result_of(self._thread.call(self._newest), self._node.executor)
        except CancelledError:
            return response
        response.map = deserialize_message(grid, OccupancyGrid)
        return response

    def post_if_due(self) -> None:
        """Post publishing to the mapping thread if the content changed and is subscribed to."""
        version = self._publication.version
        newest = version(self._current()) if version is not None else None
        is_new = version is None or self._published != newest
        is_busy = self._pending is not None and not self._pending.done()
        if is_new and not is_busy and (self._publication.is_eager or self._is_read()):
            self._published = newest
            self._thread.post(self._publish)

    def publish_if_read(self) -> None:
        """Publish to the subscribers, if there are any; called in the mapping thread."""
        if self._publication.is_eager or self._is_read():
            self._publish()

    def expire(self) -> None:
        """Mark the content as not published yet."""
        self._published = None

    def close(self) -> None:
        """End the thread that publishes, if any; of a set, the message under way is sent."""
        self._is_closed = True
        if self._background is not None:
            self._background.shutdown(cancel_futures=True)

    def _is_read(self) -> bool:
        return bool(self._publisher.get_subscription_count())

    def _on_matched(self, status: Any) -> None:
        """Publish for a new subscriber; called by the executor."""
        if status.current_count_change > 0:
            self._thread.post(self._publish_for_new)

    # Called in the mapping thread from here on.

    def _newest(self) -> bytes:
        """Return the serialised message of the present state."""
        (message,) = self._publication.messages(self._current())
        return message

    def _publish(self) -> None:
        """Publish; at a rate, the messages are prepared one step at a time between scans."""
        publication = self._publication
        if self.has_rate and publication.prepare is not None and not publication.prepare():
            self._thread.post(self._publish)
            return
        self._send(publication.messages(self._current()))

    def _publish_for_new(self) -> None:
        """Make missing content, one step at a time between scans, and then publish."""
        publication = self._publication
        if publication.prepare is not None and not publication.prepare():
            self._thread.post(self._publish_for_new)
            return
        self._send((publication.all_messages or publication.messages)(self._current()))

    def _send(self, messages: Iterable[bytes]) -> None:
        if self._background is not None:
            self._pending = self._background.submit(self._send_in_background, messages)
            return
        for message in messages:
            self._publisher.publish(message)

    def _send_in_background(self, messages: Iterable[bytes]) -> None:
        """Publish messages, each when readers have the one before, or after a second."""
        try:
            for number, message in enumerate(messages):
                if self._is_closed:
                    return
                if number:
                    self._publisher.wait_for_all_acked(PATIENCE)
                self._publisher.publish(message)
        except Exception as error:
            self._thread.post(partial(fail, error))  # counted there, as of any other topic


def fail(error: Exception) -> None:
    """Raise an error of another thread."""
    raise error


def qos_of(publication: Publication) -> QoSProfile:
    """Return the quality of service of a topic: reliable, and latched if wanted."""
    durability = DurabilityPolicy.VOLATILE
    if publication.is_latched:
        durability = DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(
        depth=publication.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


def message_class(type_name: str) -> Any:
    """Return the class of a type of messages: ``visualization_msgs/msg/Marker``."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)
