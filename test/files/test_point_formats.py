# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Points in files that other programs and libraries write are read as they are."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import libraries
from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.scan_files import read_scan, scan_files
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import extras

rng = np.random.default_rng(1)
N = 50
POINTS = rng.uniform(-5.0, 5.0, (N, 3)).round(4)
INTENSITY = rng.uniform(0.0, 100.0, N).round(3)
COLOURS = rng.integers(0, 256, (N, 3))
TABLE = np.column_stack([POINTS, INTENSITY, COLOURS])


def check(path, *columns, atol=1e-12):
    """Compare the points and some columns of a file with those above."""
    points, named = read_scan(path)
    np.testing.assert_allclose(points, POINTS, rtol=0, atol=atol)
    expected = {'intensity': INTENSITY, 'rgb': COLOURS}
    for name in columns:
        np.testing.assert_allclose(named[name], expected[name], rtol=1e-6)
    assert named.keys() >= {*columns}
    return named


@pytest.mark.parametrize(
    ('name', 'width', 'options', 'columns'),
    [
        ('a.xyz', 3, {}, ()),
        ('a.xyz', 4, {}, ('intensity',)),
        ('a.txt', 7, {'delimiter': '\t'}, ('intensity', 'rgb')),
        ('a.asc', 7, {'delimiter': ';'}, ('intensity', 'rgb')),
        ('A.XYZ', 4, {'header': 'made by numpy\n'}, ('intensity',)),
        ('a.csv', 4, {'delimiter': ',', 'header': 'x,y,z,intensity'}, ('intensity',)),
        (
            'a.csv',
            7,
            {'delimiter': ',', 'header': '"X","Y","Z","Intensity","R","G","B"', 'comments': ''},
            ('intensity', 'rgb'),
        ),
        ('a.asc', 7, {'header': 'X Y Z intensity R G B', 'comments': '//'}, ('intensity', 'rgb')),
        (
            'a.csv',
            4,
            {
                'delimiter': ',',
                'header': 'é\nX (m),Y (m),z_m,intensity',
                'encoding': 'latin-1',
            },
            ('intensity',),
        ),
        ('a.pts', 7, {'header': str(N), 'comments': ''}, ('intensity', 'rgb')),
    ],
)
def test_text_of_numpy_is_read(tmp_path, name, width, options, columns):
    np.savetxt(tmp_path / name, TABLE[:, :width], fmt='%.17g', **options)

    check(tmp_path / name, *columns)


@pytest.mark.parametrize(
    'header', ['intensity,z,x,y', '"intensity","Points:2","Points:0","Points:1"', ',z,x,y']
)
def test_columns_of_a_header_may_come_in_any_order(tmp_path, header):
    rows = TABLE[:, [3, 2, 0, 1]]
    np.savetxt(tmp_path / 'a.csv', rows, '%.17g', ',', header=header, comments='')

    columns = check(tmp_path / 'a.csv', *(('intensity',) if header[0] != ',' else ()))

    assert [*columns] == (['intensity'] if header[0] != ',' else [])


@pytest.mark.parametrize(('unit', 'factor'), [('mm', 1000.0), ('cm', 100.0)])
def test_units_in_a_header_are_converted(tmp_path, unit, factor):
    for at, header in enumerate(
        (f'x_{unit},y_{unit},z_{unit}', f'X ({unit}), Y[{unit}], Z {unit}')
    ):
        path = tmp_path / f'{at}.csv'
        np.savetxt(path, POINTS * factor, '%.17g', ',', header=header, comments='')
        check(path)


def test_intensities_of_pts_may_be_negative(tmp_path):
    rows = np.column_stack([POINTS, INTENSITY - 2000.0, COLOURS])
    np.savetxt(tmp_path / 'a.pts', rows, '%.17g', header=str(N), comments='')

    _, columns = read_scan(tmp_path / 'a.pts')

    np.testing.assert_allclose(columns['intensity'], INTENSITY - 2000.0)


@pytest.mark.parametrize(
    ('name', 'text', 'says'),
    [
        ('a.txt', 'no points\n', 'no row of three numbers, expected a header with x, y, z'),
        ('a.txt', '', 'no row of three numbers'),
        ('a.txt', '0 1 2 3 0 0 0 1\n', '8 columns'),
        ('a.csv', 't,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n', '8 columns t, x, y, z, qx'),
        ('a.csv', 'time,a,b\n0,1,2\n', '3 columns time, a, b'),
        ('a.xyz', '0 1 2 3 4\n', '5 columns, expected a header'),
        (
            'a.csv',
            ''.join(f'{row},9,8,7.5\n' for row in range(10)),
            'the first column counts the rows',
        ),
        ('a.xyz', '1 2 3\n4 5\n', 'columns'),
        ('a.xyz', '1 2 3\n4 5 x\n', "'x'"),
    ],
)
def test_text_without_points_is_refused(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)

    with pytest.raises(FileFormatError, match=rf'a\.\w+: .*{says}'):
        read_scan(tmp_path / name)


def test_tables_and_arrays_are_scans_of_a_folder_if_they_are_points(tmp_path):
    np.savetxt(tmp_path / '1.txt', POINTS)
    np.savetxt(tmp_path / 'times.txt', np.arange(3.0))
    np.savetxt(tmp_path / 'poses.txt', np.zeros((3, 12)))
    (tmp_path / 'notes.txt').write_text('three scans\n')
    np.save(tmp_path / '2.npy', POINTS)
    SurfelMap(0.5).save(tmp_path / 'map.npz')
    np.savez(tmp_path / '3.npz', points=POINTS)
    (tmp_path / 'mesh.obj').write_text('v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n')

    assert [file.name for file in scan_files(tmp_path)] == ['1.txt', '2.npy', '3.npz']

    np.savetxt(tmp_path / '4.xyz', POINTS)
    assert [file.name for file in scan_files(tmp_path)] == ['4.xyz']


def test_tables_of_a_folder_with_one_ending_are_scans_that_state_their_fault(tmp_path):
    for name in ('1.csv', '2.csv'):
        (tmp_path / name).write_text('x;y;z\n1,5;2,5;3,5\n')
    assert [file.name for file in scan_files(tmp_path)] == ['1.csv', '2.csv']
    with pytest.raises(
        FileFormatError, match=r'1\.csv: no row of three numbers, expected a header with'
    ):
        read_scan(tmp_path / '1.csv')
    (tmp_path / 'a.jpg').write_bytes(b'')
    assert scan_files(tmp_path) == []


def test_arrays_of_numpy_are_read(tmp_path):
    np.save(tmp_path / 'a.npy', TABLE)
    check(tmp_path / 'a.npy', 'intensity', 'rgb')
    np.save(tmp_path / 'grid.npy', POINTS.reshape(5, 10, 3))
    check(tmp_path / 'grid.npy')
    kinds = [*((axis, 'f8') for axis in 'xyz'), ('intensity', 'f4'), ('t', 'u4')]
    table = np.zeros(N, kinds)
    for axis, values in zip('xyz', POINTS.T, strict=True):
        table[axis] = values
    table['intensity'], table['t'] = INTENSITY, np.arange(N)
    np.save(tmp_path / 'fields.npy', table)
    assert check(tmp_path / 'fields.npy', 'intensity')['t'].tolist() == [*range(N)]


@pytest.mark.parametrize('save', [np.savez, np.savez_compressed])
def test_archives_of_numpy_are_read(tmp_path, save):
    normals = np.tile([0.0, 0.0, 1.0], (N, 1))
    arrays = {
        'colors': COLOURS / 255.0,
        'normals': normals,
        'intensity': INTENSITY,
        'pose': np.eye(4),
    }
    save(tmp_path / 'a.npz', points=POINTS, **arrays)
    assert check(tmp_path / 'a.npz', 'intensity', 'rgb')['nz'].tolist() == [1.0] * N
    save(tmp_path / 'b.npz', **dict(zip('xyz', POINTS.T, strict=True)), intensity=INTENSITY)
    check(tmp_path / 'b.npz', 'intensity')
    save(tmp_path / 'c.npz', POINTS)
    check(tmp_path / 'c.npz')
    save(
        tmp_path / 'd.npz', K=np.eye(3), boxes=np.ones((4, 7)), lidar=POINTS, flow=np.zeros((9, 3))
    )
    check(tmp_path / 'd.npz')
    save(tmp_path / 'grid.npz', pose=np.eye(4), xyz=POINTS.reshape(5, 10, 3))
    check(tmp_path / 'grid.npz')
    save(tmp_path / 'e.npz', normal=normals, points=POINTS, grid=np.zeros((2 * N, 3)))
    check(tmp_path / 'e.npz')


def test_halves_and_capitals_are_read(tmp_path):
    np.save(tmp_path / 'half.npy', POINTS.astype('f2'))
    check(tmp_path / 'half.npy', atol=3e-3)
    upper = dict(zip('XYZ', POINTS.T, strict=True))
    for module, name in ((ply, 'upper.ply'), (pcd, 'upper.pcd')):
        module.write_points(tmp_path / name, {**upper, 'intensity': INTENSITY})
        assert [*check(tmp_path / name, 'intensity')] == ['intensity']


@pytest.mark.parametrize(
    ('name', 'write', 'says'),
    [
        ('a.npy', lambda path: np.save(path, np.zeros(5)), r'float64 \(5,\), expected floats'),
        ('a.npy', lambda path: np.save(path, np.zeros((9, 640))), r'float64 \(9, 640\)'),
        ('a.npy', lambda path: np.save(path, np.array([{}], object)), 'allow_pickle'),
        ('a.npy', lambda path: path.write_bytes(b'\x93NUMPY'), 'a.npy'),
        ('a.npz', lambda path: np.savez(path, a=np.zeros(5)), r'arrays a \(5,\), expected one of'),
        (
            'a.npz',
            lambda path: np.savez(path, a=POINTS, b=POINTS),
            r'arrays a \(50, 3\), b \(50, 3\), expected one of \(N, 3\) named points',
        ),
        ('a.npz', lambda path: path.write_bytes(b'PK'), 'a.npz'),
        ('a.npz', lambda path: SurfelMap(0.5).save(path), 'a map, expected points'),
    ],
)
def test_arrays_without_points_are_refused(tmp_path, name, write, says):
    write(tmp_path / name)

    with pytest.raises(FileFormatError, match=says):
        read_scan(tmp_path / name)


def poses_of_e57():
    """Return two poses of a scanner: turned about z, and about x."""
    half = np.sqrt(0.5)
    return [((half, 0.0, 0.0, half), (1.0, 2.0, 3.0)), ((half, half, 0.0, 0.0), (-1.0, 0.0, 0.5))]


def write_e57(path, poses):
    pye57 = extras.load('pye57')
    data = {f'cartesian{axis}': values for axis, values in zip('XYZ', POINTS.T, strict=True)}
    data['intensity'] = INTENSITY.astype('f4')
    data |= {
        f'color{name}': values.astype('u1')
        for name, values in zip(('Red', 'Green', 'Blue'), COLOURS.T, strict=True)
    }
    with pye57.E57(str(path), mode='w') as file:
        for quaternion, place in poses:
            file.write_scan_raw(data, rotation=np.array(quaternion), translation=np.array(place))


def test_scans_of_e57_are_read_at_their_poses(tmp_path):
    write_e57(tmp_path / 'a.e57', poses_of_e57())

    points, columns = read_scan(tmp_path / 'a.e57')

    x, y, z = POINTS.T
    np.testing.assert_allclose(points[:N], np.column_stack([1 - y, 2 + x, 3 + z]), atol=1e-6)
    np.testing.assert_allclose(points[N:], np.column_stack([x - 1, -z, 0.5 + y]), atol=1e-6)
    np.testing.assert_allclose(columns['intensity'], np.tile(INTENSITY, 2), rtol=1e-6)
    np.testing.assert_array_equal(columns['rgb'], np.tile(COLOURS, (2, 1)))


@pytest.mark.parametrize('content', [b'', b'ASTM-E57', b'ASTM-E57' + bytes(5000)])
def test_a_damaged_e57_is_refused_with_formats_that_are_read(tmp_path, content):
    extras.load('pye57')
    (tmp_path / 'a.e57').write_bytes(content)

    says = r'a\.e57: damaged, or of another format: .*\.ply, \.pcd'
    with pytest.raises(FileFormatError, match=says):
        read_scan(tmp_path / 'a.e57')


def vtk_cloud():
    """Return the points as polygonal data of VTK, with vertices, scalars and colours."""
    extras.load('vtkmodules')
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points, vertices, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(POINTS, deep=True))
    for row in range(N):
        vertices.InsertNextCell(1, [row])
    data.SetPoints(points)
    data.SetVerts(vertices)
    for name, values in (('intensity', INTENSITY), ('colours', COLOURS.astype('u1'))):
        array = numpy_to_vtk(values, deep=True)
        array.SetName(name)
        data.GetPointData().AddArray(array)
    return data


@pytest.mark.parametrize('is_binary', [True, False])
def test_legacy_files_of_vtk_are_read(tmp_path, is_binary):
    data = vtk_cloud()
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetFileName(str(tmp_path / 'a.vtk'))
    (writer.SetFileTypeToBinary if is_binary else writer.SetFileTypeToASCII)()
    writer.SetInputData(data)
    writer.Write()

    check(tmp_path / 'a.vtk', 'intensity', 'rgb', atol=1e-5)


def test_xml_files_of_vtk_are_read(tmp_path):
    data = vtk_cloud()
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / 'a.vtp'))
    writer.SetInputData(data)
    writer.Write()

    check(tmp_path / 'a.vtp', 'intensity', 'rgb')


@pytest.mark.parametrize(
    'text',
    [
        '',
        '# vtk DataFile Version 3.0\n',
        '# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 900000000 float\n0 0 0\n',
        '# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 2\n',
    ],
)
@pytest.mark.parametrize('suffix', ['.vtk', '.vtp', '.vtu'])
def test_damaged_files_of_vtk_are_refused(tmp_path, text, suffix):
    extras.load('vtkmodules')
    (tmp_path / f'a{suffix}').write_text(text)

    with pytest.raises(FileFormatError, match=rf'a\{suffix}: '):
        read_scan(tmp_path / f'a{suffix}')


def test_points_of_obj_are_read(tmp_path):
    trimesh = pytest.importorskip('trimesh', reason='trimesh is not installed (extra meshes)')
    trimesh.PointCloud(POINTS, COLOURS.astype('u1')).export(tmp_path / 'a.obj')
    check(tmp_path / 'a.obj', 'rgb', atol=1e-6)

    trimesh.creation.box().export(tmp_path / 'box.obj')
    with pytest.raises(FileFormatError, match=r'box\.obj: a mesh, expected points'):
        read_scan(tmp_path / 'box.obj')


def test_feather_files_are_read(tmp_path):
    arrow = extras.load('pyarrow')
    extras.load('pyarrow.feather')
    half = {axis: values.astype('f2') for axis, values in zip('xyz', POINTS.T, strict=True)}
    arrow.feather.write_feather(
        arrow.table({**half, 'intensity': INTENSITY.astype('u1')}), str(tmp_path / 'a.feather')
    )

    points, columns = read_scan(tmp_path / 'a.feather')

    assert points.dtype == np.float32
    np.testing.assert_allclose(points, POINTS, atol=3e-3)
    np.testing.assert_array_equal(columns['intensity'], INTENSITY.astype('u1'))
    (tmp_path / 'b.feather').write_bytes(b'ARROW1' + bytes(50))
    with pytest.raises(FileFormatError, match=r'b\.feather: damaged, or of another'):
        read_scan(tmp_path / 'b.feather')


@pytest.mark.parametrize('suffix', ['.e57', '.vtk', '.obj', '.feather'])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, suffix):
    (tmp_path / f'a{suffix}').touch()

    def refuse(name):
        raise ImportError(f'No module named {name!r}')

    monkeypatch.setattr(libraries, 'import_module', refuse)
    says = r"pip install 'surfel_mapper\[(clouds|meshes|form)"
    with pytest.raises(DependencyError, match=says) as refused:
        read_scan(tmp_path / f'a{suffix}')
    if suffix in ('.e57', '.vtk'):
        assert '.ply and .pcd need no package' in str(refused.value)
