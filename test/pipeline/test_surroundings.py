# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Trucks on all sides that move along are mistaken for the world, and the summary says so."""

from dataclasses import replace
from functools import cache

from surfel_mapper.config import Config
from surfel_mapper.offline.summary import MOST_SURROUNDED, uncertain_text
from surfel_mapper.pipeline import Mapper
from test.bench.scenarios import LIDAR, scenarios


@cache
def scenario_of(name):
    return next(each for each in scenarios() if each.name == name)


def summary_of(name, at_rest=False, num_scans=34):
    """Return the summary of the scans of a scenario, mapped by registration."""
    scenario = replace(scenario_of(name), num_scans=num_scans, lidar=replace(LIDAR, columns=512))
    if at_rest:
        scenario = replace(scenario, course=lambda time_s: scenario_of(name).course(0.0))
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    for scan, _ in scenario.scans():
        mapper.add_scan(scan)
        list(mapper.insert_ready())
    mapper.finish()
    return mapper.summary()


def test_trucks_that_move_along_on_all_sides_are_reported():
    summary = summary_of('9 trucks')
    found = summary['registration']['tracking']['surrounded']
    assert found['scans'] >= MOST_SURROUNDED
    assert f'in {found["scans"]} of 34 scans' in uncertain_text(summary)


def test_some_trucks_that_move_along_or_pass_are_not():
    for at_rest in (False, True):
        summary = summary_of('3 trucks', at_rest=at_rest)
        assert summary['registration']['tracking']['surrounded']['scans'] < MOST_SURROUNDED
        assert uncertain_text(summary) == ''
