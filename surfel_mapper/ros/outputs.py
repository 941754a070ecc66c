# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of the map: the full map, its changes, the scan with normals, and markers.

Timers run in the executor's thread and only check for changes and subscribers; messages are built
in the mapping thread, between two scans, while the map does not change. Timers use the steady
clock, so the rates hold while simulated time stands still or jumps.
"""

from __future__ import annotations

from collections.abc import Callable
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
from surfel_mapper.filters.columns import as_fields
from surfel_mapper.mapping.ages import Ages
from surfel_mapper.mapping.surfel_columns import surfel_columns
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.messages.map_cloud import moment_cloud, voxel_columns
from surfel_mapper.messages.markers import marker_array
from surfel_mapper.messages.pointcloud2 import from_columns
from surfel_mapper.messages.scan_normals import scan_with_normals
from surfel_mapper.messages.surfel_markers import disc_colors, surfel_markers
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.ros.base_node import LATCHED, result_of, steady_timer
from surfel_mapper.ros.changes import ChangeTracker, MapChange
from surfel_mapper.ros.layer_outputs import LayerOutputs
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import cloud_message
from surfel_mapper.ros.pose_outputs import AlignmentOutputs, OriginOutput
from surfel_mapper.scan import Scan

CHANGES = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Holds 5 s at 20 Hz, so that a client that mirrors the map may lag for a while."""


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
        self._changes = ChangeTracker(mapper)
        self._ages = Ages()
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
        if self._mapper.derives:
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
        self._published.clear()
        with self._mapper.guarded('publishing of the origin'):
            self._origin.publish(self._stamp_ns)
        self._layers.expire()
        if not self._has_clients():
            self._changes.reset()
        elif self._mapper.derives:
            with self._changes.undone_on_error():
                self._publish_change(self._changes.collect())

    def start_timers(self, config: Config) -> None:
        """Publish at the rates of these settings; called in the executor's thread."""
        self.stop_timers()
        rates = config.publish
        published: list[tuple[float, Any, Callable[[], object]]] = [
            (rates.normals_rate_hz, self._normals, self._publish_normals),
            (rates.markers_rate_hz, self._markers, self._publish_markers),
            *(
                (rates.normals_rate_hz, publisher, partial(self._publish_level, level, publisher))
                for level, publisher in enumerate(self._levels, 1)
            ),
        ]
        for rate_hz, publisher, publish in published:
            if rate_hz:
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

    def _poster(self, publisher: Any, publish: Callable[[], object]) -> Callable[[], None]:
        """Return a timer callback that posts ``publish`` if the map has changed and is read."""
        is_latched_for_all = publisher is self._normals

        def post() -> None:
            is_new = self._published.get(publisher) != self._mapper.map.version
            if is_new and (is_latched_for_all or publisher.get_subscription_count()):
                self._thread.post(publish)

        return post

    async def _on_publish_normals(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            number = await result_of(self._thread.call(self._publish_normals), self._node.executor)
            response.success, response.message = True, f'{number} surfels published'
        except CancelledError:
            response.message = 'the node is about to end'
        return response

    # The methods below run in the mapping thread.

    def _publish_surfels(self, update: Update) -> None:
        if self._has_clients():
            with self._changes.undone_on_error():
                self._publish_change(self._changes.after_scan(update))
        else:
            self._changes.reset()
        if self._scan_normals.get_subscription_count():
            self._publish_scan_normals(update)

    def _has_clients(self) -> bool:
        wants_changed = self._mapper.config.publish.changed
        return bool(
            (wants_changed and self._changed.get_subscription_count())
            or self._removed.get_subscription_count()
        )

    def _publish_change(self, change: MapChange) -> None:
        mapper = self._mapper
        if mapper.config.publish.changed:
            self._changed.publish(self._surfel_cloud(change.surfels, change.removed))
        columns = voxel_columns(change.removed, mapper.map.voxel_size_m)
        content = from_columns(columns)
        self._removed.publish(cloud_message(content, self._stamp_ns, mapper.map_frame))

    def _surfel_cloud(
        self, surfels: Surfels, removed: npt.NDArray[np.int32] = NO_VOXELS
    ) -> PointCloud2:
        """Return surfels as a cloud; with ``publish.moments`` also moments and removed voxels."""
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

    def _publish_normals(self) -> int:
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
        surfels = surfel_map.surfels(config.map.min_points, config.publish.max_markers)
        markers = surfel_markers(
            surfels,
            surfel_map.voxel_size_m,
            disc_colors(config.publish.marker_color, surfels, self._mapper.window, self._ages),
            stamp_ns=self._stamp_ns,
            frame_id=self._mapper.map_frame,
        )
        self._markers.publish(marker_array(markers))
        self._published[self._markers] = surfel_map.version


def warm_up(config: Config) -> None:
    """Compile the kernels of the outputs, and load their libraries by running them once."""
    surfel_map = SurfelMap(config.map.voxel_size_m)
    scan = Scan(
        points=np.ones((1, 3), np.float64 if config.deskew.enabled else np.float32),
        stamp_ns=0,
        frame_id='',
    )
    moments = surfel_map.add(scan.points)
    surfels = surfel_map.surfels()
    scan_with_normals(scan, np.eye(4), surfel_map, 1)
    windowed = WindowedScan(moments=moments, stamp_ns=0, T_map_sensor=np.eye(4))
    colors = disc_colors('age', surfels, [windowed])
    surfel_markers(surfels, config.map.voxel_size_m, colors, stamp_ns=0, frame_id='')
    moment_cloud(surfels, surfel_map.moments(), NO_VOXELS)
