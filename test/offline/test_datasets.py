# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Folders of public data sets are recognised, with their times, poses and calibration."""

import numpy as np
import pytest

from surfel_mapper import Config
from surfel_mapper.cli.main import main
from surfel_mapper.errors import FileFormatError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.offline.datasets import find_dataset
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from test.offline import dataset_folders as folders
from test.offline.dataset_folders import ALL, lidar_poses, POINTS


@pytest.mark.parametrize('make', ALL)
def test_a_layout_is_recognised_with_its_scans_and_times(tmp_path, make, capsys):
    path, name, stamps_ns = make(tmp_path)

    with open_recording(Request(path=path), Config()) as recording:
        scan = recording.first_scan()
        assert recording.stamps == stamps_ns
    np.testing.assert_allclose(scan.points, POINTS, atol=0.0026)  # NCLT rounds to 5 mm

    assert main(['info', str(path)]) == 0
    source = 'file' if make in (*folders.WITH_POSES, folders.mulran) else 'registration'
    printed = capsys.readouterr().out
    assert f'{name} data set, 3 scans' in printed
    assert f'replay takes poses from {source}' in printed


@pytest.mark.parametrize('make', folders.WITH_POSES)
def test_poses_are_those_of_the_lidar(tmp_path, make):
    path, _, stamps_ns = make(tmp_path)

    found = find_dataset(path).trajectory

    assert found.stamp_ns.tolist() == stamps_ns
    poses = [pose_matrix(*row) for row in zip(found.xyz, found.q_xyzw, strict=True)]
    np.testing.assert_allclose(poses, lidar_poses(), atol=1e-6)


def test_poses_of_mulran_are_moved_to_the_lidar(tmp_path):
    path, _, _ = folders.mulran(tmp_path)

    found = find_dataset(path).trajectory

    np.testing.assert_allclose(found.xyz, [[1.7042, -0.021, 1.8047]] * 3)
    assert np.abs(found.q_xyzw[:, 2]).min() > 0.99999  # it looks backwards


def test_a_wrong_number_of_times_is_refused(tmp_path):
    path, _, _ = folders.kitti_odometry(tmp_path)
    (path / 'times.txt').write_text('0.0\n0.1\n')
    with pytest.raises(FileFormatError, match='2 rows for 3 scans'):
        find_dataset(path)


@pytest.mark.parametrize('make', [folders.kitti_odometry, folders.kitti_raw])
def test_the_scans_left_of_a_kitti_drive_have_their_own_times_and_poses(tmp_path, make):
    path, _, stamps_ns = make(tmp_path)
    next(path.rglob('*0001.bin')).unlink()

    found = find_dataset(path)

    assert found.stamps_ns == found.trajectory.stamp_ns.tolist() == [stamps_ns[0], stamps_ns[2]]
    np.testing.assert_allclose(found.trajectory.matrices, lidar_poses()[::2], atol=1e-6)


def test_scans_of_a_drive_without_their_oxts_are_registered(tmp_path):
    path, _, stamps_ns = folders.kitti_raw(tmp_path)
    (path / 'oxts' / 'data' / '0000000001.txt').unlink()

    found = find_dataset(path)

    assert (found.stamps_ns, found.trajectory) == (stamps_ns, None)
    measured = path / 'oxts' / 'data'
    assert found.missing == f'{measured} is not used: no 0000000001.txt in it'


def test_scans_of_a_data_set_keep_their_times_at_other_poses_without_times(tmp_path):
    path, _, stamps_ns = folders.nuscenes(tmp_path)
    poses = tmp_path / 'poses.txt'
    poses.write_text(folders.lines(pose[:3] for pose in lidar_poses()))

    with open_recording(Request(path=path, poses=poses), Config()) as recording:
        assert recording.stamps == stamps_ns
        assert recording.times_from == 'nuScenes data set'


def test_points_of_helipr_carry_times(tmp_path):
    path, _, _ = folders.helipr(tmp_path)
    (path / 'LiDAR_GT' / 'Ouster_gt.txt').unlink()
    with open_recording(Request(path=path), Config()) as recording:
        assert recording.config.pose.source == 'registration'
        assert recording.config.deskew.enabled


def replaced(name, old, new):
    """Return a change of a text file: the first occurrence of a text becomes another."""

    def change(folder):
        file = next(folder.rglob(name))
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return change


def renamed(name):
    """Return a change of the name of the last scan."""

    def change(folder):
        last = max(folder.rglob('*.bin'), default=None) or max(folder.rglob('*.pcd'))
        last.rename(last.with_name(name))

    return change


DAMAGE = {
    'a time that is none': (folders.kitti_odometry, replaced('times.txt', '0.1', 'noon')),
    'times that go back': (folders.kitti_odometry, replaced('times.txt', '0.1', '0.3')),
    'poses that are none': (folders.kitti_odometry, replaced('07.txt', '1.0 0.0', '7.0 0.0')),
    'a calibration that is none': (folders.kitti_odometry, replaced('calib.txt', ' 1.0', ' 5.0')),
    'a short calibration': (folders.kitti_odometry, replaced('calib.txt', ' 0.1', '')),
    'bytes that are no text': (
        folders.kitti_odometry,
        lambda folder: next(folder.rglob('times.txt')).write_bytes(b'\xff\xfe0\n'),
    ),
    'a date that is none': (folders.kitti_raw, replaced('timestamps.txt', '13:02', '25:02')),
    'a date before 1970': (folders.kitti_raw, replaced('timestamps.txt', '2011', '1911')),
    'a pole': (folders.kitti_raw, replaced('0000000000.txt', '0.0 8.0', '90.0 8.0')),
    'a mount of eight numbers': (
        folders.kitti_raw,
        replaced('calib_imu_to_velo.txt', '1 0 0', '1 0'),
    ),
    'a file of five numbers': (folders.kitti_raw, replaced('0000000002.txt', ' 100.0 0.0', '')),
    'a table that is no JSON': (folders.nuscenes, replaced('sample_data.json', '[', '')),
    'a table of another kind': (folders.nuscenes, replaced('ego_pose.json', '"token"', '"name"')),
    'a table that is no list': (
        folders.nuscenes,
        lambda folder: next(folder.rglob('ego_pose.json')).write_text('{}'),
    ),
    'nesting without end': (
        folders.nuscenes,
        lambda folder: next(folder.rglob('ego_pose.json')).write_text('[' * 100_000),
    ),
    'a rotation that is none': (
        folders.nuscenes,
        replaced('ego_pose.json', '[1.0, 0.0', '[7.0, 0.0'),
    ),
    'no number in a name of nuScenes': (folders.nuscenes, renamed('n0__LIDAR_TOP__x.pcd.bin')),
    'eleven numbers': (folders.mulran, replaced('global_pose.csv', ',1.0', '')),
    'no number in a name': (folders.mulran, renamed('x.bin')),
    'a number beyond int64': (folders.nclt, renamed(f'{10**19}.bin')),
    'a turn of length zero': (folders.helipr, replaced('Ouster_gt.txt', ' 1.0', ' 0.0')),
    'not a number': (folders.helipr, replaced('Ouster_gt.txt', ' 0.0', ' nan')),
    'no nanoseconds in a name': (folders.newer_college, renamed('cloud_1583836591.pcd')),
}


@pytest.mark.parametrize(('make', 'damage'), DAMAGE.values(), ids=DAMAGE)
def test_damage_is_refused_with_the_name_of_the_file(tmp_path, make, damage, capsys):
    path, _, _ = make(tmp_path / 'set')
    damage(tmp_path / 'set')

    with pytest.raises(FileFormatError, match=str(tmp_path)):
        find_dataset(path)

    assert main(['info', str(path)]) == 1
    assert 'Traceback' not in capsys.readouterr().err
