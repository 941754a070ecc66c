# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Polygons as messages to parts of space in the fixed frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from surfel_mapper.pipeline.regions import Prism
from surfel_mapper.poses import TransformBuffer


def prism(msg: Any, transforms: TransformBuffer, fixed: str) -> Prism:
    """
    Return all above and below a polygon, seen from above in the fixed frame.

    Parameters
    ----------
    msg : geometry_msgs/PolygonStamped
        The polygon. A stamp of zero means the newest transform, as RViz sends it.
    transforms : TransformBuffer
        Where its frame is in the fixed frame.
    fixed : str
        The fixed frame.

    Raises
    ------
    PoseError
        If there is no transform to the fixed frame at the stamp.
    ValueError
        If it has fewer than three corners, or one is not finite.

    """
    stamp_ns = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
    if not stamp_ns:
        stamp_ns = transforms.newest_ns or 0
    T_fixed_frame = transforms.lookup(fixed, msg.header.frame_id, stamp_ns)
    corners = np.array([(p.x, p.y, p.z) for p in msg.polygon.points]).reshape(-1, 3)
    moved = corners @ T_fixed_frame[:3, :3].T + T_fixed_frame[:3, 3]
    return Prism(tuple((float(x), float(y)) for x, y, _ in moved))
