# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the models: planes, B-spline surfaces and Gaussians.

Lengths are in voxels, the unit of the method, so that one number suits a table and a hall. The
defaults are those of Gao and Dong 2025 but where real sensors and axis-aligned buildings break
their rules; profile paper brings those back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from surfel_mapper.config.settings import setting, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsConfig(Stage):
    """Planes, B-spline surfaces and Gaussians."""

    STAGE: ClassVar[str] = 'models'

    voxel_size_m: float = setting(
        0.04, 'Points are thinned to one a voxel of this edge, m.', low=0.001, high=10.0
    )
    profile: str = setting(
        'robust',
        'robust: rules that allow for noise, outliers, bends and any direction; paper: those of '
        'the paper to the letter.',
        choices=('robust', 'paper'),
    )
    kinds: str = setting(
        'all',
        'all: planes, surfaces and Gaussians; gaussians: every cluster is a Gaussian.',
        choices=('all', 'gaussians'),
    )
    max_mixture_points: int = setting(
        200,
        'Clusters of more points are split by 2-means, others by two Gaussians.',
        low=4,
        high=100_000,
    )
    min_points: int = setting(40, 'Clusters of fewer points are not split.', low=4, high=100_000)
    min_surface_points: int = setting(
        20, 'Planes and surfaces of fewer points become Gaussians.', low=1, high=100_000
    )
    plane_pitch_voxels: float = setting(
        4.0, 'Edge of the cells that say what a plane covers, in voxels.', low=2.5, high=100.0
    )
    min_density_radius: float = setting(
        2.0, 'Least density of a flat cluster; a full sheet has 2.', low=0.1, high=2.4
    )
    outlier_share: float = setting(
        0.02, 'Share of points of a flat cluster that may be beyond 3 sigma.', low=0.0, high=1.0
    )
    max_angle_deg: float = setting(
        15.0, 'Normals of clusters on one plane differ by less, deg.', low=0.1, high=89.0
    )
    max_offset_voxels: float = setting(
        1.0, 'And their planes by less than this, in voxels.', low=0.01, high=100.0
    )
    arc_angle_deg: float = setting(
        30.0, 'Normals of neighbours on one bend differ by less, deg.', low=0.1, high=89.0
    )
    arc_offset_voxels: float = setting(
        0.5, 'And their middles lie this near to one arc, in voxels.', low=0.01, high=100.0
    )
    fold_angle_deg: float = setting(
        60.0, 'A surface that turns farther from its mean normal is cut, deg.', low=1.0, high=89.0
    )
    noise_m: float = setting(
        0.0, 'Noise of the sensor at no range, sigma, m (lidar: 0.02).', low=0.0, high=1.0
    )
    noise_per_range_sq: float = setting(
        0.0, 'Noise that grows with range^2, 1/m (Kinect: 0.001425).', low=0.0, high=1.0
    )
    degree: int = setting(3, 'Degree of the splines.', low=1, high=5)
    smoothing: float = setting(
        1e-2, 'Weight of the second differences of the control points.', low=1e-9, high=1e6
    )
    solver: str = setting(
        'pspline',
        'pspline: smooth across holes; lsqr: the least change of the initial control points.',
        choices=('pspline', 'lsqr'),
    )
