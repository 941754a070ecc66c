# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the registration, which finds poses where none come in (pose.source)."""

from __future__ import annotations

from dataclasses import dataclass
import math

from surfel_mapper.config.settings import setting, Stage
from surfel_mapper.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig(Stage):
    """How a scan is aligned to the map."""

    start: tuple[float, ...] = setting(
        (),
        'Where it begins: pose of the base in the fixed frame, x y z in m, qx qy qz qw; empty: at '
        'the origin.',
    )
    cell_m: float = setting(
        0.0,
        'Points of a scan are replaced by their means in cells of this edge, m; '
        '0: half of map.voxel_size_m.',
        low=0.0,
        high=1000.0,
        live=True,
    )
    max_cells: int = setting(
        40_000,
        'Of more cells than this only some, evenly chosen, are aligned.',
        low=100,
        high=10**7,
        live=True,
    )
    min_points: int = setting(
        5, 'Surfels of fewer points are not aligned to.', low=3, high=2**31 - 1, live=True
    )
    noise_m: float = setting(
        0.02,
        'Standard deviation of a range; surfaces are no sharper, m.',
        low=1e-5,
        high=10.0,
        live=True,
    )
    max_deviation_m: float = setting(
        1.0,
        'How far points may be from where the prediction has them as long as nothing is known, '
        'm; afterwards the last deviations tell.',
        low=0.001,
        high=1000.0,
        live=True,
    )
    coarse_levels: int = setting(
        2,
        'Where deviations exceed a voxel, alignment begins with voxels up to 2^this times larger.',
        low=0,
        high=3,
        live=True,
    )
    max_iterations: int = setting(
        30, 'Steps at most, of each level.', low=1, high=10_000, live=True
    )
    min_overlap_ratio: float = setting(
        0.03,
        'A scan is dropped unless this share of its cells meet surfels that say something.',
        low=0.0,
        high=1.0,
        live=True,
    )
    min_fit_ratio: float = setting(
        0.6,
        'A scan is dropped unless this share of these fit.',
        low=0.0,
        high=1.0,
        live=True,
    )
    search_deg: float = setting(
        60.0,
        'Where a scan fits less than is usual, headings so far to both sides are tried, deg.',
        low=0.0,
        high=180.0,
        live=True,
    )
    min_information_ratio: float = setting(
        0.003,
        'A direction of motion of which the surfaces seen say less than this, as a share of all '
        'they say, is degenerate: there the prediction stays.',
        low=0.0,
        high=1.0,
        live=True,
    )

    publish_tf: bool = setting(
        True, 'The node publishes the transform from the fixed frame to what it follows.'
    )

    def check(self, stage: str) -> None:
        """Refuse a start that is no pose."""
        if self.start and (
            len(self.start) != 7 or not abs(math.hypot(*self.start[3:]) - 1.0) <= 1e-3
        ):
            raise ConfigError(
                f'{stage}.start: {list(self.start)}, expected x y z and a unit quaternion '
                'qx qy qz qw, or nothing'
            )
