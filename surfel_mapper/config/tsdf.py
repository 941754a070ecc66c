# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the TSDF layer: how fine it is, what it keeps, how measurements are weighted.

Defaults follow Hydra's ProjectiveIntegrator where it is right. Blocks have 8 voxels a side and
not its 16: a band of 2 tau through a block of 16 leaves most of its voxels unused, and a lidar
scan at 0.2 m takes 1.6 times as long.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

from surfel_mapper.config.settings import setting, Stage
from surfel_mapper.errors import ConfigError

WEIGHT_MODES = ('constant', 'inverse_square', 'ray_density', 'ray_density_inv_sq')
DISTANCES = ('along_ray', 'to_plane')
INTERPOLATIONS = ('nearest', 'bilinear', 'adaptive')
SEMANTICS = ('none', 'majority', 'first_k', 'single', 'binary')

MAX_LABEL = (1 << 24) - 1
"""Labels are kept as float32, which holds whole numbers up to here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TsdfConfig(Stage):
    """The truncated signed distance field."""

    STAGE: ClassVar[str] = 'layers.tsdf'

    enabled: bool = setting(False, 'Fuse the scans into a signed distance field too.')
    when_final: bool = setting(
        False,
        'A scan enters when it leaves the window, so that an alignment has moved it before, and '
        'not at once.',
    )
    sensor_rows: int = setting(
        0,
        'Beams of the lidar; 0: as its first scan shows. A camera is known from its camera_info.',
        low=0,
        high=4096,
    )
    sensor_columns: int = setting(
        0, 'Steps of azimuth of the lidar; 0: as its first scan shows.', low=0, high=65536
    )
    min_range_m: float = setting(
        0.5, 'What the sensor measures nearer than this is ignored, m.', low=0.001, high=1e3
    )
    max_range_m: float = setting(
        50.0, 'Beyond this the sensor only says that there is nothing, m.', low=0.01, high=1e5
    )
    voxel_size_m: float = setting(0.1, 'Edge of a voxel, m.', low=0.001, high=100.0)
    voxels_per_side: int = setting(
        8, 'Voxels along the edge of a block, a power of two.', low=2, high=32
    )
    truncation_m: float = setting(
        0.3,
        'Distances are kept up to this on both sides of a surface, m; at least two voxels and '
        'less than half of the thinnest wall.',
        low=0.001,
        high=1000.0,
    )
    max_blocks: int = setting(
        0, 'No block is added beyond so many; 0: no such limit.', low=0, high=2**31 - 1
    )
    max_radius_m: float = setting(
        0.0,
        'Blocks farther than this from the sensor leave, m; 0: no such limit. At least the range '
        'of the sensor and the half diagonal of a block.',
        low=0.0,
        high=1e6,
    )
    max_age_s: float = setting(
        0.0, 'Blocks not updated for longer leave, s; 0: no such limit.', low=0.0, high=1e9
    )
    allocation: str = setting(
        'band',
        'Which blocks a scan visits: band, those that rays touch; frustum, all in view.',
        choices=('band', 'frustum'),
    )
    carve: bool = setting(True, 'Also visit the blocks between sensor and surface.')
    distance: str = setting(
        'along_ray',
        'How far a voxel is from a surface: along the ray; or to_plane, that times the cosine of '
        'the angle at which the ray meets the surface, which closes the ground far from a lidar.',
        choices=DISTANCES,
    )
    interpolation: str = setting(
        'adaptive', 'How a voxel is looked up in the range image.', choices=INTERPOLATIONS
    )
    max_difference_m: float = setting(
        0.2, 'Adaptive: pixels that differ by more are not mixed, m.', low=0.0, high=1e6
    )
    max_difference_ratio: float = setting(
        0.0, 'Adaptive: or by more than this share of the range.', low=0.0, high=10.0
    )
    max_ray_offset_voxels: float = setting(
        0.5,
        'Lidar: a voxel farther than this from the ray of its nearest pixel, in voxels, is left '
        'alone where pixels are not mixed; 0: no such limit.',
        low=0.0,
        high=1e6,
    )
    weight_mode: str = setting(
        'inverse_square',
        'Weight of a measurement: constant 1; 1/depth^2; rays a voxel face; and that by depth^2.',
        choices=WEIGHT_MODES,
    )
    weight_dropoff: bool = setting(True, 'Weights fall linearly to zero behind a surface.')
    dropoff_m: float = setting(
        0.0,
        'From how far behind the surface on, m; less than truncation_m; 0: one voxel.',
        low=0.0,
        high=1e3,
    )
    min_measurement_weight: float = setting(1e-4, 'No measurement weighs less.', low=0.0, high=1e6)
    max_weight: float = setting(
        1e5,
        'Weights of a voxel end here; the smaller, the faster it forgets: a measurement of weight '
        'w then counts w / (max_weight + w).',
        low=1e-6,
        high=1e9,
    )
    extra_distance_m: float = setting(
        0.0, 'Voxels up to this far behind the band take -truncation_m, m.', low=0.0, high=1e3
    )
    extra_labels: tuple[float, ...] = setting((), 'Only these labels do, where any are given.')
    skip_extra_channels: bool = setting(False, 'Neither colours nor labels are written there.')
    color: bool = setting(False, 'Keep a colour a voxel.')
    color_topic: str = setting(
        '',
        'Images that colour points without a colour of their own; nothing: none. Those of a depth '
        'camera fit its depth pixel by pixel, for a lidar camera_info beside them is read too.',
    )
    label_topic: str = setting('', 'Images of labels, likewise; 8 or 16 bits, or 32SC1.')
    image_tolerance_s: float = setting(
        0.02,
        'An image belongs to a scan if their stamps differ by no more, s.',
        low=0.0,
        high=10.0,
    )
    tracking: bool = setting(False, 'Keep the first and last stamp of every voxel.')
    semantics: str = setting(
        'none',
        'How labels are fused: majority of counts; weights of the first_k labels; one label by '
        'weighted majority vote; binary, label 0 against all others.',
        choices=SEMANTICS,
    )
    num_labels: int = setting(0, 'Majority: labels are 0 to num_labels - 1.', low=0, high=4096)
    first_k: int = setting(5, 'Labels a voxel keeps with first_k.', low=1, high=64)
    min_label_weight: float = setting(
        0.0, 'first_k: the heaviest label counts above this only.', low=0.0, high=1e9
    )
    dynamic_labels: tuple[float, ...] = setting(
        (), 'Labels of what moves: it frees space and leaves no surface.'
    )
    invalid_labels: tuple[float, ...] = setting((), 'Labels treated the same: sky, the robot.')
    mesh_rate_hz: float = setting(
        1.0,
        'Rate of ~/mesh, Hz, while somebody reads it; 0: never.',
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
    mesh_min_weight: float = setting(
        1e-4, 'The mesh uses voxels of at least this weight.', low=0.0, high=1e9
    )
    mesh_max_step_voxels: float = setting(
        0.0,
        'The mesh has no cube where distances of neighbours differ by more through the surface, '
        'in voxels: free space beside the shadow of a thing; 0: no such limit. For to_plane: the '
        'truncation and 1.25 voxels.',
        low=0.0,
        high=1e3,
    )
    threads: int = setting(0, 'Threads; 0: as many as there are cores.', low=0, high=1024)

    def check(self, stage: str) -> None:
        """Check what concerns several settings."""
        side = self.voxels_per_side
        checks = (
            ('voxels_per_side', side & (side - 1) == 0, 'a power of two'),
            (
                'dropoff_m',
                not self.weight_dropoff or self.dropoff_start_m < self.truncation_m,
                f'less than truncation_m = {self.truncation_m}; 0 stands for one voxel, '
                f'{self.voxel_size_m}',
            ),
            (
                'skip_extra_channels',
                not (self.skip_extra_channels and self.extra_labels),
                'false where extra_labels are given',
            ),
            (
                'max_range_m',
                self.max_range_m > self.min_range_m,
                f'more than min_range_m = {self.min_range_m}',
            ),
            ('color', self.color or not self.color_topic, 'true where color_topic is given'),
            (
                'semantics',
                self.semantics != 'none' or not self.label_topic,
                'another where label_topic is given',
            ),
            ('num_labels', self.semantics != 'majority' or self.num_labels > 0, 'positive'),
        )
        for name, holds, expected in checks:
            if not holds:
                raise ConfigError(f'{stage}.{name}: {getattr(self, name)}, expected {expected}')
        for name in ('extra_labels', 'dynamic_labels', 'invalid_labels'):
            for label in getattr(self, name):
                if not (label.is_integer() and 0 <= label <= MAX_LABEL):
                    raise ConfigError(
                        f'{stage}.{name}: {label}, expected whole numbers from 0 to {MAX_LABEL}'
                    )

    @property
    def image_topics(self) -> dict[str, str]:
        """What is joined with the scans, color or label, and the topics of its images."""
        topics = {'color': self.color_topic, 'label': self.label_topic}
        return {kind: topic for kind, topic in topics.items() if topic and self.enabled}

    @property
    def block_size_m(self) -> float:
        """Edge of a block."""
        return self.voxel_size_m * self.voxels_per_side

    @property
    def dropoff_start_m(self) -> float:
        """From how far behind a surface on weights fall."""
        return self.dropoff_m or self.voxel_size_m

    @property
    def reach_behind_m(self) -> float:
        """How far behind a surface voxels change."""
        return self.truncation_m + self.extra_distance_m

    @property
    def mesh_max_step_m(self) -> float:
        """By how much distances of neighbouring voxels may differ in the mesh; inf: any."""
        return self.mesh_max_step_voxels * self.voxel_size_m or math.inf

    @property
    def votes_per_voxel(self) -> int:
        """How many numbers a voxel keeps for its label."""
        widths = {'majority': self.num_labels, 'first_k': 2 * self.first_k}
        return widths.get(self.semantics, 0 if self.semantics == 'none' else 2)
