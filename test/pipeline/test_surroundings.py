# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Trucks on all sides that move along.

From the first scan on they are mistaken for the world, and the summary says so. Trucks that come
later are left out, and the summary names these scans too.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.geometry import inverse
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.offline.summary import DOUBTFUL, uncertain_text
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.surroundings import SurroundingMotion
from surfel_mapper.simulation import World
from test.pipeline.scenarios import LIDAR, scenarios


@cache
def scenarios_in_view():
    """Return the scenarios by name, without the parts of the street that no scan reaches."""
    found = {}
    for scenario in scenarios():
        start = scenario.course(0.0)[:3, 3]
        world = World([each for each in scenario.world.primitives if is_near(each, start)])
        found[scenario.name] = replace(scenario, world=world)
    return found


def is_near(primitive, place):
    """Return whether the lidar may see a primitive from a place or 40 m further on."""
    away_m = np.linalg.norm(np.subtract(primitive.xyz, place)) - np.linalg.norm(primitive.half_m)
    return away_m < LIDAR.max_range_m + 40.0


def mapped(name, at_rest=False, num_scans=34, rate_hz=10.0):
    """Return the mapper of the scans of a scenario by registration, and the errors of poses, m."""
    driven = scenarios_in_view()[name]
    scenario = replace(
        driven, num_scans=num_scans, lidar=replace(LIDAR, columns=512, rate_hz=rate_hz)
    )
    if at_rest:
        scenario = replace(scenario, course=lambda time_s: driven.course(0.0))
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    true, found = {}, {}
    for scan, pose in scenario.scans():
        true[scan.stamp_ns] = pose
        mapper.add_scan(scan)
        found.update((update.stamp_ns, update.T_map_sensor) for update in mapper.insert_ready())
    mapper.finish()
    first = min(found)
    moves = {stamp_ns: inverse(true[first]) @ true[stamp_ns] for stamp_ns in found}
    errors_m = [np.linalg.norm(found[s][:3, 3] - moves[s][:3, 3]) for s in sorted(found)]
    return mapper, errors_m


def test_trucks_that_move_along_on_all_sides_are_reported():
    summary = mapped('9 trucks')[0].summary()
    found = summary['registration']['tracking']['surrounded']
    assert found['scans'] >= DOUBTFUL['surrounded'][0]
    assert f'in {found["scans"]} of 34 scans' in uncertain_text(summary)


def test_some_trucks_that_move_along_or_pass_are_not():
    for at_rest in (False, True):
        summary = mapped('3 trucks', at_rest=at_rest)[0].summary()
        tracking = summary['registration']['tracking']
        assert tracking['surrounded']['scans'] < DOUBTFUL['surrounded'][0]
        assert uncertain_text(summary) == ''


def is_in_doubt(shares):
    """Return the scans that are reported, from their motions and shares of new voxels."""
    surroundings, surfel_map = SurroundingMotion(), SurfelMap(1.0)
    standing = np.arange(1000)[:, None] * [1.0, 0.0, 0.0] + 0.5
    surfel_map.add(standing)
    doubts = []
    for share in shares:
        cells = standing + [0.0, 1.0, 0.0] * (np.arange(1000)[:, None] < 1000 * share)
        doubts.append(surroundings.move_along(cells, np.eye(4), surfel_map))
    return doubts


def test_a_steady_share_of_new_voxels_at_rest_is_in_doubt():
    assert is_in_doubt([0.03] * 40) == [False] * 40
    assert is_in_doubt([0.08] * 40) == [False] * 19 + [True] * 21


def test_a_new_area_that_comes_into_view_is_not_in_doubt():
    new_area = [0.63, 0.39, 0.38, 0.51, 0.31, 0.26, 0.3]  # of a hall, by every second beam
    assert not any(is_in_doubt([0.02] * 20 + new_area + [0.02] * 10))


def test_trucks_that_come_do_not_pull_the_poses_along():
    mapper, errors_m = mapped('9 trucks that come', num_scans=44)
    assert len(errors_m) == 44
    assert max(errors_m) < 0.1  # 2.4 m if all cells decide
    summary = mapper.summary()
    spent = summary['registration']['tracking']['surrounded']
    assert spent['scans'] >= 20
    assert f'{spent["first_s"]:.3f} to {spent["last_s"]:.3f} s' in uncertain_text(summary)


def test_trucks_that_come_between_a_few_scans_are_reported():
    mapper, errors_m = mapped('9 trucks that come', num_scans=27, rate_hz=10.0 / 3.0)
    assert max(errors_m) > 10.0  # they are taken for a sudden stop
    assert 'a place far from the expected one' in uncertain_text(mapper.summary())
