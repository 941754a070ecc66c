# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Colours have one form, whatever the file; columns without names get those that they can have."""

import numpy as np
import pytest

from surfel_mapper.files import pcd, ply
from surfel_mapper.files.point_columns import named_columns
from surfel_mapper.files.scan_files import read_scan

POINTS = np.random.default_rng(1).normal(size=(4, 3)).astype('f4')
BYTES = np.array([[0, 255, 7], [255, 0, 128], [1, 2, 3], [200, 100, 50]], 'u1')
XYZ = dict(zip('xyz', POINTS.T, strict=True))
PLAIN = ('red', 'green', 'blue')


@pytest.mark.parametrize(
    ('names', 'type_', 'factor'),
    [
        (PLAIN, 'u1', 1.0),
        (PLAIN, 'f4', 1 / 255),
        (PLAIN, 'f8', 1 / 255),
        (PLAIN, 'u2', 257.0),
        (PLAIN, 'u2', 1.0),
        ([f'diffuse_{name}' for name in PLAIN], 'u1', 1.0),
        ('rgb', 'u1', 1.0),
    ],
)
@pytest.mark.parametrize('module', [ply, pcd])
def test_every_form_of_colour_becomes_bytes(tmp_path, module, names, type_, factor):
    path = tmp_path / f'a.{module.__name__[-3:]}'
    channels = (BYTES * factor).astype(type_)
    module.write_points(path, {**XYZ, **dict(zip(names, channels.T, strict=True))})

    _, columns = read_scan(path)

    assert columns['rgb'].dtype == np.uint8
    np.testing.assert_array_equal(columns['rgb'], BYTES)
    assert list(columns) == ['rgb']


@pytest.mark.parametrize('type_', ['f4', 'u4', 'i4'])
@pytest.mark.parametrize('name', ['rgb', 'rgba'])
def test_packed_colours_of_pcd_become_bytes(tmp_path, name, type_):
    packed = (BYTES.astype('u4') * (65536, 256, 1)).sum(axis=1).astype('u4')
    pcd.write_points(tmp_path / 'a.pcd', {**XYZ, name: packed.view(type_)})

    np.testing.assert_array_equal(read_scan(tmp_path / 'a.pcd')[1]['rgb'], BYTES)


def test_colours_of_pcd_are_packed_for_pcl(tmp_path):
    pypcd4 = pytest.importorskip('pypcd4')
    colours = dict(zip(PLAIN, BYTES.T, strict=True))
    pcd.write_points(tmp_path / 'a.pcd', {**XYZ, **colours})

    cloud = pypcd4.PointCloud.from_path(tmp_path / 'a.pcd')

    assert cloud.fields == ('x', 'y', 'z', 'rgb')
    found = pypcd4.PointCloud.decode_rgb(cloud.pc_data['rgb'])
    np.testing.assert_array_equal(found, BYTES)


@pytest.mark.parametrize(
    ('further', 'names'),
    [
        ([[0.5], [7.0]], ['intensity']),
        ([[0.5, 3.0], [7.0, 4.0]], ['intensity', 'ring']),
        ([[0.5, 3.0], [7.0, -1.0]], ['intensity', 'column_4']),
        ([[0.0, 255.0, 3.0], [7.0, 4.0, 5.0]], list(PLAIN)),
        ([[0.0, 1.0, 0.5], [0.1, 0.2, 0.3]], list(PLAIN)),
        ([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0]], ['nx', 'ny', 'nz']),
        ([[0.5, 255.0, 3.0, 9.0], [7.0, 4.0, 5.0, 6.0]], ['intensity', *PLAIN]),
        ([[255.0, 3.0, 9.0, 0.5], [4.0, 5.0, 6.0, -0.5]], [*PLAIN, 'column_6']),
    ],
)
def test_columns_without_names_get_those_that_they_can_have(further, names):
    table = np.column_stack([POINTS[:2], further])

    assert list(named_columns(table)) == ['x', 'y', 'z', *names]
