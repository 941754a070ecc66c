# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stage of the grid of slopes and steps that navigation reads."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.config.settings import setting, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class GridConfig(Stage):
    """The nav_msgs/OccupancyGrid on ~/grid."""

    rate_hz: float = setting(0.0, 'Rate of ~/grid, Hz; 0: never.', low=0.0, high=100.0, live=True)
    size_m: float = setting(
        100.0,
        'Edge of the grid, with the sensor in its middle, m.',
        low=1.0,
        high=4000.0,
        live=True,
    )
    max_slope_deg: float = setting(
        30.0, 'Ground that is steeper is an obstacle, deg.', low=1.0, high=90.0, live=True
    )
    max_step_m: float = setting(
        0.25,
        'A difference in height between neighbours above this is an obstacle, m.',
        low=0.01,
        high=100.0,
        live=True,
    )
    clearance_m: float = setting(
        2.0,
        'What is higher above the ground of its cell than this is passed under, m.',
        low=0.0,
        high=1000.0,
        live=True,
    )
