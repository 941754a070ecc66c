# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Properties of every registered filter; a new filter is tested by them at once."""

from __future__ import annotations

from dataclasses import replace
import inspect
import math
import re

import numpy as np
import pytest

from surfel_mapper.config import settings_of
from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import FiniteFilter
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.registry import all_filters, find
from surfel_mapper.scan import Scan
from test.filters import libpointmatcher
from test.filters.examples import random_scan

FILTERS = all_filters()
PARAMETERS = [(cls, declared) for cls in FILTERS for declared in settings_of(cls)]
NUMBERS = [
    (cls, declared)
    for cls, declared in PARAMETERS
    if isinstance(declared.default, (int, float)) and not isinstance(declared.default, bool)
]

SETTINGS = {
    'add_descriptor': {'values': (1.5,)},
    'cut_at_descriptor_threshold': {'column_name': 'intensity', 'threshold': 100.0},
    'label_mask': {'labels': (1, 3)},
}
"""Parameters of filters whose defaults do nothing or are refused."""

COMPANIONS = {
    ('add_descriptor', 'num_components'): lambda value: {'values': (0.0,) * min(value, 9)},
    ('range_limit', 'min_m'): lambda value: {'max_m': math.inf},
    ('range_limit', 'max_m'): lambda value: {'min_m': 0.0},
}
"""Parameters that a parameter at its bounds needs beside it."""

JOINT = {
    ('add_descriptor', 'num_components'),
    ('range_limit', 'min_m'),
}
"""Parameters of which one bound cannot be reached, because another parameter forbids it."""

SNAKE = r'[a-z0-9]+(_[a-z0-9]+)*'

every = pytest.mark.parametrize('cls', FILTERS, ids=lambda cls: cls.name)


def made(cls, **parameters):
    return cls(**{**SETTINGS.get(cls.name, {}), **parameters})


def bits_of(scan):
    """Return everything in a scan as bytes."""
    arrays = {'points': scan.points, **scan.columns}
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in arrays.items()}


def refusal(function, *args, **kwargs):
    """Return the message of the ConfigError that a call raises."""
    try:
        function(*args, **kwargs)
    except ConfigError as error:
        return str(error)
    return 'not refused'


def test_every_filter_has_a_summary_and_a_name_in_snake_case():
    faults = []
    for cls in FILTERS:
        first = inspect.getdoc(cls).partition('\n')[0]
        if not (first.endswith('.') and len(first) <= 97):
            faults.append(f'{cls.name}: {first}')
        if not re.fullmatch(SNAKE, cls.name):
            faults.append(f'{cls.name}: not in snake case')
    assert faults == []


def test_every_parameter_has_a_meaning_and_an_allowed_default():
    faults = []
    for cls, declared in PARAMETERS:
        name = f'{cls.name}.{declared.name}'
        if not declared.meaning.endswith('.') or not re.fullmatch(SNAKE, declared.name):
            faults.append(f'{name}: {declared.meaning}')
        if declared.libpointmatcher and not cls.libpointmatcher:
            faults.append(f'{name}: libpointmatcher has no such filter')
        defaults = (declared.default, declared.libpointmatcher_default)
        if declared.is_number and not all(declared.low <= d <= declared.high for d in defaults):
            faults.append(f'{name}: default out of bounds')
    assert faults == []


def test_filters_of_libpointmatcher_have_its_parameters_defaults_and_bounds():
    faults = []
    for name, expected in libpointmatcher.FILTERS.items():
        settings = settings_of(find(f'{name}DataPointsFilter'))
        found = {each.libpointmatcher: each for each in settings if each.libpointmatcher}
        if set(found) != set(expected):
            faults.append(f'{name}: {sorted(set(found) ^ set(expected))}')
            continue
        for parameter, (default, low, high) in expected.items():
            declared = found[parameter]
            if (type(declared.default), declared.libpointmatcher_default) != (
                type(default),
                default,
            ):
                faults.append(f'{name}.{parameter}: {declared.libpointmatcher_default}')
            low, high = libpointmatcher.NARROWER.get((name, parameter), (low, high))
            bounds = (declared.low, declared.high)
            if declared.is_number and low is not None and bounds != (low, high):
                faults.append(f'{name}.{parameter}: {declared.allowed}')
    assert faults == []


@every
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_the_given_scan_is_not_changed_and_the_dtype_stays(cls, dtype):
    scan = random_scan(dtype=dtype)
    before = bits_of(scan)
    found = made(cls).apply(scan)
    assert bits_of(scan) == before
    assert found.points.dtype == dtype
    assert (found.stamp_ns, found.frame_id) == (scan.stamp_ns, scan.frame_id)
    assert found.T_base_sensor is scan.T_base_sensor
    assert all(len(column) == len(found) for column in found.columns.values())


MAKE_POINTS = {'voxel_grid', 'remove_sensor_bias'}
"""Filters whose points are not among those of the scan."""


@every
def test_points_keep_their_order_and_their_columns(cls):
    scan = random_scan()
    scan = replace(scan, columns={**scan.columns, 'id': np.arange(len(scan))})
    found = made(cls).apply(scan)
    rows = found.columns['id']
    assert (np.diff(rows) > 0).all()
    if cls.name not in MAKE_POINTS:
        np.testing.assert_array_equal(found.points, scan.points[rows])
    if cls.name != 'voxel_grid':
        for name in ('intensity', 'ring', 'label', 't', 'times', 'rgb'):
            np.testing.assert_array_equal(found.columns[name], scan.columns[name][rows])


CHANCE = {
    'fix_step_sampling': {},
    'gestalt': {'ratio': 0.5, 'radius_m': 1.0},
    'max_density': {},
    'max_point_count': {'max_points': 100},
    'normal_space': {'num_points': 100},
    'octree_grid': {'max_size_m': 1.0, 'sampling_method': 1},
    'random_sampling': {'probability': 0.5},
    'sampling_surface_normal': {},
    'spectral_decomposition': {'num_neighbours': 20, 'radius_m': 1.0},
}
"""Parameters with which chance matters."""


@pytest.mark.parametrize('name', CHANCE)
def test_chance_follows_the_seed(name):
    scan = random_scan(2000)
    one, again, two = (
        bits_of(find(name)(**CHANCE[name], seed=seed).apply(scan)) for seed in (1, 1, 2)
    )
    assert one == again != two


@every
def test_the_order_in_memory_makes_no_difference(cls):
    scan = random_scan()
    other = replace(scan, points=np.ascontiguousarray(scan.points))
    assert bits_of(made(cls).apply(other)) == bits_of(made(cls).apply(scan))


@every
def test_an_empty_scan_stays_empty_and_gets_the_columns_that_others_get(cls):
    scan = random_scan()
    found = made(cls).apply(scan.select(np.zeros(0, np.int64)))
    expected = made(cls).apply(scan)
    assert len(found) == 0
    assert set(found.columns) == set(expected.columns)
    for name, column in expected.columns.items():
        assert found.columns[name].shape[1:] == column.shape[1:] or name == 'matchedIds'
        assert found.columns[name].dtype == column.dtype


@every
def test_one_point_and_several_at_one_place_are_accepted(cls):
    one = random_scan(1)
    assert len(made(cls).apply(one)) <= 1
    found = made(cls).apply(one.select(np.zeros(40, np.int64)))
    assert len(found) <= 40


@every
@pytest.mark.parametrize('number', [1, 250, 500])
def test_points_that_are_not_finite_lose_no_scan_and_are_counted_where_dropped(cls, number):
    scan = random_scan()
    points = scan.points.copy()
    points[:number] = np.nan
    points[number : 2 * number, 2] = np.inf
    scan = replace(scan, points=points)
    found, (step,) = Chain([made(cls)]).run(scan)
    assert len(found) == step.points_out <= len(scan)
    if issubclass(cls, FiniteFilter):
        assert step.not_finite == min(2 * number, 500)
        expected = made(cls).apply(scan.select(np.arange(2 * number, 500)))
        assert bits_of(found) == bits_of(expected) == bits_of(made(cls).apply(scan))
    else:
        assert step.not_finite == 0


@every
def test_an_array_of_points_stands_for_a_scan(cls):
    points = random_scan(40).points
    try:
        expected = made(cls).apply(Scan(points=points, stamp_ns=0, frame_id=''))
    except FilterError as error:  # a column or a pose is missing
        with pytest.raises(FilterError, match=re.escape(str(error).split("'")[0])):
            made(cls).apply(points)
    else:
        np.testing.assert_array_equal(made(cls).apply(points).points, expected.points)
        doubles = made(cls).apply(points.astype(np.float64)).points
        np.testing.assert_array_equal(Chain([made(cls)]).apply(points.tolist()).points, doubles)


def test_bounds_are_allowed_and_values_beyond_are_refused_by_name():
    faults = []
    for cls, declared in NUMBERS:
        whole = isinstance(declared.default, int)
        for bound, outwards in ((declared.low, -math.inf), (declared.high, math.inf)):
            companions = COMPANIONS.get((cls.name, declared.name), lambda value: {})(bound)
            try:
                found = made(cls, **{declared.name: bound, **companions})
                taken = getattr(found, declared.name) == bound
            except ConfigError:
                taken = (cls.name, declared.name) in JOINT
            if not taken:
                faults.append(f'{cls.name}.{declared.name}: bound {bound} not taken')
            if math.isinf(bound):
                continue
            step = 1 if outwards > 0 else -1
            beyond = bound + step if whole else math.nextafter(bound, outwards)
            message = refusal(made, cls, **{declared.name: beyond})
            if not re.match(rf'{cls.name}: {declared.name}: .*expected a value in \[', message):
                faults.append(f'{cls.name}.{declared.name} = {beyond}: {message}')
    assert faults == []


def test_a_chain_of_all_filters_survives_writing_and_reading():
    chain = Chain(made(cls) for cls in FILTERS)
    assert Chain.from_list(chain.to_list()).filters == chain.filters


def test_a_chain_of_all_can_be_warmed_up():
    Chain(made(cls) for cls in FILTERS).warm_up()
