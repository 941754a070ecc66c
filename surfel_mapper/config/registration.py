# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of registration, which finds poses if none are given, and of alignment.

Registration aligns each scan to the map as it comes (``pose.source: registration``). Alignment
moves all scans of the window until they agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from surfel_mapper.arguments import is_unit
from surfel_mapper.config.settings import setting, Stage
from surfel_mapper.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig(Stage):
    """Registration of a scan to the map."""

    start: tuple[float, ...] = setting(
        (),
        'Initial pose of the base in the fixed frame, x y z in m, qx qy qz qw. Empty: the origin, '
        'or found by a search with map.mode frozen.',
    )
    noise_m: float = setting(
        0.02,
        'Standard deviation of a range, m; the least assumed thickness of a surface.',
        low=1e-5,
        high=10.0,
        live=True,
    )

    publish_tf: bool = setting(
        True, 'The node publishes the transform from the fixed frame to the frame it localises.'
    )

    # No settings: callers of the library may change the fields.
    cell_m: float = 0.0
    """Points of a scan are replaced by their means in cells of this edge, m; 0: half of
    map.voxel_size_m."""

    max_cells: int = 40_000
    """At most this many cells of a scan are aligned, an even selection of them."""

    min_points: int = 5
    """Scans are not aligned to surfels of fewer points."""

    max_deviation_m: ClassVar[float] = 1.0
    """Largest initial distance of points from their prediction, m; later scans use the deviations
    of the last ones."""

    coarse_levels: int = 2
    """If deviations exceed a voxel, registration starts with voxels up to 2^this times larger."""

    max_iterations: int = 30
    """At most this many iterations on each level."""

    min_overlap_ratio: ClassVar[float] = 0.03
    """A scan is dropped unless this share of its cells match surfels that constrain them."""

    min_fit_ratio: float = 0.6
    """A scan is dropped unless this share of the matched cells fit."""

    search_deg: float = 180.0
    """If a scan fits worse than usual, headings up to this to both sides are tried, deg."""

    min_information_ratio: ClassVar[float] = 0.003
    """A direction of motion with less than this share of the total information is degenerate: the
    prediction is kept along it."""

    def check(self, stage: str) -> None:
        """Refuse a start that is not a pose."""
        if self.start and (len(self.start) != 7 or not is_unit(self.start[3:])):
            raise ConfigError(
                f'{stage}.start: {list(self.start)}, expected x y z and a unit quaternion '
                'qx qy qz qw, or nothing'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignConfig(Stage):
    """Consistent poses for the scans of the window."""

    every_scans: int = setting(
        0,
        'Align the scans of the window after this many new ones; needs window.keep_points. '
        '0: only on request.',
        low=0,
        high=2**31 - 1,
        live=True,
    )
    voxel_size_m: float = setting(
        1.0, 'Edge of the voxels whose surfels are matched between scans, m.', low=0.01, high=100.0
    )
    map_frame: str = setting(
        '',
        'Frame of the map if alignment moves scans; its transform to frames.fixed is published. '
        'Empty: the map stays in frames.fixed, without such a transform.',
    )

    # No settings: callers of the library may change the fields.
    loop_distance_m: float = 10.0
    """Scans nearer to each other than this are compared as loop closures, m; 0: no loops."""

    key_distance_m: float = 1.0
    """Distance travelled between keyframes, m; scans between them move with them. 0: every scan is
    a keyframe."""

    max_distance_m: float = 1.0
    """Surfels farther apart are not matched, m."""

    max_angle_deg: float = 30.0
    """Surfels whose normals differ by more are not matched, deg."""

    min_overlap: ClassVar[float] = 0.2
    """Two scans are compared if at least this share of the surfels of one match the other."""

    max_rounds: ClassVar[int] = 20
    """At most this many rounds of matching."""

    settled_m: ClassVar[float] = 0.002
    """Poses have converged when none moves by more in a round, m."""

    settled_deg: ClassVar[float] = 0.01
    """Poses have converged when none turns by more in a round, deg."""

    move_m: float = 0.002
    """Scans that the alignment moves by more are moved in the map, m."""

    move_deg: float = 0.01
    """Scans that the alignment turns by more are moved in the map, deg."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopsConfig(Stage):
    """Loops of a drive: places seen twice, at which the drift of the poses is corrected."""

    enabled: bool = setting(
        False,
        'Keep the points of all scans in a file, to close loops on request: at the end of a '
        'replay, or by ~/align.',
    )
    directory: str = setting(
        '', 'Directory of the file with the points; empty: that of temporary files.'
    )

    # No settings: callers of the library may change the fields.
    key_distance_m: ClassVar[float] = 5.0
    """Distance travelled between keyframes, m."""

    recognise_distance_m: float = 25.0
    """Distance travelled between keyframes that are compared with all earlier ones, m."""

    near_distance_m: float = 10.0
    """Keyframes nearer to each other by their poses are compared too, m."""

    local_map_m: float = 40.0
    """Length of the path whose scans make up the map of a keyframe, m."""

    odometry_map_m: float = 100.0
    """With pose.source registration, scans are registered only to scans at most this far back
    along the path, m, so that earlier passes of a place do not affect them."""

    min_votes: ClassVar[int] = 5
    """A place is recognised if this many features agree."""

    min_overlap_ratio: ClassVar[float] = 0.7
    """A loop is refused unless this share of a local map overlaps the other."""

    min_fit_ratio: ClassVar[float] = 0.8
    """A loop is refused unless this share of the overlap fits."""

    drift_ratio: ClassVar[float] = 0.01
    """Standard deviation of a step of the poses that come in, as a share of its length."""

    max_rounds: ClassVar[int] = 5
    """At most this many rounds of comparing keyframes near each other."""
