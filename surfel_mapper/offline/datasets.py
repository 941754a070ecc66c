# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Folders of public data sets, recognised by their layout: scans, times, poses, calibration.

``find_dataset`` tries the layouts of KITTI odometry and raw, nuScenes, MulRan, HeLiPR, Newer
College, NCLT and Boreas. Poses are returned as poses of the lidar, if the folder has them and the
calibration they need; without, the scans are registered.

One module of 370 lines: a list of layouts, a function each.

Sources: development kits and papers of the data sets. Poses of Newer College, NCLT and Boreas are
not read, because the folders do not contain the calibration of the lidar.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import by_number
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import pose_matrix, q_xyzw

Floats = npt.NDArray[np.float64]

Columns = dict[str, npt.NDArray[Any]]

Read = Callable[[Path], tuple[npt.NDArray[Any], Columns]]

HELIPR_OUSTER = np.dtype(
    [(name, '<f4') for name in ('x', 'y', 'z', 'intensity')]
    + [('t', '<u4'), ('reflectivity', '<u2'), ('ring', '<u2'), ('ambient', '<u2')]
)
"""Point of HeLiPR's Ouster, 26 bytes; t in ns after the stamp."""

NCLT_POINT = np.dtype(
    [('x', '<u2'), ('y', '<u2'), ('z', '<u2'), ('intensity', 'u1'), ('ring', 'u1')]
)
"""Point of NCLT, coordinates in 5 mm from -100 m."""

BOREAS_POINT = np.dtype([(name, '<f4') for name in ('x', 'y', 'z', 'intensity', 'ring', 'time')])
"""Point of Boreas; time in s relative to the stamp."""

MULRAN_MOUNT = (1.7042, -0.021, 1.8047, 0.0001, 0.0003, 179.6654)
"""Pose of MulRan's Ouster in its base: x y z in m, roll pitch yaw in deg; of its calibration."""

EARTH_M = 6378137.0


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """
    Scans of a data set.

    Attributes
    ----------
    name : str
        Name of the data set.
    files : list of Path
        One file a scan.
    stamps_ns : list of int
        Time of each scan.
    trajectory : Trajectory, optional
        Poses of the lidar.
    poses_path : Path, optional
        File of the poses.
    read : callable
        Returns points (N, 3) and columns of a file.

    """

    name: str
    files: list[Path]
    stamps_ns: list[int]
    trajectory: Trajectory | None = None
    poses_path: Path | None = None
    read: Read = read_scan


def find_dataset(path: Path) -> Dataset | None:
    """
    Return the data set in a directory; None if it has no known layout.

    Raises
    ------
    FileFormatError
        If a file of times, poses or calibration is damaged.

    """
    if not path.is_dir():
        return None
    for recognise in LAYOUTS:
        found = recognise(path)
        if found is not None:
            return found
    return None


def kitti_odometry(path: Path) -> Dataset | None:
    """Recognise sequences/NN: velodyne/, times.txt, calib.txt; poses/NN.txt two levels up."""
    files, times = scans_in(path / 'velodyne', '.bin'), path / 'times.txt'
    if not files or not times.is_file():
        return None
    stamps_ns = [round(float(word) * 1e9) for word in words(times)]
    check_number(times, stamps_ns, files)
    candidates = (path / 'poses.txt', path.parent.parent / 'poses' / f'{path.name}.txt')
    poses_path = next((each for each in candidates if each.is_file()), None)
    mount = calibration(path / 'calib.txt').get('Tr')
    if poses_path is None or mount is None:
        return Dataset('KITTI odometry', files, stamps_ns)
    rows = table(poses_path, 12)
    check_number(poses_path, rows, files)
    T_cam_velo = square(mount)
    poses = [np.linalg.inv(T_cam_velo) @ square(row) @ T_cam_velo for row in rows]
    return Dataset('KITTI odometry', files, stamps_ns, trajectory(stamps_ns, poses), poses_path)


def kitti_raw(path: Path) -> Dataset | None:
    """Recognise DATE_drive_N_sync: velodyne_points/{data,timestamps.txt}, oxts/data."""
    folder = path if path.name == 'velodyne_points' else path / 'velodyne_points'
    files, times = scans_in(folder / 'data', '.bin'), folder / 'timestamps.txt'
    if not files or not times.is_file():
        return None
    lines = [line for line in times.read_text(encoding='utf-8').splitlines() if line.strip()]
    stamps_ns = [date_ns(line, times) for line in lines]
    check_number(times, stamps_ns, files)
    drive = folder.parent
    oxts = scans_in(drive / 'oxts' / 'data', '.txt')
    mount = calibration(drive.parent / 'calib_imu_to_velo.txt')
    if len(oxts) != len(files) or not {'R', 'T'} <= mount.keys():
        return Dataset('KITTI raw', files, stamps_ns)
    T_velo_imu = square(np.column_stack([np.reshape(mount['R'], (3, 3)), mount['T']]).ravel())
    poses = oxts_poses([table(file, None)[0] for file in oxts])
    lidar = [T_map_imu @ np.linalg.inv(T_velo_imu) for T_map_imu in poses]
    return Dataset(
        'KITTI raw', files, stamps_ns, trajectory(stamps_ns, lidar), drive / 'oxts' / 'data'
    )


def nuscenes(path: Path) -> Dataset | None:
    """Recognise samples/LIDAR_TOP and sweeps/LIDAR_TOP, with the tables of v1.0-*/."""
    found = [
        file
        for name in ('samples', 'sweeps')
        for file in scans_in(path / name / 'LIDAR_TOP', '.pcd.bin')
    ]
    if not found:
        return None
    by_time = sorted((int(name_number(file)) * 1000, file) for file in found)
    stamps_ns, files = [stamp for stamp, _ in by_time], [file for _, file in by_time]
    tables = next(iter(sorted(path.glob('v1.0-*/sample_data.json'))), None)
    if tables is None:
        return Dataset('nuScenes', files, stamps_ns)
    rows = {Path(row['filename']).name: row for row in json.loads(tables.read_text())}
    ego, mounts = (
        {row['token']: row for row in json.loads((tables.parent / name).read_text())}
        for name in ('ego_pose.json', 'calibrated_sensor.json')
    )
    poses = []
    for file in files:
        row = rows.get(file.name)
        if row is None:
            raise FileFormatError(f'{tables}: no entry for {file.name}')
        T_map_ego = wxyz_pose(ego[row['ego_pose_token']])
        poses.append(T_map_ego @ wxyz_pose(mounts[row['calibrated_sensor_token']]))
    return Dataset('nuScenes', files, stamps_ns, trajectory(stamps_ns, poses), tables)


def mulran(path: Path) -> Dataset | None:
    """Recognise Ouster/ or sensor_data/Ouster/ with names in ns, and global_pose.csv."""
    folders = (path / 'Ouster', path / 'sensor_data' / 'Ouster')
    files = next(filter(None, (scans_in(folder, '.bin') for folder in folders)), [])
    if not files:
        return None
    stamps_ns = [int(name_number(file)) for file in files]
    poses_path = path / 'global_pose.csv'
    if not poses_path.is_file():
        return Dataset('MulRan', files, stamps_ns)
    rows = [line.split(',') for line in poses_path.read_text().splitlines() if line.strip()]
    T_base_lidar = euler_pose(MULRAN_MOUNT[:3], np.radians(MULRAN_MOUNT[3:]))
    poses = [square(np.array(row[1:], np.float64)) @ T_base_lidar for row in rows]
    times_ns = [int(row[0]) for row in rows]
    return Dataset('MulRan', files, stamps_ns, trajectory(times_ns, poses), poses_path)


def helipr(path: Path) -> Dataset | None:
    """Recognise LiDAR/Ouster/ with names in ns, and LiDAR_GT/Ouster_gt.txt."""
    files = scans_in(path / 'LiDAR' / 'Ouster', '.bin')
    if not files:
        return None
    stamps_ns, read = [int(name_number(file)) for file in files], structured(HELIPR_OUSTER)
    poses_path = path / 'LiDAR_GT' / 'Ouster_gt.txt'
    if not poses_path.is_file():
        return Dataset('HeLiPR', files, stamps_ns, read=read)
    rows = [line.split() for line in poses_path.read_text().splitlines() if line.strip()]
    numbers = np.array([row[1:8] for row in rows], np.float64).reshape(-1, 7)
    found = Trajectory(np.array([int(row[0]) for row in rows]), numbers[:, :3], numbers[:, 3:])
    return Dataset('HeLiPR', files, stamps_ns, found, poses_path, read)


def newer_college(path: Path) -> Dataset | None:
    """Recognise raw_format/ouster_scan/cloud_SECONDS_NANOSECONDS.pcd."""
    folders = (path / 'raw_format' / 'ouster_scan', path / 'ouster_scan')
    files = next(filter(None, (scans_in(folder, '.pcd') for folder in folders)), [])
    if not files or not all(file.name.startswith('cloud_') for file in files):
        return None
    parts = [file.stem.split('_')[1:3] for file in files]
    stamps_ns = [int(second) * 10**9 + int(rest) for second, rest in parts]
    return Dataset('Newer College', files, stamps_ns)


def nclt(path: Path) -> Dataset | None:
    """Recognise velodyne_sync/ with names in us."""
    files = scans_in(path / 'velodyne_sync', '.bin')
    if not files:
        return None
    stamps_ns = [int(name_number(file)) * 1000 for file in files]
    return Dataset('NCLT', files, stamps_ns, read=read_nclt)


def boreas(path: Path) -> Dataset | None:
    """Recognise lidar/ with names in us, beside applanix/ or calib/."""
    files = scans_in(path / 'lidar', '.bin')
    if not files or not ((path / 'applanix').is_dir() or (path / 'calib').is_dir()):
        return None
    stamps_ns = [int(name_number(file)) * 1000 for file in files]
    return Dataset('Boreas', files, stamps_ns, read=structured(BOREAS_POINT))


LAYOUTS = (kitti_odometry, kitti_raw, nuscenes, mulran, helipr, newer_college, nclt, boreas)


def scans_in(folder: Path, suffix: str) -> list[Path]:
    """Return the files of a directory with an ending, 2 before 10; empty without the directory."""
    if not folder.is_dir():
        return []
    return sorted((f for f in folder.iterdir() if f.name.endswith(suffix)), key=by_number)


def structured(dtype: np.dtype[Any]) -> Read:
    """Return a reader of files of packed points."""

    def read(path: Path) -> tuple[npt.NDArray[Any], Columns]:
        rows = packed(path, dtype)
        names = [name for name in dtype.names or () if name not in 'xyz']
        points = np.stack([rows[name] for name in 'xyz'], axis=1)
        return points, {name: np.ascontiguousarray(rows[name]) for name in names}

    return read


def read_nclt(path: Path) -> tuple[npt.NDArray[Any], Columns]:
    """Return points (N, 3) float32, m, and columns of a file of NCLT."""
    rows = packed(path, NCLT_POINT)
    points = np.stack([rows[name] * 0.005 - 100.0 for name in 'xyz'], axis=1)
    columns = {name: np.ascontiguousarray(rows[name]) for name in ('intensity', 'ring')}
    return points.astype(np.float32), columns


def packed(path: Path, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return the points of a file of one type; raise FileFormatError for a part of a point."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    if len(content) % dtype.itemsize:
        raise FileFormatError(
            f'{path}: {len(content)} bytes, expected {dtype.itemsize} for every point'
        )
    return np.frombuffer(content, dtype)


def words(path: Path) -> list[str]:
    """Return the words of a text file."""
    return path.read_text(encoding='utf-8').split()


def table(path: Path, columns: int | None) -> Floats:
    """Return the numbers of a text file, (R, columns)."""
    try:
        rows = np.loadtxt(path, np.float64, ndmin=2)
    except ValueError as error:
        raise FileFormatError(f'{path}: no table of numbers: {error}') from error
    if columns is not None and rows.shape[1] != columns:
        raise FileFormatError(f'{path}: {rows.shape[1]} columns, expected {columns}')
    return rows


def calibration(path: Path) -> dict[str, Floats]:
    """Return the numbers of a file of lines NAME: NUMBERS; empty without the file."""
    found: dict[str, Floats] = {}
    for line in path.read_text(encoding='utf-8').splitlines() if path.is_file() else []:
        name, _, rest = line.partition(':')
        try:
            found[name.strip()] = np.array(rest.split(), np.float64)
        except ValueError:  # the date of the calibration
            continue
    return found


def check_number(path: Path, rows: Sequence[object] | Floats, files: Sequence[Path]) -> None:
    """Raise FileFormatError unless a file has one row for each scan."""
    if len(rows) != len(files):
        raise FileFormatError(f'{path}: {len(rows)} rows for {len(files)} scans, expected as many')


def name_number(file: Path) -> str:
    """Return the number at the end of the name of a file."""
    return file.name.partition('.')[0].rpartition('__')[2]


def date_ns(line: str, path: Path) -> int:
    """Return the time of a line 2011-09-26 13:02:25.594360375, ns since 1970."""
    date, _, fraction = line.strip().partition('.')
    try:
        second = datetime.strptime(date, '%Y-%m-%d %H:%M:%S').replace(tzinfo=timezone.utc)
        return int(second.timestamp()) * 10**9 + int(fraction.ljust(9, '0')[:9])
    except ValueError as error:
        raise FileFormatError(f'{path}: {line!r} is no time') from error


def square(numbers: npt.ArrayLike) -> Floats:
    """Return the (4, 4) matrix of 12 numbers, row by row."""
    return np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def euler_pose(xyz: npt.ArrayLike, rpy: npt.ArrayLike) -> Floats:
    """Return the (4, 4) pose of a position and roll, pitch, yaw in rad, R = Rz Ry Rx."""
    roll, pitch, yaw = np.asarray(rpy, np.float64)
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = xyz
    return pose


def wxyz_pose(row: dict[str, Any]) -> Floats:
    """Return the (4, 4) pose of a row of nuScenes: translation, rotation w x y z."""
    w, x, y, z = row['rotation']
    return pose_matrix(row['translation'], (x, y, z, w))


def oxts_poses(rows: Sequence[Floats]) -> list[Floats]:
    """Return the poses of the IMU by lat lon alt roll pitch yaw, Mercator from the first one."""
    scale, origin, poses = math.cos(math.radians(rows[0][0])) * EARTH_M, None, []
    for latitude, longitude, altitude, roll, pitch, yaw in (row[:6] for row in rows):
        north = scale * math.log(math.tan(math.pi * (90.0 + latitude) / 360.0))
        position = np.array([scale * math.radians(longitude), north, altitude])
        origin = position if origin is None else origin
        poses.append(euler_pose(position - origin, (roll, pitch, yaw)))
    return poses


def trajectory(stamps_ns: Sequence[int], poses: Sequence[Floats]) -> Trajectory:
    """Return a trajectory of poses (4, 4)."""
    return Trajectory(
        np.array(stamps_ns, np.int64),
        np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3),
        np.array([q_xyzw(pose) for pose in poses]).reshape(-1, 4),
    )
