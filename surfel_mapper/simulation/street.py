# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A street canyon of primitives: road, pavements, houses, parked cars, trees, lamps, bins.

In the frame of the street x runs along the road, y to the left and z up from the road. The street
is rotated in the world, and nearly every object in the street, so that no plane is parallel to the
voxel grid, which would hide rounding errors. Solids reach into the ground and into the objects
below them, so that there are no gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Any

import numpy as np

from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import compose, pose_matrix, q_xyzw, se3_exp
from surfel_mapper.simulation.primitives import Primitive

STREET_XYZ = (3.7, -12.4, 1.3)
"""Start of the street in the world, m."""

STREET_TURN_DEG = (2.6, -1.9, 27.0)
"""Rotation vector of the street in the world, deg."""

BEYOND_M = 60.0
"""Length of the street before the start and after the end of a drive."""

GROUND_WIDTH_M = 90.0
PAVEMENT_Y_M = (5.8, 8.8)
PAVEMENT_HEIGHT_M = 0.13


def street_pose() -> list[float]:
    """Return the pose of the street in the world, x y z in m, qx qy qz qw."""
    turn = np.deg2rad([0.0, 0.0, 0.0, *STREET_TURN_DEG])
    return [*STREET_XYZ, *(float(v) for v in q_xyzw(se3_exp(turn)))]


def street_primitives(seed: int, length_m: float) -> list[Primitive]:
    """
    Return the primitives of a street for drives of up to length_m.

    Raises
    ------
    ConfigError
        If the seed is negative or the length is not positive and finite.

    """
    if seed < 0:
        raise ConfigError(f'seed: {seed}, expected zero or positive')
    if not 0.0 < length_m < math.inf:
        raise ConfigError(f'length_m: {length_m}, expected a positive, finite length')
    street = Street(np.random.default_rng(seed), length_m)
    return [
        *street.ends(),
        *(
            primitive
            for side in (-1, 1)
            for row in (street.pavement, street.houses, street.cars, street.furniture)
            for primitive in row(side)
        ),
    ]


class Street:
    """Generates the rows of objects along one street, in the order of its random numbers."""

    def __init__(self, rng: np.random.Generator, length_m: float) -> None:
        self._rng = rng
        self._length_m = length_m
        pose = street_pose()
        self._T_world_street = pose_matrix(pose[:3], pose[3:])

    def ends(self) -> Iterator[Primitive]:
        """Yield the ground and a house across each end."""
        size = (self._length_m + 2.0 * BEYOND_M + 40.0, GROUND_WIDTH_M)
        midpoint = (self._length_m / 2.0, 0.0, 0.0)
        yield self._primitive('rectangle', size, midpoint, label='ground', reflectivity=0.25)
        for x in (-BEYOND_M - 4.0, self._length_m + BEYOND_M + 4.0):
            turn = (self._about(0.0, 1.0), self._about(0.0, 1.0), self._about(0.0, 8.0))
            yield self._primitive('box', (8.0, 40.0, 24.0), (x, 0.0, 2.0), turn, label='building')

    def pavement(self, side: int) -> Iterator[Primitive]:
        """Yield the slabs of a pavement."""
        near, far = PAVEMENT_Y_M
        slab = 24.0
        for x in np.arange(-BEYOND_M, self._length_m + BEYOND_M, slab).tolist():
            size = (slab + 0.5, far - near, 1.0)
            centre = (x + slab / 2.0, side * (near + far) / 2.0, PAVEMENT_HEIGHT_M - 0.5)
            turn = (self._about(0.0, 0.4), self._about(0.0, 0.1), self._about(0.0, 0.2))
            yield self._primitive('box', size, centre, turn, label='pavement', reflectivity=0.4)

    def houses(self, side: int) -> Iterator[Primitive]:
        """Yield a row of houses, some with a gap, a bay window or a sign."""
        rng, x = self._rng, -BEYOND_M
        while x < self._length_m + BEYOND_M:
            width, height = rng.uniform(8.0, 16.0), rng.uniform(6.0, 15.0)
            front = side * (PAVEMENT_Y_M[1] + rng.uniform(-0.2, 1.2))
            turn = (self._about(0.0, 1.5), self._about(0.0, 1.5), self._about(0.0, 4.0))
            look = {'label': 'building', 'reflectivity': self._rng.uniform(0.3, 0.8)}
            centre = (x + width / 2.0, front + side * 5.0, height / 2.0 - 1.0)
            yield self._primitive('box', (width, 10.0, height + 2.0), centre, turn, **look)
            if rng.random() < 0.5:
                size = (rng.uniform(2.0, 4.0), 2.0, rng.uniform(2.0, height - 3.5))
                centre = (x + width / 2.0, front + side * 0.2, 3.0 + size[2] / 2.0)
                yield self._primitive('box', size, centre, turn, **look)
            if rng.random() < 0.3:
                centre = (x + rng.uniform(1.0, width - 1.0), front - side * 0.7, 3.2)
                turn = (self._about(0.0, 2.0), self._about(0.0, 2.0), self._about(0.0, 5.0))
                look = {'label': 'sign', 'reflectivity': 0.9}
                yield self._primitive('box', (0.06, 0.8, 1.2), centre, turn, **look)
            x += width + (rng.uniform(3.0, 8.0) if rng.random() < 0.2 else -0.2)

    def cars(self, side: int) -> Iterator[Primitive]:
        """Yield parked cars: a body and a cabin with the same rotation."""
        for x in np.arange(-BEYOND_M, self._length_m + BEYOND_M, 7.0).tolist():
            if self._rng.random() < 0.4:
                continue
            length, height = self._rng.uniform(3.6, 4.8), self._rng.uniform(0.8, 1.1)
            at = x + self._about(0.0, 1.0), side * self._about(4.6, 0.15)
            turn = (self._about(0.0, 1.5), self._about(0.0, 1.5), self._about(0.0, 5.0))
            look = {'label': 'car', 'reflectivity': self._rng.uniform(0.2, 0.9)}
            body, cabin = (length, 1.8, height + 0.4), (length * 0.55, 1.6, 0.8)
            yield self._primitive('box', body, (*at, height / 2.0 - 0.2), turn, **look)
            yield self._primitive('box', cabin, (*at, height + 0.25), turn, **look)

    def furniture(self, side: int) -> Iterator[Primitive]:
        """Yield lamps, trees and bins on the pavement, in turn."""
        kinds = (self._lamp, self._tree, self._bin, self._tree)
        along = np.arange(-BEYOND_M, self._length_m + BEYOND_M, 5.5)
        for number, x in enumerate(along.tolist()):
            if self._rng.random() < 0.75:
                at = x + self._about(0.0, 0.8), side * self._about(6.6, 0.3)
                yield from kinds[number % len(kinds)](*at)

    def _lamp(self, x: float, y: float) -> Iterator[Primitive]:
        height = self._rng.uniform(4.5, 6.5)
        turn = (self._about(0.0, 2.0), self._about(0.0, 2.0), 0.0)
        size = (self._rng.uniform(0.07, 0.12), height)
        yield self._primitive('cylinder', size, (x, y, height / 2.0 - 0.2), turn, label='pole')
        yield self._primitive('sphere', (0.3,), (x, y, height), label='lamp', reflectivity=0.95)

    def _tree(self, x: float, y: float) -> Iterator[Primitive]:
        size = (self._rng.uniform(0.15, 0.35), 5.0)
        turn = (self._about(0.0, 5.0), self._about(0.0, 5.0), 0.0)
        yield self._primitive('cylinder', size, (x, y, 2.2), turn, label='trunk', reflectivity=0.3)
        for _ in range(2):
            centre = (self._about(x, 0.6), self._about(y, 0.6), self._about(5.0, 0.5))
            radius = self._rng.uniform(0.9, 1.4)
            yield self._primitive('sphere', (radius,), centre, label='crown', reflectivity=0.45)

    def _bin(self, x: float, y: float) -> Iterator[Primitive]:
        turn = (self._about(0.0, 4.0), self._about(0.0, 4.0), 0.0)
        yield self._primitive(
            'tube', (0.32, 1.6), (x, y, 0.3), turn, label='bin', reflectivity=0.6
        )

    def _about(self, value: float, spread: float) -> float:
        """Return a uniform random number in value +- spread."""
        return float(self._rng.uniform(value - spread, value + spread))

    def _primitive(
        self,
        kind: str,
        size_m: tuple[float, ...],
        xyz: tuple[float, ...],
        turn_deg: tuple[float, ...] = (0.0, 0.0, 0.0),
        **look: Any,
    ) -> Primitive:
        """Return a primitive from its centre and rotation vector in the street."""
        turn = se3_exp(np.deg2rad([0.0, 0.0, 0.0, *turn_deg]))
        T_world_primitive = compose(self._T_world_street, pose_matrix(xyz, q_xyzw(turn)))
        return Primitive(
            kind=kind,
            size_m=size_m,
            xyz=tuple(T_world_primitive[:3, 3]),
            q_xyzw=tuple(q_xyzw(T_world_primitive)),
            **look,
        )
