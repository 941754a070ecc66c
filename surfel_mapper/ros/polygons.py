# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Polygons as messages to parts of space in the map."""

from __future__ import annotations

from typing import Any

import numpy as np

from surfel_mapper.errors import PoseError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Prism


def prism(msg: Any, mapper: Mapper) -> Prism:
    """
    Return all above and below a polygon, seen from above in the map.

    Parameters
    ----------
    msg : geometry_msgs/PolygonStamped
        The polygon. A stamp of zero means the newest transform, as RViz sends it.
    mapper : Mapper
        Knows where its frame is in the map.

    Raises
    ------
    PoseError
        If it names no frame, or there is no transform to the fixed one at the stamp.
    ValueError
        If it has fewer than three corners, or one is not finite.

    """
    if not msg.header.frame_id:
        raise PoseError('its frame_id is empty')
    stamp_ns = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
    T_map_frame = mapper.T_map_of(msg.header.frame_id, stamp_ns)
    corners = np.array([(p.x, p.y, p.z) for p in msg.polygon.points]).reshape(-1, 3)
    moved = corners @ T_map_frame[:3, :3].T + T_map_frame[:3, 3]
    return Prism(tuple((float(x), float(y)) for x, y, _ in moved))
