# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert surfels to the columns of a cloud, as in ~/normals, PCD files and bags of normals."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

logger = logging.getLogger(__name__)

FLOAT_REACH_M = 8192.0
"""Coordinates to which float32 is exact to 0.5 mm."""

Columns = dict[str, npt.NDArray[Any]]


def surfel_columns(surfels: Surfels) -> Columns:
    """
    Return the columns of ~/normals and ~/changed: float32, and uint32 for num_points.

    If the map sums them, also the mean intensity, and the mean colour packed as RViz draws it.
    """
    values = {
        **dict(zip('xyz', surfels.position.T, strict=True)),
        **dict(zip(('normal_x', 'normal_y', 'normal_z'), surfels.normal.T, strict=True)),
        'curvature': surfels.curvature,
        'planarity': surfels.planarity,
    }
    columns: Columns = {k: v.astype(np.float32) for k, v in values.items()}
    columns['num_points'] = surfels.num_points.astype(np.uint32)
    if 'intensity' in surfels.channels:
        columns['intensity'] = surfels.channels['intensity'].astype(np.float32)
    if 'red' in surfels.channels:
        channels = (surfels.channels[name] for name in ('red', 'green', 'blue'))
        columns['rgb'] = packed_rgb(*channels)
    return columns


def packed_rgb(
    red: npt.NDArray[Any], green: npt.NDArray[Any], blue: npt.NDArray[Any]
) -> npt.NDArray[np.float32]:
    """Return colours packed into float32: bytes 0, red, green, blue from the highest."""
    red, green, blue = (np.rint(channel).astype(np.uint32) for channel in (red, green, blue))
    packed: npt.NDArray[np.float32] = ((red << 16) | (green << 8) | blue).view(np.float32)
    return packed


def file_positions(path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike) -> Columns:
    """
    Return x, y, z of surfels for a file, with the origin of the map added.

    They are float32, which the Point Cloud Library needs, unless that rounds by more than 0.5 mm.
    """
    position = surfels.position + np.asarray(origin_m)
    is_far = np.abs(position).max(initial=0.0) >= FLOAT_REACH_M
    if is_far:
        logger.warning(
            '%s: x, y, z as doubles, since float32 rounds coordinates beyond %g m by more than '
            '0.5 mm; PCL does not read them',
            *(path, FLOAT_REACH_M),
        )
    return dict(zip('xyz', position.T.astype(np.float64 if is_far else np.float32), strict=True))
