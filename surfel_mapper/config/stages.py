# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the pipeline's stages: input, deskewing, frames, poses, map, window and output.

Every map has these stages; settings of optional layers are in layers.py, those of registration
and alignment in registration.py.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from surfel_mapper.arguments import is_unit
from surfel_mapper.config.settings import read_number, setting, Stage
from surfel_mapper.errors import ConfigError

POSE_SOURCES = ('auto', 'tf', 'odometry', 'pose', 'identity', 'registration')

INPUT_KINDS = ('cloud', 'depth')

AUTO = 'auto'
"""Value of map.origin: found from the first pose, or point, in the fixed frame."""

MAX_ORIGIN_M = 1e9
"""Limit of a coordinate of map.origin, m: float64 resolves 0.1 micrometres there."""

MARKER_COLORS = ('planarity', 'normal', 'age')


@dataclass(frozen=True, slots=True, kw_only=True)
class MapConfig(Stage):
    """The voxel map."""

    voxel_size_m: float = setting(0.5, 'Edge of a voxel, m.', low=0.001, high=1000.0)
    min_points: int = setting(
        5, 'Surfels of fewer points are not published.', low=1, high=2**31 - 1, live=True
    )
    mode: str = setting(
        'live',
        'live: scans are added to the map; frozen: they are only aligned to the map of map.load, '
        'which does not change.',
        choices=('live', 'frozen'),
    )
    origin: str = setting(
        '',
        'Point of the fixed frame that is the origin of the map, for poses in UTM or ECEF. '
        'Text of x y z, m; auto: near the first pose. Files have the coordinates of the fixed '
        'frame, topics those of the map. Empty: the two are the same.',
    )
    load: str = setting(
        '',
        'Map to start from: a file of ~/save_map or replay (.npz, .parquet), the output directory '
        'of a replay, tiles, or a cloud of points (.ply, .pcd, .las, ...). Its surfels stay. '
        'latest: the newest map or checkpoint in output.directory, if any, with its window. '
        'Empty: none.',
    )
    max_bytes: int = setting(
        -1,
        'The oldest scans are evicted while map and window need more bytes. The distance field '
        'loses its farthest blocks while it needs more than they leave. -1: half of the memory '
        'of the machine, for scans if the window has a limit. 0: no such limit.',
        low=-1,
        high=2**62,
        live=True,
    )
    intensity: bool = setting(
        False, 'Sum the intensity of the points too; clouds without one are dropped.'
    )
    color: bool = setting(
        False, 'Sum the colour (rgb) of the points too; clouds without one are dropped.'
    )

    def check(self, stage: str) -> None:
        """Refuse a frozen map without a map to load, and an origin that is no point."""
        _ = self.origin_m
        if self.mode == 'frozen' and not self.load:
            raise ConfigError(f'{stage}.load: empty, expected a map to freeze (map.mode frozen)')

    @property
    def origin_m(self) -> tuple[float, ...]:
        """The origin, x y z in m; () if it is to be found (``auto``) or not set."""
        if self.origin in ('', AUTO):
            return ()
        words = self.origin.strip('[]() ').replace(',', ' ').split()
        numbers = tuple(value for word in words if (value := read_number(word, float)) is not None)
        if not len(words) == len(numbers) == 3 or any(not abs(v) < MAX_ORIGIN_M for v in numbers):
            raise ConfigError(
                f'map.origin: {self.origin!r}, expected nothing, {AUTO}, or a text of x y z in m, '
                "each below 1e9, such as '400000 5400000 0'"
            )
        return numbers

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the points that the map sums."""
        wanted = {'intensity': self.intensity, 'rgb': self.color}
        return tuple(name for name, is_wanted in wanted.items() if is_wanted)


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowConfig(Stage):
    """Which scans stay in the map; the first limit reached evicts the oldest."""

    max_scans: int = setting(
        100, 'At most this many scans; 0: no such limit.', low=0, high=2**31 - 1, live=True
    )
    max_age_s: float = setting(
        0.0,
        'A scan older than the newest by more than this is evicted, s; 0: no such limit.',
        low=0.0,
        high=1e9,
        live=True,
    )
    max_distance_m: float = setting(
        0.0,
        'A scan is evicted once the sensor has travelled farther than this since that scan, m; '
        '0: no such limit.',
        low=0.0,
        high=1e9,
        live=True,
    )
    max_bytes: int = setting(
        0,
        'The oldest scans are evicted while the window needs more bytes; 0: no such limit.',
        low=0,
        high=2**62,
        live=True,
    )
    keep_points: bool = setting(False, 'Keep the points of the scans of the window.')
    gate_distance_m: float = setting(
        0.0,
        'A scan is left out unless the sensor has moved this far since the last one mapped, m, '
        'or turned by gate_angle_deg. Both 0: every scan is mapped.',
        low=0.0,
        high=1e6,
        live=True,
    )
    gate_angle_deg: float = setting(
        0.0,
        'A scan is left out unless the sensor has turned by this since the last one mapped, '
        'deg, or moved by gate_distance_m.',
        low=0.0,
        high=180.0,
        live=True,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseConfig(Stage):
    """Source of the poses of scans."""

    source: str = setting(
        'auto',
        'auto: the first of tf, odometry and pose that is there, else registration. tf: the tree '
        'in /tf. odometry: nav_msgs/Odometry. pose: geometry_msgs/PoseStamped. identity: clouds '
        'are in the fixed frame. registration: scans are aligned to the map.',
        choices=POSE_SOURCES,
    )
    registration_after_s: float = setting(
        5.0,
        'With auto, the node takes registration if no source is there this long after the first '
        'cloud, s.',
        low=0.0,
        high=3600.0,
    )
    max_wait_s: float = setting(
        0.5,
        'A scan is dropped if its pose is missing when data newer by this arrives, s.',
        low=0.0,
        high=3600.0,
        live=True,
    )
    max_delay_s: float = setting(
        4.0,
        'A scan that is newer than all poses waits until data newer by this arrives, s, if this '
        'is longer than max_wait_s: Fast DDS repeats a lost pose after up to 3 s.',
        low=0.0,
        high=3600.0,
        live=True,
    )
    max_gap_s: float = setting(
        0.5,
        'Poses are interpolated between two at most this far apart, s; a scan in a longer gap '
        'waits, then is dropped; 0: no such limit.',
        low=0.0,
        high=1e9,
        live=True,
    )
    max_waiting_scans: int = setting(
        100,
        'At most this many scans wait for their pose; the oldest is dropped.',
        low=1,
        high=10**6,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesConfig(Stage):
    """Coordinate frames, after REP 105."""

    fixed: str = setting('odom', 'The frame of the map and of all output.')
    base: str = setting('base_link', 'The frame whose pose odometry or pose messages give.')
    sensors: tuple[str, ...] = setting(
        (),
        'Frames whose poses base_to_sensor lists, in its order; empty: one pose for all sensors.',
        items=str,
    )
    base_to_sensor: tuple[float, ...] = setting(
        (),
        'Pose of the sensor in the base frame, x y z in m, qx qy qz qw; of several sensors one '
        'after the other. Empty: from /tf_static. With pose.source identity: position of a sensor '
        'that does not move, in the fixed frame, towards which normals point.',
    )

    def check(self, stage: str) -> None:
        """Refuse empty frames and extrinsics that are not rigid transforms."""
        for name in ('fixed', 'base'):
            if not getattr(self, name):
                raise ConfigError(f'{stage}.{name}: empty, expected the name of a frame')
        if len(set(self.sensors)) < len(self.sensors) or '' in self.sensors:
            raise ConfigError(f'{stage}.sensors: {self.sensors}, expected names that differ')
        values, number = self.base_to_sensor, len(self.sensors)
        if len(values) not in ((7 * number,) if number else (0, 7)):
            expected = f'for each of {number} sensors' if number else 'or none'
            raise ConfigError(
                f'{stage}.base_to_sensor: {len(values)} values, '
                f'expected 7 (x y z qx qy qz qw) {expected}'
            )
        for first in range(0, len(values), 7):
            q_xyzw = values[first + 3 : first + 7]
            if not is_unit(q_xyzw):
                raise ConfigError(
                    f'{stage}.base_to_sensor: quaternion {list(q_xyzw)} has norm '
                    f'{math.hypot(*q_xyzw):.6g}, expected 1 (order x y z w)'
                )

    def mount_of(self, frame_id: str) -> tuple[float, ...]:
        """Return the pose of a sensor in the base frame, 7 numbers; empty if none is set."""
        if not self.sensors:
            return self.base_to_sensor
        if frame_id not in self.sensors:
            return ()
        first = 7 * self.sensors.index(frame_id)
        return self.base_to_sensor[first : first + 7]


@dataclass(frozen=True, slots=True, kw_only=True)
class InputConfig(Stage):
    """Topics of the input, its ranges and its queue."""

    kind: str = setting(
        'cloud',
        'cloud: sensor_msgs/PointCloud2; depth: sensor_msgs/Image of depth, with its camera_info.',
        choices=INPUT_KINDS,
    )
    topics: tuple[str, ...] = setting(
        (),
        'Topics of the clouds or images, one a sensor; empty: points, or depth/image.',
        items=str,
    )
    filters_directory: str = setting(
        '',
        'Directory of the files that filters may name while the node runs; empty: that of the '
        'parameter file.',
    )
    min_range_m: float = setting(
        0.1, 'Points nearer to the origin of their frame are ignored, m.', low=0.0, high=1e6
    )
    max_range_m: float = setting(
        0.0, 'Points farther from that origin are ignored, m; 0: no limit.', low=0.0, high=1e6
    )
    reset_after_s: float = setting(
        1.0,
        'Time that goes back by more than this clears the map, s; a scan older by less than the '
        'one before it is sorted in.',
        low=0.0,
        high=1e9,
    )
    time_offset_s: float = setting(
        0.0,
        'Added to the stamps of clouds, s: the clock of the poses less that of the sensors.',
        low=-1e10,
        high=1e10,
    )
    time_offsets_s: tuple[float, ...] = setting(
        (),
        'Added as well, one for each of input.topics, if sensors have clocks of their own; empty: '
        'none.',
    )
    max_waiting_clouds: int = setting(
        20,
        'At most this many clouds wait to be mapped; the oldest is dropped.',
        low=1,
        high=10**4,
    )

    def check(self, stage: str) -> None:
        """Refuse an empty range, topics that are empty or repeated, and offsets of no topic."""
        if '' in self.topics or len(set(self.topics)) < len(self.topics):
            raise ConfigError(f'{stage}.topics: {self.topics}, expected names that differ')
        if len(self.time_offsets_s) not in (0, len(self.topics)):
            raise ConfigError(
                f'{stage}.time_offsets_s: {list(self.time_offsets_s)}, expected one for each of '
                f'{stage}.topics {list(self.topics)}, or none'
            )
        if 0.0 < self.max_range_m <= self.min_range_m:
            raise ConfigError(
                f'{stage}.max_range_m: {self.max_range_m}, expected more than '
                f'{stage}.min_range_m ({self.min_range_m}), or 0 for no limit'
            )

    def offset_s(self, topic: str) -> float:
        """Return the seconds that are added to the stamps of clouds of a topic."""
        return self.time_offset_s + self.own_offset_s(topic)

    def own_offset_s(self, topic: str) -> float:
        """Return the seconds of ``time_offsets_s`` for a topic, by its full name."""
        own = [
            (len(name), seconds)
            for name, seconds in zip(self.topics, self.time_offsets_s, strict=False)
            if f'/{topic}'.endswith(f'/{name.lstrip("/")}')
        ]
        return max(own)[1] if own else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishConfig(Stage):
    """Topics that the node publishes, and their rates."""

    normals_rate_hz: float = setting(
        1.0, 'Rate of the full map on ~/normals, Hz; 0: never.', low=0.0, high=1000.0, live=True
    )
    markers_rate_hz: float = setting(
        1.0, 'Rate of ~/markers, Hz; 0: never.', low=0.0, high=1000.0, live=True
    )
    levels: int = setting(
        0,
        'Number of coarser maps to publish too, each with voxels twice as large as the one '
        'before, on ~/level_1/normals and so on, at the rate of ~/normals.',
        low=0,
        high=8,
    )
    marker_color: str = setting(
        'planarity',
        'Colour of the discs of ~/markers; age: of the newest scan that saw the voxel.',
        choices=MARKER_COLORS,
        live=True,
    )
    moments: bool = setting(
        False,
        'Add the exact moments to ~/normals and ~/changed, of all voxels, so that clients can '
        'mirror the map.',
        live=True,
    )
    covariance: bool = setting(
        False,
        'Add the covariance of the points to ~/normals and ~/changed, cov_xx to cov_zz, m^2.',
        live=True,
    )
    adaptive: bool = setting(
        False,
        'Publish adaptive surfels on ~/normals, ~/changed, ~/removed and ~/markers: of the '
        'largest cells, of up to 16 voxels an axis, whose points lie on one plane.',
    )
    diagnostics_rate_hz: float = setting(
        1.0, 'Rate of /diagnostics, Hz; 0: never.', low=0.0, high=100.0
    )

    # No settings: callers of the library may change the fields.
    max_markers: int = 20_000
    """At most this many surfels are drawn in ~/markers."""

    def check(self, stage: str) -> None:
        """Refuse adaptive surfels with what belongs to single voxels."""
        if self.adaptive and self.moments:
            raise ConfigError(
                f'{stage}.adaptive: the moments are those of voxels, expected {stage}.moments '
                'false; a client that mirrors the map has mirror.map.adaptive()'
            )
        if self.adaptive and self.marker_color == 'age':
            raise ConfigError(
                f'{stage}.marker_color: age is known of voxels, expected another colour with '
                f'{stage}.adaptive'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputConfig(Stage):
    """Directory and name of the files that the node writes; it writes nowhere else."""

    directory: str = setting('surfel_maps', 'Directory of ~/save_map; created when first needed.')
    map_name: str = setting('map', 'Name of the files of ~/save_map inside it, no extension.')
    save_on_shutdown: bool = setting(
        False, 'Save the map when the node ends, as ~/save_map does.', live=True
    )
    checkpoint_s: float = setting(
        0.0,
        'The node saves the map this often while it changes, next to map_name, s; 0: never.',
        low=0.0,
        high=1e9,
        live=True,
    )

    def check(self, stage: str) -> None:
        """Refuse names that would leave the directory."""
        if not self.directory:
            raise ConfigError(f'{stage}.directory: empty, expected the path of a directory')
        name = self.map_name
        if not name or name.startswith('.') or any(c in name for c in '/\\\0'):
            raise ConfigError(
                f'{stage}.map_name: {name!r}, expected a plain file name: '
                'not empty, no leading dot, no slash'
            )


TIME_UNITS = ('auto', 's', 'ms', 'us', 'ns')

TIME_REFERENCES = ('auto', 'stamp', 'epoch', 'first')


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewConfig(Stage):
    """Correction of the motion during a scan: each point gets the pose at its own time."""

    enabled: bool = setting(
        False,
        'Give each point the pose at its own time; a scan waits for the pose of its last point.',
    )
    field: str = setting(
        '',
        'Field with the times of the points; empty: the first of t, time, timestamp, offset_time, '
        'time_stamp, else the only one named like a time.',
    )
    unit: str = setting(
        'auto',
        'Unit of these times; auto: by the end of the name (_ns) or the length of the sweep.',
        choices=TIME_UNITS,
    )

    reference: str = setting(
        'auto',
        'Times count from the stamp of the scan (stamp), from 1970 (epoch), or from the first '
        'point, measured at the stamp (first).',
        choices=TIME_REFERENCES,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ClearConfig(Stage):
    """Regions that ~/clear_box and ~/clear_radius empty."""

    box: tuple[float, ...] = setting(
        (0.0,) * 6,
        'The box of ~/clear_box in the fixed frame, m: least x y z, then greatest.',
        live=True,
    )
    radius_m: float = setting(
        2.0,
        'The radius of ~/clear_radius about the latest position of the sensor, m.',
        low=0.0,
        high=1e6,
        live=True,
    )

    def check(self, stage: str) -> None:
        """Refuse a box whose least corner is above its greatest."""
        if len(self.box) != 6:
            raise ConfigError(
                f'{stage}.box: {len(self.box)} values, expected 6 (least x y z, greatest x y z)'
            )
        for axis, least, greatest in zip('xyz', self.box[:3], self.box[3:], strict=True):
            if least > greatest:
                raise ConfigError(
                    f'{stage}.box: least {axis} {least} is above the greatest, {greatest}'
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticsConfig(Stage):
    """Limits beyond which /diagnostics reports a warning or an error."""

    silence_s: float = setting(
        2.0,
        'Report an error if no cloud arrives for longer than this, s; 0: never.',
        low=0.0,
        high=1e6,
        live=True,
    )
    warn_latency_s: float = setting(
        0.3,
        'Warn if the 99th percentile of the time from stamp to publication exceeds this, s; '
        '0: never.',
        low=0.0,
        high=1e6,
        live=True,
    )

    # No settings: callers of the library may change the fields.
    error_latency_s: float = 1.0
    """An error is reported if the 99th percentile of that time exceeds this, s; 0: never."""

    warn_dropped_ratio: float = 0.0
    """Warn if a larger share of the clouds since the last report was dropped."""

    error_dropped_ratio: float = 0.5
    """Report an error if a larger share of the clouds since the last report was dropped."""
