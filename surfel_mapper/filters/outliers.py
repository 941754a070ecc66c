# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that drop points far from all others, as PCL and Open3D have them.

A lidar measures near surfaces more densely than far ones, so that a limit for the whole scan
drops far points first; a radius says at least what it means.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from surfel_mapper.filters.base import Filter, Mask
from surfel_mapper.filters.neighbours import coordinates, neighbourhoods
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

INT32_MAX = 2**31 - 1


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class StatisticalOutliers(Filter):
    """Drop the points whose mean distance to their neighbours is unusual for the scan."""

    num_neighbours: int = parameter(
        20, 'Neighbours of each point, itself not counted.', low=1, high=INT32_MAX
    )
    std_ratio: float = parameter(
        2.0,
        'Distances above mean + this times standard deviation, over all points, are unusual.',
        low=0.0,
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; nan and infinite ones are refused."""
        points = coordinates(scan)
        number = min(self.num_neighbours + 1, len(points))  # the nearest is the point itself
        if number < 2 or self.std_ratio == math.inf:
            return np.ones(len(points), np.bool_)
        distances = np.empty(len(points))
        for rows, _, around in neighbourhoods(points, number):
            distances[rows] = around[:, 1:].mean(axis=1)
        limit = distances.mean() + self.std_ratio * distances.std(ddof=1)
        return np.asarray(distances <= limit, np.bool_)


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class RadiusOutliers(Filter):
    """Drop the points that have too few others around them."""

    radius_m: float = parameter(0.5, 'How far around a point, m; the limit is in.', low=0.0)
    min_neighbours: int = parameter(2, 'Others that have to be there.', low=0, high=INT32_MAX)

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; nan and infinite ones are refused."""
        points = coordinates(scan)
        number = self.min_neighbours + 1  # the point itself among them
        if number > len(points):
            return np.zeros(len(points), np.bool_)
        if number == 1:
            return np.ones(len(points), np.bool_)
        stays = np.empty(len(points), np.bool_)
        # whether there are so many is settled by the last of the nearest so many
        for rows, _, distances in neighbourhoods(points, number, self.radius_m):
            stays[rows] = np.isfinite(distances[:, -1])
        return stays
