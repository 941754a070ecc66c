# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Folders of depth images, recognised by their layout: TUM RGB-D, 7-Scenes, Replica, ScanNet.

Poses are those of the camera, x right, y down, z ahead, and depth is along z. Intrinsics are read
from a file beside the images, else those that the data set states are taken, with a warning. The
value 65535 is no depth (7-Scenes), nor is 0.

Sources: the pages of the data sets; Replica as NICE-SLAM rendered it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
import json
import logging
from pathlib import Path
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, FileFormatError
from surfel_mapper.files.atomic import by_number
from surfel_mapper.files.pose_rows import MAX_SKEW, rigid_poses
from surfel_mapper.files.stamps import column_ns
from surfel_mapper.files.text_table import read_lines, table_rows
from surfel_mapper.files.trajectory import read_trajectory, Trajectory
from surfel_mapper.geometry import quaternions
from surfel_mapper.messages.compressed_image import pixels_of
from surfel_mapper.offline.datasets import content_of
from surfel_mapper.scan import DepthImage, Scan

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels."""

FRAME_NS = 33_333_333
"""Period of images without times: 30 Hz."""

NO_DEPTH = 65535

DEPTH_VOXEL_M = 0.08
"""Edge of the voxels of a map of depth images, m: twice that for models of one image. In voxels of
0.5 m a kitchen has too few surfaces for registration: 79 of 100 images were placed, not all."""

TUM_M, MM, REPLICA_M = 5000.0, 1000.0, 6553.5
"""Units of depth in a metre."""

FREIBURG: dict[str, Intrinsics] = {
    '1': (517.3, 516.5, 318.6, 255.3),
    '2': (520.9, 521.0, 325.1, 249.7),
    '3': (535.4, 539.2, 320.1, 247.6),
}
"""Cameras of TUM by the number in the name of the folder; those of others are KINECT's."""

KINECT: Intrinsics = (525.0, 525.0, 319.5, 239.5)

SEVEN_SCENES: Intrinsics = (585.0, 585.0, 320.0, 240.0)

REPLICA: Intrinsics = (600.0, 600.0, 599.5, 339.5)

USUAL_M = 0.8, 12.0
"""Limits of the depth below which nine tenths of an image are, m: cameras measure 0.4 to 10 m."""

INTRINSICS = (
    'cam_params.json',
    'intrinsic_depth.txt',
    'intrinsics.txt',
    'camera-intrinsics.txt',
    'intrinsic/intrinsic_depth.txt',
)
"""Files of a matrix of 3 x 3 or 4 x 4, or of fx fy cx cy, in the folder or the one above."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class DepthFolder:
    """
    Depth images of a folder.

    Attributes
    ----------
    format : str
        Name of the layout, for info.
    files : list of Path
        One image a scan.
    stamps_ns : list of int
        Time of each.
    trajectory : Trajectory, optional
        Poses of the camera.
    poses_path : Path
        Their file or folder.
    intrinsics : fx, fy, cx, cy
    units_per_m : float
        Values of a pixel in a metre, unless the folder states others.

    """

    format: str
    files: list[Path]
    stamps_ns: list[int]
    trajectory: Trajectory | None
    poses_path: Path
    intrinsics: Intrinsics
    units_per_m: float

    def depth_scan(self, number: int, stamp_ns: int, frame_id: str) -> Scan:
        """
        Return the points of an image, with the image.

        Raises
        ------
        FileFormatError
            If it is no PNG of 16 bits.

        """
        from surfel_mapper.sensors.depth import depth_points, PinholeCamera  # the compiler

        file = self.files[number]
        try:
            encoding, pixels = pixels_of(content_of(file), str(file), ('PNG',), None)
        except CloudFormatError as error:
            raise FileFormatError(str(error)) from error
        if encoding != '16UC1':
            raise FileFormatError(f'{file}: a PNG of {encoding}, expected depth of 16 bits')
        depth = pixels.astype(np.float32) / np.float32(self.units_per_m)
        depth[pixels == NO_DEPTH] = np.nan
        camera = PinholeCamera(pixels.shape[1], pixels.shape[0], *self.intrinsics)
        points = depth_points(depth, camera)
        return Scan(
            points=points,
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            camera=astuple(camera),
            depth=DepthImage(points=points, depth=depth),
        )

    def check_scale(self, scan: Scan) -> None:
        """Warn if the depth of a scan is unusual for a camera, as if its unit were another."""
        depth_m = float(np.quantile(scan.points[:, 2], 0.9)) if len(scan) else USUAL_M[0]
        if not USUAL_M[0] <= depth_m <= USUAL_M[1]:
            logger.warning(
                '%s: 90%% of the depth is below %.2f m, which is unusual: is a metre not %g '
                'values (%s)? State others as scale in cam_params.json, with fx, fy, cx, cy',
                *(self.files[0], depth_m, self.units_per_m, self.format),
            )


def find_depth_folder(path: Path) -> DepthFolder | None:
    """
    Return the depth images in a directory; None if it has no known layout.

    Raises
    ------
    FileFormatError
        If a file of times, poses or intrinsics is damaged.

    """
    layout = layout_of(path)
    return None if layout is None else layout(path)


def layout_of(path: Path) -> Callable[[Path], DepthFolder] | None:
    """Return the reader of the layout of a directory, by some of its files; None for others."""
    if path.is_dir():
        for layout, patterns in LAYOUTS:
            if all(next(path.glob(pattern), None) is not None for pattern in patterns):
                return layout
    return None


def tum(path: Path) -> DepthFolder:
    """Return the images of depth.txt, lines of a time and a file, beside groundtruth.txt."""
    table = path / 'depth.txt'
    rows = table_rows(read_lines(table), 2, meaning=': a time and a file')
    stamps_ns = column_ns(rows, 0).tolist()
    files = [path / words[1] for words in rows.words]
    poses_path = path / 'groundtruth.txt'
    poses = read_trajectory(poses_path, 'tum') if poses_path.is_file() else None
    camera = re.search('freiburg([123])|fr([123])', path.name.lower())
    nominal = FREIBURG[camera[1] or camera[2]] if camera else KINECT
    intrinsics, units_per_m = camera_of(path, nominal, TUM_M)
    return DepthFolder('TUM RGB-D', files, stamps_ns, poses, poses_path, intrinsics, units_per_m)


def seven_scenes(path: Path) -> DepthFolder:
    """Return the images frame-N.depth.png with frame-N.pose.txt."""
    files = images(path, 'frame-*.depth.png')
    poses = [path / f'{file.name.partition(".")[0]}.pose.txt' for file in files]
    return numbered_folder('7-Scenes', path, files, poses, SEVEN_SCENES, path)


def replica(path: Path) -> DepthFolder:
    """Return the images results/depthN.png with traj.txt, a matrix a line."""
    files, poses_path = images(path / 'results', 'depth*.png'), path / 'traj.txt'
    poses, numbers = read_trajectory(poses_path, 'kitti'), list(map(number_of, files))
    if numbers[-1] >= len(poses):
        raise FileFormatError(
            f'{poses_path}: {len(poses)} poses, none for {files[-1].name}; expected one a line'
        )
    stamps_ns = [FRAME_NS * number for number in numbers]
    trajectory = Trajectory(np.array(stamps_ns), poses.xyz[numbers], poses.q_xyzw[numbers])
    intrinsics, units_per_m = camera_of(path, REPLICA, REPLICA_M)
    return DepthFolder(
        'Replica', files, stamps_ns, trajectory, poses_path, intrinsics, units_per_m
    )


def scannet(path: Path) -> DepthFolder:
    """Return the images depth/N.png with pose/N.txt, in the folder or in frames/."""
    folder = path if (path / 'depth').is_dir() else path / 'frames'
    files = images(folder / 'depth', '*.png')
    poses = [folder / 'pose' / f'{file.stem}.txt' for file in files]
    return numbered_folder('ScanNet', folder, files, poses, None, folder / 'pose')


LAYOUTS = (
    (tum, ('depth.txt', 'depth')),
    (seven_scenes, ('frame-*.depth.png',)),
    (replica, ('results/depth*.png', 'traj.txt')),
    (scannet, ('depth/*.png', 'pose')),
    (scannet, ('frames/depth/*.png', 'frames/pose')),
)
"""The reader of each layout, and patterns of files that it has."""


def images(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a pattern in a folder by their numbers, hidden ones left out."""
    return sorted((f for f in folder.glob(pattern) if f.name[0] != '.'), key=by_number)


def number_of(file: Path) -> int:
    """Return the number in the name of an image."""
    digits = re.search(r'\d+', file.name)
    if digits is None:
        raise FileFormatError(f'{file}: no number in its name')
    return int(digits[0])


def numbered_folder(
    name: str,
    path: Path,
    files: list[Path],
    pose_files: Sequence[Path],
    nominal: Intrinsics | None,
    poses_path: Path,
) -> DepthFolder:
    """Return images in mm whose poses are files of a matrix; lost ones, not finite, have none."""
    stamps_ns = [FRAME_NS * number_of(file) for file in files]
    matrices = np.array([pose_matrix_in(file) for file in pose_files])
    is_known = np.isfinite(matrices).all(axis=1)
    poses, skew = rigid_poses(matrices[is_known])
    if len(skew) and not skew.max() <= MAX_SKEW:
        raise FileFormatError(f'{pose_files[0]} and others: a matrix that is no rotation')
    stamps = np.array(stamps_ns)[is_known]
    trajectory = Trajectory(stamps, poses[:, :3, 3].copy(), quaternions(poses))
    intrinsics, units_per_m = camera_of(path, nominal, MM)
    return DepthFolder(
        name,
        files,
        stamps_ns,
        trajectory if len(stamps) else None,
        poses_path,
        intrinsics,
        units_per_m,
    )


def pose_matrix_in(file: Path) -> npt.NDArray[np.float64]:
    """Return the 12 numbers of a pose in a file of 4 x 4; nan without the file."""
    return numbers_in(file, (16,))[:12] if file.is_file() else np.full(12, np.nan)


def numbers_in(file: Path, sizes: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return all numbers of a text; raise FileFormatError for another number of them."""
    words = ' '.join(read_lines(file).texts).replace(',', ' ').split()
    try:
        numbers = np.array(words, np.float64)
    except ValueError as error:
        raise FileFormatError(f'{file}: {error}') from error
    if len(numbers) not in sizes:
        expected = ' or '.join(map(str, sizes))
        raise FileFormatError(f'{file}: {len(numbers)} numbers, expected {expected}')
    return numbers


def camera_of(
    path: Path, nominal: Intrinsics | None, units_per_m: float
) -> tuple[Intrinsics, float]:
    """Return intrinsics and units of depth, of a file in the folder or above it, else as known."""
    candidates = [folder / name for folder in (path, path.parent) for name in INTRINSICS]
    file = next(filter(Path.is_file, candidates), None)
    if file is None:
        if nominal is None:
            raise FileFormatError(f'{path}: no intrinsics of its camera, expected {INTRINSICS[1]}')
        logger.warning(
            '%s: no file of intrinsics, uses those of the data set: fx, fy, cx, cy %s',
            *(path, nominal),
        )
        return nominal, units_per_m
    if file.suffix == '.json':
        return camera_in_json(file, units_per_m)
    numbers = numbers_in(file, (4, 9, 16))
    if len(numbers) > 4:
        matrix = numbers.reshape(int(len(numbers) ** 0.5), -1)
        numbers = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    fx, fy, cx, cy = numbers.tolist()
    return (fx, fy, cx, cy), units_per_m


def camera_in_json(file: Path, units_per_m: float) -> tuple[Intrinsics, float]:
    """Return intrinsics and units of depth of Replica's cam_params.json."""
    try:
        camera: dict[str, Any] = json.loads(content_of(file))['camera']
        fx, fy, cx, cy = (float(camera[name]) for name in ('fx', 'fy', 'cx', 'cy'))
        return (fx, fy, cx, cy), float(camera.get('scale', units_per_m))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise FileFormatError(
            f'{file}: no camera with fx, fy, cx, cy: {type(error).__name__}: {error}'
        ) from error


def for_depth_images(config: Config) -> Config:
    """Return the settings for depth images, with voxels of DEPTH_VOXEL_M if no size is set."""
    settings: dict[str, Any] = {'input.kind': 'depth'}
    if config.map.voxel_size_m == Config().map.voxel_size_m and not config.map.load:
        settings['map.voxel_size_m'] = DEPTH_VOXEL_M
    return config.replace(settings)
