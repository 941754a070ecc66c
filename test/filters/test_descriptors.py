# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters that add or use columns, against values computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError, FilterError
from test.filters.examples import filter_of, scan_of

AXES = np.eye(3)


def test_add_descriptor_gives_every_point_the_value():
    scan = scan_of(np.zeros((2, 3)), test=np.zeros((2, 3)), one=[7.0, 8.0])
    found = filter_of(
        'AddDescriptorDataPointsFilter',
        descriptorName='test',
        descriptorDimension=3,
        descriptorValues='[2.2, 3.0, 6.1]',
    ).apply(scan)
    np.testing.assert_array_equal(found.columns['test'], [[2.2, 3.0, 6.1]] * 2)
    one = filter_of('add_descriptor', column_name='p', values=[0.6]).apply(scan)
    assert (one.columns['p'].tolist(), one.columns['one'].tolist()) == ([0.6, 0.6], [7.0, 8.0])
    with pytest.raises(FilterError, match="column 'test' of 3 components, expected 1"):
        filter_of('add_descriptor', column_name='test', values=[0.6]).apply(scan)


def test_add_descriptor_wants_as_many_values_as_components_and_a_name():
    with pytest.raises(ConfigError, match=r'0 numbers, expected num_components .* = 1'):
        filter_of('AddDescriptorDataPointsFilter')
    with pytest.raises(ConfigError, match=r'column_name \(descriptorName\): empty'):
        filter_of('add_descriptor', column_name='', values=[1])


@pytest.mark.parametrize(('above', 'rows'), [(1, [0, 1]), (0, [1, 2])])
def test_cut_at_descriptor_threshold_keeps_what_equals_it_and_no_nan(above, rows):
    scan = scan_of(np.zeros((4, 3)), p=[[0.5, 9], [0.6, 9], [0.7, 9], [np.nan, 9]], row=range(4))
    found = filter_of(
        'CutAtDescriptorThresholdDataPointsFilter',
        descName='p',
        useLargerThan=above,
        threshold=0.6,
    ).apply(scan)
    assert found.columns['row'].tolist() == rows


def test_a_column_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(FilterError, match="needs the column 'none'; the points have p"):
        filter_of('CutAtDescriptorThresholdDataPointsFilter').apply(
            scan_of(np.zeros((1, 3)), p=[1.0])
        )


def test_observation_directions_point_from_the_points_to_the_sensor():
    scan = scan_of([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    found = filter_of('ObservationDirectionDataPointsFilter', x=1, y=0, z=-1).apply(scan)
    np.testing.assert_array_equal(
        found.columns['observationDirections'], [[0.0, -2.0, -4.0], [1.0, 0.0, -1.0]]
    )


@pytest.mark.parametrize(('toward', 'sign'), [(1, 1.0), (0, -1.0)])
def test_normals_are_turned_to_the_sensor_or_away_and_stay_where_neither_is_meant(toward, sign):
    scan = scan_of(
        np.zeros((3, 3)),
        normals=[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]],
        observationDirections=[[0.0, 0.0, 5.0]] * 3,
    )
    found = filter_of('OrientNormalsDataPointsFilter', towardCenter=toward).apply(scan)
    np.testing.assert_array_equal(
        found.columns['normals'], [[0, 0, sign], [0, 0, sign], [1.0, 0.0, 0.0]]
    )


def test_normals_may_come_as_three_fields():
    scan = scan_of(
        np.zeros((1, 3)),
        normal_x=[0.0],
        normal_y=[-1.0],
        normal_z=[0.0],
        observationDirections=[[0.0, 2.0, 0.0]],
    )
    found = filter_of('orient_normals').apply(scan).columns
    assert set(found) == {'normals', 'observationDirections'}
    np.testing.assert_array_equal(found['normals'], [[0.0, 1.0, 0.0]])


def test_incidence_angles_lie_between_normal_and_direction_to_the_sensor():
    angles = np.radians([0.0, 30.0, 90.0, 180.0])
    towards = 3.0 * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    scan = scan_of(
        np.zeros((5, 3)),
        normals=[[1.0, 0.0, 0.0]] * 5,
        observationDirections=[*towards, [0.0, 0.0, 0.0]],
    )
    found = filter_of('IncidenceAngleDataPointsFilter').apply(scan).columns['incidenceAngles']
    np.testing.assert_allclose(found, [*angles, np.nan], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        ([1.0, 1.0, 1.0], 1.0),  # a ball
        ([0.0, 1.0, 1.0], -1.0),  # a plane
        ([0.0, 0.0, 1.0], 0.0),  # a line
        ([3.0, 4.0, 5.0], 3 / 5 - 4 / 5 * (1 / 5)),
        ([5.0, 4.0, 3.0], 3 / 5 - 4 / 5 * (1 / 5)),  # in any order
        ([0.0, 0.0, 0.0], np.nan),
        ([-1.0, 1.0, 1.0], np.nan),
    ],
)
def test_sphericality_goes_from_a_plane_to_a_ball(values, expected):
    scan = scan_of(np.zeros((1, 3)), eigValues=[values])
    found = filter_of(
        'SphericalityDataPointsFilter', keepUnstructureness=1, keepStructureness=1
    ).apply(scan)
    np.testing.assert_allclose(found.columns['sphericality'], [expected], atol=1e-15)
    parts = found.columns['unstructureness'] - found.columns['structureness']
    np.testing.assert_allclose(parts, [expected], atol=1e-15)
    plain = filter_of('sphericality').apply(scan).columns
    assert set(plain) == {'eigValues', 'sphericality'}


def test_sphericality_wants_three_eigenvalues():
    with pytest.raises(FilterError, match=r'eigValues: shape \(1, 2\), expected \(N, 3\)'):
        filter_of('sphericality').apply(scan_of(np.zeros((1, 3)), eigValues=[[1.0, 2.0]]))


NS = 10**18


def rows_kept(name, scan, /, **parameters):
    scan = replace(scan, columns={**scan.columns, 'row': np.arange(len(scan))})
    return filter_of(name, **parameters).apply(scan).columns['row'].tolist()


def sweep(**columns):
    return scan_of(np.zeros((4, 3)), stamp_ns=NS, **columns)


def test_label_mask_drops_or_keeps_points_with_certain_labels():
    scan = sweep(label=np.array([3, 1, 4, 1], np.uint16), object=[1, 2, 1, 2])
    assert rows_kept('label_mask', scan, labels=[1, 9]) == [0, 2]
    assert rows_kept('label_mask', scan, labels='1 4', remove=0) == [1, 2, 3]
    assert rows_kept('label_mask', scan, labels=[2], column_name='object') == [0, 2]
    assert rows_kept('label_mask', scan) == [0, 1, 2, 3]
    with pytest.raises(FilterError, match="needs the column 'class'; the points have label, obj"):
        filter_of('label_mask', column_name='class').apply(scan)
