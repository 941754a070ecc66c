# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scenarios that are hard for registration, simulated with known poses.

A scan is measured from one pose, so no deskewing is needed. Scans are 64 beams by 1024 columns
with 2 cm of noise at 10 Hz, if a scenario does not state otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import math

import numpy as np

from surfel_mapper.geometry import compose, pose_matrix, q_xyzw, se3_exp, Transform
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
        Scenario(name='corridor', world=corridor(), course=corridor_course),
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
            movers=lambda time_s: trucks(street, NINE, 8.0, time_s, behind_m=coming_m(time_s)),
        ),
        Scenario(name='180 deg/s', world=street, course=spinning_course(street)),
        Scenario(
            name='16 beams, 5 Hz',
            world=street,
            course=street_course(street, 5.0),
            lidar=replace(LIDAR, beams=16, columns=1800, elevation_deg=(-15, 15), rate_hz=5.0),
        ),
        Scenario(
            name='15 m/s, 5 Hz',
            world=street,
            course=street_course(street, 15.0),
            lidar=replace(LIDAR, rate_hz=5.0),
        ),
        Scenario(name='tunnel', world=tunnel(), course=tunnel_course),
    ]


def street_course(street: World, speed_m_s: float) -> Callable[[float], Transform]:
    """Return the course of a vehicle that drives along a street from its start."""
    drive = Drive(start=street.start, speed_m_s=speed_m_s, start_ns=0)
    return lambda time_s: drive.T_odom_sensor(round(1e9 * time_s))


def spinning_course(street: World) -> Callable[[float], Transform]:
    """Return a course of 2 m/s that turns by 180 deg/s from the second second on, to and fro."""
    straight = street_course(street, 2.0)

    def course(time_s: float) -> Transform:
        since_s = max(time_s - 1.0, 0.0)
        along = since_s % 8.0
        turn = math.radians(180.0) * (along if along < 4.0 else 8.0 - along)
        return compose(straight(time_s), se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, turn])))

    return course


def coming_m(time_s: float) -> float:
    """Return how far trucks are still away that come within 2 s, m."""
    return max(30.0 - 15.0 * time_s, 0.0)


def trucks(
    street: World,
    places: tuple[tuple[float, float], ...],
    speed_m_s: float,
    time_s: float,
    behind_m: float = 0.0,
) -> list[Primitive]:
    """
    Return trucks that move along with a vehicle, each with a sway of 0.3 m of its own.

    Those of the next lanes, and of the vehicle's own behind it, are further behind by a distance,
    those ahead of it further ahead.
    """
    found = []
    for number, (x, y) in enumerate(places):
        sway = 0.3 * math.sin(0.7 * time_s + 1.9 * number)
        away_m = behind_m if y == 0.0 < x else -behind_m
        xyz = (speed_m_s * time_s + 0.85 + x + sway + away_m, y, 0.5 * TRUCK_M[2] + 0.4)
        pose = compose(street.T_world_start, pose_matrix(xyz, (0.0, 0.0, 0.0, 1.0)))
        found.append(
            Primitive(
                kind='box', size_m=TRUCK_M, xyz=tuple(pose[:3, 3]), q_xyzw=tuple(q_xyzw(pose))
            )
        )
    return found


def corridor() -> World:
    """Return a corridor of 30 m, 2.2 m wide, with doors, which ends in a hall of 20 x 16 m."""
    walls = [
        box((15.0, 1.6, 1.3), (30.0, 1.0, 3.2)),
        box((15.0, -1.6, 1.3), (30.0, 1.0, 3.2)),
        box((-0.5, 0.0, 1.3), (1.0, 5.0, 3.2)),
        box((25.0, 0.0, -0.25), (60.0, 30.0, 0.5)),
        box((15.0, 0.0, 2.95), (30.0, 4.2, 0.5)),
        box((40.5, 8.5, 3.0), (21.0, 1.0, 6.5)),
        box((40.5, -8.5, 3.0), (21.0, 1.0, 6.5)),
        box((51.0, 0.0, 3.0), (1.0, 18.0, 6.5)),
        box((29.5, 5.6, 3.0), (1.0, 7.0, 6.5)),
        box((29.5, -5.6, 3.0), (1.0, 7.0, 6.5)),
        box((44.0, 3.0, 1.0), (2.0, 1.0, 2.0)),
        box((38.0, -4.0, 0.6), (1.0, 3.0, 1.2)),
    ]
    doors = [
        box((x, side * 1.08, 1.0), (0.12, 0.1, 2.0))
        for x in (3.5, 4.4, 9.0, 9.9, 17.5, 18.4, 24.0, 24.9)
        for side in (-1, 1)
    ]
    return World([*walls, *doors])


def corridor_course(time_s: float) -> Transform:
    """Return a walk of 4.5 m/s at most out of the corridor, from rest."""
    along = 2.0 + (0.75 * time_s**2 if time_s < 3.0 else 6.75 + 4.5 * (time_s - 3.0))
    turn = math.radians(8.0) * math.sin(1.1 * time_s)
    return pose_matrix(
        (along, 0.25 * math.sin(0.8 * time_s), 1.2 + 0.03 * math.sin(9.0 * time_s)),
        (0.0, 0.0, math.sin(turn / 2.0), math.cos(turn / 2.0)),
    )


def tunnel() -> World:
    """Return a tunnel of 300 m, 8 m wide, with a niche or a box of 1 m every 25 m."""
    walls = [
        box((120.0, 4.5, 2.5), (300.0, 1.0, 6.0)),
        box((120.0, -4.5, 2.5), (300.0, 1.0, 6.0)),
        box((120.0, 0.0, 5.5), (300.0, 10.0, 1.0)),
        box((120.0, 0.0, -0.5), (300.0, 10.0, 1.0)),
    ]
    boxes = [
        box((x, side * 3.8, 1.0), (1.2, 0.6, 1.6))
        for x, side in zip(range(-20, 260, 25), (1, -1) * 6, strict=True)
    ]
    return World([*walls, *boxes])


def tunnel_course(time_s: float) -> Transform:
    """Return a drive of 10 m/s through the tunnel, from rest, which accelerates by 2.5 m/s^2."""
    along = 1.25 * time_s**2 if time_s < 4.0 else 20.0 + 10.0 * (time_s - 4.0)
    turn = math.radians(1.5) * math.sin(0.4 * time_s)
    return pose_matrix(
        (along, 0.3 * math.sin(0.4 * time_s), 1.8),
        (0.0, 0.0, math.sin(turn / 2.0), math.cos(turn / 2.0)),
    )


def box(centre: tuple[float, ...], size_m: tuple[float, ...]) -> Primitive:
    """Return a box that is parallel to the axes of the world."""
    return Primitive(kind='box', size_m=size_m, xyz=centre)
