# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes of the models: pictures, tables, outlines, and whose each surfel is.

They are published when they have followed the map, which they do at a period of their own, and
once more to whoever subscribes later; nothing is made while nobody does. Messages are made in the
mapping thread, between two scans, and shapes only of what has changed; for somebody who comes late
to a large map, a few between each two scans.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PolygonInstanceStamped
import numpy as np
import numpy.typing as npt
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from surfel_mapper.messages.markers import marker_array, polygon_instance
from surfel_mapper.messages.model_messages import (
    model_markers,
    primitive_columns,
    surfel_primitive_columns,
)
from surfel_mapper.messages.pointcloud2 import from_columns
from surfel_mapper.models.live import LiveModels
from surfel_mapper.models.outlines import bridged
from surfel_mapper.models.shapes import PatchShape, Shapes
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.ros.base_node import LATCHED
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import cloud_message

OUTLINES = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""A message a polygon: there may be hundreds at once."""


STEP = 50
"""So many shapes are made at a time for a new subscriber: some 15 ms."""


class ModelOutputs:
    """
    The publishers of live models.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    mapper : Mapper
        Whose models they are.
    models : LiveModels
        What they publish.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(
        self, node: Node, mapper: Mapper, models: LiveModels, thread: MappingThread
    ) -> None:
        """Make the publishers."""
        self._node = node
        self._mapper = mapper
        self._models = models
        self._thread = thread
        self._shapes = Shapes()
        self._stamp_ns = 0
        self._told: dict[int, int] = {}
        """Versions of the outlines that subscribers know, by id."""
        self._planes = self._advertise(
            MarkerArray, '~/planes', LATCHED, self._in_steps(self._publish_planes)
        )
        self._primitives = self._advertise(
            PointCloud2, '~/primitives', LATCHED, self._in_steps(self._publish_primitives)
        )
        self._surfels = self._advertise(
            PointCloud2, '~/surfel_primitives', LATCHED, self._publish_surfels
        )
        outlines = self._in_steps(self._publish_all_outlines)
        self._outlines = self._advertise(PolygonInstanceStamped, '~/outlines', OUTLINES, outlines)

    def note(self, update: Update) -> None:
        """Take note of a scan, and publish where the models have followed it."""
        self._stamp_ns = update.stamp_ns
        if update.models is not None:
            self.expire()

    def expire(self) -> None:
        """Publish all that somebody reads; called in the mapping thread."""
        for publisher, publish in (
            (self._planes, self._publish_planes),
            (self._primitives, self._publish_primitives),
            (self._surfels, self._publish_surfels),
            (self._outlines, self._publish_outlines),
        ):
            if publisher.get_subscription_count():
                publish()

    def _advertise(
        self, kind: Any, topic: str, qos: QoSProfile, publish: Callable[[], None]
    ) -> Publisher:
        """Return a publisher that publishes once more for everybody who subscribes."""

        def on_matched(status: Any) -> None:
            if status.current_count_change > 0:
                self._thread.post(publish)

        events = PublisherEventCallbacks(matched=on_matched)
        return self._node.create_publisher(kind, topic, qos, event_callbacks=events)

    def _in_steps(self, publish: Callable[[], None]) -> Callable[[], None]:
        """Return what makes missing shapes, a few at a time, and then publishes."""

        def step() -> None:
            if self._shapes.make(self._models.model, self._models.versions, STEP):
                publish()
            else:
                self._thread.post(step)  # after the scans that wait

        return step

    # What follows is called in the mapping thread.

    def _current_shapes(self) -> list[PatchShape]:
        return self._shapes.of(self._models.model, self._models.versions)

    def _publish_planes(self) -> None:
        markers = model_markers(
            self._current_shapes(),
            self._models.model.gaussians,
            self._mapper.map.voxel_size_m,
            stamp_ns=self._stamp_ns,
            frame_id=self._mapper.map_frame,
        )
        self._planes.publish(marker_array(markers))

    def _publish_primitives(self) -> None:
        gaussians, versions = self._models.model.gaussians, self._models.versions
        columns = primitive_columns(self._current_shapes(), gaussians, versions)
        self._primitives.publish(self._cloud(columns))

    def _publish_surfels(self) -> None:
        columns = surfel_primitive_columns(self._models.surfels, self._models.model)
        self._surfels.publish(self._cloud(columns))

    def _publish_all_outlines(self) -> None:
        self._told = dict.fromkeys(self._told, 0)  # what is no more is still to be told
        self._publish_outlines()

    def _publish_outlines(self) -> None:
        """Publish outlines that have changed, and empty ones of what is no more."""
        shapes = {shape.patch.id: shape for shape in self._current_shapes()}
        versions = {number: self._models.versions[number] for number in shapes}
        for number in self._told.keys() - shapes.keys():
            self._publish_outline(number, np.empty((0, 3)))
        for number, version in versions.items():
            if self._told.get(number) != version:
                self._publish_outline(number, bridged(shapes[number].rings))
        self._told = versions

    def _publish_outline(self, number: int, ring: npt.NDArray[np.float64]) -> None:
        frame_id = self._mapper.map_frame
        message = polygon_instance(ring, number, stamp_ns=self._stamp_ns, frame_id=frame_id)
        self._outlines.publish(message)

    def _cloud(self, columns: dict[str, Any]) -> PointCloud2:
        content = from_columns(columns)
        return cloud_message(content, self._stamp_ns, self._mapper.map_frame)
