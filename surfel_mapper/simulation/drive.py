# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Drive: the pose of the vehicle at any time; Simulation: the scans of its lidar.

The odom frame is the frame of the world. The course is a sum of sines of the distance driven, so
the pose at any stamp is known exactly and a standing vehicle does not rock. Matrices of poses are
computed from position and quaternion, so that readers of a message get the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import (
    compose,
    pose_matrix,
    q_xyzw,
    se3_exp,
    Transform,
)
from surfel_mapper.scan import Scan
from surfel_mapper.simulation.lidar import Lidar
from surfel_mapper.simulation.world import World

START_NS = 1_700_000_000_000_000_000
"""Default stamp of the first scan, ns."""

END_NS = 2**31 * 10**9
"""First time whose seconds do not fit a stamp of ROS, ns."""

WEAVE_M = ((1.0, 70.0), (0.5, 31.0))
"""Amplitude and wavelength of the lateral curves, m; the heading deviates by up to 11 deg."""

BUMPS_M = ((0.02, 9.0), (0.01, 3.7))
"""Amplitude and wavelength of the unevenness of the road, m."""

ROLL_DEG, PITCH_DEG = (0.9, 17.0), (0.6, 13.0)
"""Amplitude, deg, and wavelength, m, of roll and pitch."""


def base_to_sensor() -> tuple[float, ...]:
    """Return the default pose of the lidar on the vehicle, x y z qx qy qz qw: slightly tilted."""
    turn = np.deg2rad([0.0, 0.0, 0.0, 0.7, -1.1, 2.3])
    return (0.85, 0.04, 1.9, *(float(v) for v in q_xyzw(se3_exp(turn))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """
    The course of a vehicle along a street, and the mounting of its lidar.

    Attributes
    ----------
    start : (7,) float
        Start pose x y z (m) qx qy qz qw in odom, usually World.start.
    speed_m_s : float
        Speed along the road; the path along the curves is up to 2 % longer.
    start_ns : int
        Stamp at the start pose; at earlier stamps the vehicle is behind it.
    base_to_sensor : (7,) float
        Pose of the lidar on the vehicle, as in the setting frames.base_to_sensor.

    Raises
    ------
    ConfigError
        If a value is out of bounds or not a pose.

    """

    start: tuple[float, ...]
    speed_m_s: float = 5.0
    start_ns: int = START_NS
    base_to_sensor: tuple[float, ...] = field(default_factory=base_to_sensor)

    def __post_init__(self) -> None:
        """Check every value."""
        if not 0.0 <= self.speed_m_s <= 100.0:
            raise ConfigError(f'speed_m_s: {self.speed_m_s}, expected a value in [0, 100]')
        if not 0 <= self.start_ns < END_NS:
            raise ConfigError(f'start_ns: {self.start_ns}, expected a value in [0, {END_NS})')
        for name in ('start', 'base_to_sensor'):
            pose = getattr(self, name)
            try:
                pose_matrix(pose[:3], pose[3:])
            except ValueError as error:
                raise ConfigError(f'{name}: {error}') from error

    @property
    def T_base_sensor(self) -> Transform:
        """Pose of the lidar on the vehicle."""
        return pose_matrix(self.base_to_sensor[:3], self.base_to_sensor[3:])

    def pose(self, stamp_ns: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return position (3,), m, and quaternion (4,) xyzw of base_link in odom at a stamp."""
        along = self.speed_m_s * (stamp_ns - self.start_ns) * 1e-9
        aside, slope = _sines(along, WEAVE_M)
        up, _ = _sines(along, BUMPS_M)
        roll, _ = _sines(along, (ROLL_DEG,))
        pitch, _ = _sines(along, (PITCH_DEG,))
        turn = np.array([0.0, 0.0, 0.0, math.radians(roll), math.radians(pitch), math.atan(slope)])
        T_start_base = pose_matrix((along, aside, up), q_xyzw(se3_exp(turn)))
        T_odom_base = compose(pose_matrix(self.start[:3], self.start[3:]), T_start_base)
        return T_odom_base[:3, 3].copy(), q_xyzw(T_odom_base)

    def T_odom_base(self, stamp_ns: int) -> Transform:
        """Return the pose of the vehicle at a stamp."""
        return pose_matrix(*self.pose(stamp_ns))

    def T_odom_sensor(self, stamp_ns: int) -> Transform:
        """Return the pose of the lidar at a stamp."""
        return compose(self.T_odom_base(stamp_ns), self.T_base_sensor)


@dataclass(frozen=True, slots=True)
class Simulation:
    """
    A lidar on a drive through a world.

    Attributes
    ----------
    world : World
    lidar : Lidar
    drive : Drive
        By default a drive from the start of the world.
    num_scans : int
    rolling : bool
        Whether each column is measured from the pose of the lidar at its time; otherwise a whole
        scan is measured from the pose at its stamp.

    Raises
    ------
    ConfigError
        If the number of scans is not positive.

    """

    world: World
    lidar: Lidar = field(default_factory=Lidar)
    drive: Drive = None  # type: ignore[assignment]  # set in __post_init__
    num_scans: int = field(default=100, kw_only=True)
    rolling: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        """Set the default drive and check the number of scans."""
        if self.drive is None:
            object.__setattr__(self, 'drive', Drive(start=self.world.start))
        if self.num_scans < 1:
            raise ConfigError(f'scans: {self.num_scans}, expected one or more')

    def stamp_ns(self, number: int) -> int:
        """Return the stamp of a scan, the beginning of its turn, ns."""
        return self.drive.start_ns + round(number * 1e9 / self.lidar.rate_hz)

    def scan(self, number: int, frame_id: str = 'lidar') -> Scan:
        """Return a scan; it does not depend on other calls. See Lidar.scan."""
        stamp_ns = self.stamp_ns(number)
        if self.rolling:
            delays = np.rint(self.lidar.column_times() * 1e9).astype(np.int64).tolist()
            pose = np.array([self.drive.T_odom_sensor(stamp_ns + delay) for delay in delays])
        else:
            pose = self.drive.T_odom_sensor(stamp_ns)
        return self.lidar.scan(
            self.world, pose, stamp_ns=stamp_ns, frame_id=frame_id, number=number
        )

    def scans(self) -> Iterator[Scan]:
        """Yield all scans in order."""
        for number in range(self.num_scans):
            yield self.scan(number)


def _sines(along: float, waves: tuple[tuple[float, float], ...]) -> tuple[float, float]:
    """Return the sum of sines at a distance and its slope."""
    value = slope = 0.0
    for amplitude, length in waves:
        turn = 2.0 * math.pi / length
        value += amplitude * math.sin(turn * along)
        slope += amplitude * turn * math.cos(turn * along)
    return value, slope
