# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""PLY files are read back equal, by this package and by plyfile; damage is named."""

import struct

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.mesh_ply import write_mesh
from surfel_mapper.files.ply import read_mesh, read_points, write_points, write_surfels
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.tsdf.mesh import EMPTY, Mesh
from test.messages.examples import make_surfels

QUALITY = ('thickness', 'normal_sigma', 'radius', 'num_scans', 'size')
COVARIANCE = ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz')
NAMES = [*'xyz', 'nx', 'ny', 'nz', 'planarity', 'curvature', 'num_points', *QUALITY, *COVARIANCE]


def assert_equals_surfels(columns, surfels):
    places = np.stack([columns[n] for n in 'xyz'], 1)
    np.testing.assert_array_equal(places, surfels.position.astype(places.dtype))
    normal = np.stack([columns[n] for n in ('nx', 'ny', 'nz')], 1)
    np.testing.assert_array_equal(normal, surfels.normal.astype(np.float32))
    for name in ('planarity', 'curvature', 'thickness', 'normal_sigma', 'radius', 'size'):
        np.testing.assert_array_equal(columns[name], getattr(surfels, name).astype(np.float32))
    for name in ('num_points', 'num_scans'):
        np.testing.assert_array_equal(columns[name], getattr(surfels, name))
    for name, values in zip(COVARIANCE, surfels.covariance.T, strict=True):
        np.testing.assert_array_equal(columns[name], values.astype(np.float32))


def test_a_file_is_a_text_header_and_a_little_endian_table(tmp_path):
    surfels = make_surfels(1)
    write_surfels(tmp_path / 'map.ply', surfels)
    header = (
        b'ply\nformat binary_little_endian 1.0\ncomment surfel_mapper, metres\n'
        b'element vertex 1\nproperty float x\nproperty float y\nproperty float z\n'
        b'property float nx\nproperty float ny\nproperty float nz\n'
        b'property float planarity\nproperty float curvature\nproperty uint num_points\n'
        b'property float thickness\nproperty float normal_sigma\nproperty float radius\n'
        b'property uint num_scans\nproperty float size\n'
        b'property float cov_xx\nproperty float cov_xy\nproperty float cov_xz\n'
        b'property float cov_yy\nproperty float cov_yz\nproperty float cov_zz\n'
        b'end_header\n'
    )
    row = struct.pack(
        '<8fI3fI7f',
        *surfels.position[0],
        *surfels.normal[0],
        surfels.planarity[0],
        surfels.curvature[0],
        surfels.num_points[0],
        *(getattr(surfels, name)[0] for name in QUALITY),
        *surfels.covariance[0],
    )
    assert (tmp_path / 'map.ply').read_bytes() == header + row


@pytest.mark.parametrize('number', [0, 1, 1000])
def test_surfels_come_back_equal(tmp_path, number):
    surfels = make_surfels(number, centre=(5e6, -4e5, 100.0))
    write_surfels(tmp_path / 'map.ply', surfels)
    columns = read_points(tmp_path / 'map.ply')
    assert list(columns) == NAMES
    assert_equals_surfels(columns, surfels)


def test_plyfile_reads_the_same(tmp_path):
    plyfile = pytest.importorskip('plyfile')
    surfels = make_surfels(100, centre=(5e6, -4e5, 100.0))
    write_surfels(tmp_path / 'map.ply', surfels)
    vertex = plyfile.PlyData.read(tmp_path / 'map.ply')['vertex']
    assert [p.name for p in vertex.properties] == NAMES
    assert_equals_surfels(vertex, surfels)


@pytest.mark.parametrize('order', ['<', '>'])
def test_files_of_plyfile_are_read(tmp_path, order):
    plyfile = pytest.importorskip('plyfile')
    dtype = [('x', 'f4'), ('ring', 'u2'), ('t', 'f8'), ('a', 'i1'), ('b', 'u1'), ('c', 'i4')]
    table = np.array([(1.5, 2, 3.25, -4, 5, -6), (-1.5, 65535, 1e300, 7, 255, 9)], dtype)
    elements = [
        plyfile.PlyElement.describe(table, 'vertex'),
        plyfile.PlyElement.describe(np.array([([0, 1, 0],)], [('v', 'i4', (3,))]), 'face'),
    ]
    plyfile.PlyData(elements, byte_order=order, comments=['c'], obj_info=['i']).write(
        tmp_path / 'points.ply'
    )
    columns = read_points(tmp_path / 'points.ply')
    assert list(columns) == [name for name, _ in dtype]
    for name in columns:
        assert columns[name].dtype == table.dtype[name]
        np.testing.assert_array_equal(columns[name], table[name])


def test_columns_of_every_type_come_back_equal(tmp_path):
    kinds = ['i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8', '>f4']
    columns = {f'c{i}': np.arange(5).astype(kind) for i, kind in enumerate(kinds)}
    write_points(tmp_path / 'points.ply', columns)
    back = read_points(tmp_path / 'points.ply')
    assert list(back) == list(columns)
    for name in columns:
        assert back[name].dtype == columns[name].dtype.newbyteorder('=')
        np.testing.assert_array_equal(back[name], columns[name])


HEADER = 'ply\nformat binary_little_endian 1.0\n'


@pytest.mark.parametrize(
    ('content', 'expected'),
    [
        ('', 'not a PLY file'),
        (HEADER + 'element vertex 1\nproperty float x\n', 'not a PLY file'),
        (HEADER + 'end_header\n', 'no elements, expected'),
        (HEADER + 'element vertex 1\nend_header\n', 'of 0 properties'),
        (
            HEADER + 'element vertex 1\nproperty list uchar int x\nend_header\n',
            'at least one number',
        ),
        (HEADER + 'element vertex -1\nproperty float x\nend_header\n', '-1 x vertex'),
        (HEADER + 'element face 1\nproperty float x\nend_header\n', '1 x face'),
        ('ply\nformat latin 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n', 'a PLY'),
        (
            'ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n',
            '1 rows, expected 2 points',
        ),
        (
            'ply\nformat binary_big_endian 2.0\nelement vertex 1\nproperty int x\nend_header\n',
            'version 2.0',
        ),
        (
            HEADER + 'element vertex 2\nproperty float x\nend_header\n1234567',
            '7 bytes after the header, expected 8 for 2 vertices',
        ),
        (
            HEADER + 'element vertex 2\nproperty float x\nend_header\n123456789012',
            '12 bytes after the header, expected 8',
        ),
        (HEADER + f'element vertex {10**30}\nproperty double x\nend_header\n', 'truncated'),
    ],
)
def test_truncated_and_inconsistent_files_are_refused(tmp_path, content, expected):
    path = tmp_path / 'bad.ply'
    path.write_bytes(content.encode())
    with pytest.raises(FileFormatError, match=rf'bad\.ply: .*{expected}'):
        read_points(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileFormatError, match=r'absent\.ply: cannot be read: No such file'):
        read_points(tmp_path / 'absent.ply')


def test_scans_of_real_lidars_are_read_like_plyfile_reads_them(data_folder):
    plyfile = pytest.importorskip('plyfile')
    paths = sorted((data_folder / 'data/scans').glob('*.ply'))
    assert paths
    for path in paths:
        columns, vertex = read_points(path), plyfile.PlyData.read(path)['vertex']
        assert list(columns) == [p.name for p in vertex.properties]
        for name, values in columns.items():
            np.testing.assert_array_equal(values, vertex[name])


def test_intensity_and_colour_are_written_if_the_map_has_them(tmp_path):
    plyfile = pytest.importorskip('plyfile')
    surfel_map = SurfelMap(0.5, columns=('intensity', 'rgb'))
    columns = {'intensity': np.array([1.0, 2.0]), 'rgb': np.array([[255, 0, 7], [255, 1, 7]])}
    surfel_map.add([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1]], columns=columns)
    write_surfels(tmp_path / 'map.ply', surfel_map.surfels())
    vertex = plyfile.PlyData.read(tmp_path / 'map.ply')['vertex']
    assert vertex['intensity'].tolist() == [1.5]
    assert [vertex[name].tolist() for name in ('red', 'green', 'blue')] == [[255], [0], [7]]
    assert vertex['red'].dtype == np.uint8


def test_an_ascii_file_of_plyfile_reads_like_its_binary(tmp_path):
    plyfile = pytest.importorskip('plyfile')
    rows = [(1.5, -2.25, 7), (np.nan, 1e30, 255)]
    table = np.array(rows, [('x', 'f4'), ('y', 'f8'), ('ring', 'u1')])
    found = []
    for name, text in (('text.ply', True), ('binary.ply', False)):
        vertices = plyfile.PlyElement.describe(table, 'vertex')
        plyfile.PlyData([vertices], text=text).write(str(tmp_path / name))
        found.append(read_points(tmp_path / name))

    for name in table.dtype.names:
        assert found[0][name].dtype == found[1][name].dtype
        np.testing.assert_array_equal(found[0][name], found[1][name])


@pytest.mark.parametrize('colored', [False, True])
def test_a_mesh_is_read_back_by_plyfile(tmp_path, colored):
    rng = np.random.default_rng(4)
    mesh = Mesh(
        vertices=rng.normal(scale=1e5, size=(30, 3)),
        triangles=rng.integers(0, 30, (50, 3)).astype(np.int32),
        colors=rng.integers(0, 256, (30 * colored, 3)).astype(np.uint8),
    )
    write_mesh(tmp_path / 'mesh.ply', mesh)
    plyfile = pytest.importorskip('plyfile')
    found = plyfile.PlyData.read(tmp_path / 'mesh.ply')
    for axis, name in enumerate('xyz'):
        assert found['vertex'][name].tolist() == mesh.vertices[:, axis].tolist()
    assert np.array_equal(np.stack(found['face']['vertex_indices']), mesh.triangles)
    names = [p.name for p in found['vertex'].properties]
    assert names == ['x', 'y', 'z', *(['red', 'green', 'blue'] if colored else [])]
    if colored:
        assert found['vertex']['green'].tolist() == mesh.colors[:, 1].tolist()


def test_an_empty_mesh_gives_an_empty_file(tmp_path):
    write_mesh(tmp_path / 'mesh.ply', EMPTY)
    plyfile = pytest.importorskip('plyfile')
    found = plyfile.PlyData.read(tmp_path / 'mesh.ply')
    assert len(found['vertex'].data) == len(found['face'].data) == 0


@pytest.mark.parametrize('name', ['a b', 'a\nend_header', '\x1b[31m', 'é', ''])
def test_a_name_that_would_change_the_header_is_refused(tmp_path, name):
    columns = {'x': np.zeros(1), name: np.zeros(1)}
    with pytest.raises(FileFormatError, match='expected ASCII without spaces'):
        write_points(tmp_path / 'a.ply', columns)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('text', [True, False])
@pytest.mark.parametrize('lengths', [(2, 2, 2), (0, 3, 1)])
def test_lists_among_vertices_and_elements_around_them_are_left_out(tmp_path, text, lengths):
    plyfile = pytest.importorskip('plyfile')
    rows = [(1.5, np.arange(n, dtype='f8'), 7 + n, -2.5) for n in lengths]
    table = np.array(rows, [('x', 'f4'), ('descriptor', 'O'), ('ring', 'u1'), ('y', 'f8')])
    camera = np.array([(1.0, 2.0)], [('view_px', 'f4'), ('view_py', 'f4')])
    describe = plyfile.PlyElement.describe
    elements = [
        describe(camera, 'camera'),
        describe(table, 'vertex', len_types={'descriptor': 'u1'}, val_types={'descriptor': 'f8'}),
        describe(np.array([([0, 1, 2],)], [('vertex_indices', 'i4', (3,))]), 'face'),
    ]
    plyfile.PlyData(elements, text=text).write(str(tmp_path / 'a.ply'))

    columns = read_points(tmp_path / 'a.ply')

    assert {name: values.tolist() for name, values in columns.items()} == {
        'x': [1.5] * 3,
        'ring': [7 + n for n in lengths],
        'y': [-2.5] * 3,
    }
    assert columns['ring'].dtype == np.uint8


def test_lists_of_big_endian_files_are_skipped(tmp_path):
    head = 'ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty float x\n'
    rows = struct.pack('>fB2hd', 1.5, 2, 3, 4, -2.5) + struct.pack('>fB1hd', 2.5, 1, 3, 0.125)
    content = f'{head}property list uchar short d\nproperty double y\nend_header\n'.encode()
    (tmp_path / 'a.ply').write_bytes(content + rows)

    columns = read_points(tmp_path / 'a.ply')

    assert columns['x'].tolist() == [1.5, 2.5]
    assert columns['y'].tolist() == [-2.5, 0.125]


@pytest.mark.parametrize('text', [True, False])
def test_faces_of_any_number_of_corners_become_triangles(tmp_path, text):
    plyfile = pytest.importorskip('plyfile')
    vertices = np.array([(k, 0, 0) for k in range(5)], [(axis, 'f4') for axis in 'xyz'])
    faces = np.empty(3, [('flags', 'u1'), ('vertex_indices', 'O')])
    faces['flags'] = 1
    for row, corners in enumerate(([0, 1, 2], [0, 1, 2, 3], [4, 3, 2, 1, 0])):
        faces['vertex_indices'][row] = np.array(corners, 'i4')
    describe = plyfile.PlyElement.describe
    elements = [describe(vertices, 'vertex'), describe(faces, 'face')]
    plyfile.PlyData(elements, text=text).write(str(tmp_path / 'a.ply'))

    mesh = read_mesh(tmp_path / 'a.ply')

    expected = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [4, 3, 2], [4, 2, 1], [4, 1, 0]]
    assert mesh.triangles.tolist() == expected
    assert mesh.vertices[:, 0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ('rows', 'says'),
    [
        ('1 2 0.5\n', r'1 x vertex: other numbers than stated'),
        ('1 -1\n', 'other numbers'),
        ('1\n', 'truncated'),
        ('1 1 0.5 7\n', 'other numbers'),
    ],
)
def test_lists_of_another_length_than_stated_are_refused(tmp_path, rows, says):
    head = 'ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n'
    (tmp_path / 'a.ply').write_text(f'{head}property list uchar float d\nend_header\n{rows}')

    with pytest.raises(FileFormatError, match=says):
        read_points(tmp_path / 'a.ply')


def test_coordinates_are_floats_for_pcl_unless_that_rounds_by_half_a_millimetre(tmp_path, caplog):
    plyfile = pytest.importorskip('plyfile')
    for centre, kind in (((8000.0, 0.0, 0.0), 'f4'), ((-9000.0, 0.0, 0.0), 'f8')):
        surfels = make_surfels(10, centre=centre)
        write_surfels(tmp_path / 'map.ply', surfels)
        vertex = plyfile.PlyData.read(tmp_path / 'map.ply')['vertex']
        assert vertex['x'].dtype == kind
        np.testing.assert_allclose(vertex['x'], surfels.position[:, 0], rtol=0, atol=0.5e-3)
        assert ('PCL does not read' in caplog.text) == (kind == 'f8')
