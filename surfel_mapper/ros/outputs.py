# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes: the map, its changes, markers, diagnostics.

Timers run in the executor's thread and only ask whether there is news and somebody to read it;
messages are made in the mapping thread, between two scans, where the map does not change. Rates
are those of a steady clock: they hold while simulated time stands still or jumps.
"""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
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
from surfel_mapper.ros.inputs import Inputs
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import diagnostics, surfel_cloud

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
    inputs : Inputs
        Knows what was lost on the way.

    """

    def __init__(
        self, node: Node, mapper: Mapper, thread: MappingThread, inputs: Inputs
    ) -> None:
        """Make the publishers; ``start_timers`` starts what is published at a rate."""
        self._node = node
        self._mapper = mapper
        self._thread = thread
        self._inputs = inputs
        self._normals = node.create_publisher(PointCloud2, '~/normals', LATCHED)
        self._changed = node.create_publisher(PointCloud2, '~/changed', 10)
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._stamp_ns = 0
        self._normals_version = self._markers_version = mapper.map.version
        self._report_s = time.monotonic()
        self._report_received = self._report_dropped = self._report_lost = 0
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
            (rates.diagnostics_rate_hz, self._on_diagnostics_timer),
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

    def _on_diagnostics_timer(self) -> None:
        if self._diagnostics.get_subscription_count():
            self._thread.post(self._publish_diagnostics)

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

    def _publish_diagnostics(self) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        message = diagnostics(self._node.get_name(), now_ns, self._problem(), self._figures())
        self._diagnostics.publish(message)

    def _problem(self) -> str:
        """Return what went wrong since the last report, or nothing."""
        counters, lost = self._mapper.counters, self._inputs.clouds_lost
        dropped = counters.dropped.total()
        new_drops, self._report_dropped = dropped - self._report_dropped, dropped
        new_losses, self._report_lost = lost - self._report_lost, lost
        problems = []
        if not counters.received:
            problems.append(f'no cloud on {self._inputs.cloud_topic} yet')
        if new_losses:
            problems.append(self._inputs.loss())
        if new_drops:
            causes = ', '.join(f'{cause} {number}' for cause, number in counters.dropped.items())
            problems.append(f'{new_drops} scans dropped just now; in all: {causes}')
        return '; '.join(problems)

    def _figures(self) -> dict[str, Any]:
        """Return counts, rates, times and sizes."""
        mapper, counters = self._mapper, self._mapper.counters
        now_s = time.monotonic()
        rate_hz = (counters.received - self._report_received) / (now_s - self._report_s)
        self._report_s, self._report_received = now_s, counters.received
        done = counters.mapped + counters.gated + counters.dropped.total()
        return {
            'received_hz': round(rate_hz, 2),
            'clouds_lost': self._inputs.clouds_lost,
            'waiting': counters.received - done,
            **counters.summary(),
            'voxels': mapper.map.num_voxels,
            'map_bytes': mapper.map.nbytes,
            'window_scans': len(mapper.window),
            'window_bytes': mapper.window.nbytes,
        }
