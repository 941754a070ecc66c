# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A view of a running node by its topics, for ``surfel-mapper view --live``.

Shows ``~/normals`` (latched, so at once), ``~/changed``, ``~/mesh`` and ``~/planes``, from any
machine that receives them. The topics lack the moments, so there is one level of detail; the size
of discs is found from the gaps between them.

Maps and changes are shown at most every MAP_S and CHANGE_S: all that the topics have of a lidar
of 128 beams would be 25 MB a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
import logging
import time
from typing import Any

import numpy as np
import numpy.typing as npt
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from surfel_mapper.errors import CloudFormatError, one_line
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline.drops import described
from surfel_mapper.ros.base_node import LATCHED
from surfel_mapper.ros.context import context
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.contents import discs_of
from surfel_mapper.viz.discs import Colouring, DrawnDiscs
from surfel_mapper.viz.scene import Scene

SILENT_S = 5.0
"""Time without surfels after which a warning names the topics that were found, s."""

MAP_S, CHANGE_S = 5.0, 1.0
"""Shortest time between two maps, and between two changes, that are shown, s."""

NORMALS = {'normal_x', 'normal_y', 'normal_z'}

log = logging.getLogger(__name__)


class NodeView:
    """
    Topics of a node in a scene.

    Parameters
    ----------
    node : rclpy Node
        The node that subscribes.
    name : str
        Full name of the node to be shown.
    scene : Scene
        The scene that shows it.
    colouring : str
        One of discs.COLOURINGS.

    Attributes
    ----------
    num_shown : int
        Number of maps that were shown.

    """

    def __init__(self, node: Any, name: str, scene: Scene, colouring: str) -> None:
        self._node, self._name, self._scene, self._colouring = node, name, scene, colouring
        self.num_shown = 0
        self._waiting: PointCloud2 | None = None
        self._map_due_s = self._change_due_s = 0.0
        changes = QoSProfile(depth=10)
        for topic, kind, show, qos in (
            ('normals', PointCloud2, self.show_normals, LATCHED),
            ('changed', PointCloud2, self.show_changed, changes),
            ('mesh', Marker, self._on_mesh, LATCHED),
            ('planes', MarkerArray, self._on_planes, LATCHED),
        ):
            topic = f'{name}/{topic}'
            node.create_subscription(kind, topic, partial(self._show, topic, show), qos)

    def _show(self, topic: str, show: Callable[[Any], None], msg: Any) -> None:
        """Show a message; one that cannot be shown is left out, with a warning."""
        try:
            show(msg)
        except Exception as error:  # anyone can publish there
            text = one_line(f'{topic}: a message is not shown: {described(error)}')
            self._node.get_logger().warning(text, throttle_duration_sec=1.0)

    def show_normals(self, msg: PointCloud2) -> None:
        """Show all surfels, if it is time."""
        self._waiting = msg
        if time.monotonic() >= self._map_due_s:
            self._show_map(msg)

    def finish(self) -> None:
        """Show the newest map, if it is not shown."""
        if self._waiting is not None:
            self._show(f'{self._name}/normals', self._show_map, self._waiting)

    def _show_map(self, msg: PointCloud2) -> None:
        """Show all surfels."""
        self._waiting = None
        discs = self._discs(msg)
        self._scene.colouring = Colouring.over(self._colouring, [discs])
        self._scene.discs('map/surfels', discs)
        self.num_shown += 1
        self._map_due_s = time.monotonic() + MAP_S

    def show_changed(self, msg: PointCloud2) -> None:
        """Show the surfels that the last scan changed, if it is time."""
        if time.monotonic() >= self._change_due_s:
            self._scene.discs('map/changed', self._discs(msg))
            self._change_due_s = time.monotonic() + CHANGE_S

    def _discs(self, msg: PointCloud2) -> DrawnDiscs:
        """Return the surfels of a cloud, and go to its stamp."""
        scan = to_scan(msg)
        if not scan.columns.keys() >= NORMALS:
            raise CloudFormatError(f'no {", ".join(sorted(NORMALS))} among its columns')
        self._scene.set_stamp(scan.stamp_ns)
        return discs_of(scan.points.astype(np.float64), scan.columns)

    def _on_mesh(self, msg: Marker) -> None:
        """Show the mesh of the distance field."""
        self._scene.mesh('map/mesh', marker_mesh(msg))

    def _on_planes(self, msg: MarkerArray) -> None:
        """Show planes and surfaces, in place of the ones before."""
        self._scene.clear('map/models')
        for marker in msg.markers:
            path = f'map/models/{marker.ns}_{marker.id}'
            if marker.action != Marker.ADD:
                continue
            if marker.type == Marker.TRIANGLE_LIST:
                self._scene.mesh(path, marker_mesh(marker))
            elif marker.type == Marker.LINE_LIST:
                lines = list(places_of(marker, 2).reshape(-1, 2, 3))
                shape = self._scene.rerun.LineStrips3D(lines, colors=colours_of(marker)[::2])
                self._scene.log(path, shape)


def show_node(
    scene: Scene,
    name: str,
    colouring: str,
    ros_args: Sequence[str],
    stopped: Callable[[], bool],
) -> int:
    """Show a node until ``stopped`` returns True; return the number of maps shown."""
    with context(ros_args):
        node = rclpy.create_node('surfel_mapper_view')
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        view = NodeView(node, name, scene, colouring)
        warn_s = time.monotonic() + SILENT_S
        try:
            while not stopped():
                executor.spin_once(0.1)
                if not view.num_shown and time.monotonic() > warn_s:
                    warn_s = float('inf')
                    log.warning(silence(node, name))
        finally:
            view.finish()
            executor.shutdown()
            node.destroy_node()
    return view.num_shown


def silence(node: Any, name: str) -> str:
    """Return why nothing is shown."""
    topic = f'{name}/normals'
    if node.count_publishers(topic):
        return f'{topic}: no map yet; the node waits for its input, see /diagnostics'
    kind = 'sensor_msgs/msg/PointCloud2'
    clouds = [cloud for cloud, kinds in node.get_topic_names_and_types() if kind in kinds]
    maps = [cloud.removesuffix('/normals') for cloud in clouds if cloud.endswith('/normals')]
    nodes = ', '.join(cloud for cloud in maps if cloud != name) or 'none'
    return f'{topic}: nothing publishes it; nodes that publish such a map: {nodes}'


def places_of(marker: Marker, corners: int) -> npt.NDArray[np.float64]:
    """
    Return the points of a marker, (N, 3) m, of shapes of that many corners.

    Raises
    ------
    CloudFormatError
        If the last shape is not complete, or colours are not one for each point.

    """
    number, colours = len(marker.points), len(marker.colors)
    if number % corners or colours not in (0, number):
        raise CloudFormatError(
            f'marker {marker.ns!r}: {number} points and {colours} colours, expected {corners} '
            'points a shape, and no colours or one for each'
        )
    return np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3)


def colours_of(marker: Marker) -> npt.NDArray[np.uint8]:
    """Return the colours of the points of a marker, (N, 3)."""
    rgb = [(c.r, c.g, c.b) for c in marker.colors] or [
        (marker.color.r, marker.color.g, marker.color.b)
    ] * len(marker.points)
    shares = np.clip(np.nan_to_num(np.array(rgb).reshape(-1, 3)), 0.0, 1.0)
    colours: npt.NDArray[np.uint8] = np.rint(255.0 * shares).astype(np.uint8)
    return colours


def marker_mesh(marker: Marker) -> Mesh:
    """Return the triangles of a marker."""
    corners = places_of(marker, 3)
    number = len(corners) // 3
    return Mesh(
        vertices=corners,
        triangles=np.arange(3 * number, dtype=np.int32).reshape(-1, 3),
        colors=colours_of(marker),
    )
