# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scenarios that are hard for registration, simulated with known poses.

A scan is measured from one pose, so no deskewing is needed. Scans are 64 beams by 1024 columns
with 2 cm of noise at 10 Hz, if a scenario does not state otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import math

from surfel_mapper.geometry import compose, pose_matrix, q_xyzw, Transform
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Drive, Lidar, World
from surfel_mapper.simulation.primitives import Primitive

LIDAR = Lidar(beams=64, columns=1024, range_noise_m=0.02)

NUM_SCANS = 80

LANE_M = 3.3
"""Distance between the middles of two lanes."""

TRUCK_M = (9.0, 2.5, 3.6)
"""Length, width and height of a truck."""

THREE = ((11.0, 0.0), (1.0, LANE_M), (-1.0, -LANE_M))
"""Positions of the trucks about the lidar, x ahead, y left, m."""

NINE = (
    *((x, s * LANE_M) for x in (-11.0, 0.0, 11.0) for s in (-1, 1)),
    (11.0, 0.0),
    (-11.0, 0.0),
    (22.0, 0.0),
)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """
    Scans of a lidar on a known course.

    Attributes
    ----------
    name : str
    world : World
        All that stands still.
    course : callable
        Pose of the sensor in the world at a time, s.
    lidar : Lidar
    num_scans : int
    movers : callable
        Primitives that move, at a time, s.

    """

    name: str
    world: World
    course: Callable[[float], Transform]
    lidar: Lidar = LIDAR
    num_scans: int = NUM_SCANS
    movers: Callable[[float], list[Primitive]] = lambda time_s: []

    def scans(self) -> Iterator[tuple[Scan, Transform]]:
        """Yield every scan and its true pose."""
        for number in range(self.num_scans):
            time_s = number / self.lidar.rate_hz
            pose, movers = self.course(time_s), self.movers(time_s)
            world = World([*self.world.primitives, *movers]) if movers else self.world
            stamp_ns = round(1e9 * (1.0 + time_s))
            yield self.lidar.scan(world, pose, stamp_ns=stamp_ns, number=number), pose


def scenarios() -> list[Scenario]:
    """Return all scenarios."""
    street = World.street(seed=1, length_m=600.0)
    return [
        Scenario(
            name='3 trucks',
            world=street,
            course=street_course(street, 8.0),
            movers=lambda time_s: trucks(street, THREE, 8.0, time_s),
        ),
        Scenario(
            name='9 trucks',
            world=street,
            course=street_course(street, 8.0),
            movers=lambda time_s: trucks(street, NINE, 8.0, time_s),
        ),
        Scenario(
            name='9 trucks that come',
            world=street,
            course=street_course(street, 8.0),
            movers=lambda time_s: trucks(street, NINE, 8.0, time_s, away_m=coming_m(time_s)),
        ),
    ]


def street_course(street: World, speed_m_s: float) -> Callable[[float], Transform]:
    """Return the course of a vehicle that drives along a street from its start."""
    drive = Drive(start=street.start, speed_m_s=speed_m_s, start_ns=0)
    return lambda time_s: drive.T_odom_sensor(round(1e9 * time_s))


def coming_m(time_s: float) -> float:
    """Return the distance at which trucks are still away that come within 2 s, m."""
    return max(30.0 - 15.0 * time_s, 0.0)


def trucks(
    street: World,
    places: tuple[tuple[float, float], ...],
    speed_m_s: float,
    time_s: float,
    away_m: float = 0.0,
) -> list[Primitive]:
    """
    Return trucks that move along with a vehicle, each with a sway of 0.3 m of its own.

    They are behind their positions by a distance, those ahead on the own lane before them.
    """
    found = []
    for number, (x, y) in enumerate(places):
        sway = 0.3 * math.sin(0.7 * time_s + 1.9 * number)
        off_m = sway + (away_m if y == 0.0 < x else -away_m)
        xyz = (speed_m_s * time_s + 0.85 + x + off_m, y, 0.5 * TRUCK_M[2] + 0.4)
        pose = compose(street.T_world_start, pose_matrix(xyz, (0.0, 0.0, 0.0, 1.0)))
        found.append(
            Primitive(
                kind='box', size_m=TRUCK_M, xyz=tuple(pose[:3, 3]), q_xyzw=tuple(q_xyzw(pose))
            )
        )
    return found
