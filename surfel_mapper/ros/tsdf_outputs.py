# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes of the TSDF layer: its mesh, and a slice of what is free."""

from __future__ import annotations

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.timer import Timer
from visualization_msgs.msg import Marker

from surfel_mapper.config import TsdfConfig
from surfel_mapper.messages.markers import marker_bytes
from surfel_mapper.messages.surfel_markers import mesh_marker
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.tsdf_layer import TsdfLayer
from surfel_mapper.ros.base_node import LATCHED, steady_timer
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import grid_message
from surfel_mapper.tsdf.obstacles import slice_at


class TsdfOutputs:
    """
    The publishers of a TSDF layer.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    mapper : Mapper
        Whose layer it is.
    layer : TsdfLayer
        What they publish.
    thread : MappingThread
        The thread that owns the mapper.

    """

    def __init__(
        self, node: Node, mapper: Mapper, layer: TsdfLayer, thread: MappingThread
    ) -> None:
        """Make the publishers; ``start_timers`` starts what is published at a rate."""
        self._node = node
        self._mapper = mapper
        self._layer = layer
        self._thread = thread
        self._mesh = node.create_publisher(Marker, '~/mesh', LATCHED)
        self._slice = node.create_publisher(OccupancyGrid, '~/tsdf_slice', LATCHED)
        self._stamp_ns = 0
        self._timers: list[Timer] = []

    def note(self, update: Update) -> None:
        """Take note of a scan; called in the mapping thread."""
        self._stamp_ns = update.stamp_ns

    def start_timers(self, config: TsdfConfig) -> None:
        """Publish at the rates of these settings; called in the executor's thread."""
        for rate_hz, callback in (
            (config.mesh_rate_hz, self._on_mesh_timer),
            (config.slice_rate_hz, self._on_slice_timer),
        ):
            if rate_hz:
                self._timers.append(steady_timer(self._node, rate_hz, callback))

    def stop_timers(self) -> None:
        """Publish nothing any more."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers.clear()

    def _on_mesh_timer(self) -> None:
        if self._mesh.get_subscription_count():
            self._thread.post(self._publish_mesh)

    def _on_slice_timer(self) -> None:
        self._thread.post(self._publish_slice)

    # What follows is called in the mapping thread.

    def _publish_mesh(self) -> None:
        frame_id = self._mapper.map_frame
        marker = mesh_marker(self._layer.mesh(), stamp_ns=self._stamp_ns, frame_id=frame_id)
        self._mesh.publish(marker_bytes(marker))

    def _publish_slice(self) -> None:
        found = slice_at(self._layer.blocks, self._mapper.config.tsdf.slice_height_m)
        self._slice.publish(grid_message(found, self._stamp_ns, self._mapper.map_frame))
