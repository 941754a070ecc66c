# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The costs of the ground as a layer: ``~/grid`` for Nav2, made from the surfels when published.

It stands apart from traversability.py, which needs no layer. The layer keeps nothing: the grid
follows from the surfels around the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surfel_mapper.layers.costs.traversability import traversability
from surfel_mapper.layers.layer import Layer, Moment, Publication
from surfel_mapper.messages.grids import occupancy_grid


class CostsLayer(Layer):
    """Publishes the cost of every cell around the sensor."""

    name = 'grid'

    def publications(self) -> Sequence[Publication]:
        """Return the grid, computed again when the map or the cell of its centre has changed."""
        return (
            Publication(
                topic='~/grid',
                type_name='nav_msgs/msg/OccupancyGrid',
                messages=self._grid_messages,
                rate_hz=lambda config: config.grid.rate_hz,
                version=self._version,
                is_eager=True,
            ),
        )

    def _version(self, moment: Moment) -> tuple[float, ...]:
        """Return a value for each map and cell of the sensor; a frozen map keeps its version."""
        surfel_map = self.around.surfel_map
        cell = np.floor(moment.T_map_sensor[:2, 3] / surfel_map.voxel_size_m)
        return surfel_map.version, *cell.tolist()

    def _grid_messages(self, moment: Moment) -> list[bytes]:
        config, surfel_map = self.config, self.around.surfel_map
        surfels = surfel_map.surfels(config.map.min_points)
        center = moment.T_map_sensor[:2, 3]
        grid = traversability(surfels, surfel_map.voxel_size_m, center, config.grid)
        return [occupancy_grid(grid.resolution_m, grid.origin, grid.cost, **moment.header)]
