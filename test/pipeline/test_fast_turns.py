# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A hand-held lidar in a hall of right angles, thinned: long steps and large turns between scans.

The scans follow each other at 10 Hz by their stamps, as those of a folder without times do. The
steps are no motion that a vehicle could make.
"""

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.geometry import compose, inverse, pose_matrix
from surfel_mapper.pipeline import Mapper
from surfel_mapper.simulation import Lidar, World
from surfel_mapper.simulation.primitives import Primitive

LIDAR = Lidar(beams=32, columns=360, elevation_deg=(-40.0, 40.0), range_noise_m=0.01)

HALL_M = (30.0, 22.0, 6.0)

WAYPOINTS = ((-9.0, -6.0), (9.0, -6.0), (9.0, 5.0), (-9.0, 5.0))


def box(size_m, xyz, heading_deg=0.0):
    half = np.radians(heading_deg) / 2.0
    return Primitive(
        kind='box', size_m=size_m, xyz=xyz, q_xyzw=(0.0, 0.0, np.sin(half), np.cos(half))
    )


def hall():
    """Return a hall with pillars and boxes that break its symmetry."""
    length, width, height = HALL_M
    walls = [
        box((length, width, 0.2), (0.0, 0.0, -0.1)),
        box((length, width, 0.2), (0.0, 0.0, height + 0.1)),
        *(box((0.2, width, height), (s * 0.5 * length, 0.0, 0.5 * height)) for s in (-1, 1)),
        *(box((length, 0.2, height), (0.0, s * 0.5 * width, 0.5 * height)) for s in (-1, 1)),
    ]
    furniture = [
        box((0.8, 0.8, height), (-5.0, 0.0, 0.5 * height)),
        box((3.0, 1.5, 2.0), (12.0, -9.0, 1.0)),
        box((1.5, 6.0, 3.0), (-14.0, 6.0, 1.5)),
        box((2.0, 2.0, 1.0), (4.0, 9.5, 0.5), 20.0),
    ]
    return World([*walls, *furniture])


def hand_held(steps_m, turns_deg):
    """Yield poses around the hall, steps apart, at headings that change by given angles."""
    corners = np.array([*WAYPOINTS, WAYPOINTS[0]])
    along_m = np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
    heading = way_m = 0.0
    for step_m, turn_deg in zip(steps_m, turns_deg, strict=True):
        heading, way_m = heading + np.radians(turn_deg), way_m + step_m
        x, y = (np.interp(way_m, along_m, corners[:, axis]) for axis in (0, 1))
        yield pose_matrix((x, y, 1.3), (0.0, 0.0, np.sin(heading / 2.0), np.cos(heading / 2.0)))


def registered(poses):
    """Return the mapper of scans at poses, and the errors of those that it mapped, m."""
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    world, true, errors_m = hall(), {}, []
    for number, pose in enumerate(poses):
        scan = LIDAR.scan(world, pose, stamp_ns=(number + 1) * 10**8, number=number)
        true[scan.stamp_ns] = pose
        mapper.add_scan(scan)
        for update in mapper.insert_ready():
            expected = compose(inverse(true[10**8]), true[update.stamp_ns])
            errors_m.append(np.linalg.norm(update.T_map_sensor[:3, 3] - expected[:3, 3]))
    mapper.finish()
    return mapper, errors_m


@pytest.mark.parametrize(
    'turns_deg',
    [
        (0, 15, 30, 48, 30, -40, 106, 76, -21, 90, 10, -95),
        (0, 130, -60, 90, 90, -170, 45, 100, -100, 60, 180, 20),
    ],
    ids=('hand', 'any'),
)
def test_long_steps_and_turns_between_scans_are_followed(turns_deg):
    _, errors_m = registered(hand_held([1.8] * len(turns_deg), turns_deg))

    assert len(errors_m) == len(turns_deg)
    assert max(errors_m) < 0.05


def test_steps_of_any_length_are_believed():
    # 7.5 m within 0.1 s by the assumed times
    steps_m = (0.0, 1.5, 3.0, 4.5, 6.0, 7.5)
    _, errors_m = registered(hand_held(steps_m, [0.0] * 6))

    assert len(errors_m) == 6
    assert max(errors_m) < 0.05


def test_a_first_step_beyond_reach_is_never_taken_for_rest():
    # along the walls, which fit at rest as well
    mapper, errors_m = registered(hand_held([0.0, *[7.5] * 5], [0.0] * 6))

    assert len(errors_m) < 6
    assert not any(abs(error_m - 7.5) < 0.1 for error_m in errors_m)
    assert sum(mapper.counters.dropped.values()) == 6 - len(errors_m)
