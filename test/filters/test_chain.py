# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Chains: the YAML that libpointmatcher reads, reports and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.grids import VoxelGrid
from surfel_mapper.filters.limits import BoundingBox
from test.filters.examples import scan_of

MIXED = """\
# comments and flow style work
- RemoveNaNDataPointsFilter
- VoxelGridDataPointsFilter:
    vSizeX: 0.5
    useCentroid: 1
- AddDescriptorDataPointsFilter:
    descriptorName: test
    descriptorDimension: 3
    descriptorValues: [2.2, 3.0, 6.1]
- voxel_grid: {size_x_m: '0.25', vSizeY: 5e-1}
- IdentityDataPointsFilter:
"""


def load(tmp_path, text, keys=''):
    path = tmp_path / 'chain.yaml'
    path.write_text(text, encoding='utf-8')
    return Chain.load(f'{path}{keys}')


def test_a_chain_runs_in_the_order_of_its_list(tmp_path):
    chain = load(tmp_path, MIXED)
    assert chain.names == (
        '1 remove_nan',
        '2 voxel_grid',
        '3 add_descriptor',
        '4 voxel_grid',
        '5 identity',
    )
    assert chain.filters[1] == VoxelGrid(size_x_m=0.5, unit_normals=False, anchor='minimum')
    assert chain.filters[2].values == (2.2, 3.0, 6.1)
    assert chain.filters[3] == VoxelGrid(size_x_m=0.25, size_y_m=0.5)


def test_steps_report_points_and_time_of_each_filter():
    chain = Chain.from_list(['remove_nan', {'bounding_box': {'x_max_m': 5.0}}, 'max_dist'])
    points = [[np.nan, 0.0, 0.0], [0.5, 0.0, 0.0], [7.0, 0.0, 0.0], [0.0, 0.0, -9.0]]
    scan, steps = chain.run(scan_of(points, row=np.arange(4)))
    assert [(step.name, step.points_in, step.points_out) for step in steps] == [
        ('1 remove_nan', 4, 3),
        ('2 bounding_box', 3, 2),
        ('3 max_dist', 2, 0),
    ]
    assert all(step.milliseconds >= 0.0 for step in steps)
    assert (len(scan), list(scan.columns)) == (0, ['row'])


@pytest.mark.parametrize('text', ['', '# nothing\n', '[]', '~'])
def test_an_empty_file_is_a_chain_that_changes_nothing(tmp_path, text):
    chain = load(tmp_path, text) if text != '~' else Chain.from_list(None)
    scan = scan_of([[1.0, 2.0, 3.0]])
    assert len(chain) == 0
    assert chain.apply(scan) is scan


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('- VoxelGridDataPointsFilter: {useCentroid: 2}', "useCentroid: '2', expected 0 or 1"),
        ('- VoxelGridDataPointsFilter: {vSizeX: 0.0005}', r'vSizeX: 0.0005, .*\[0.001, inf\]'),
        ('- VoxelGridDataPointsFilter: {vSize: 1}', 'vSize: no such parameter; did you mean vS'),
        ('- RemoveNaNDataPointsFilter: {a: 1}', r'a: no such parameter .*\(it has none\)'),
        ('- VoxelDataPointsFilter', 'filter 1: VoxelDataPointsFilter: no such filter'),
        ('- MaxPointCountDataPointsFilter: {maxCount: -1}', r'maxCount: -1, .*\[0, 2147483647\]'),
        ('- VoxelGridDataPointsFilter:\n  vSizeX: 1', r'2 keys .*indented deeper'),
        ('- VoxelGridDataPointsFilter: 1', "'1', expected parameters"),
        ('- [VoxelGridDataPointsFilter]', 'expected the name of a filter'),
        ('- {}', '0 keys'),
        ('VoxelGridDataPointsFilter: {}', 'chain.yaml: a mapping, expected a list .*#Voxel'),
        ('just text', 'a str, expected a list of filters'),
        ('- a: [', 'not YAML'),
        ('- range_limit: {min_m: 5, max_m: 1}', 'max_m: 1, expected at least min_m'),
    ],
)
def test_content_that_is_no_chain_is_refused_in_words(tmp_path, text, expected):
    with pytest.raises(ConfigError, match=expected):
        load(tmp_path, text)


def test_the_last_of_repeated_keys_counts(tmp_path):
    chain = load(tmp_path, '- VoxelGridDataPointsFilter: {vSizeX: 1, vSizeX: 2}')
    assert chain.filters[0].size_x_m == 2.0


def test_a_chain_may_stand_under_a_key_of_a_larger_file(tmp_path):
    text = 'icp:\n  readingDataPointsFilters:\n    - RemoveNaNDataPointsFilter\ninput:\n'
    assert load(tmp_path, text, '#icp.readingDataPointsFilters').names == ('1 remove_nan',)
    assert len(load(tmp_path, text, '#input')) == 0
    with pytest.raises(ConfigError, match="no key 'output' there; keys: icp, input"):
        load(tmp_path, text, '#output')
    with pytest.raises(ConfigError, match=r'a mapping, .* write .*#icp.readingDataPointsFilters'):
        load(tmp_path, text, '#icp')


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match=r'none.yaml: cannot be read: No such file'):
        Chain.load(tmp_path / 'none.yaml')
    (tmp_path / 'bytes.yaml').write_bytes(b'\xff\xfe\xfd')
    with pytest.raises(ConfigError, match='not YAML'):
        Chain.load(tmp_path / 'bytes.yaml')


def test_a_filter_that_cannot_work_is_named_with_its_place():
    chain = Chain.from_list(['identity', 'shadow'])
    with pytest.raises(FilterError, match="filter 2 shadow: needs the column 'normals'"):
        chain.apply(scan_of([[1.0, 0.0, 0.0]]))


def test_a_chain_can_be_made_of_filters_and_written_as_a_list():
    chain = Chain([BoundingBox(x_max_m=np.inf)])
    (written,) = chain.to_list()
    assert written['bounding_box']['x_max_m'] == 'inf'
    assert Chain.from_list([written]).filters == chain.filters


def test_a_chain_is_read_from_text():
    chain = Chain.from_yaml("- RemoveNaNDataPointsFilter\n- voxel_grid: {vSizeX: '0.5'}\n")
    assert chain.names == ('1 remove_nan', '2 voxel_grid')
    assert chain.filters[1].size_x_m == 0.5
    assert len(Chain.from_yaml('')) == 0
    with pytest.raises(ConfigError, match='filters: not YAML'):
        Chain.from_yaml('- [')


def test_points_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r'shape \(4, 2\), expected \(N, 3\)'):
        Chain.from_yaml('- voxel_grid').apply(np.zeros((4, 2)))
