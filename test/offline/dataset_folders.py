# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tiny folders in the layouts of public data sets: three scans, and poses where they have any."""

import json

import numpy as np

from surfel_mapper.files import pcd
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.offline.datasets import EARTH_M, HELIPR_OUSTER, NCLT_POINT
from test import extras

US, NS = 1_700_000_000_000_000, 1_700_000_000_000_000_000
POINTS = np.random.default_rng(1).uniform(-5.0, 5.0, (50, 3)).astype(np.float32)


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content)
    else:
        np.asarray(content).tofile(path)


def raw(width):
    return np.column_stack([POINTS, np.zeros((50, width - 3))]).astype('<f4')


def lines(rows):
    return '\n'.join(' '.join(map(str, np.ravel(row))) for row in rows) + '\n'


def lidar_poses():
    """Return three poses of a lidar that drives ahead and turns."""
    return [
        pose_matrix((2.0 * i, 0.1 * i, 0.0), (0.0, 0.0, np.sin(0.05 * i), np.cos(0.05 * i)))
        for i in range(3)
    ]


def kitti_odometry(root):
    path = root / 'sequences' / '07'
    mount = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    for i in range(3):
        write(path / 'velodyne' / f'{i:06}.bin', raw(4))
    write(path / 'times.txt', '0.0\n0.1\n0.2\n')
    write(path / 'calib.txt', f'P0: 1 0\nTr: {lines([mount[:3]])}')
    cameras = [mount @ pose @ np.linalg.inv(mount) for pose in lidar_poses()]
    write(root / 'poses' / '07.txt', lines(pose[:3] for pose in cameras))
    return path, 'KITTI odometry', [0, 10**8, 2 * 10**8]


def kitti_raw(root):
    path = root / '2011_09_26' / '2011_09_26_drive_0001_sync'
    for i in range(3):
        write(path / 'velodyne_points' / 'data' / f'{i:010}.bin', raw(4))
        east, north, _ = lidar_poses()[i][:3, 3]
        degree = np.degrees(1.0 / EARTH_M)
        oxts = [north * degree, 8.0 + east * degree, 100.0, 0.0, 0.0, 0.1 * i, 7.0]
        write(path / 'oxts' / 'data' / f'{i:010}.txt', lines([oxts]))
    write(path.parent / 'calib_imu_to_velo.txt', 'R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n')
    times = [f'2011-09-26 13:02:25.{i}00000007' for i in range(3)]
    write(path / 'velodyne_points' / 'timestamps.txt', '\n'.join(times))
    start = 1317042145 * 10**9 + 7
    return path, 'KITTI raw', [start, start + 10**8, start + 2 * 10**8]


def nuscenes(root):
    rows, ego = [], []
    for i, pose in enumerate(lidar_poses()):
        folder = 'samples' if i == 1 else 'sweeps'
        name = f'{folder}/LIDAR_TOP/n0__LIDAR_TOP__{US + i * 50_000}.pcd.bin'
        write(root / name, raw(5))
        rows.append({'filename': name, 'ego_pose_token': f'e{i}', 'calibrated_sensor_token': 'c'})
        rotation = [np.cos(0.05 * i), 0.0, 0.0, np.sin(0.05 * i)]
        place = (pose @ np.array([-1.0, 0.0, 0.0, 1.0]))[:3]
        ego.append({'token': f'e{i}', 'translation': place.tolist(), 'rotation': rotation})
    mount = {'token': 'c', 'translation': [1.0, 0.0, 0.0], 'rotation': [1.0, 0.0, 0.0, 0.0]}
    tables = {'sample_data': rows, 'ego_pose': ego, 'calibrated_sensor': [mount]}
    for name, content in tables.items():
        write(root / 'v1.0-mini' / f'{name}.json', json.dumps(content))
    return root, 'nuScenes', [(US + i * 50_000) * 1000 for i in range(3)]


def helipr(root):
    points = np.zeros(50, HELIPR_OUSTER)
    for axis, values in zip('xyz', POINTS.T, strict=True):
        points[axis] = values
    points['t'] = np.arange(50) * 2_000_000
    rows = []
    for i, pose in enumerate(lidar_poses()):
        write(root / 'LiDAR' / 'Ouster' / f'{NS + i}.bin', points)
        turn = [0.0, 0.0, np.sin(0.05 * i), np.cos(0.05 * i)]
        rows.append(f'{NS + i} ' + ' '.join(map(str, [*pose[:3, 3], *turn])))
    write(root / 'LiDAR_GT' / 'Ouster_gt.txt', '\n'.join(rows))
    return root, 'HeLiPR', [NS, NS + 1, NS + 2]


def mulran(root):
    for i in range(3):
        write(root / 'sensor_data' / 'Ouster' / f'{NS + i}.bin', raw(4))
    rows = [','.join(map(str, [NS + i, *np.eye(4)[:3].ravel()])) for i in range(3)]
    write(root / 'global_pose.csv', '\n'.join(rows))
    return root, 'MulRan', [NS, NS + 1, NS + 2]


def newer_college(root):
    for i in range(3):
        path = root / 'raw_format' / 'ouster_scan' / f'cloud_1583836591_{i:09}.pcd'
        path.parent.mkdir(parents=True, exist_ok=True)
        pcd.write_points(path, dict(zip('xyz', POINTS.T, strict=True)))
    return root, 'Newer College', [1583836591 * 10**9 + i for i in range(3)]


def nclt(root):
    points = np.zeros(50, NCLT_POINT)
    for axis, values in zip('xyz', POINTS.T, strict=True):
        points[axis] = np.round((values + 100.0) / 0.005)
    for i in range(3):
        write(root / 'velodyne_sync' / f'{US + i}.bin', points)
    return root, 'NCLT', [(US + i) * 1000 for i in range(3)]


def boreas(root):
    (root / 'applanix').mkdir(parents=True)
    for i in range(3):
        write(root / 'lidar' / f'{US + i}.bin', raw(6))
    return root, 'Boreas', [(US + i) * 1000 for i in range(3)]


def argoverse2(root):
    arrow = extras.load('pyarrow')
    extras.load('pyarrow.feather')
    half = {axis: values.astype('f2') for axis, values in zip('xyz', POINTS.T, strict=True)}
    folder = root / 'sensors' / 'lidar'
    folder.mkdir(parents=True)
    for i in range(3):
        table = arrow.table({**half, 'offset_ns': np.arange(50, dtype='i4')})
        arrow.feather.write_feather(table, str(folder / f'{NS + i}.feather'))
    poses = np.array(lidar_poses())
    turns = 0.05 * np.arange(3.0)
    columns = {
        'timestamp_ns': NS + np.arange(3),
        'qw': np.cos(turns),
        'qx': np.zeros(3),
        'qy': np.zeros(3),
        'qz': np.sin(turns),
        **{f't{axis}_m': poses[:, at, 3] for at, axis in enumerate('xyz')},
    }
    arrow.feather.write_feather(arrow.table(columns), str(root / 'city_SE3_egovehicle.feather'))
    return root, 'Argoverse 2', [NS, NS + 1, NS + 2]


WITH_POSES = (kitti_odometry, kitti_raw, nuscenes, helipr, argoverse2)
ALL = (*WITH_POSES, mulran, newer_college, nclt, boreas)
