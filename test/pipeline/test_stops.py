# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stops that no brake explains: collisions, and drivers that repeat a cloud.

Such scans look like company that moves along. A stop explains the scans better; where the
fit does not tell, the velocity is believed for a few seconds at most.
"""

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.alignment import registration, tracking
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
    """Return the mapper of scans with true poses, and the errors of its poses, m."""
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    errors_m, first = [], None
    for scan, pose in scans:
        first = pose if first is None else first
        mapper.add_scan(scan)
        way_m = (inverse(first) @ pose)[:3, 3]
        errors_m += [np.linalg.norm(u.T_map_sensor[:3, 3] - way_m) for u in mapper.insert_ready()]
    mapper.finish()
    return mapper, errors_m


@pytest.mark.parametrize('stops_s', [2.0, 2.03, 2.07])
def test_a_collision_ends_the_motion(stops_s):
    mapper, errors_m = mapped(drive(ending(stops_s)))
    assert len(errors_m) == 30
    assert max(errors_m) < 0.1 * SPEED_M_S  # in the scan of the stop, 7 m if the velocity is kept
    assert max(errors_m[22:]) < 0.05
    assert mapper.summary()['registration']['tracking']['stopped']['scans'] >= 1


def test_a_repeated_cloud_ends_the_motion():
    moving = list(drive(COURSE, num_scans=21))
    last, pose = moving[-1]
    repeats = [
        (replace(last, stamp_ns=last.stamp_ns + round(1e8 * number)), pose)
        for number in range(1, 10)
    ]
    mapper, errors_m = mapped([*moving, *repeats])
    assert len(errors_m) == 30
    assert max(errors_m[20:]) < 0.05
    assert mapper.summary()['registration']['tracking']['stopped']['scans'] >= 1


def test_driving_and_braking_are_no_stops():
    def course(time_s):
        braked_s = max(time_s - 1.0, 0.0)  # at 8 m/s^2
        return COURSE(time_s - 0.5 * braked_s**2 if braked_s < 1.0 else 1.5)

    mapper, errors_m = mapped(drive(course))
    assert max(errors_m) < 0.15
    assert mapper.summary()['registration']['tracking']['stopped']['scans'] == 0


def test_the_velocity_alone_is_not_believed_for_long(monkeypatch):
    for name in ('CLEARER', 'CLEARER_IF_ALL_STAYS'):  # the fit never tells
        monkeypatch.setattr(registration, name, np.inf)
    monkeypatch.setattr(tracking, 'LONGEST_UNTOLD_S', 1.0)
    mapper, errors_m = mapped(drive(ending(1.0), num_scans=30))
    summary = mapper.summary()['registration']
    assert summary['tracking']['lost']['scans'] + summary['tracking']['unconfirmed']['scans']
    assert max(errors_m) < SPEED_M_S * (1.0 + 0.5)
    assert abs(errors_m[-1] - errors_m[-5]) < 0.05  # at rest again
