# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the models that are kept up to date while a map changes.

The voxels of the map are the pieces that planes and surfaces are made of, so lengths are theirs
and no cloud is thinned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from surfel_mapper.config.settings import setting, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsLayerConfig(Stage):
    """Planes, B-spline surfaces and Gaussians of the map as it changes."""

    STAGE: ClassVar[str] = 'layers.models'

    enabled: bool = setting(
        False, 'Keep planes, B-spline surfaces and Gaussians of the map up to date.'
    )
    extract_period_s: float = setting(
        1.0,
        'They follow the map this often, by the stamps of the scans, s; 0: after every scan.',
        low=0.0,
        high=1e6,
    )
    min_points: int = setting(
        10, 'A voxel of fewer points is no piece of anything yet.', low=3, high=1_000_000
    )
    flat_thickness_m: float = setting(
        0.0,
        'A voxel is flat where 6 sigma across are less, m; 0: a fifth of it, 0.02 at least.',
        low=0.0,
        high=10.0,
    )
    noise_m: float = setting(
        0.0, 'Noise of the sensor, sigma, m: flat things may be as thick.', low=0.0, high=1.0
    )
    max_angle_deg: float = setting(
        15.0, 'Normals of neighbours on one plane differ by less, deg.', low=0.1, high=89.0
    )
    arc_angle_deg: float = setting(
        30.0, 'Normals of neighbours on one bend differ by less, deg.', low=0.1, high=89.0
    )
    fold_angle_deg: float = setting(
        60.0, 'A surface that turns farther from its mean normal is cut, deg.', low=1.0, high=89.0
    )
    reach_voxels: int = setting(
        1, 'Neighbours are so many voxels away; 2 for lidars of few beams.', low=1, high=2
    )
    min_voxels: int = setting(
        4, 'Planes and surfaces of fewer voxels become Gaussians.', low=1, high=100_000
    )
    absorb: bool = setting(
        True, 'Voxels of few points, and rough ones, join the flat neighbour that they lie on.'
    )
