# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""pypcd4 reads PCD files back equal, its files of every encoding read here; damage is refused."""

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.pcd import (
    ORIGIN,
    read_points,
    read_viewpoint,
    write_points,
    write_surfels,
)
from surfel_mapper.mapping.surfels import QUALITY


@pytest.fixture(scope='module')
def pypcd4():
    return pytest.importorskip('pypcd4', reason='pypcd4 is not installed (extra test)')


def some_surfels(columns=()):
    rng = np.random.default_rng(7)
    surfel_map = SurfelMap(0.5, columns=columns)
    points = rng.uniform(-6.0, 6.0, (4000, 3)) * [1.0, 1.0, 0.05]
    values = {'intensity': rng.uniform(0, 255, 4000), 'rgb': rng.integers(0, 256, (4000, 3))}
    surfel_map.add(points, origin=[0.0, 0.0, 3.0], columns=values)
    return surfel_map.surfels()


def test_surfels_are_read_back_equal_by_pypcd4(pypcd4, tmp_path):
    surfels = some_surfels(('intensity', 'rgb'))
    write_surfels(tmp_path / 'map.pcd', surfels)

    cloud = pypcd4.PointCloud.from_path(tmp_path / 'map.pcd')

    assert cloud.fields == (
        'x',
        'y',
        'z',
        'normal_x',
        'normal_y',
        'normal_z',
        'curvature',
        'planarity',
        'num_points',
        *QUALITY,
        'intensity',
        'rgb',
    )
    for name in QUALITY:
        expected = getattr(surfels, name).astype(cloud.pc_data[name].dtype)
        np.testing.assert_array_equal(cloud.pc_data[name], expected)
    for axis, name in enumerate('xyz'):
        np.testing.assert_array_equal(cloud.pc_data[name], surfels.position[:, axis].astype('f4'))
        normal = surfels.normal[:, axis].astype('f4')
        np.testing.assert_array_equal(cloud.pc_data[f'normal_{name}'], normal)
    np.testing.assert_array_equal(cloud.pc_data['num_points'], surfels.num_points)
    np.testing.assert_array_equal(cloud.pc_data['planarity'], surfels.planarity.astype('f4'))
    red = cloud.pc_data['rgb'].view(np.uint32) >> 16
    np.testing.assert_array_equal(red, np.rint(surfels.channels['red']))


def test_surfels_are_read_back_equal_here(tmp_path):
    surfels = some_surfels()
    write_surfels(tmp_path / 'map.pcd', surfels)

    found = read_points(tmp_path / 'map.pcd')

    np.testing.assert_array_equal(found['x'], surfels.position[:, 0].astype('f4'))
    assert found['num_points'].dtype == np.uint32


@pytest.mark.parametrize('encoding', ['ascii', 'binary', 'binary_compressed'])
def test_files_of_pypcd4_read_equal(pypcd4, tmp_path, encoding):
    rng = np.random.default_rng(2)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    points[3] = np.nan
    ring, stamp = rng.integers(0, 128, 500), np.arange(500) * 1e-4 + 1.7e9
    columns = [*points.T, ring.astype('u2'), stamp]
    cloud = pypcd4.PointCloud.from_points(
        columns, ('x', 'y', 'z', 'ring', 'stamp'), (*[np.float32] * 3, np.uint16, np.float64)
    )
    cloud.save(tmp_path / 'a.pcd', pypcd4.Encoding(encoding))

    found = read_points(tmp_path / 'a.pcd')

    tolerance = 1e-6 if encoding == 'ascii' else 0.0  # pypcd4 writes ten digits
    for axis, name in enumerate('xyz'):
        np.testing.assert_allclose(found[name], points[:, axis], rtol=tolerance)
    np.testing.assert_array_equal(found['ring'], ring)
    np.testing.assert_allclose(found['stamp'], stamp, rtol=tolerance)
    assert found['stamp'].dtype == np.float64


def test_fields_of_several_numbers_and_padding_read(tmp_path):
    layout = [('x', '<f4'), ('a', 'u1', (2,)), ('b', '<f4', (33,)), ('c', 'u1', (1,))]
    table = np.zeros(3, layout)
    table['x'], table['b'] = [1, 2, 3], np.arange(99).reshape(3, 33)
    header = (
        '# .PCD v0.7\nVERSION 0.7\nFIELDS x _ fpfh _\nSIZE 4 1 4 1\nTYPE F U F U\n'
        'COUNT 1 2 33 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n'
    )
    (tmp_path / 'a.pcd').write_bytes(header.encode() + table.tobytes())

    found = read_points(tmp_path / 'a.pcd')

    np.testing.assert_array_equal(found['x'], [1, 2, 3])
    np.testing.assert_array_equal(found['fpfh'], np.arange(99).reshape(3, 33))


def test_the_number_of_points_may_be_that_of_the_rows(tmp_path):
    header = HEADER.replace('POINTS 2\n', '')
    (tmp_path / 'a.pcd').write_bytes(f'{header}DATA ascii\n1\n2\n'.encode())
    assert read_points(tmp_path / 'a.pcd')['x'].tolist() == [1.0, 2.0]


@pytest.mark.parametrize('num_zeros', [1, 12, 3906, 4096])
def test_zeros_up_to_a_page_may_follow_the_points(tmp_path, num_zeros):
    content = HEADER.encode() + b'DATA binary\n' + np.array([1, 2], '<f4').tobytes()
    (tmp_path / 'a.pcd').write_bytes(content + bytes(num_zeros))
    np.testing.assert_array_equal(read_points(tmp_path / 'a.pcd')['x'], [1, 2])


HEADER = 'VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n'
UNSIZED = HEADER.replace('WIDTH 2', 'WIDTH 0')


@pytest.mark.parametrize(
    ('content', 'says'),
    [
        ('', 'not a PCD file'),
        ('x' * 10**6, 'not a PCD file'),
        (HEADER + 'DATA binary\n1234567', '7 bytes after the header, expected 8'),
        (HEADER + 'DATA binary\n' + '\0' * 8 + '1234', 'is its header damaged'),
        (HEADER + 'DATA binary\n' + '\0' * 4105, 'is its header damaged'),
        (HEADER + 'DATA ascii\n1\n', '1 rows, expected 2 points'),
        (HEADER.replace('WIDTH 2', 'WIDTH 3') + 'DATA ascii\n1\n2\n', 'WIDTH 3, HEIGHT 1'),
        (HEADER + 'DATA packed\n', 'DATA packed, expected'),
        (HEADER + 'DATA binary_compressed\n1234', 'truncated'),
        (HEADER + 'DATA binary_compressed\n\x02\0\0\0\x08\0\0\0ab', 'damaged'),
        (HEADER + 'DATA binary_compressed\n\x02\0\0\0\x08\0\0\1ab', 'expected 8'),
        (HEADER.replace('SIZE 4', 'SIZE 3') + 'DATA binary\n', 'field x of type F, size 3'),
        (HEADER.replace('TYPE F', 'TYPE Q') + 'DATA binary\n', 'inconsistent PCD header'),
        (HEADER.replace('COUNT 1', 'COUNT 0') + 'DATA binary\n', 'count 0'),
        (UNSIZED.replace('POINTS 2', 'POINTS -2') + 'DATA binary\n', '-2 points'),
        (HEADER.replace('FIELDS', 'COLUMNS') + 'DATA binary\n', "header: no 'FIELDS'"),
        (HEADER + 'DATA ascii\n1,2\n', 'could not convert string .*'),
        (HEADER.replace('FIELDS x', 'FIELDS x x') + 'DATA binary\n', 'inconsistent PCD header'),
    ],
)
def test_truncated_and_inconsistent_files_are_refused(tmp_path, content, says):
    (tmp_path / 'bad.pcd').write_bytes(content.encode('latin-1'))

    with pytest.raises(FileFormatError, match=rf'bad\.pcd: .*{says}'):
        read_points(tmp_path / 'bad.pcd')


@pytest.mark.parametrize('name', ['a b', 'a\nend_header', '\x1b[31m', 'é', ''])
def test_a_name_that_would_change_the_header_is_refused(tmp_path, name):
    columns = {'x': np.zeros(1), name: np.zeros(1)}
    with pytest.raises(FileFormatError, match='expected ASCII without spaces'):
        write_points(tmp_path / 'a.pcd', columns)
    assert not list(tmp_path.iterdir())


def test_the_viewpoint_is_kept(tmp_path):
    place = (400000.125, -2.5, 3.0, 0.8, 0.0, 0.0, 0.6)
    write_points(tmp_path / 'a.pcd', {'x': np.zeros(1)}, place)

    assert read_viewpoint(tmp_path / 'a.pcd') == place


@pytest.mark.parametrize('words', ['', '0 0 0 0 0 0 0', '1 2 3', 'nan 0 0 1 0 0 0'])
def test_a_viewpoint_that_is_no_pose_is_the_origin(tmp_path, words):
    write_points(tmp_path / 'a.pcd', {'x': np.zeros(1)})
    content = (tmp_path / 'a.pcd').read_bytes()
    changed = content.replace(b'VIEWPOINT 0 0 0 1 0 0 0', f'VIEWPOINT {words}'.encode())
    (tmp_path / 'a.pcd').write_bytes(changed)

    assert read_viewpoint(tmp_path / 'a.pcd') == ORIGIN
