# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories come back as written; files of other tools are read; invalid ones are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.trajectory import read_trajectory, Trajectory, write_tum
from surfel_mapper.geometry import pose_matrix
from test import extras

START_NS = 1_700_000_000_123_456_789


def some_poses(number=20):
    rng = np.random.default_rng(3)
    q = rng.normal(size=(number, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    xyz = rng.uniform(-1e4, 1e4, (number, 3))
    stamps = START_NS + np.arange(number) * 100_000_001
    return stamps, np.array([pose_matrix(t, r) for t, r in zip(xyz, q, strict=True)])


def text_file(tmp_path, text, name='poses.txt'):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_tum_poses_come_back_to_the_nanosecond_and_the_last_digit(tmp_path):
    stamps, poses = some_poses()
    write_tum(tmp_path / 'a.tum', stamps, poses)

    found = read_trajectory(tmp_path / 'a.tum')

    np.testing.assert_array_equal(found.stamp_ns, stamps)
    np.testing.assert_array_equal(found.xyz, poses[:, :3, 3])
    turned = Rotation.from_quat(found.q_xyzw).as_matrix()
    np.testing.assert_allclose(turned, poses[:, :3, :3], atol=1e-15)
    assert len(found) == len(stamps)


def test_tum_text_reads_in_numpy_as_eight_columns(tmp_path):
    stamps, poses = some_poses()
    write_tum(tmp_path / 'a.tum', stamps, poses)

    table = np.loadtxt(tmp_path / 'a.tum')

    np.testing.assert_allclose(table[:, 0], stamps / 1e9, rtol=1e-15)
    np.testing.assert_array_equal(table[:, 1:4], poses[:, :3, 3])


def test_no_poses_write_a_header_alone(tmp_path):
    write_tum(tmp_path / 'a.tum', [], np.empty((0, 4, 4)))

    assert (tmp_path / 'a.tum').read_text().startswith('# stamp_s x y z')
    with pytest.raises(FileFormatError, match='no poses in it'):
        read_trajectory(tmp_path / 'a.tum')


KITTI = """\
1 0 0 0.5 0 1 0 0 0 0 1 0
0 -1 0 1.5 1 0 0 2 0 0 1 -1

"""


def test_kitti_rows_are_matrices_without_stamps(tmp_path):
    found = read_trajectory(text_file(tmp_path, KITTI))

    assert found.stamp_ns is None
    np.testing.assert_array_equal(found.xyz, [[0.5, 0, 0], [1.5, 2, -1]])
    np.testing.assert_allclose(found.q_xyzw[1], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)


@pytest.mark.parametrize('determinant', [0.9995, 0.99901, 1.0009])
def test_kitti_rotations_of_few_digits_are_made_orthonormal_with_a_warning(
    tmp_path, caplog, determinant
):
    angle = np.radians(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = np.eye(4)[:3]
    matrix[:2, :2] = turn
    matrix[:, 0] *= determinant
    text = ' '.join(f'{value:.17g}' for value in matrix.ravel())
    found = read_trajectory(text_file(tmp_path, f'{KITTI.strip()}\n{text}\n'))
    np.testing.assert_allclose(found.q_xyzw[2], [0, 0, np.sin(angle / 2), np.cos(angle / 2)])
    assert 'rotations are not orthonormal' in caplog.text
    assert len(caplog.records) == 1


def test_kitti_stamps_come_from_the_times_beside_it(tmp_path):
    text_file(tmp_path, '0.000000e+00\n1.036224e-01\n', 'times.txt')

    found = read_trajectory(text_file(tmp_path, KITTI))

    np.testing.assert_array_equal(found.stamp_ns, [0, 103_622_400])


CSV = [
    'stamp_ns,x,y,z,qx,qy,qz,qw\n1700000000000000001,1,2,3,0,0,0,1\n',
    'qw,qx,qy,qz,z,y,x,label,time\n1,0,0,0,3,2,1,a,1700000000.000000001\n',
    '#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], '
    'q_RS_z [], v_RS_R_x [m s^-1]\n1700000000000000001,1,2,3,1,0,0,0,9\n',
    't_us,tx,ty,tz,qx,qy,qz,qw\r\n1700000000000000.001,1.0,2.0,3.0,0,0,0,-1\r\n',
]


@pytest.mark.parametrize('text', CSV)
def test_csv_columns_are_found_by_name_and_stamps_by_unit(tmp_path, text):
    found = read_trajectory(text_file(tmp_path, text))

    assert found.stamp_ns.tolist() == [1_700_000_000_000_000_001]
    assert found.xyz.tolist() == [[1.0, 2.0, 3.0]]
    assert abs(found.q_xyzw[0, 3]) == 1.0


@pytest.mark.parametrize(
    ('text', 'format_', 'says'),
    [
        ('', None, 'no poses in it'),
        ('1 2 3', None, '3 columns in the first line, expected 8 .TUM., 12'),
        ('0 0 0 0 0 0 0 1', 'kitti', ':1: 8 columns, expected 12'),
        ('0 0 0 0 0 0 0 1', 'tmu', "format 'tmu', expected one of tum, kitti, csv"),
        ('0 0 0 0 0 0 0 1\n1 0 0', None, ':2: 3 columns, expected 8'),
        ('0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1', None, ':2: stamp is not after'),
        ('0 0 0 0 0 0 0 2', None, ':1: .*norm'),
        ('0 0 0 nan 0 0 0 1', None, ':1: .*finite'),
        ('0 0 0 x 0 0 0 1', None, ":1: .*'x', expected a number"),
        ('nan 0 0 0 0 0 0 1', None, ":1: time 'nan'"),
        ('1700000000000000000 0 0 0 0 0 0 1', None, ':1: time .*, expected seconds'),
        ('-1 0 0 0 0 0 0 1', None, ":1: time '-1'"),
        ('2 0 0 0 0 1 0 0 0 0 1 0', None, ':1: .* no rotation'),
        ('1 0 0 0 0 1 0 0 0 0 -1 0', None, ':1: .* no rotation'),
        ('0.998 0 0 0 0 1 0 0 0 0 1 0', None, ':1: .* no rotation'),
        ('stamp,x,y,z\n0,0,0,0', None, ':1: columns stamp, x, y, z; expected a header'),
        ('stamp_s,x,y,z,qx,qy,qz,qw', None, 'only a header'),
        ('stamp_s,x,y,z,qx,qy,qz,qw\n1,2', None, ':2: 2 columns, expected 8'),
        ('stamp_ns,x,y,z,qx,qy,qz,qw\n1e99999999,0,0,0,0,0,0,1', None, ':2: time'),
        ('stamp[h],x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1', None, ":2: unit 'h'"),
    ],
)
def test_invalid_trajectories_are_refused_with_their_line(tmp_path, text, format_, says):
    with pytest.raises(FileFormatError, match=f'poses.txt.*{says}'):
        read_trajectory(text_file(tmp_path, text), format_)


def test_a_number_of_times_other_than_that_of_poses_is_refused(tmp_path):
    text_file(tmp_path, '0\n', 'times.txt')

    with pytest.raises(FileFormatError, match=r'times\.txt: 1 stamps for 2 poses'):
        read_trajectory(text_file(tmp_path, KITTI))


@pytest.mark.parametrize('content', [b'\xff\xfe\x00', None])
def test_binary_and_missing_files_are_refused(tmp_path, content):
    path = tmp_path / 'poses.txt'
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(FileFormatError, match=r'poses\.txt: '):
        read_trajectory(path)


def test_a_trajectory_takes_and_gives_matrices(tmp_path):
    stamps, poses = some_poses()
    trajectory = Trajectory.from_matrices(poses, stamps)
    np.testing.assert_allclose(trajectory.matrices, poses, rtol=0, atol=1e-12)
    trajectory.save(tmp_path / 'drive.tum')
    loaded = Trajectory.load(tmp_path / 'drive.tum')
    np.testing.assert_array_equal(loaded.stamp_ns, stamps)
    np.testing.assert_allclose(loaded.matrices, poses, rtol=0, atol=1e-9)
    assert repr(loaded) == 'Trajectory(20 poses in 1.900 s)'
    assert repr(Trajectory.from_matrices(poses)) == 'Trajectory(20 poses)'


@pytest.mark.parametrize(
    ('poses', 'stamps', 'message'),
    [
        (np.eye(4), [0], r'shape \(4, 4\), expected \(S, 4, 4\)'),
        (2.0 * np.eye(4)[None], [0], r'T_fixed_sensor\[0\]: .*a rigid transform'),
        (np.eye(4)[None], [0.5], 'whole nanoseconds'),
        (np.tile(np.eye(4), (2, 1, 1)), [5, 5], 'ascending'),
    ],
)
def test_odd_matrices_and_stamps_are_refused(poses, stamps, message):
    with pytest.raises(ValueError, match=message):
        Trajectory.from_matrices(poses, stamps)


def test_poses_without_stamps_are_not_written_as_tum(tmp_path):
    with pytest.raises(FileFormatError, match='without stamps'):
        Trajectory.from_matrices(np.eye(4)[None]).save(tmp_path / 'a.tum')


def test_evo_reads_the_trajectory_as_written(tmp_path):
    file_interface = extras.load('evo.tools.file_interface')
    stamps, poses = some_poses()
    Trajectory.from_matrices(poses, stamps).save(tmp_path / 'drive.tum')
    found = file_interface.read_tum_trajectory_file(str(tmp_path / 'drive.tum'))
    np.testing.assert_allclose(found.timestamps, stamps / 1e9, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.array(found.poses_se3), poses, rtol=0, atol=1e-9)
    assert found.check()[0]


@pytest.mark.parametrize('cut', ['poses.txt', 'times.txt'])
def test_a_last_number_with_fewer_decimals_than_all_others_is_refused(tmp_path, caplog, cut):
    path = tmp_path / 'poses.txt'
    path.write_text('1 0 0 0.25 0 1 0 0.5 0 0 1 0.125\n' * 4)
    (tmp_path / 'times.txt').write_text('0.000\n0.100\n0.200\n0.300\n')
    whole = (tmp_path / cut).read_bytes()
    (tmp_path / cut).write_bytes(whole[:-1])  # as editors and scripts leave it
    assert len(read_trajectory(path)) == 4
    assert f'{tmp_path / cut}:4: the last line has no end' in caplog.text
    for length in (2, 3, 4):
        (tmp_path / cut).write_bytes(whole[:-length])
        with pytest.raises(FileFormatError, match=f'{cut}:4: no end of line after the last'):
            read_trajectory(path)


@pytest.mark.parametrize('last', ['1', '1.', '1.0'])
def test_numbers_of_any_length_need_no_end_of_the_last_line(tmp_path, caplog, last):
    path = tmp_path / 'poses.tum'
    path.write_text(
        '\n'.join(f'{i} 0 0 0 0 0 0 {qw}' for i, qw in enumerate(['1.0', '1.00', last]))
    )
    assert len(read_trajectory(path)) == 3
    assert 'poses.tum:3: the last line has no end; is the file cut off there?' in caplog.text


def test_stamps_before_1970_are_written_with_their_sign(tmp_path):
    Trajectory.from_matrices(np.tile(np.eye(4), (2, 1, 1)), [-5_000_000_123, -1]).save(
        tmp_path / 'a.tum'
    )
    lines = (tmp_path / 'a.tum').read_text().splitlines()
    assert [line.split()[0] for line in lines[-2:]] == ['-5.000000123', '-0.000000001']
