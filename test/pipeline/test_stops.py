# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stops that no brake explains: collisions, and drivers that repeat a cloud.

Nothing is concluded from the velocity before: the fit of the scans alone decides.
"""

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.geometry import inverse
from surfel_mapper.pipeline import Mapper
from surfel_mapper.simulation import World
from test.pipeline.scenarios import LIDAR, Scenario, street_course

SPEED_M_S = 8.0

STREET = World.street(seed=1, length_m=600.0)

COURSE = street_course(STREET, SPEED_M_S)


def drive(course, num_scans=30):
    """Return the scans and true poses of a course."""
    return Scenario(
        name='stop',
        world=STREET,
        course=course,
        lidar=replace(LIDAR, columns=256),
        num_scans=num_scans,
    ).scans()


def ending(stops_s):
    """Return the course that ends within no time."""
    return lambda time_s: COURSE(min(time_s, stops_s))


def mapped(scans):
    """Return the errors of the registered poses of scans with true poses, m."""
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    errors_m, first = [], None
    for scan, pose in scans:
        first = pose if first is None else first
        mapper.add_scan(scan)
        way_m = (inverse(first) @ pose)[:3, 3]
        errors_m += [np.linalg.norm(u.T_map_sensor[:3, 3] - way_m) for u in mapper.insert_ready()]
    mapper.finish()
    return errors_m


@pytest.mark.parametrize('stops_s', [2.0, 2.03, 2.07])
def test_a_collision_ends_the_motion(stops_s):
    errors_m = mapped(drive(ending(stops_s)))
    assert len(errors_m) == 30
    assert max(errors_m) < 0.1 * SPEED_M_S  # in the scan of the stop, 7 m if the velocity is kept
    assert max(errors_m[22:]) < 0.05


def test_a_repeated_cloud_ends_the_motion():
    moving = list(drive(COURSE, num_scans=21))
    last, pose = moving[-1]
    repeats = [
        (replace(last, stamp_ns=last.stamp_ns + round(1e8 * number)), pose)
        for number in range(1, 10)
    ]
    errors_m = mapped([*moving, *repeats])
    assert len(errors_m) == 30
    assert max(errors_m) < 0.1 * SPEED_M_S  # in the first repeat, which the velocity predicts
    assert max(errors_m[22:]) < 0.05


def test_braking_at_8_m_s2_is_followed():
    def course(time_s):
        braked_s = max(time_s - 1.0, 0.0)  # at 8 m/s^2
        return COURSE(time_s - 0.5 * braked_s**2 if braked_s < 1.0 else 1.5)

    errors_m = mapped(drive(course))
    assert max(errors_m) < 0.15
