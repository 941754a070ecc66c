# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes of the map: all of it, its changes, markers.

Timers run in the executor's thread and only ask whether there is news and somebody to read it;
messages are made in the mapping thread, between two scans, where the map does not change. Rates
are those of a steady clock: they hold while simulated time stands still or jumps.
"""

from __future__ import annotations

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from surfel_mapper.config import PublishConfig
from surfel_mapper.io.cdr import marker_array
from surfel_mapper.io.markers import surfel_markers
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import surfel_cloud

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The last message is kept for those who subscribe later."""


class Outputs:
    """
    The publishers of a node.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    mapper : Mapper
        What they publish.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(self, node: Node, mapper: Mapper, thread: MappingThread) -> None:
        """Make the publishers; ``start_timers`` starts what is published at a rate."""
        self._node = node
        self._mapper = mapper
        self._thread = thread
        self._normals = node.create_publisher(PointCloud2, '~/normals', LATCHED)
        self._changed = node.create_publisher(PointCloud2, '~/changed', 10)
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._stamp_ns = 0
        self._normals_version = self._markers_version = mapper.map.version
        self._timers: list[Timer] = []

    def publish_update(self, update: Update) -> None:
        """Publish what a scan changed; called in the mapping thread."""
        self._stamp_ns = update.stamp_ns
        if self._mapper.config.publish.changed and self._changed.get_subscription_count():
            self._changed.publish(surfel_cloud(update.changed, update.stamp_ns, update.frame_id))

    def expire(self) -> None:
        """Publish all anew, as other settings make other surfels; called in the mapping thread."""
        self._normals_version = self._markers_version = -1

    def start_timers(self, rates: PublishConfig) -> None:
        """Publish at these rates from now on; called in the executor's thread."""
        self.stop_timers()
        for rate_hz, callback in (
            (rates.normals_rate_hz, self._on_normals_timer),
            (rates.markers_rate_hz, self._on_markers_timer),
        ):
            if rate_hz:
                steady = Clock(clock_type=ClockType.STEADY_TIME)
                timer = self._node.create_timer(1.0 / rate_hz, callback, clock=steady)
                self._timers.append(timer)

    def stop_timers(self) -> None:
        """Publish nothing at a rate any more."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers.clear()

    def _on_normals_timer(self) -> None:
        if self._normals_version != self._mapper.map.version:
            self._thread.post(self._publish_normals)

    def _on_markers_timer(self) -> None:
        news = self._markers_version != self._mapper.map.version
        if news and self._markers.get_subscription_count():
            self._thread.post(self._publish_markers)

    def _publish_normals(self) -> None:
        config, surfel_map = self._mapper.config, self._mapper.map
        surfels = surfel_map.surfels(config.map.min_points)
        self._normals.publish(surfel_cloud(surfels, self._stamp_ns, config.frames.fixed))
        self._normals_version = surfel_map.version

    def _publish_markers(self) -> None:
        config, surfel_map = self._mapper.config, self._mapper.map
        markers = surfel_markers(
            surfel_map.surfels(config.map.min_points),
            surfel_map.voxel_size_m,
            stamp_ns=self._stamp_ns,
            frame_id=config.frames.fixed,
            max_markers=config.publish.max_markers,
        )
        self._markers.publish(marker_array(markers))
        self._markers_version = surfel_map.version
