# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert surfels to the columns of a cloud, as in ~/normals, PCD files and bags of normals."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels


def surfel_columns(surfels: Surfels) -> dict[str, npt.NDArray[Any]]:
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
    columns: dict[str, npt.NDArray[Any]] = {k: v.astype(np.float32) for k, v in values.items()}
    columns['num_points'] = surfels.num_points.astype(np.uint32)
    if 'intensity' in surfels.channels:
        columns['intensity'] = surfels.channels['intensity'].astype(np.float32)
    if 'red' in surfels.channels:
        columns['rgb'] = packed_rgb(surfels)
    return columns


def packed_rgb(surfels: Surfels) -> npt.NDArray[np.float32]:
    """Return the mean colours packed into float32: bytes 0, red, green, blue from the highest."""
    red, green, blue = (
        np.rint(surfels.channels[name]).astype(np.uint32) for name in ('red', 'green', 'blue')
    )
    return ((red << 16) | (green << 8) | blue).view(np.float32)
