# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The services of the node, and ~/clear_polygon: commands that change, save or load the map.

Requests are carried out in the mapping thread, behind the clouds that arrived before them, so the
answer covers all of these; ~/save_map copies the map there, and writes it in another thread. The
executor runs other callbacks meanwhile. Every answer states the
result and its location; it is logged too, because nav_msgs/LoadMap has no field for text.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any

from geometry_msgs.msg import PolygonStamped
from nav_msgs.srv import LoadMap
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from surfel_mapper.errors import (
    counted,
    FileFormatError,
    MapError,
    one_line,
    PoseError,
    SurfelMapperError,
)
from surfel_mapper.messages.cdr import frame_name
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.drops import described
from surfel_mapper.pipeline.regions import Ball, Box, MAX_CORNERS, Prism, Region
from surfel_mapper.ros.base_node import result_of
from surfel_mapper.ros.map_files import load_map, MapWriter
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.outputs import Outputs

LOADED = LoadMap.Response.RESULT_SUCCESS
LOAD_ERRORS: tuple[tuple[type[Exception], int], ...] = (
    (FileNotFoundError, LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
    (FileFormatError, LoadMap.Response.RESULT_INVALID_MAP_DATA),
    (MapError, LoadMap.Response.RESULT_INVALID_MAP_METADATA),
    (Exception, LoadMap.Response.RESULT_UNDEFINED_FAILURE),
)
"""Result code of ~/load_map by the error raised; the first match counts."""

EXPECTED = (SurfelMapperError, OSError, ValueError)
"""Errors of requests that are answered only; all others are counted too."""

MAX_WAITING = 10
"""
Most requests that may wait; more are refused. A service client holds as many answers.

Polygons have a queue of the same length, which drops the oldest.
"""


class Services:
    """
    The services ~/align, ~/clear, ~/clear_box, ~/clear_radius, ~/save_map, ~/load_map, ~/pause.

    Parameters
    ----------
    node : Node
        The node that offers them.
    mapper : Mapper
        The mapper they act on.
    thread : MappingThread
        The thread that owns the mapper.
    outputs : Outputs
        Publishes the map again after a change.
    writer : MapWriter
        Saves the map.

    """

    def __init__(
        self,
        node: Node,
        mapper: Mapper,
        thread: MappingThread,
        outputs: Outputs,
        writer: MapWriter,
    ) -> None:
        """Create the services and the subscription to ~/clear_polygon."""
        self._node = node
        self._mapper = mapper
        self._thread = thread
        self._outputs = outputs
        self._num_waiting = 0
        self._polygons: deque[PolygonStamped] = deque(maxlen=MAX_WAITING)
        group = ReentrantCallbackGroup()  # a request may wait while others are answered
        for name, action in (
            ('~/align', self._align),
            ('~/clear', self._clear),
            ('~/clear_box', self._clear_box),
            ('~/clear_radius', self._clear_radius),
        ):
            start = partial(thread.call, action)
            node.create_service(Trigger, name, self._trigger(start), callback_group=group)
        save = self._trigger(writer.save)
        node.create_service(Trigger, '~/save_map', save, callback_group=group)
        node.create_service(LoadMap, '~/load_map', self._on_load_map, callback_group=group)
        node.create_service(SetBool, '~/pause', self._on_pause, callback_group=group)
        node.create_subscription(PolygonStamped, '~/clear_polygon', self._on_polygon, 10)

    def _trigger(self, start: Callable[[], Future[str]]) -> Callable[..., Any]:
        """Return a service callback that starts an action in another thread, and awaits it."""

        async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message = await self._run(start)
                response.success = True
            except Exception as error:  # MemoryError too
                response.message = self._log_failure(error)
            return response

        return answer

    async def _on_load_map(
        self, request: LoadMap.Request, response: LoadMap.Response
    ) -> LoadMap.Response:
        try:
            await self._run(partial(self._thread.call, partial(self._load, request.map_url)))
        except Exception as error:  # MemoryError too
            self._log_failure(error)
            response.result = next(code for kind, code in LOAD_ERRORS if isinstance(error, kind))
            return response
        response.result = LOADED
        config = self._mapper.config
        response.map.header.frame_id = self._mapper.map_frame
        response.map.info.resolution = config.map.voxel_size_m
        now_ns = self._node.get_clock().now().nanoseconds
        response.map.header.stamp = response.map.info.map_load_time = time_message(now_ns)
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._thread.paused = request.data
        response.success = True
        response.message = 'paused: clouds are dropped' if request.data else 'mapping'
        self._node.get_logger().info(response.message)
        return response

    def _on_polygon(self, msg: PolygonStamped) -> None:
        self._polygons.append(msg)
        self._thread.post(self._clear_polygons)

    async def _run(self, start: Callable[[], Future[str]]) -> str:
        """Start an action in another thread; log its answer and return it."""
        if self._num_waiting >= MAX_WAITING:
            raise MapError(f'{MAX_WAITING} requests wait already; try again')
        self._num_waiting += 1
        try:
            answer = await result_of(start(), self._node.executor)
        finally:
            self._num_waiting -= 1
        self._node.get_logger().info(answer)
        return answer

    def _log_failure(self, error: Exception) -> str:
        """Log why a request failed, and count it if nothing expects that; return the text."""
        if isinstance(error, CancelledError):
            text = 'the node is about to end'
        elif isinstance(error, EXPECTED):
            text = one_line(error)
        else:
            self._thread.report_failure('a request', error)
            return described(error)
        self._node.get_logger().error(text)
        return text

    # The methods below run in the mapping thread.

    def _align(self) -> str:
        """
        Close loops if their points are kept, and align the scans of the window if theirs are.

        Returns the corrections in words.
        """
        mapper, done = self._mapper, []
        try:
            if mapper.loops is not None:
                done.append(str(mapper.close_loops()))
            if mapper.loops is None or mapper.config.window.keep_points:
                done.append(str(mapper.align()))
        finally:
            if done:
                self._outputs.publish_aligned()
        return '; '.join(done)

    def _clear(self) -> str:
        """Remove all voxels and scans; return their numbers."""
        mapper = self._mapper
        scans = counted(len(mapper.window), 'scan')
        answer = f'cleared {counted(mapper.map.num_voxels, "voxel")} of {scans}'
        mapper.clear()
        self._outputs.expire()
        return answer

    def _clear_box(self) -> str:
        """Clear the box given by the setting ``clear.box``."""
        x0, y0, z0, x1, y1, z1 = self._mapper.config.clear.box
        box = Box((x0, y0, z0), (x1, y1, z1))
        return self._clear_region(box, f'clear.box from {box.low} to {box.high}')

    def _clear_radius(self) -> str:
        """Clear the ball of ``clear.radius_m`` about the newest position of the sensor."""
        newest, radius_m = self._mapper.window.newest, self._mapper.config.clear.radius_m
        if newest is None:
            raise MapError('no scan in the map yet, so the position of the sensor is not known')
        x, y, z = newest.T_map_sensor[:3, 3].tolist()
        where = f'{radius_m:g} m about the sensor at ({x:.2f}, {y:.2f}, {z:.2f})'
        return self._clear_region(Ball((x, y, z), radius_m), where)

    def _clear_polygons(self) -> None:
        """Clear the region of the next polygon; those behind it follow after other work."""
        self._clear_polygon(self._polygons.popleft())
        if self._polygons:
            self._thread.post(self._clear_polygons)

    def _clear_polygon(self, msg: PolygonStamped) -> None:
        topic, log = self._node.resolve_topic_name('~/clear_polygon'), self._node.get_logger()
        frame_id = msg.header.frame_id
        try:
            region = prism(msg, self._mapper)
            log.info(self._clear_region(region, f'the polygon on {topic} in frame {frame_id}'))
        except EXPECTED as error:
            log.warning(
                f'polygon on {topic} in frame {frame_id!r} ignored: {error}',
                throttle_duration_sec=1.0,
            )

    def _clear_region(self, region: Region, where: str) -> str:
        """Clear a region of the map; return the number of voxels removed."""
        num_voxels = self._mapper.map.num_voxels
        self._mapper.clear_region(region)
        self._outputs.expire()
        num_cleared = num_voxels - self._mapper.map.num_voxels
        return f'cleared {counted(num_cleared, "voxel")} in {where}'

    def _load(self, url: str) -> str:
        """Replace the map by the one in a file."""
        answer = load_map(self._mapper, url)
        self._outputs.expire()
        return answer


def prism(msg: Any, mapper: Mapper) -> Prism:
    """
    Return the vertical prism over a polygon: the region above and below it in the map.

    Parameters
    ----------
    msg : geometry_msgs/PolygonStamped
        The polygon. A stamp of zero, as RViz sends it, means the newest transform.
    mapper : Mapper
        Looks up the transform from the polygon's frame to the map.

    Raises
    ------
    CloudFormatError
        If the frame_id is longer than that of any frame.
    PoseError
        If the frame_id is empty, or there is no transform to the fixed frame at the stamp.
    ValueError
        If it has fewer than three corners or too many, or one is not finite.

    """
    if len(msg.polygon.points) > MAX_CORNERS:
        raise ValueError(f'{len(msg.polygon.points)} corners, expected at most {MAX_CORNERS}')
    frame_id = frame_name(msg.header.frame_id)
    if not frame_id:
        raise PoseError('its frame_id is empty')
    stamp_ns = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
    T_map_frame = mapper.T_map_of(frame_id, stamp_ns)
    corners = np.array([(p.x, p.y, p.z) for p in msg.polygon.points]).reshape(-1, 3)
    moved = corners @ T_map_frame[:3, :3].T + T_map_frame[:3, 3]
    return Prism(tuple((float(x), float(y)) for x, y, _ in moved))
