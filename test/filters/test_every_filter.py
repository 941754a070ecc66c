# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What holds for every registered filter, whatever it does; new ones are tested at once."""

from __future__ import annotations

from dataclasses import replace
import inspect
import math
import re

import numpy as np
import pytest

from surfel_mapper.config import settings_of
from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.registry import all_filters, find
from test.filters import libpointmatcher
from test.filters.examples import random_scan, scan_of

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
"""Of filters whose defaults do nothing or are refused."""

COMPANIONS = {
    ('add_descriptor', 'num_components'): lambda value: {'values': (0.0,) * min(value, 9)},
    ('range_limit', 'min_m'): lambda value: {'max_m': math.inf},
    ('range_limit', 'max_m'): lambda value: {'min_m': 0.0},
    ('time_slice', 'start_s'): lambda value: {'end_s': math.inf},
    ('time_slice', 'end_s'): lambda value: {'start_s': -math.inf},
    ('field_of_view', 'azimuth_min_deg'): lambda value: {'azimuth_max_deg': value + 1.0},
    ('field_of_view', 'azimuth_max_deg'): lambda value: {'azimuth_min_deg': value - 1.0},
    ('field_of_view', 'elevation_min_deg'): lambda value: {'elevation_max_deg': 90.0},
    ('field_of_view', 'elevation_max_deg'): lambda value: {'elevation_min_deg': -90.0},
}
"""What a parameter at its bounds needs beside it."""

JOINT = {
    ('add_descriptor', 'num_components'),
    ('range_limit', 'min_m'),
    ('time_slice', 'start_s'),
    ('time_slice', 'end_s'),
    ('field_of_view', 'azimuth_min_deg'),
    ('field_of_view', 'azimuth_max_deg'),
}
"""Parameters of which one bound cannot be reached, because another parameter forbids it."""

every = pytest.mark.parametrize('cls', FILTERS, ids=lambda cls: cls.name)


def made(cls, **parameters):
    return cls(**{**SETTINGS.get(cls.name, {}), **parameters})


def ids(value):
    return getattr(value, 'name', None)


def bits_of(scan):
    """Return everything in a scan as bytes."""
    arrays = {'points': scan.points, **scan.columns}
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in arrays.items()}


@every
def test_it_says_in_one_line_what_it_does(cls):
    first = inspect.getdoc(cls).partition('\n')[0]
    assert first.endswith('.')
    assert len(first) <= 97
    assert re.fullmatch(r'[a-z0-9]+(_[a-z0-9]+)*', cls.name)


@pytest.mark.parametrize(('cls', 'declared'), PARAMETERS, ids=ids)
def test_a_parameter_says_what_it_means_and_defaults_to_what_it_allows(cls, declared):
    assert declared.meaning.endswith('.')
    assert re.fullmatch(r'[a-z0-9]+(_[a-z0-9]+)*', declared.name)
    assert bool(cls.libpointmatcher) or not declared.libpointmatcher
    if isinstance(declared.default, (int, float)):
        assert declared.low <= declared.default <= declared.high
        assert declared.low <= declared.libpointmatcher_default <= declared.high


@pytest.mark.parametrize('name', libpointmatcher.FILTERS)
def test_every_filter_of_libpointmatcher_is_there_with_its_parameters(name):
    cls = find(f'{name}DataPointsFilter')
    found = {
        declared.libpointmatcher: declared
        for declared in settings_of(cls)
        if declared.libpointmatcher
    }
    expected = libpointmatcher.FILTERS[name]
    assert set(found) == set(expected)
    for parameter, (default, low, high) in expected.items():
        declared = found[parameter]
        assert (type(declared.default), declared.libpointmatcher_default) == (
            type(default),
            default,
        )
        if isinstance(default, (int, float)) and not isinstance(default, bool):
            low, high = libpointmatcher.NARROWER.get((name, parameter), (low, high))
            if low is not None:
                assert (declared.low, declared.high) == (low, high)


@every
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_it_leaves_what_comes_in_as_it_is_and_keeps_the_type(cls, dtype):
    scan = random_scan(dtype=dtype)
    before = bits_of(scan)
    found = made(cls).apply(scan)
    assert bits_of(scan) == before
    assert found.points.dtype == dtype
    assert (found.stamp_ns, found.frame_id) == (scan.stamp_ns, scan.frame_id)
    assert found.T_base_sensor is scan.T_base_sensor
    assert all(len(column) == len(found) for column in found.columns.values())


MAKE_POINTS = {'voxel_grid', 'remove_sensor_bias'}
"""Those whose points are not among those of the scan."""


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


@every
def test_the_same_scan_always_gives_the_same(cls):
    assert bits_of(made(cls).apply(random_scan())) == bits_of(made(cls).apply(random_scan()))


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
def test_one_point_or_several_at_one_place_are_taken(cls):
    one = random_scan(1)
    assert len(made(cls).apply(one)) <= 1
    found = made(cls).apply(one.select(np.zeros(40, np.int64)))
    assert len(found) <= 40


@every
@pytest.mark.parametrize('number', [1, 250, 500])
def test_points_that_are_not_finite_are_handled_or_refused_in_words(cls, number):
    scan = random_scan()
    points = scan.points.copy()
    points[:number] = np.nan
    points[number : 2 * number, 2] = np.inf
    try:
        found = made(cls).apply(replace(scan, points=points))
    except FilterError as error:
        refusal = str(error)
    else:
        refusal = ''
        assert len(found) <= len(scan)
    assert not refusal or 'nan or infinite' in refusal


@every
def test_what_it_leaves_can_be_filtered_again(cls):
    again = made(cls).apply(made(cls).apply(random_scan()))
    assert len(again) <= 500


@pytest.mark.parametrize(('cls', 'declared'), NUMBERS, ids=ids)
def test_a_bound_is_allowed_and_what_lies_beyond_is_not(cls, declared):
    whole = isinstance(declared.default, int)
    for bound, outwards in ((declared.low, -math.inf), (declared.high, math.inf)):
        companions = COMPANIONS.get((cls.name, declared.name), lambda value: {})(bound)
        try:
            found = made(cls, **{declared.name: bound, **companions})
            assert getattr(found, declared.name) == bound
        except ConfigError:
            assert (cls.name, declared.name) in JOINT
        if math.isfinite(bound):
            step = 1 if outwards > 0 else -1
            beyond = bound + step if whole else math.nextafter(bound, outwards)
            message = rf'^{cls.name}: {declared.name}: .*expected a value in \['
            with pytest.raises(ConfigError, match=message):
                made(cls, **{declared.name: beyond})


@pytest.mark.parametrize(('cls', 'declared'), NUMBERS, ids=ids)
@pytest.mark.parametrize('value', ['many', None, True, [1.0], {}, math.nan, 'nan', '1_0', ''])
def test_what_is_no_number_is_refused_by_name(cls, declared, value):
    with pytest.raises(ConfigError, match=f'^{cls.name}: {declared.name}: .*expected a'):
        made(cls, **{declared.name: value})


@every
def test_a_parameter_that_it_does_not_have_is_refused(cls):
    with pytest.raises(ConfigError, match=f'filter 1, {cls.name}: no_such: no such parameter'):
        Chain.from_list([{cls.name: {**SETTINGS.get(cls.name, {}), 'no_such': 1}}])


@every
def test_a_chain_can_be_written_and_read_back(cls):
    chain = Chain([made(cls)])
    assert Chain.from_list(chain.to_list()).filters == chain.filters


@every
def test_it_cannot_be_changed_in_place(cls):
    found = made(cls)
    for declared in settings_of(cls):
        with pytest.raises(AttributeError):
            setattr(found, declared.name, declared.default)


def test_a_chain_of_all_can_be_warmed_up():
    Chain(made(cls) for cls in FILTERS).warm_up()


def test_scans_without_the_columns_needed_are_refused_with_what_they_have():
    needy = [cls for cls in FILTERS if cls.name in {'shadow', 'max_density', 'orient_normals'}]
    assert len(needy) == 3
    for cls in needy:
        with pytest.raises(FilterError, match=r'needs the column .*; the points have intensity'):
            cls().apply(scan_of(np.zeros((2, 3)), intensity=[1.0, 2.0]))
