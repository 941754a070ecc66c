# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of the map: the full map, its changes, the scan with normals, and markers.

Timers run in the executor's thread and only check for changes and subscribers; messages are built
in the mapping thread, between two scans, while the map does not change. Timers use the steady
clock, so the rates hold while simulated time stands still or jumps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from surfel_mapper.config import Config
from surfel_mapper.errors import counted
from surfel_mapper.filters.columns import as_fields
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfels import surfel_columns, Surfels
from surfel_mapper.messages.map_cloud import adaptive_cloud, moment_cloud, voxel_columns
from surfel_mapper.messages.markers import marker_array
from surfel_mapper.messages.pointcloud2 import from_columns
from surfel_mapper.messages.scan_normals import scan_with_normals
from surfel_mapper.messages.surfel_markers import disc_colors, surfel_markers
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.ros.base_node import LATCHED, result_of, steady_timer
from surfel_mapper.ros.changes import AdaptiveTracker, ChangeTracker, MapChange
from surfel_mapper.ros.layer_outputs import LayerOutputs
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import cloud_message
from surfel_mapper.ros.pose_outputs import AlignmentOutputs, OriginOutput
from surfel_mapper.scan import Scan

CHANGES = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Holds 5 s at 20 Hz, so that a client that mirrors the map may lag for a while."""

OBSOLETE = -1
"""Version of a published map that has to be replaced; the map counts from 0."""

NO_VOXELS = np.empty((0, 3), np.int32)


class Outputs:
    """
    The publishers of a node.

    Parameters
    ----------
    node : Node
        The node that publishes.
    mapper : Mapper
        The mapper whose map is published.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(self, node: Node, mapper: Mapper, thread: MappingThread) -> None:
        """Create the publishers; ``start_timers`` starts the periodic ones."""
        self._node = node
        self._mapper = mapper
        self._thread = thread
        self._adaptive = AdaptiveTracker(mapper) if mapper.config.publish.adaptive else None
        self._changes = self._adaptive or ChangeTracker(mapper)
        self._origin = OriginOutput(node, mapper)
        self._alignment = AlignmentOutputs(node, mapper)
        self._layers = LayerOutputs(node, mapper, thread)
        self._normals = node.create_publisher(PointCloud2, '~/normals', LATCHED)
        self._levels = [
            node.create_publisher(PointCloud2, f'~/level_{level}/normals', LATCHED)
            for level in range(1, mapper.config.publish.levels + 1)
        ]
        self._changed = node.create_publisher(PointCloud2, '~/changed', CHANGES)
        self._removed = node.create_publisher(PointCloud2, '~/removed', CHANGES)
        self._scan_normals = node.create_publisher(PointCloud2, '~/scan_normals', 10)
        self._filtered = node.create_publisher(PointCloud2, '~/filtered', 10)
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._stamp_ns = 0
        # an empty map is published too: it replaces the latched one of a node that was killed
        self._published: dict[Any, int] = {}
        self._timers: list[Timer] = []
        group = ReentrantCallbackGroup()  # it waits for the mapping thread
        node.create_service(
            Trigger, '~/publish_normals', self._on_publish_normals, callback_group=group
        )

    def publish_update(self, update: Update) -> None:
        """Publish the changes of a scan; called in the mapping thread."""
        self._stamp_ns = update.stamp_ns
        guarded = self._mapper.guarded  # a topic that fails keeps none of the others back
        with guarded('publishing of the origin'):
            self._origin.publish(update.stamp_ns)
        with guarded('publishing of the alignment'):
            self._alignment.publish(update)
        self._layers.publish_update(update)
        with guarded('publishing of surfels'):
            self._publish_surfels(update)
        if self._filtered.get_subscription_count():
            with guarded('publishing of the filtered scan'):
                self._publish_filtered(update.filtered)

    def publish_aligned(self) -> None:
        """Publish the result of ~/align; called in the mapping thread."""
        self._alignment.publish_path()
        self.expire()

    def expire(self) -> None:
        """
        Publish the present state of all topics; called in the mapping thread.

        Needed whenever the map or its settings have changed otherwise than by a scan.
        """
        self._published = dict.fromkeys(self._published, OBSOLETE)
        with self._mapper.guarded('publishing of the origin'):
            self._origin.publish(self._stamp_ns)
        self._layers.expire()
        self._publish_changes(lambda tracker: tracker.collect())
        if not self._timers:
            self.publish_latest()

    def publish_latest(self) -> None:
        """
        Publish the map for late subscribers if it has changed; called in the mapping thread.

        Needed while no timer runs. Markers and coarser maps that were never published are left
        out, as nothing obsolete is kept of them.
        """
        for _, publisher, publish in self._periodic(self._mapper.config):
            was_published = publisher in self._published
            if self._is_due(publisher) or (was_published and self._is_new(publisher)):
                with self._mapper.guarded('publishing of surfels'):
                    publish()

    def start_timers(self, config: Config) -> None:
        """Publish at the rates of these settings; called in the executor's thread."""
        self.stop_timers()
        for rate_hz, publisher, publish in self._periodic(config):
            callback = self._poster(publisher, publish)
            self._timers.append(steady_timer(self._node, rate_hz, callback))
        self._layers.start_timers(config)

    def stop_timers(self) -> None:
        """Stop publishing periodically."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers.clear()
        self._layers.stop_timers()

    def close(self) -> None:
        """End the threads that publish, before their publishers are destroyed."""
        self._layers.close()

    def _periodic(self, config: Config) -> Iterator[tuple[float, Any, Callable[[], object]]]:
        """Yield rate in Hz, publisher and method of each topic that has a rate above 0."""
        rates = config.publish
        if rates.normals_rate_hz:
            yield rates.normals_rate_hz, self._normals, self._publish_normals
            for level, publisher in enumerate(self._levels, 1):
                publish = partial(self._publish_level, level, publisher)
                yield rates.normals_rate_hz, publisher, publish
        if rates.markers_rate_hz:
            yield rates.markers_rate_hz, self._markers, self._publish_markers

    def _is_new(self, publisher: Any) -> bool:
        """Return whether the map has changed since a topic was published."""
        return self._published.get(publisher) != self._mapper.map.version

    def _is_due(self, publisher: Any) -> bool:
        """Return whether the map has changed and is read; ~/normals is kept for all."""
        is_read = publisher is self._normals or publisher.get_subscription_count()
        return bool(self._is_new(publisher) and is_read)

    def _poster(self, publisher: Any, publish: Callable[[], object]) -> Callable[[], None]:
        """Return a timer callback that posts ``publish`` if the map has changed and is read."""

        def post() -> None:
            if self._is_due(publisher):
                self._thread.post(publish)

        return post

    async def _on_publish_normals(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            number = await result_of(self._thread.call(self._publish_normals), self._node.executor)
            response.success, response.message = True, f'{counted(number, "surfel")} published'
        except CancelledError:
            response.message = 'the node is about to end'
        return response

    # The methods below run in the mapping thread.

    def _publish_surfels(self, update: Update) -> None:
        self._publish_changes(lambda tracker: tracker.after_scan(update))
        if self._scan_normals.get_subscription_count():
            self._publish_scan_normals(update)

    def _publish_changes(
        self, find: Callable[[ChangeTracker | AdaptiveTracker], MapChange]
    ) -> None:
        """Publish the changes that ``find`` returns of the tracker, if they are subscribed to."""
        topics = self._changed, self._removed
        if any(topic.get_subscription_count() for topic in topics):
            self._publish_change(find(self._changes))
        else:
            self._changes.reset()

    def _publish_change(self, change: MapChange) -> None:
        self._changed.publish(self._surfel_cloud(change.surfels, change.removed))
        columns = voxel_columns(change.removed, change.removed_size_m)
        content = from_columns(columns)
        self._removed.publish(cloud_message(content, self._stamp_ns, self._mapper.map_frame))

    def _surfel_cloud(
        self, surfels: Surfels, removed: npt.NDArray[np.int32] = NO_VOXELS
    ) -> PointCloud2:
        """Return surfels as a cloud; with ``publish.moments`` also moments and removed voxels."""
        if self._adaptive:
            content = adaptive_cloud(surfels)
            return cloud_message(content, self._stamp_ns, self._mapper.map_frame)
        if self._mapper.config.publish.covariance:
            rows = self._mapper.map.find(pack_keys(surfels.voxel_index))
            surfels = self._mapper.map.surfels_of(rows, covariance=True)
        if self._mapper.config.publish.moments:
            moments = self._mapper.map.moments(surfels.voxel_index)
            content = moment_cloud(surfels, moments, removed)
        else:
            content = from_columns(surfel_columns(surfels))
        return cloud_message(content, self._stamp_ns, self._mapper.map_frame)

    def _publish_scan_normals(self, update: Update) -> None:
        scan, surfel_map = update.scan, self._mapper.map
        min_points = self._mapper.config.map.min_points
        content = scan_with_normals(scan, update.T_map_sensor, surfel_map, min_points)
        self._scan_normals.publish(cloud_message(content, scan.stamp_ns, scan.frame_id))

    def _publish_filtered(self, scan: Scan) -> None:
        content = from_columns(as_fields(scan))
        self._filtered.publish(cloud_message(content, scan.stamp_ns, scan.frame_id))

    def _followed(self, tracker: AdaptiveTracker, at_most: int | None = None) -> Surfels:
        """Return the adaptive surfels; changes that they have are published first."""
        change = tracker.changes()
        if len(change.surfels) or len(change.removed):
            self._publish_change(change)
        return tracker.surfels(at_most)

    def _publish_normals(self) -> int:
        if self._adaptive:
            surfels = self._followed(self._adaptive)
        else:
            surfels = self._mapper.map.surfels(self._changes.min_points)
        self._normals.publish(self._surfel_cloud(surfels))
        self._published[self._normals] = self._mapper.map.version
        return len(surfels)

    def _publish_level(self, level: int, publisher: Any) -> None:
        cloud = from_columns(surfel_columns(self._mapper.surfels(level)))
        publisher.publish(cloud_message(cloud, self._stamp_ns, self._mapper.map_frame))
        self._published[publisher] = self._mapper.map.version

    def _publish_markers(self) -> None:
        config, surfel_map = self._mapper.config, self._mapper.map
        at_most = config.publish.max_markers
        if self._adaptive:
            surfels = self._followed(self._adaptive, at_most)
        else:
            surfels = surfel_map.surfels(config.map.min_points, at_most)
        markers = surfel_markers(
            surfels,
            surfel_map.voxel_size_m,
            disc_colors(config.publish.marker_color, surfels, self._mapper.window),
            stamp_ns=self._stamp_ns,
            frame_id=self._mapper.map_frame,
        )
        self._markers.publish(marker_array(markers))
        self._published[self._markers] = surfel_map.version
