# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Columns that are taken when asked for: the same as those taken at once, and no earlier."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import select, with_columns, with_points
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.columns import LazyColumns
from surfel_mapper.scan import PointTimes
from test.filters.examples import random_scan, scan_of


class Counting(Mapping):
    """Columns that count how often each is asked for."""

    num_rows = 6

    def __init__(self):
        self.columns = {'a': np.arange(6), 'b': 10.0 * np.arange(6)}
        self.asked = []

    def __getitem__(self, name):
        self.asked.append(name)
        return self.columns[name]

    def __iter__(self):
        return iter(self.columns)

    def __len__(self):
        return len(self.columns)


def test_rows_of_rows_are_taken_once_and_only_when_asked_for():
    counting = Counting()
    scan = replace(scan_of(np.arange(18.0).reshape(6, 3)), columns=counting)
    counting.asked.clear()
    found = select(select(scan, np.arange(6) > 1), np.array([3, 0]))
    assert counting.asked == []
    assert found.columns['b'].tolist() == [50.0, 20.0]
    assert found.columns['b'] is found.columns['b']
    assert counting.asked == ['b']
    np.testing.assert_array_equal(found.points[:, 0], [15.0, 6.0])


def test_names_are_known_without_taking_anything():
    columns = LazyColumns({'a': np.arange(3)}, np.array([1]), 1, {'c': np.ones(1)})
    assert (list(columns), len(columns)) == (['a', 'c'], 2)
    assert 'a' in columns
    assert 'c' in columns
    assert 'd' not in columns
    with pytest.raises(KeyError):
        columns['d']


def test_new_columns_stand_in_place_of_old_ones_of_the_same_name():
    scan = select(scan_of(np.zeros((3, 3)), a=[1, 2, 3], b=[4, 5, 6]), np.array([0, 2]))
    found = with_columns(scan, a=np.array([7, 8]), c=np.array([9, 9]))
    assert {name: column.tolist() for name, column in found.columns.items()} == {
        'a': [7, 8],
        'b': [4, 6],
        'c': [9, 9],
    }
    again = select(found, np.array([1]))
    assert {name: column.tolist() for name, column in again.columns.items()} == {
        'a': [8],
        'b': [6],
        'c': [9],
    }
    assert scan.columns['a'].tolist() == [1, 3]


def test_a_column_of_another_length_is_refused():
    with pytest.raises(FilterError, match=r"column 'a': 2 rows for 3 points"):
        with_columns(scan_of(np.zeros((3, 3))), a=np.zeros(2))
    filtered = select(scan_of(np.zeros((3, 3)), a=[1, 2, 3]), np.array([0]))
    with pytest.raises(ValueError, match='column a: 1 rows'):
        replace(filtered, points=np.zeros((2, 3)))


def test_a_chain_gives_what_taking_at_once_gives():
    scan = random_scan(400)
    steps = [
        {'range_limit': {'max_m': 4.0}},
        'random_sampling',
        'surface_normal',
        {'label_mask': {'labels': [1]}},
        {'max_point_count': {'max_points': 50}},
    ]
    lazy = Chain.from_list(steps).apply(scan)
    at_once = scan
    for step in steps:
        at_once = Chain.from_list([step]).apply(at_once)
        at_once = replace(at_once, columns=dict(at_once.columns))
    assert list(lazy.columns) == list(at_once.columns)
    for name, column in at_once.columns.items():
        np.testing.assert_array_equal(lazy.columns[name], column)


def test_times_of_points_stay_with_them_and_the_message_does_not():
    times = PointTimes(np.array([5, 6, 7]), 5, 7)
    scan = replace(scan_of(np.zeros((3, 3))), times=times, msg='a cloud')
    found = select(scan, np.array([True, False, True]))
    assert found.times.offsets.tolist() == [5, 7]
    assert found.msg is None
    made = with_points(scan, np.zeros((1, 3)), {})
    assert (len(made), made.times, made.msg) == (1, None, None)
    assert with_columns(scan, a=np.zeros(3)).msg == 'a cloud'
