# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Circuits: streets that meet at corners, and routes that return to their start.

A street of the simulation is straight. A circuit is one street for every leg between two corners,
without the objects that would stand in the road of another leg, on one ground. A route follows
corners on arcs; legs may be driven several times and in both directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import compose, inverse, pose_matrix, q_xyzw, se3_exp, Transform
from surfel_mapper.simulation import Drive, Primitive, World
from surfel_mapper.simulation.street import (
    BEYOND_M,
    PAVEMENT_Y_M,
    street_pose,
    street_primitives,
)

Corners = Sequence[tuple[float, float]]
"""Places x y in the frame of the street, m."""

TURN_RADIUS_M = 7.0
"""Radius of the arc at a corner, m."""

MIN_STEP_M = 1e-6
"""Two arcs that touch share a point; the heading of a shorter step, m, is rounding."""

END_M = 12.0
"""Length of a street beyond its corners, m."""


class Route:
    """
    A way along corners, rounded by arcs; it begins at the first corner towards the second.

    Parameters
    ----------
    corners : sequence of (float, float)
        Two or more places, m; consecutive ones at least twice the radius of the arcs apart.

    """

    def __init__(self, corners: Corners) -> None:
        points = np.array(corners, np.float64)
        ways = np.linalg.norm(np.diff(points, axis=0), axis=1)
        steps = np.diff(points, axis=0) / ways[:, None]
        pieces = [points[:1]]
        for number in range(1, len(points) - 1):
            corner, incoming, outgoing = points[number], steps[number - 1], steps[number]
            along = np.linspace(0.0, 1.0, 33)[:, None]
            a, b = corner - TURN_RADIUS_M * incoming, corner + TURN_RADIUS_M * outgoing
            pieces.append((1 - along) ** 2 * a + 2 * along * (1 - along) * corner + along**2 * b)
        route = np.concatenate([*pieces, points[-1:]])
        is_apart = np.linalg.norm(np.diff(route, axis=0), axis=1) > MIN_STEP_M
        self._points = route[np.concatenate([[True], is_apart])]
        slopes = np.diff(self._points, axis=0)
        lengths = np.linalg.norm(slopes, axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(lengths)])
        self._heading = np.unwrap(np.arctan2(slopes[:, 1], slopes[:, 0]))

    def T_start_at(self, along_m: float) -> Transform:
        """Return the pose on the route in the frame of the corners; beyond the ends straight."""
        piece = int(np.clip(np.searchsorted(self._along, along_m) - 1, 0, len(self._heading) - 1))
        middle = 0.5 * (self._along[1:] + self._along[:-1])
        heading = float(np.interp(along_m, middle, self._heading))
        slope = self._heading[piece]
        over = along_m - self._along[piece]
        x, y = self._points[piece] + over * np.array([math.cos(slope), math.sin(slope)])
        turn = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading]))
        return pose_matrix((x, y, 0.0), q_xyzw(turn))


@dataclass(frozen=True, kw_only=True)
class CircuitDrive(Drive):
    """A drive along corners, places x y in the frame of ``start``, m."""

    corners: tuple[tuple[float, float], ...]

    def pose(self, stamp_ns):
        """Return position (3,), m, and quaternion (4,) xyzw of base_link in odom at a stamp."""
        along = self.speed_m_s * (stamp_ns - self.start_ns) * 1e-9
        T_odom_start = pose_matrix(self.start[:3], self.start[3:])
        T_route_base = compose(inverse(T_odom_start), pose_matrix(*super().pose(stamp_ns)))
        T_route_base[0, 3] -= along
        T_start_base = compose(route_along(self.corners).T_start_at(along), T_route_base)
        T_odom_base = compose(T_odom_start, T_start_base)
        return T_odom_base[:3, 3].copy(), q_xyzw(T_odom_base)


def circuit_world(corners: Corners, *, seed: int = 0) -> World:
    """Return the streets between corners."""
    return World(circuit_primitives(seed, corners), street_pose())


@cache
def route_along(corners: tuple[tuple[float, float], ...]) -> Route:
    """Return the route along corners, made once."""
    return Route(corners)


def circuit_primitives(seed: int, corners: Corners) -> list[Primitive]:
    """Return the primitives of the streets between corners, in the world of ``street_pose``."""
    points = [(float(x), float(y)) for x, y in corners]
    legs = sorted({tuple(sorted(leg)) for leg in pairwise(points)})
    pose = street_pose()
    T_world_street = pose_matrix(pose[:3], pose[3:])
    T_street_world = inverse(T_world_street)
    kept = [_ground(T_world_street, np.array(points))]
    for number, (first, last) in enumerate(legs):
        other_legs = np.array([leg for leg in legs if leg != (first, last)]).reshape(-1, 2, 2)
        T_street_leg = _leg_pose(first, last)
        length_m = math.dist(first, last)
        move = compose(T_world_street, compose(T_street_leg, T_street_world))
        for primitive in street_primitives(1000 * seed + number, length_m):
            if primitive.label == 'ground':
                continue
            at = compose(T_street_world, primitive.T_world_primitive)[:2, 3]
            if not -END_M <= at[0] <= length_m + END_M:
                continue
            position = T_street_leg[:2, :2] @ at + T_street_leg[:2, 3]
            reach_m = math.hypot(*primitive.half_m[:2]) + PAVEMENT_Y_M[1]
            if (_distances(position, other_legs) < reach_m).any():
                continue
            kept.append(_moved(primitive, move))
    return kept


def _leg_pose(first: tuple[float, float], last: tuple[float, float]) -> Transform:
    heading = math.atan2(last[1] - first[1], last[0] - first[0])
    turn = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading]))
    return pose_matrix((*first, 0.0), q_xyzw(turn))


def _ground(T_world_street: Transform, corners: npt.NDArray[np.float64]) -> Primitive:
    """Return the ground below all streets."""
    low, high = corners.min(axis=0) - 2.0 * BEYOND_M, corners.max(axis=0) + 2.0 * BEYOND_M
    middle = pose_matrix((*(0.5 * (low + high)), 0.0), (0.0, 0.0, 0.0, 1.0))
    T = compose(T_world_street, middle)
    return Primitive(
        kind='rectangle',
        size_m=tuple(high - low),
        xyz=tuple(T[:3, 3]),
        q_xyzw=tuple(q_xyzw(T)),
        label='ground',
        reflectivity=0.25,
    )


def _moved(primitive: Primitive, motion: Transform) -> Primitive:
    """Return a primitive moved by a motion of the world."""
    T = compose(motion, primitive.T_world_primitive)
    return replace(primitive, xyz=tuple(T[:3, 3]), q_xyzw=tuple(q_xyzw(T)))


def _distances(
    position: npt.NDArray[np.float64], legs: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the distances of a position (2,) from (L, 2, 2) legs, (L,) m."""
    first, way = legs[:, 0], legs[:, 1] - legs[:, 0]
    off = position - first
    along = (off * way).sum(axis=1) / (way * way).sum(axis=1)
    off = off - np.clip(along, 0.0, 1.0)[:, None] * way
    distances_m: npt.NDArray[np.float64] = np.hypot(off[:, 0], off[:, 1])
    return distances_m
