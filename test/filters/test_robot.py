# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters for a robot: body box, range by sensor, time slice, labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError, FilterError
from test.filters.examples import filter_of, kept, random_scan, scan_of

NS = 10**18


def rows(name, scan, /, **parameters):
    scan = replace(scan, columns={**scan.columns, 'row': np.arange(len(scan))})
    return filter_of(name, **parameters).apply(scan).columns['row'].tolist()


def test_the_body_box_stands_in_the_frame_of_the_robot():
    # the sensor is 1 m ahead of the robot and 2 m up, and looks to the left
    T_base_sensor = np.array(
        [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0], [0, 0, 0, 1.0]]
    )
    points = [[0.0, 1.0, -2.0], [0.0, 0.0, 0.0], [0.5, 0.5, -2.5], [np.nan, 0, 0], [0, 0, -2.0]]
    scan = replace(scan_of(points), T_base_sensor=T_base_sensor)
    in_base = [(0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (0.5, 0.5, -0.5), None, (1.0, 0.0, 0.0)]
    inside = [i for i, p in enumerate(in_base) if p is not None and max(map(abs, p)) < 1.0]
    assert rows('body_box', scan, remove_inside=False) == inside == [0, 2]
    assert rows('body_box', scan) == [1, 4]  # a face is outside, a nan nowhere


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_a_turned_body_box_keeps_what_numpy_says(dtype):
    rng = np.random.default_rng(2)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, [0.3, -0.2, 1.0]
    scan = replace(random_scan(3000, dtype=dtype), T_base_sensor=pose)
    in_base = scan.points.astype(np.float64) @ rotation.T + pose[:3, 3]
    outside = ~(np.abs(in_base) < 1.0).all(axis=1)
    assert 0 < np.count_nonzero(outside) < 3000
    assert rows('body_box', scan) == np.flatnonzero(outside).tolist()


def test_without_the_place_of_the_sensor_the_body_box_says_how_to_give_it():
    scan = replace(random_scan(3), T_base_sensor=None)
    with pytest.raises(FilterError, match=r"'sensor' on the robot is not known; set frames.base"):
        filter_of('body_box').apply(scan)


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_range_limit_keeps_both_limits(dtype):
    points = np.array(
        [[0.0, 0, 0], [0, 3, 4], [0, 0, 5.001], [6, 0, 8], [0, 10.01, 0], [np.nan, 0, 0]], dtype
    )
    assert kept('range_limit', points, min_m=5.0, max_m=10.0) == [1, 2, 3]
    assert kept('range_limit', points, min_m=0.0, max_m='inf') == [0, 1, 2, 3, 4]


def test_range_limit_may_be_for_one_sensor():
    points = [[50.0, 0.0, 0.0]]
    assert kept('range_limit', points, max_m=10.0, sensor='sensor') == []
    assert kept('range_limit', points, max_m=10.0, sensor='another') == [0]
    with pytest.raises(ConfigError, match=r'max_m: 1, expected at least min_m \(2\)'):
        filter_of('range_limit', min_m=2.0, max_m=1.0)


def sweep(**columns):
    return scan_of(np.zeros((4, 3)), stamp_ns=NS, **columns)


@pytest.mark.parametrize(
    ('column', 'settings'),
    [
        (np.array([0, 20, 50, 70], np.uint32) * 10**6, {}),  # ns since the first point
        (np.array([1.0, 1.02, 1.05, 1.07]), {}),  # s
        (NS + np.array([0, 20, 50, 70]) * 10**6, {}),  # ns since 1970, exact
        (
            NS + np.array([-70, -50, -20, 0]) * 10**6,
            {'since': 'stamp', 'start_s': -0.055, 'end_s': -0.01},
        ),
        (np.array([0, 20, 50, 70], np.uint16), {'unit_s': 1e-3}),
        (np.array([0.0, 20.0, 50.0, 70.0], np.float32), {'unit_s': 1e-3, 'since': 'zero'}),
    ],
)
def test_time_slice_keeps_points_from_a_time_on_until_another(column, settings):
    settings = {'start_s': 0.02, 'end_s': 0.06, **settings}
    scan = sweep(time=column)
    expected = [1, 2]
    assert rows('time_slice', scan, **settings) == expected


def test_time_slice_counts_its_start_in_and_its_end_out():
    scan = sweep(t=np.array([0, 1, 2, 3], np.uint32) * 10**9)
    assert rows('time_slice', scan, start_s=1.0, end_s=3.0) == [1, 2]


def test_time_slice_takes_the_first_usual_column_or_the_one_named():
    scan = sweep(stamps=[0.0, 1.0, 2.0, np.nan])
    assert rows('time_slice', scan, column_name='stamps', start_s=1.0) == [1, 2]
    with pytest.raises(FilterError, match="needs the column 'time'; the points have stamps"):
        filter_of('time_slice').apply(scan)
    with pytest.raises(ConfigError, match='end_s: 1, expected more than start_s'):
        filter_of('time_slice', start_s=1.0, end_s=1.0)


def test_label_mask_drops_or_keeps_points_with_certain_labels():
    scan = sweep(label=np.array([3, 1, 4, 1], np.uint16), object=[1, 2, 1, 2])
    assert rows('label_mask', scan, labels=[1, 9]) == [0, 2]
    assert rows('label_mask', scan, labels='1 4', remove=0) == [1, 2, 3]
    assert rows('label_mask', scan, labels=[2], column_name='object') == [0, 2]
    assert rows('label_mask', scan) == [0, 1, 2, 3]
    with pytest.raises(FilterError, match="needs the column 'class'; the points have label, obj"):
        filter_of('label_mask', column_name='class').apply(scan)
