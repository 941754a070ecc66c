# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters that thin: how many stay, that none is preferred, and that chance repeats itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from test.filters.examples import filter_of, kept, scan_of

NUMBER = 40_000


def line(number=NUMBER, stamp_ns=1, **columns):
    points = np.zeros((number, 3))
    points[:, 0] = np.arange(number)
    return scan_of(points, stamp_ns=stamp_ns, **columns)


def rows(name, scan=None, /, **parameters):
    return filter_of(name, **parameters).apply(scan or line()).points[:, 0].astype(int)


def assert_even(found, number=NUMBER, parts=10):
    """Check that no part of the scan is preferred, within 5 standard deviations."""
    counts = np.bincount(found * parts // number, minlength=parts)
    assert np.abs(counts - len(found) / parts).max() < 5.0 * math.sqrt(len(found) / parts)
    assert (np.diff(found) > 0).all()


@pytest.mark.parametrize('probability', [0.1, 0.75])
def test_random_sampling_keeps_each_point_with_its_probability(probability):
    found = rows('RandomSamplingDataPointsFilter', prob=probability)
    deviation = math.sqrt(NUMBER * probability * (1.0 - probability))
    assert abs(len(found) - NUMBER * probability) < 5.0 * deviation
    assert_even(found)


def test_random_sampling_keeps_all_or_nothing_where_asked():
    assert len(rows('RandomSamplingDataPointsFilter', prob=1)) == NUMBER
    assert len(rows('RandomSamplingDataPointsFilter', prob=0)) == 0


@pytest.mark.parametrize(
    ('name', 'settings'),
    [
        ('random_sampling', {'probability': 0.5}),
        ('max_point_count', {'max_points': 1000}),
        ('fix_step_sampling', {'start_step': 1000, 'end_step': 1000}),
    ],
)
def test_chance_follows_the_seed_and_the_stamp(name, settings):
    first = rows(name, line(), **settings, seed=1).tolist()
    assert rows(name, line(), **settings, seed=1).tolist() == first
    assert rows(name, line(stamp_ns=2), **settings, seed=1).tolist() != first
    assert rows(name, line(), **settings, seed=2).tolist() != first


@pytest.mark.parametrize(
    ('number', 'count'), [(5, 1000), (1000, 1000), (1001, 1000), (NUMBER, 999), (3, 0)]
)
def test_max_point_count_keeps_so_many(number, count):
    found = rows('MaxPointCountDataPointsFilter', line(number), maxCount=count)
    assert len(found) == min(number, count)
    assert (np.diff(found) > 0).all()


def test_max_point_count_prefers_no_part_of_the_scan():
    assert_even(rows('MaxPointCountDataPointsFilter', maxCount=5000))


def test_fix_step_sampling_keeps_every_tenth_from_one_of_the_first_ten_on():
    found = rows('FixStepSamplingDataPointsFilter')
    assert found[0] < 10
    assert (np.diff(found) == 10).all()
    phases = {rows('fix_step_sampling', line(stamp_ns=stamp))[0] for stamp in range(100)}
    assert phases == set(range(10))


@pytest.mark.parametrize(
    ('start', 'end', 'factor', 'steps'),
    [
        (10, 100, 3.0, [10, 30, 90, 100, 100]),
        (100, 7, 0.25, [100, 25, 7, 7]),
        (10, 3, 2.0, [10, 3, 3]),  # on the far side of its end already
        (10, 99, 1.0, [10, 10, 10]),
    ],
)
def test_the_step_moves_to_its_end_from_scan_to_scan(start, end, factor, steps):
    each = filter_of(
        'FixStepSamplingDataPointsFilter', startStep=start, endStep=end, stepMult=factor
    )
    found = [np.diff(each.apply(line()).points[:, 0])[0] for _ in steps]
    assert found == steps


def test_max_density_thins_what_is_too_dense_and_only_that():
    densities = np.where(np.arange(NUMBER) < NUMBER // 2, 40.0, 5.0)
    found = rows('MaxDensityDataPointsFilter', line(densities=densities), maxDensity=10)
    dense = np.count_nonzero(found < NUMBER // 2)
    assert abs(dense - NUMBER / 2 / 4) < 5.0 * math.sqrt(NUMBER / 2 * 0.25 * 0.75)
    assert np.count_nonzero(found >= NUMBER // 2) == NUMBER // 2
    with pytest.raises(FilterError, match="needs the column 'densities'"):
        filter_of('max_density').apply(line(1))


def test_max_density_drops_what_has_no_density():
    scan = line(3, densities=[1.0, np.nan, np.inf])
    assert rows('max_density', scan).tolist() == [0]


def test_max_quantile_keeps_what_is_strictly_below_or_above():
    points = np.zeros((5, 3))
    points[:, 1] = [4.0, 0.0, 3.0, 1.0, 2.0]
    name = 'MaxQuantileOnAxisDataPointsFilter'
    assert kept(name, points, dim=1, ratio=0.5) == [1, 3]
    assert kept(name, points, dim=1, ratio=0.5, removeBeyond=0) == [0, 2]
    assert kept(name, points, dim=1, ratio=1e-7) == []
    assert kept(name, points, dim=1, ratio=0.9999999) == [1, 2, 3, 4]
    assert kept(name, points, dim=0) == []  # all are at the quantile


def test_a_quantile_is_that_of_the_points_that_have_the_coordinate():
    points = np.full((4, 3), np.nan)
    points[:3, 0] = [1.0, 2.0, 3.0]
    assert kept('max_quantile_on_axis', points, ratio=0.5) == [0]
    assert kept('max_quantile_on_axis', np.full((4, 3), np.nan)) == []
