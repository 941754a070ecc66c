# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The services of a node, and the topic that clears: what to do with the map, at whose word.

What is asked for is done in the mapping thread, behind the clouds that came before the request,
so an answer is about all of them. The executor goes on meanwhile (waiting.py). Every answer says
what was done and where, in the log too: nav_msgs/LoadMap has no room for a word.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError
from functools import partial
from typing import Any

from geometry_msgs.msg import PolygonStamped
from nav_msgs.srv import LoadMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from surfel_mapper.errors import FileFormatError, MapError, PoseError, SurfelMapperError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball, Box, Region
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.outputs import Outputs
from surfel_mapper.ros.polygons import prism
from surfel_mapper.ros.saving import load_map, save_map
from surfel_mapper.ros.waiting import result_of

LOADED = LoadMap.Response.RESULT_SUCCESS
UNLOADED: tuple[tuple[type[Exception], int], ...] = (
    (FileNotFoundError, LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
    (FileFormatError, LoadMap.Response.RESULT_INVALID_MAP_DATA),
    (MapError, LoadMap.Response.RESULT_INVALID_MAP_METADATA),
    (Exception, LoadMap.Response.RESULT_UNDEFINED_FAILURE),
)
"""What the answer to ~/load_map is, by the error that loading ended with; the first that fits."""

MAX_WAITING = 10
"""
Requests that may wait, as many as a client holds answers to; more are refused.

Polygons likewise; the oldest gives way.
"""


class Control:
    """
    Services ~/align, ~/clear, ~/clear_box, ~/clear_radius, ~/save_map, ~/load_map, ~/pause.

    Parameters
    ----------
    node : Node
        Whose services they are.
    mapper : Mapper
        What they are about.
    thread : MappingThread
        The thread that owns the mapper.
    outputs : Outputs
        Told when the map is not what was published.

    """

    def __init__(
        self, node: Node, mapper: Mapper, thread: MappingThread, outputs: Outputs
    ) -> None:
        """Offer the services and listen for polygons."""
        self._node = node
        self._mapper = mapper
        self._thread = thread
        self._outputs = outputs
        self._num_waiting = 0
        self._polygons: deque[PolygonStamped] = deque(maxlen=MAX_WAITING)
        group = ReentrantCallbackGroup()  # one may wait while the others go on
        for name, action in (
            ('~/align', self._align),
            ('~/clear', self._clear),
            ('~/clear_box', self._clear_box),
            ('~/clear_radius', self._clear_radius),
            ('~/save_map', self._save),
        ):
            node.create_service(Trigger, name, self._trigger(action), callback_group=group)
        node.create_service(LoadMap, '~/load_map', self._on_load_map, callback_group=group)
        node.create_service(SetBool, '~/pause', self._on_pause, callback_group=group)
        node.create_subscription(PolygonStamped, '~/clear_polygon', self._on_polygon, 10)

    def _trigger(self, action: Callable[[], str]) -> Callable[..., Any]:
        """Return the callback of a service that does something in the mapping thread."""

        async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message = await self._done(action)
                response.success = True
            except (SurfelMapperError, OSError, ValueError, CancelledError) as error:
                response.message = self._refused(error)
            return response

        return answer

    async def _on_load_map(
        self, request: LoadMap.Request, response: LoadMap.Response
    ) -> LoadMap.Response:
        try:
            await self._done(partial(self._load, request.map_url))
        except (SurfelMapperError, OSError, ValueError, CancelledError) as error:
            self._refused(error)
            response.result = next(code for kind, code in UNLOADED if isinstance(error, kind))
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

    async def _done(self, action: Callable[[], str]) -> str:
        """Do something in the mapping thread; return what it says, and log it."""
        if self._num_waiting >= MAX_WAITING:
            raise MapError(f'{MAX_WAITING} requests wait already; try again')
        self._num_waiting += 1
        try:
            said = await result_of(self._thread.call(action), self._node.executor)
        finally:
            self._num_waiting -= 1
        self._node.get_logger().info(said)
        return said

    def _refused(self, error: BaseException) -> str:
        """Return why something was not done, and log it."""
        said = 'the node is about to end' if isinstance(error, CancelledError) else str(error)
        self._node.get_logger().error(said)
        return said

    # What follows is called in the mapping thread.

    def _align(self) -> str:
        """Move the scans of the window to where they agree; return by how much."""
        aligned = self._mapper.align()
        self._outputs.publish_aligned(aligned)
        return str(aligned)

    def _clear(self) -> str:
        """Empty the map; return what was in it."""
        mapper = self._mapper
        said = f'cleared {mapper.map.num_voxels} voxels of {len(mapper.window)} scans'
        mapper.clear()
        self._outputs.expire()
        return said

    def _clear_box(self) -> str:
        """Empty the box of the settings."""
        x0, y0, z0, x1, y1, z1 = self._mapper.config.clear.box
        box = Box((x0, y0, z0), (x1, y1, z1))
        return self._clear_region(box, f'clear.box from {box.low} to {box.high}')

    def _clear_radius(self) -> str:
        """Empty all about the sensor."""
        newest, radius_m = self._mapper.window.newest, self._mapper.config.clear.radius_m
        if newest is None:
            raise MapError('no scan in the map yet, so that the sensor is nowhere')
        x, y, z = newest.T_map_sensor[:3, 3].tolist()
        where = f'{radius_m:g} m about the sensor at ({x:.2f}, {y:.2f}, {z:.2f})'
        return self._clear_region(Ball((x, y, z), radius_m), where)

    def _clear_polygons(self) -> None:
        """Empty all above and below the polygons that came on the topic."""
        while self._polygons:
            self._clear_polygon(self._polygons.popleft())

    def _clear_polygon(self, msg: PolygonStamped) -> None:
        topic, log = self._node.resolve_topic_name('~/clear_polygon'), self._node.get_logger()
        frame_id = msg.header.frame_id
        try:
            region = prism(msg, self._mapper)
            log.info(self._clear_region(region, f'the polygon on {topic} in frame {frame_id}'))
        except (PoseError, MapError, ValueError) as error:
            log.warning(
                f'polygon on {topic} in frame {frame_id!r} ignored: {error}',
                throttle_duration_sec=1.0,
            )

    def _clear_region(self, region: Region, where: str) -> str:
        """Empty a part of space; return what was in it."""
        before = self._mapper.map.num_voxels
        self._mapper.clear_region(region)
        self._outputs.expire()
        return f'cleared {before - self._mapper.map.num_voxels} voxels in {where}'

    def _save(self) -> str:
        """Write the map to its files."""
        return save_map(self._mapper)

    def _load(self, url: str) -> str:
        """Put the map of a file in the place of the one there is."""
        said = load_map(self._mapper, url)
        self._outputs.expire()
        return said
