# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Columns: taken lazily, and merged by their kind when several points become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import select, with_columns, with_points
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.merging import merged_columns, PointGroups
from surfel_mapper.scan import PointTimes
from test.filters.examples import random_scan, scan_of


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


GROUPS = PointGroups.of(np.array([1, 0, 1, 0, 1]), 2)


def merged(column, **settings):
    scan = scan_of(np.zeros((5, 3)), **{settings.pop('name', 'value'): column})
    (found,) = merged_columns(scan.columns, GROUPS, **settings).values()
    assert found.dtype == np.asarray(column).dtype
    return found


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_numbers_are_averaged(dtype):
    assert merged(np.array([1, 2, 3, 5, 8], dtype)).tolist() == [3.5, 4.0]
    many = np.arange(10, dtype=dtype).reshape(5, 2)
    np.testing.assert_array_equal(merged(many), [[4.0, 5.0], [4.0, 5.0]])


@pytest.mark.parametrize('dtype', [np.uint8, np.int16, np.uint32, np.int32])
def test_whole_numbers_are_averaged_and_rounded(dtype):
    assert merged(np.array([1, 2, 2, 5, 2], dtype)).tolist() == [4, 2]  # 3.5 to even, 5/3


def test_booleans_are_true_if_half_of_them_are():
    assert merged(np.array([True, True, False, False, False])).tolist() == [True, False]


def test_labels_and_other_identities_are_the_first():
    values = np.array([7, 1, 8, 2, 9], np.int32)
    for name in ('label', 'ring', 'instance', 'matchedIds'):
        assert merged(values, name=name).tolist() == [1, 7]
    assert merged(np.array(list('abcde'))).tolist() == ['b', 'a']


def test_stamps_are_averaged_exactly_and_towards_zero():
    epoch = 1_700_000_000_000_000_000
    values = np.array([epoch, epoch + 1, epoch + 1, epoch + 4, epoch + 4], np.int64)
    assert merged(values).tolist() == [epoch + 2, epoch + 1]  # 5/2, 5/3
    assert merged(-values).tolist() == [-epoch - 2, -epoch - 1]
    assert merged(values.astype(np.uint64)).tolist() == [epoch + 2, epoch + 1]


def test_seven_stamps_do_not_overflow():
    scan = scan_of(np.zeros((7, 3)), times=np.full(7, 2**62, np.int64))
    found = merged_columns(scan.columns, PointGroups.of(np.zeros(7, np.int64), 1))['times']
    assert found.tolist() == [2**62]


def test_normals_are_averaged_as_directions():
    normals = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, -1], [1, 0, 0]], np.float64)
    found = merged(normals, name='normals')
    np.testing.assert_allclose(found[1], np.array([2.0, 1.0, 0.0]) / 5**0.5)
    np.testing.assert_array_equal(found[0], [0.0, 0.0, 1.0])  # opposite ones cancel: the first
    plain = merged(normals, name='normals', unit=False)
    np.testing.assert_allclose(plain, [[0, 0, 0], [2 / 3, 1 / 3, 0]])


def test_colours_are_averaged_by_channel():
    red, blue = 0x00FF0000, 0x000000FF
    values = np.array([0, red, 0, blue, 0x00030000], np.uint32)
    assert merged(values, name='rgb').tolist() == [0x00800080, 0x00010000]
    packed = values.view(np.float32)
    assert merged(packed, name='rgb').view(np.uint32).tolist() == [0x00800080, 0x00010000]


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.int32])
def test_unpacked_colours_are_averaged_and_rounded(dtype):
    values = np.array([[254, 0], [1, 7], [255, 0], [2, 7], [255, 1]], dtype)
    assert merged(values, name='rgb').tolist() == [[2, 7], [255, 0]]  # 3/2 to even, 764/3, 1/3


def test_no_points_leave_no_rows():
    scan = scan_of(np.zeros((0, 3)), value=np.zeros((0, 4)), times=np.zeros(0, np.int64))
    found = merged_columns(scan.columns, PointGroups.of(np.zeros(0, np.int64), 0))
    assert (found['value'].shape, found['times'].shape) == ((0, 4), (0,))
