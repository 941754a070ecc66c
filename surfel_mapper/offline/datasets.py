# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Folders of public data sets, recognised by their layout: scans, times, poses, calibration.

``find_dataset`` tries the layouts of KITTI odometry and raw, nuScenes, Argoverse 2, MulRan,
HeLiPR, Newer College, NCLT and Boreas. An E57 file has scans with poses too. Poses are returned as
poses of the lidar, if the folder has them and the calibration they need; without, the scans are
registered. Of a KITTI drive, a part of the scans may have been copied: their names are the numbers
of their rows.

Sources: development kits and papers of the data sets. Poses of Newer College, NCLT and Boreas are
not read, because the folders do not contain the calibration of the lidar.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import ConfigError, FileFormatError, refusing
from surfel_mapper.files.atomic import by_number
from surfel_mapper.files.foreign_points import read_feather
from surfel_mapper.files.pose_rows import (
    MAX_SKEW,
    rigid_poses,
    warn_of_skew,
)
from surfel_mapper.files.raw import FLOATS
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.stamps import read_dates, read_times
from surfel_mapper.files.text_table import finite, read_lines
from surfel_mapper.files.trajectory import read_trajectory, Trajectory
from surfel_mapper.geometry import pose_matrix, quaternions
from surfel_mapper.offline.scan_times import numbered, rows_of

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

MAX_CALIBRATION_BYTES = 1 << 16
"""Size limit of a calibration; those of KITTI have 2 kB."""


def read_kitti(path: Path) -> tuple[npt.NDArray[Any], Columns]:
    """Return the points of a scan, in a .bin four float32 each, as most data sets have them."""
    return read_scan(path, FLOATS)


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
    missing : str
        Why poses in the folder are not used; empty if it has none.

    """

    name: str
    files: list[Path]
    stamps_ns: list[int]
    trajectory: Trajectory | None = None
    poses_path: Path | None = None
    read: Read = read_kitti
    missing: str = ''

    @property
    def format(self) -> str:
        """Name of the layout, for info."""
        return f'{self.name} data set'

    def scan(self, number: int) -> tuple[npt.NDArray[Any], Columns]:
        """Return points (N, 3), m, and columns of a scan; raises FileFormatError."""
        return self.read(self.files[number])


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
        dataset = recognise(path)
        if dataset is not None:
            return dataset
    return None


def kitti_odometry(path: Path) -> Dataset | None:
    """Recognise sequences/NN: velodyne/, times.txt, calib.txt; poses/NN.txt two levels up."""
    files, times = scans_in(path / 'velodyne', '.bin'), path / 'times.txt'
    if not files or not times.is_file():
        return None
    stamps_ns = scan_rows(times, read_times(times), files).tolist()
    candidates = (path / 'poses.txt', path.parent.parent / 'poses' / f'{path.name}.txt')
    poses_path = next((file for file in candidates if file.is_file()), None)
    mount = calibration(path / 'calib.txt').get('Tr')
    if poses_path is None:
        return Dataset('KITTI odometry', files, stamps_ns)
    if mount is None:
        missing = f'{poses_path} is not used: {lacking(path / "calib.txt", "Tr")}'
        return Dataset('KITTI odometry', files, stamps_ns, missing=missing)
    cameras = scan_rows(poses_path, read_trajectory(poses_path, 'kitti').matrices, files)
    T_cam_velo = rigid(path / 'calib.txt', mount)
    poses = np.linalg.inv(T_cam_velo) @ cameras @ T_cam_velo
    motion = trajectory(times, stamps_ns, poses)
    return Dataset('KITTI odometry', files, stamps_ns, motion, poses_path)


def kitti_raw(path: Path) -> Dataset | None:
    """Recognise DATE_drive_N_sync: velodyne_points/{data,timestamps.txt}, oxts/data."""
    folder = path if path.name == 'velodyne_points' else path / 'velodyne_points'
    files, times = scans_in(folder / 'data', '.bin'), folder / 'timestamps.txt'
    if not files or not times.is_file():
        return None
    stamps_ns = scan_rows(times, read_dates(times), files).tolist()
    drive = folder.parent
    measured = drive / 'oxts' / 'data'
    names = {file.name for file in scans_in(measured, '.txt')}
    if not names:
        return Dataset('KITTI raw', files, stamps_ns)
    oxts = [measured / f'{file.stem}.txt' for file in files]
    calibrated = drive.parent / 'calib_imu_to_velo.txt'
    mount = calibration(calibrated)
    absent = [file for file in oxts if file.name not in names]
    if absent or not {'R', 'T'} <= mount.keys():
        why = f'no {absent[0].name} in it' if absent else lacking(calibrated, 'R and T')
        missing = f'{measured} is not used: {why}'
        return Dataset('KITTI raw', files, stamps_ns, missing=missing)
    R, t = mount['R'], mount['T']
    if len(R) != 9 or len(t) != 3:
        raise FileFormatError(
            f'{calibrated}: {len(R)} numbers of R and {len(t)} of T, expected 9, 3'
        )
    T_velo_imu = rigid(calibrated, np.column_stack([R.reshape(3, 3), t]).ravel())
    lidar = np.array(oxts_poses(oxts)) @ np.linalg.inv(T_velo_imu)
    motion = trajectory(times, stamps_ns, lidar)
    return Dataset('KITTI raw', files, stamps_ns, motion, measured)


def nuscenes(path: Path) -> Dataset | None:
    """Recognise samples/LIDAR_TOP and sweeps/LIDAR_TOP, with the tables of v1.0-*/."""
    scans = [
        file
        for name in ('samples', 'sweeps')
        for file in scans_in(path / name / 'LIDAR_TOP', '.pcd.bin')
    ]
    if not scans:
        return None
    by_time = sorted((stamp_in_name(file, 1000), file) for file in scans)
    stamps_ns, files = [stamp for stamp, _ in by_time], [file for _, file in by_time]
    tables = next(iter(sorted(path.glob('v1.0-*/sample_data.json'))), None)
    if tables is None:
        return Dataset('nuScenes', files, stamps_ns, read=read_scan)
    poses = np.array(nuscenes_poses(tables, files))
    motion = trajectory(tables, stamps_ns, poses)
    return Dataset('nuScenes', files, stamps_ns, motion, tables, read_scan)


def nuscenes_poses(tables: Path, files: Sequence[Path]) -> list[Floats]:
    """Return the poses of the lidar, T_map_lidar (4, 4), of scans in nuScenes."""
    try:
        rows = {Path(row['filename']).name: row for row in json_of(tables)}
        ego, mounts = (
            {row['token']: row for row in json_of(tables.parent / name)}
            for name in ('ego_pose.json', 'calibrated_sensor.json')
        )
        poses = []
        for file in files:
            row = rows.get(file.name)
            if row is None:
                raise FileFormatError(f'{tables}: no entry for {file.name}')
            T_map_ego = wxyz_pose(ego[row['ego_pose_token']])
            poses.append(T_map_ego @ wxyz_pose(mounts[row['calibrated_sensor_token']]))
    except (FileFormatError, ConfigError):
        raise
    except Exception as error:  # of rows of any shape, with numbers of any size
        raise FileFormatError(
            f'{tables.parent}: its tables are not those of nuScenes: '
            f'{type(error).__name__}: {error}'
        ) from error
    return poses


def argoverse2_poses(path: Path) -> Trajectory:
    """Return the poses of the vehicle in Argoverse 2."""
    table = read_feather(path)
    names = ('tx_m', 'ty_m', 'tz_m', 'qx', 'qy', 'qz', 'qw')
    missing = [name for name in ('timestamp_ns', *names) if name not in table]
    if missing:
        raise FileFormatError(f'{path}: no {missing[0]} among {", ".join(table)}')
    order = np.argsort(table['timestamp_ns'])
    numbers = np.stack([table[name][order] for name in names], axis=1)
    return Trajectory(table['timestamp_ns'][order], numbers[:, :3], numbers[:, 3:])


def read_argoverse2(path: Path) -> tuple[npt.NDArray[Any], Columns]:
    """Return the points of a sweep, which are those at its stamp: their times are left out."""
    points, columns = read_scan(path)
    return points, {name: values for name, values in columns.items() if name != 'offset_ns'}


def mulran_poses(path: Path) -> Trajectory:
    """Return the poses of the lidar in MulRan, a time in ns and a matrix of the base a line."""
    T_base_lidar = euler_pose(MULRAN_MOUNT[:3], np.radians(MULRAN_MOUNT[3:]))
    poses = read_trajectory(path)
    return Trajectory.from_matrices(poses.matrices @ T_base_lidar, poses.stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedByTime:
    """
    A layout of scans in a folder that are named by their times.

    Attributes
    ----------
    name : str
        Name of the data set.
    folders : tuple of str
        The first that has files of the ending has the scans.
    suffix : str
        The ending.
    unit_ns : int
        Unit of the times in the names, ns.
    read : callable
        Reads the points of a file.
    poses : str
        File of poses; empty: none.
    read_poses : callable
        Reads it.
    beside : tuple of str
        Directories, one of which tells the layout from others.

    """

    name: str
    folders: tuple[str, ...]
    suffix: str = '.bin'
    unit_ns: int = 1
    read: Read = read_kitti
    poses: str = ''
    read_poses: Callable[[Path], Trajectory] = read_trajectory
    beside: tuple[str, ...] = ('',)

    def __call__(self, path: Path) -> Dataset | None:
        """Return the data set in a directory; None if it has another layout."""
        folders = (scans_in(path / folder, self.suffix) for folder in self.folders)
        files = next(filter(None, folders), [])
        if not files or not any((path / name).is_dir() for name in self.beside):
            return None
        stamps_ns = [stamp_in_name(file, self.unit_ns) for file in files]
        poses_path = path / self.poses
        if not self.poses or not poses_path.is_file():
            return Dataset(self.name, files, stamps_ns, read=self.read)
        poses = self.read_poses(poses_path)
        return Dataset(self.name, files, stamps_ns, poses, poses_path, self.read)


def scans_in(folder: Path, suffix: str) -> list[Path]:
    """Return the files of a directory with an ending, 2 before 10; empty without the directory."""
    if not folder.is_dir():
        return []
    files = (f for f in folder.iterdir() if f.name.lower().endswith(suffix) and f.name[0] != '.')
    return sorted(files, key=by_number)


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
    content = content_of(path)
    if len(content) % dtype.itemsize:
        raise FileFormatError(
            f'{path}: {len(content)} bytes, expected {dtype.itemsize} for every point'
        )
    return np.frombuffer(content, dtype)


def content_of(path: Path) -> bytes:
    """Return the content of a file; raise FileFormatError if it cannot be read."""
    with refusing(path), open_regular(path) as file:
        return file.read()


LAYOUTS: tuple[Callable[[Path], Dataset | None], ...] = (
    kitti_odometry,
    kitti_raw,
    nuscenes,
    NamedByTime(
        name='Argoverse 2',
        folders=('sensors/lidar',),
        suffix='.feather',
        read=read_argoverse2,
        poses='city_SE3_egovehicle.feather',
        read_poses=argoverse2_poses,
    ),
    NamedByTime(
        name='MulRan',
        folders=('Ouster', 'sensor_data/Ouster'),
        poses='global_pose.csv',
        read_poses=mulran_poses,
    ),
    NamedByTime(
        name='HeLiPR',
        folders=('LiDAR/Ouster',),
        read=structured(HELIPR_OUSTER),
        poses='LiDAR_GT/Ouster_gt.txt',
    ),
    NamedByTime(
        name='Newer College', folders=('raw_format/ouster_scan', 'ouster_scan'), suffix='.pcd'
    ),
    NamedByTime(name='NCLT', folders=('velodyne_sync',), unit_ns=1000, read=read_nclt),
    NamedByTime(
        name='Boreas',
        folders=('lidar',),
        unit_ns=1000,
        read=structured(BOREAS_POINT),
        beside=('applanix', 'calib'),
    ),
)


def json_of(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table in JSON."""
    with refusing(path):
        rows = json.loads(content_of(path))
    if not isinstance(rows, list):
        raise FileFormatError(f'{path}: expected a list of rows')
    return rows


def calibration(path: Path) -> dict[str, Floats]:
    """Return the numbers of a file of lines NAME: NUMBERS; empty without the file."""
    numbers: dict[str, Floats] = {}
    if not path.is_file():
        return numbers
    if path.stat().st_size > MAX_CALIBRATION_BYTES:
        raise FileFormatError(f'{path}: larger than {MAX_CALIBRATION_BYTES} bytes')
    for line in read_lines(path).texts:
        name, _, values = line.partition(':')
        try:
            numbers[name.strip()] = np.array(values.split(), np.float64)
        except ValueError:  # the date of the calibration
            continue
    return numbers


def lacking(path: Path, names: str) -> str:
    """Return, for a reason, which part of a calibration is missing."""
    return f'no {names} in {path}' if path.is_file() else f'no {path}'


def rigid(path: Path, numbers: npt.ArrayLike) -> Floats:
    """Return the pose (4, 4) nearest to 12 numbers, row by row; warn if they are no rotation."""
    flat = np.ravel(np.asarray(numbers, np.float64))
    poses, skew = rigid_poses(flat[None] if len(flat) == 12 else np.full((1, 12), np.nan))
    if not (np.isfinite(flat).all() and skew[0] <= MAX_SKEW):
        raise FileFormatError(
            f'{path}: {flat.tolist()}, expected 3 rows of a rotation and a place'
        )
    warn_of_skew(path, skew[0])
    return np.asarray(poses[0], np.float64)


def scan_rows(path: Path, rows: npt.NDArray[Any], files: Sequence[Path]) -> npt.NDArray[Any]:
    """Return the row of each scan; raise FileFormatError if not all scans have one."""
    numbers = rows_of(files, len(rows))
    if numbers is None:
        raise FileFormatError(
            f'{path}: {len(rows)} rows for {len(files)} scans, expected as many, or '
            f'{numbered(len(rows))}'
        )
    return rows[numbers]


def stamp_in_name(file: Path, unit_ns: int) -> int:
    """Return the time, ns, that ends the name of a file as a number of a unit."""
    name = file.name.partition('.')[0].rpartition('__')[2]
    seconds, _, digits = name.removeprefix('cloud_').rpartition('_')  # both in Newer College
    is_time = digits.isdecimal() and (seconds or '0').isdecimal() and len(name) <= 26
    is_time &= bool(seconds) == name.startswith('cloud_')
    stamp_ns = int(seconds or 0) * 10**9 + int(digits) * unit_ns if is_time else -1
    if not 0 <= stamp_ns < 2**63:
        raise FileFormatError(
            f'{file}: expected a name that ends with its time, {unit_ns} ns a unit'
        )
    return stamp_ns


def euler_pose(xyz: npt.ArrayLike, rpy: npt.ArrayLike) -> Floats:
    """Return the (4, 4) pose of a position and roll, pitch, yaw in rad, R = Rz Ry Rx."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler('xyz', rpy).as_matrix()
    pose[:3, 3] = xyz
    return pose


def wxyz_pose(row: dict[str, Any]) -> Floats:
    """Return the (4, 4) pose of a row of nuScenes: translation, rotation w x y z."""
    w, x, y, z = row['rotation']
    return pose_matrix(row['translation'], (x, y, z, w))


def oxts_poses(files: Sequence[Path]) -> list[Floats]:
    """Return the poses of the IMU by lat lon alt roll pitch yaw, Mercator from the first one."""
    scale = 0.0
    first: Floats = np.zeros(3)
    poses: list[Floats] = []
    for file in files:
        lines = read_lines(file)
        numbers = finite(lines.texts[0].split()[:6], lines.where(0)) if lines.texts else []
        if len(numbers) != 6 or not abs(numbers[0]) < 90.0:
            raise FileFormatError(
                f'{file}: {numbers}, expected latitude, longitude, altitude, three angles'
            )
        latitude, longitude, altitude, *angles = numbers
        scale = scale or math.cos(math.radians(latitude)) * EARTH_M
        north = scale * math.log(math.tan(math.pi * (90.0 + latitude) / 360.0))
        position = np.array([scale * math.radians(longitude), north, altitude])
        first = first if poses else position
        poses.append(euler_pose(position - first, angles))
    return poses


def trajectory(path: Path, stamps_ns: Sequence[int], poses: Floats) -> Trajectory:
    """Return a trajectory of poses (S, 4, 4); raise FileFormatError unless stamps ascend."""
    times_ns = np.array(stamps_ns, np.int64)
    back = np.flatnonzero(np.diff(times_ns) <= 0)
    if len(back):
        raise FileFormatError(
            f'{path}: row {back[0] + 2}: time {times_ns[back[0] + 1]} ns is not after that before'
        )
    return Trajectory(times_ns, poses[:, :3, 3].copy(), quaternions(poses))
