# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories come back as written; files of other tools are read; invalid ones are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.trajectory import read_trajectory, Trajectory, write_tum
from surfel_mapper.geometry import pose_matrix

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


STAMPS = [1_403_636_580_838_555_648, 1_403_636_580_938_555_648]
POSE = ('px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')
TWICE = ','.join(f'{who}_{name}' for who in ('est', 'gt') for name in POSE)
QUATERNIONS = [(0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.5, 2.0, -1.0, 0.0, 0.0, 0.6, 0.8)]
MATRICES = ['1 0 0 0.5 0 1 0 0 0 0 1 0', '0.28 -0.96 0 1.5 0.96 0.28 0 2 0 0 1 -1']


def rows(*columns, separator=' '):
    """Return lines of the numbers, or tuples of them, in columns."""
    words = ([*np.atleast_1d(np.array(value, object))] for value in zip(*columns, strict=True))
    flat = [
        [w for cell in row for w in (cell if isinstance(cell, tuple) else [cell])] for row in words
    ]
    return '\n'.join(separator.join(map(str, row)) for row in flat)


def wxyz(pose):
    return (*pose[:3], pose[6], *pose[3:6])


@pytest.mark.parametrize(
    ('text', 'stamps', 'number'),
    [
        # EuRoC's #timestamp without a unit
        (
            '#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], '
            'q_RS_y [], q_RS_z []\n' + rows(STAMPS, map(wxyz, QUATERNIONS), separator=','),
            STAMPS,
            None,
        ),
        # ORB-SLAM3 with EuRoC: TUM in ns
        (rows([f'{stamp}.000000' for stamp in STAMPS], QUATERNIONS), STAMPS, None),
        # TUM in us
        (
            rows([stamp // 1000 for stamp in STAMPS], QUATERNIONS),
            [s // 1000 * 1000 for s in STAMPS],
            None,
        ),
        # Newer College
        (
            '#sec,nsec,x,y,z,qx,qy,qz,qw\n'
            + rows([1_403_636_580] * 2, [838_555_648, 938_555_648], QUATERNIONS, separator=','),
            STAMPS,
            None,
        ),
        # its second part, and a unit in round brackets
        (
            '#counter, sec, nsec, x, y, z, qx, qy, qz, qw\n'
            + rows(
                [0, 1],
                [1_403_636_580] * 2,
                [838_555_648, 938_555_648],
                QUATERNIONS,
                separator=', ',
            ),
            STAMPS,
            None,
        ),
        (
            'timestamp (ns),x,y,z,qx,qy,qz,qw\n' + rows(STAMPS, QUATERNIONS, separator=','),
            STAMPS,
            None,
        ),
        # RTAB-Map: TUM with an id
        (
            '#timestamp x y z qx qy qz qw id\n'
            + rows(['1403636580.838555648', '1403636580.938555648'], QUATERNIONS, [1, 2]),
            STAMPS,
            None,
        ),
        # another order of the quaternion, in a comment below another one
        (
            '# by hand, 2024\n# timestamp tx ty tz qw qx qy qz\n'
            + rows(['1403636580.838555648', '1403636580.938555648'], map(wxyz, QUATERNIONS)),
            STAMPS,
            None,
        ),
        # a header without a mark, tabs, a comment behind it
        (
            'Timestamp PosX PosY PosZ QuatX QuatY QuatZ QuatW\n% metres\n'
            + rows(STAMPS, QUATERNIONS, separator='\t'),
            STAMPS,
            None,
        ),
        # rostopic echo -p: the time of the record comes first
        (
            '%time,field.header.seq,field.header.stamp,field.header.frame_id,'
            + ','.join(f'field.pose.pose.position.{axis}' for axis in 'xyz')
            + ','
            + ','.join(f'field.pose.pose.orientation.{axis}' for axis in 'xyzw')
            + ','
            + ','.join(f'field.twist.twist.linear.{axis}' for axis in 'xyz')
            + '\n'
            + rows(
                [7, 8], [0, 1], STAMPS, ['odom'] * 2, QUATERNIONS, ['9,9,9'] * 2, separator=','
            ),
            STAMPS,
            None,
        ),
        # PlotJuggler, with semicolons
        (
            '__time;'
            + ';'.join(f'/odom/pose/pose/position/{axis}' for axis in 'xyz')
            + ';'
            + ';'.join(f'/odom/pose/pose/orientation/{axis}' for axis in 'xyzw')
            + '\n'
            + rows(STAMPS, QUATERNIONS, separator=';'),
            STAMPS,
            None,
        ),
        # numpy.savetxt of nanoseconds, rounded to float64
        (
            rows([f'{stamp:.18e}' for stamp in STAMPS], QUATERNIONS),
            [int(f'{stamp:.0f}') for stamp in map(float, STAMPS)],
            None,
        ),
        # times before matrices, and commas between their numbers
        (rows(['0.5', '0.75'], MATRICES), [500_000_000, 750_000_000], None),
        (rows(STAMPS, MATRICES).replace(' ', ','), STAMPS, None),
        (rows(MATRICES).replace(' ', ', '), None, None),
        # KITTI-360: poses.txt, and cam0_to_world.txt
        (rows([1, 7], MATRICES), None, [1, 7]),
        (rows([1, 7], MATRICES, ['0 0 0 1'] * 2), None, [1, 7]),
        # Replica
        (rows(MATRICES, ['0 0 0 1'] * 2), None, None),
        # g2o, in any order, with edges
        (
            'VERTEX_SE3:QUAT 9 1.5 2 -1 0 0 0.6 0.8\nFIX 4\nVERTEX_SE3:QUAT 4 0.5 0 0 0 0 0 1\n'
            'EDGE_SE3:QUAT 4 9 1 0 0 0 0 0 1 ' + '1 ' * 21,
            None,
            [4, 9],
        ),
        (
            'VERTEX_SE3:QUAT 0 0.5 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1.5 2.0 -1.0 0 0 0.6 0.8',
            None,
            None,
        ),
    ],
)
def test_poses_of_programs_and_data_sets_are_read_by_their_first_line(
    tmp_path, text, stamps, number
):
    found = read_trajectory(text_file(tmp_path, text))

    np.testing.assert_allclose(np.hstack([found.xyz, found.q_xyzw]), QUATERNIONS, atol=1e-15)
    assert (None if found.stamp_ns is None else found.stamp_ns.tolist()) == stamps
    assert (None if found.number is None else found.number.tolist()) == number


@pytest.mark.parametrize(
    ('text', 'format_', 'says'),
    [
        ('', None, 'no poses in it'),
        ('1 2 3', None, '3 columns in the first line, expected 8 .TUM; 9 with an id., 12'),
        ('0 0 0 0 0 0 0 1', 'tmu', "format 'tmu', expected one of tum, kitti, csv, g2o"),
        ('0 0 0 0 0 0 0 1\n1 0 0', None, ':2: 3 columns, expected 8'),
        ('0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1', None, ':2: stamp is not after'),
        ('0 0 0 0 0 0 0 2', None, ':1: .*norm'),
        ('0 0 0 nan 0 0 0 1', None, ':1: .*finite'),
        ('0 0 0 x 0 0 0 1', None, ":1: .*'x', expected a number"),
        ('nan 0 0 0 0 0 0 1', None, ":1: time 'nan'"),
        ('17000000000000000000 0 0 0 0 0 0 1', None, ':1: time .*, expected seconds'),
        ('1 2 3 4', None, '4 columns in the first line'),
        (f'1 0 0 0 0 1 0 0 0 0 1 0 {"0 0 0 2"}', None, 'last rows of matrices, expected 0 0 0 1'),
        ('EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1', None, 'no line VERTEX_SE3:QUAT'),
        ('VERTEX_SE3:QUAT 0 0 0 0 0 0 0', None, ':1: 8 columns, expected 9: number x y z q'),
        (f'{"VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1"}\n' * 2, None, 'vertices of equal numbers'),
        ('-1 0 0 0 0 0 0 1', None, ":1: time '-1'"),
        ('2 0 0 0 0 1 0 0 0 0 1 0', None, ':1: .* no rotation'),
        ('0.998 0 0 0 0 1 0 0 0 0 1 0', None, ':1: .* no rotation'),
        ('stamp,x,y,z\n0,0,0,0', None, ':1: columns stamp, x, y, z; expected a header'),
        (f't,{TWICE}\n0,{"0," * 13}1', None, 'one each of x, y, z, qx, qy, qz, qw'),
        ('0,1,2,3,0,0,0,1', None, ':1: columns 0, 1, 2, 3, 0, 0, 0, 1; expected a header'),
        (f'[{"1, " * 200}]', None, r':1: columns \[1, (1, )+1? ?\.\.\.; expected a header'),
        ('stamp_s,x,y,z,qx,qy,qz,qw\n1,2', None, ':2: 2 columns, expected 8'),
        ('stamp_ns,x,y,z,qx,qy,qz,qw\n1e99999999,0,0,0,0,0,0,1', None, ':2: time'),
        ('stamp[h],x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1', None, ":2: unit 'h'"),
    ],
)
def test_invalid_trajectories_are_refused_with_their_line(tmp_path, text, format_, says):
    with pytest.raises(FileFormatError, match=f'poses.txt.*{says}'):
        read_trajectory(text_file(tmp_path, text), format_)


def test_a_header_counts_before_the_first_pose_only(tmp_path):
    text = '0 1 2 3 0.6 0 0 0.8\n# t x y z qw qx qy qz\n1 1 2 3 0.6 0 0 0.8\n'
    assert read_trajectory(text_file(tmp_path, text)).q_xyzw.tolist() == [[0.6, 0, 0, 0.8]] * 2


def test_a_level_drive_with_w_first_gives_a_warning(tmp_path, caplog):
    yaw = np.linspace(0.0, 3.0, 7)
    level = np.column_stack([np.zeros((7, 3)), 0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)])
    camera = np.tile([0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5], (7, 1))  # z ahead
    turned = level[:, [0, 1, 2, 6, 5, 3, 4]]  # upside down
    for poses in (level, camera, turned):
        read_trajectory(text_file(tmp_path, rows(range(7), map(tuple, poses))))
    assert not caplog.text

    path = text_file(tmp_path, rows(range(7), map(wxyz, map(tuple, level))))
    read_trajectory(path)
    assert 'poses.txt: read as x y z w, it rolls over' in caplog.text
    header = '# stamp x y z qw qx qy qz\n'
    path.write_text(header + path.read_text())  # the remedy
    np.testing.assert_allclose(read_trajectory(path).q_xyzw, level[:, 3:])


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


def test_stamps_before_1970_are_written_with_their_sign(tmp_path):
    Trajectory.from_matrices(np.tile(np.eye(4), (2, 1, 1)), [-5_000_000_123, -1]).save(
        tmp_path / 'a.tum'
    )
    lines = (tmp_path / 'a.tum').read_text().splitlines()
    assert [line.split()[0] for line in lines[-2:]] == ['-5.000000123', '-0.000000001']
