# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the optional layers: distance field, models, dynamic objects and the costs for Nav2.

Defaults of the distance field follow Hydra's ProjectiveIntegrator unless it has a fault. Its
blocks have 16 voxels a side, ours 8: a band of 2 tau through a block of 16 leaves most of its
voxels unused, and a lidar scan at 0.2 m takes 1.6 times as long.

Defaults of the models are those of Gao and Dong 2025 except where real sensors and axis-aligned
buildings break its rules; profile paper restores those. Lengths are in voxels, the unit of the
method, so that one number suits a table and a hall.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

from surfel_mapper.config.settings import setting, Stage
from surfel_mapper.errors import ConfigError

SEMANTICS = ('none', 'single')

LIDAR_NOISE_M = 0.02
"""Standard deviation of the ranges of a lidar, m; data sheets state 0.01 to 0.03."""

MAX_LABEL = (1 << 24) - 1
"""Labels are kept as float32, which holds whole numbers up to here."""

LEAST_WEIGHT, MAX_WEIGHT = 1e-4, 1e5
"""
Least weight of a measurement, and of a voxel in the mesh; largest weight of a voxel.

At 1 m a measurement has 1.
"""

LABEL_ODDS = 9.0
"""A voxel has a label that is 9 times as likely as another: one measurement of Hydra's default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TsdfConfig(Stage):
    """The truncated signed distance field."""

    STAGE: ClassVar[str] = 'layers.tsdf'

    enabled: bool = setting(False, 'Fuse the scans into a signed distance field too.')
    when_final: bool = setting(
        False,
        'Fuse a scan when it leaves the window, after alignments have moved it, not at once.',
    )
    sensor_frame: str = setting(
        '',
        'Frame of the optical centre of the lidar, for clouds that are given in another, such as '
        'base_link; its pose: from TF or frames.base_to_sensor. Empty: the frame of the clouds.',
    )
    min_range_m: float = setting(
        0.5, 'Measurements nearer than this are ignored, m.', low=0.001, high=1e3
    )
    max_range_m: float = setting(
        50.0, 'Measurements beyond this only free the space up to it, m.', low=0.01, high=1e5
    )
    voxel_size_m: float = setting(0.1, 'Edge of a voxel, m.', low=0.001, high=100.0)
    truncation_m: float = setting(
        0.0,
        'Distances are kept up to this in front of a surface, m; at least two voxels. 0: two '
        'voxels and three times the noise of a lidar (0.02 m), at most three voxels.',
        low=0.0,
        high=1000.0,
    )
    max_radius_m: float = setting(
        0.0,
        'Blocks farther than this from the sensor are dropped, m; 0: no such limit. At least the '
        'range of the sensor and half the diagonal of a block.',
        low=0.0,
        high=1e6,
    )
    carve_m: float = setting(
        10.0,
        'Rays free the space up to this far from the sensor, m; beyond, only surfaces are kept; '
        '0: no space.',
        low=0.0,
        high=1e5,
    )
    forget_s: float = setting(
        10.0,
        'A surface that is gone becomes free within this time of being seen through, s. A new '
        'one appears as fast, however often the voxels were observed, and so do colours and '
        'labels. 0: after as many scans as have seen the opposite. Needs stamps.',
        low=0.0,
        high=1e9,
    )
    color: bool = setting(False, 'Keep a colour for each voxel.')
    color_topic: str = setting(
        '',
        'Topic of images that colour points without a colour; empty: none. Images of a depth '
        'camera match its depth pixel by pixel; for a lidar their camera_info is read too.',
    )
    label_topic: str = setting(
        '', 'Topic of images of labels, 8 or 16 bits or 32SC1; empty: none.'
    )
    semantics: str = setting(
        'none',
        'Labels of voxels: none; single, one for each voxel by majority vote of measurements.',
        choices=SEMANTICS,
    )
    label_confidence: float = setting(
        0.9,
        'Probability that a measured label is right. A voxel has a label once it is 9 times as '
        'likely as any other: from 0.9 on one measurement ahead of all others, at 0.75 two, at '
        '0.6 six. Else it has none.',
        low=0.6,
        high=1.0,
    )
    dynamic_labels: tuple[float, ...] = setting(
        (), 'Labels of moving objects: they free space and leave no surface.'
    )
    max_weight_by_label: tuple[float, ...] = setting(
        (),
        'Label, weight, label, weight, ...: voxels of these labels keep at most that weight, 1e-4 '
        'to 1e5, and fade the sooner. A measurement has 1 / distance^2: 1 at 1 m, 0.01 at 10 m.',
    )
    mesh_rate_hz: float = setting(
        1.0,
        'Rate of ~/mesh and ~/mesh_tiles, Hz, while each has subscribers; 0: never.',
        low=0.0,
        high=100.0,
        live=True,
    )
    slice_rate_hz: float = setting(
        0.0, 'Rate of ~/tsdf_slice, Hz; 0: never.', low=0.0, high=100.0, live=True
    )
    slice_height_m: float = setting(
        0.5, 'Height of ~/tsdf_slice in the fixed frame, m.', low=-1e5, high=1e5, live=True
    )

    # No settings: callers of the library may change the fields.
    voxels_per_side: int = 8
    """Voxels along the edge of a block, a power of two."""

    threads: int = 0
    """Threads; 0: one for each core that the process may use."""

    def check(self, stage: str) -> None:
        """Check conditions on several settings."""
        side, caps = self.voxels_per_side, self.max_weight_by_label
        checks = (
            ('voxels_per_side', side & (side - 1) == 0, 'a power of two'),
            (
                'truncation_m',
                self.truncation_m == 0.0 or self.voxel_size_m < self.truncation_m,
                f'0, or more than {self.voxel_size_m}, a voxel',
            ),
            (
                'max_range_m',
                self.max_range_m > self.min_range_m,
                f'more than min_range_m = {self.min_range_m}',
            ),
            ('color', self.color or not self.color_topic, 'true where color_topic is given'),
            (
                'semantics',
                self.semantics != 'none' or not (self.label_topic or caps),
                'another where label_topic or max_weight_by_label is given',
            ),
            (
                'max_weight_by_label',
                2 * len(self.label_caps) == len(caps)
                and all(LEAST_WEIGHT <= weight <= MAX_WEIGHT for weight in caps[1::2])
                and not set(caps[::2]) & set(self.dynamic_labels),
                f'pairs of a label, once and not in dynamic_labels, and a weight from '
                f'{LEAST_WEIGHT} to {MAX_WEIGHT}',
            ),
        )
        for name, holds, expected in checks:
            if not holds:
                raise ConfigError(f'{stage}.{name}: {getattr(self, name)}, expected {expected}')
        labels = [('dynamic_labels', label) for label in self.dynamic_labels]
        for name, label in labels + [('max_weight_by_label', label) for label in caps[::2]]:
            if not (label.is_integer() and 0 <= label <= MAX_LABEL):
                raise ConfigError(
                    f'{stage}.{name}: {label}, expected whole numbers from 0 to {MAX_LABEL}'
                )

    @property
    def image_topics(self) -> dict[str, str]:
        """Topics of the images joined with the scans, by kind: color, label."""
        topics = {'color': self.color_topic, 'label': self.label_topic}
        return {kind: topic for kind, topic in topics.items() if topic and self.enabled}

    @property
    def label_lead(self) -> int:
        """Measurements by which a label has to be ahead of all others, at least."""
        odds = self.label_confidence / max(1.0 - self.label_confidence, 1e-9)
        return math.ceil(math.log(LABEL_ODDS) / math.log(odds) - 1e-9)

    @property
    def label_caps(self) -> dict[float, float]:
        """Largest weight of the voxels of some labels."""
        pairs = self.max_weight_by_label
        return dict(zip(pairs[::2], pairs[1::2], strict=False))

    @property
    def block_size_m(self) -> float:
        """Edge of a block."""
        return self.voxel_size_m * self.voxels_per_side

    @property
    def tau_m(self) -> float:
        """The truncation: as set, or chosen by voxel and noise."""
        size_m = self.voxel_size_m
        return self.truncation_m or min(2.0 * size_m + 3.0 * LIDAR_NOISE_M, 3.0 * size_m)

    @property
    def mesh_max_step_m(self) -> float:
        """
        Largest difference of the distances of neighbouring voxels in the mesh, m.

        It leaves out faces between free space and the back of a surface, along shadows.
        """
        return self.tau_m + 0.5 * self.voxel_size_m


@dataclass(frozen=True, slots=True, kw_only=True)
class EsdfConfig(Stage):
    """Euclidean distances to the nearest obstacle, from the distance field (layers.tsdf)."""

    rate_hz: float = setting(
        0.0, 'Rate of ~/esdf, Hz; 0: never. Needs layers.tsdf.enabled.', low=0.0, high=100.0
    )
    slice_rate_hz: float = setting(
        0.0, 'Rate of ~/esdf_slice, Hz; 0: never. Needs layers.tsdf.enabled.', low=0.0, high=100.0
    )
    max_m: float = setting(
        2.0,
        'Distances are exact up to this, m; at most 127 voxels of layers.tsdf.voxel_size_m.',
        low=0.001,
        high=1e4,
    )
    slice_min_m: float = setting(
        0.3,
        'Lowest height of obstacles in ~/esdf_slice, fixed frame, m; choose it above the ground.',
        low=-1e5,
        high=1e5,
    )
    slice_max_m: float = setting(
        1.5,
        'Largest height of obstacles in ~/esdf_slice, fixed frame, m: that of the robot.',
        low=-1e5,
        high=1e5,
    )

    # No settings: callers of the library may change the fields.
    radius_m: float = 20.0
    """Distances are computed within this of the sensor, m; 0: everywhere."""

    def check(self, stage: str) -> None:
        """Check that the heights ascend."""
        if self.slice_max_m < self.slice_min_m:
            raise ConfigError(
                f'{stage}.slice_max_m: {self.slice_max_m}, expected at least slice_min_m = '
                f'{self.slice_min_m}'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsConfig(Stage):
    """Planes, B-spline surfaces and Gaussians."""

    STAGE: ClassVar[str] = 'models'

    voxel_size_m: float = setting(
        0.04, 'Points are thinned to one per voxel of this edge, m.', low=0.001, high=10.0
    )
    profile: str = setting(
        'robust',
        'robust: rules that allow for noise, outliers, bends and any direction; paper: the rules '
        'of the paper unchanged.',
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
        3.0, 'Edge of the cells of the outline of a sparse plane, in voxels.', low=2.5, high=100.0
    )
    min_density_radius: float = setting(
        2.0, 'Least density of a flat cluster; a full sheet has 2.', low=0.1, high=3.0
    )
    outlier_share: float = setting(
        0.02, 'Largest share of the points of a flat cluster beyond 3 sigma.', low=0.0, high=1.0
    )
    max_angle_deg: float = setting(
        15.0, 'Angle between normals of clusters on one plane, at most, deg.', low=0.1, high=89.0
    )
    max_offset_voxels: float = setting(
        1.0, 'Offset between clusters on one plane, at most, in voxels.', low=0.01, high=100.0
    )
    arc_angle_deg: float = setting(
        30.0, 'Angle between normals of neighbours on one arc, at most, deg.', low=0.1, high=89.0
    )
    arc_offset_voxels: float = setting(
        0.5,
        'Distance of the middles of neighbours from a common arc, at most, in voxels.',
        low=0.01,
        high=100.0,
    )
    fold_angle_deg: float = setting(
        60.0, 'A surface that bends farther from its mean normal is cut, deg.', low=1.0, high=89.0
    )
    noise_m: float = setting(
        0.0, 'Noise of the sensor at range 0, sigma, m (lidar: 0.02).', low=0.0, high=1.0
    )
    noise_per_range_sq: float = setting(
        0.0, 'Noise that grows with range^2, 1/m (Kinect: 0.001425).', low=0.0, high=1.0
    )
    degree: int = setting(3, 'Degree of the splines.', low=1, high=5)
    smoothing: float = setting(
        1e-2, 'Weight of the second differences of the control points.', low=1e-9, high=1e6
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsLayerConfig(Stage):
    """Planes, B-spline surfaces and Gaussians of the voxels of the map, as it changes."""

    STAGE: ClassVar[str] = 'layers.models'

    enabled: bool = setting(
        False, 'Keep planes, B-spline surfaces and Gaussians of the map up to date.'
    )
    extract_period_s: float = setting(
        1.0,
        'Time between updates of the models, by the stamps of the scans, s; 0: after every scan.',
        low=0.0,
        high=1e6,
    )

    # No settings: callers of the library may change the fields.
    min_points: int = 10
    """Voxels of fewer points are not used yet."""

    flat_thickness_m: float = 0.0
    """A voxel is flat if 6 sigma along its normal are less, m; 0: a fifth of its edge, 0.02 at
    least."""

    noise_m: float = 0.0
    """Noise of the sensor, sigma, m, allowed on top of the thickness; 0: estimated from the map,
    0.02 at most."""

    max_angle_deg: ClassVar[float] = 15.0
    """Angle between normals of neighbours on one plane, at most, deg."""

    arc_angle_deg: ClassVar[float] = 30.0
    """Angle between normals of neighbours on one arc, at most, deg."""

    fold_angle_deg: float = 60.0
    """A surface that bends farther from its mean normal is cut, deg."""

    min_voxels: int = 4
    """Planes and surfaces of fewer voxels become Gaussians; curved ones of fewer than 15 voxels
    and 1,000 points, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DynamicConfig(Stage):
    """Clearing of voxels that later rays pass through."""

    clear: bool = setting(False, 'Remove voxels of the surfel map that later scans see through.')

    # No settings: callers of the library may change the fields.
    min_scans: int = 5
    """Remove a voxel after this many scans saw through it without one hitting it."""

    margin_m: float = 0.0
    """A ray passes through a voxel if it ends farther than this behind its centre, m; 0: the
    diagonal of a voxel."""


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
        30.0, 'Steeper ground is an obstacle, deg.', low=1.0, high=90.0, live=True
    )
    max_step_m: float = setting(
        0.25,
        'Largest height difference between neighbouring cells that is no obstacle, m.',
        low=0.01,
        high=100.0,
        live=True,
    )

    # No settings: callers of the library may change the fields.
    clearance_m: float = 2.0
    """Obstacles higher above the ground of their cell than this are ignored, m."""
