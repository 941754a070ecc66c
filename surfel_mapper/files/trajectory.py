# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Trajectories as text: reading those of most programs, writing TUM.

A line is a pose: a stamp or nothing, x y z and a quaternion, or a matrix. A header names the
columns, also in a comment (EuRoC, Newer College, rostopic echo -p). Without one the first line
decides. Read are TUM (with an id behind it: RTAB-Map; in nanoseconds: ORB-SLAM3), KITTI, matrices
of four rows in a line (Replica), with the number of the scan (KITTI-360) or a time (MulRan) before
them, and g2o's VERTEX_SE3.

Coordinates are written with the digits that restore the same float64, stamps with all nanoseconds
(stamps.py). Poses are neither sorted nor interpolated here: a pose of the wrong time maps a scan
to the wrong place.

The formats are in one module because they share the class and the check of stamps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import logging
from pathlib import Path
import re
from textwrap import shorten
from typing import Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers, as_path, as_whole, made_array
from surfel_mapper.errors import counted, FileFormatError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.pose_rows import matrix_rows, quaternion_rows, warn_of_skew
from surfel_mapper.files.stamps import column_ns, read_times, unit_by_digits
from surfel_mapper.files.text_table import is_comment, read_lines, Rows, table_rows, TextLines
from surfel_mapper.geometry import check_rigid, pose_matrix, q_xyzw, quaternions
from surfel_mapper.poses.buffer import seconds

logger = logging.getLogger(__name__)

SUFFIXES = ('.tum', '.txt', '.csv', '.kitti', '.g2o')
"""Endings of trajectories."""

LEVEL = 0.9
"""Cosine of the inclination of a vehicle that is level."""

FORMATS = ('tum', 'kitti', 'csv', 'g2o')

TRAJECTORY = 'trajectory.tum'
"""File of a replay with the poses of its scans, beside the map and in its frame."""

TUM_HEADER = '# stamp_s x y z qx qy qz qw\n'

KITTI_TIMES = 'times.txt'
"""The file beside KITTI poses with the seconds of each."""

POSE_COLUMNS = [
    *(rf'((.*_)?(pos|pose|position|translation|t|p)_?|p_rs_r_)?{axis}' for axis in 'xyz'),
    *(rf'(.*_)?(q|q_rs|quat|quaternion|orientation|rot|rotation)_?{axis}' for axis in 'xyzw'),
]
"""
Names of the seven numbers of a pose in a header, as of EuRoC (p_RS_R_x) or a topic of ROS
(field.pose.pose.position.x, /odom/pose/pose/orientation/w).
"""

STAMP_COLUMN = re.compile(r'(?:.*_)?(?:u?time|(?:time)?stamp|t)(?:_(sec|[mun]?s))?')
"""Names of a stamp, perhaps with its unit."""

PARTS = ('(.*_)?secs?', '(.*_)?(nsecs?|nanosec)')
"""Names of the columns of a stamp in two numbers."""

MOST_NUMBER = 10**9
"""Limit of the number of a scan; larger ones before a matrix are times."""

MOST_SHOWN = 200
"""Length of the names of columns in an error, characters."""

TUM, RTABMAP = 8, 9
"""Numbers of columns: stamp x y z qx qy qz qw, and an id."""

MATRICES = (12, 13, 16, 17)
"""Numbers of columns of three or four rows of a matrix, and of the number of the scan first."""

VERTEX = 'VERTEX_SE3:QUAT'
"""First word of a pose in g2o: its number, x y z qx qy qz qw."""


class PoseColumns(NamedTuple):
    """Number of columns of a table, those of its stamp with their units, those of the pose."""

    width: int
    stamps: dict[int, str]
    pose: list[int]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """
    Poses of one frame in another over time, by ascending stamp.

    Attributes
    ----------
    stamp_ns : (S,) int64, or None
        None for KITTI poses without a times.txt: pose i is that of scan i.
    number : (S,) int64, or None
        Of poses without stamps of some scans: the numbers of these, ascending.
    xyz : (S, 3) float64, m
    q_xyzw : (S, 4) float64
        Of squared norm 1 within 1e-2.

    Examples
    --------
    >>> import numpy as np
    >>> poses = np.repeat(np.eye(4)[None], 3, axis=0)
    >>> poses[:, 0, 3] = [0, 1, 2]
    >>> trajectory = Trajectory.from_matrices(poses, np.arange(3) * 10**9)
    >>> trajectory, trajectory[2][:3, 3].tolist()
    (Trajectory(3 poses in 2.000 s), [2.0, 0.0, 0.0])

    """

    stamp_ns: npt.NDArray[np.int64] | None
    xyz: npt.NDArray[np.float64]
    q_xyzw: npt.NDArray[np.float64]
    number: npt.NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        """Turn lists into arrays; raise ValueError if shapes or types are not as above."""
        for name, width in (('xyz', 3), ('q_xyzw', 4)):
            numbers = as_numbers(name, getattr(self, name))
            if numbers.ndim != 2 or numbers.shape[1] != width:
                raise ValueError(f'{name}: shape {numbers.shape}, expected (S, {width})')
            object.__setattr__(self, name, numbers)
        lengths = [len(self.xyz), len(self.q_xyzw)]
        if self.stamp_ns is not None:
            stamps = as_array('stamp_ns', self.stamp_ns)
            if stamps.ndim != 1 or (stamps.size and stamps.dtype.kind not in 'iu'):
                raise ValueError(
                    f'stamp_ns: {stamps.dtype} {stamps.shape}, expected whole nanoseconds (S,)'
                )
            object.__setattr__(self, 'stamp_ns', stamps.astype(np.int64, copy=False))
            lengths.append(len(stamps))
        if len(set(lengths)) > 1:
            raise ValueError(f'positions, rotations, stamps: {lengths}, expected equal numbers')

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.xyz)

    @overload
    def __getitem__(self, row: int | np.integer[Any]) -> npt.NDArray[np.float64]: ...

    @overload
    def __getitem__(self, row: slice) -> Trajectory: ...

    def __getitem__(self, row: Any) -> Any:
        """
        Return one pose (4, 4) for a whole number, a Trajectory for a slice.

        Raises
        ------
        IndexError
            If there is no such pose.
        TypeError
            If it is neither a whole number nor a slice; ``matrices`` takes every index of numpy.

        """
        if isinstance(row, slice):
            stamps = None if self.stamp_ns is None else self.stamp_ns[row]
            if stamps is not None and (np.diff(stamps) < 0).any():
                raise IndexError(f'{row}: stamps would descend, expected a positive step')
            number = None if self.number is None else self.number[row]
            return Trajectory(stamps, self.xyz[row], self.q_xyzw[row], number)
        row = as_whole('pose', row)
        if not -len(self) <= row < len(self):
            raise IndexError(
                f'pose {row} of {len(self)}, expected {-len(self)} to {len(self) - 1}'
            )
        return pose_matrix(self.xyz[row].tolist(), self.q_xyzw[row].tolist())

    def __iter__(self) -> Iterator[npt.NDArray[np.float64]]:
        """Yield the poses, (4, 4) each."""
        return iter(self.matrices)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return ``matrices``, (S, 4, 4), for np.asarray."""
        return made_array(self.matrices, dtype, copy)

    def __repr__(self) -> str:
        """Return the number of poses and their duration."""
        if self.stamp_ns is None or not len(self):
            return f'Trajectory({counted(len(self), "pose")})'
        lasts_s = (self.stamp_ns[-1] - self.stamp_ns[0]) / 1e9
        return f'Trajectory({counted(len(self), "pose")} in {lasts_s:.3f} s)'

    @classmethod
    def from_matrices(
        cls, T_fixed_sensor: npt.ArrayLike, stamp_ns: npt.ArrayLike | None = None
    ) -> Trajectory:
        """
        Return the trajectory of transforms.

        Parameters
        ----------
        T_fixed_sensor : (S, 4, 4) float
            The poses.
        stamp_ns : (S,) int, optional
            Their times, nanoseconds, ascending.

        Raises
        ------
        ValueError
            If shapes or types are wrong, or a transform is not rigid.

        """
        poses = as_numbers('T_fixed_sensor', T_fixed_sensor)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ValueError(f'T_fixed_sensor: shape {poses.shape}, expected (S, 4, 4)')
        for row, pose in enumerate(poses):
            check_rigid(f'T_fixed_sensor[{row}]', pose)
        turns = np.array([q_xyzw(pose) for pose in poses]).reshape(-1, 4)
        trajectory = cls(stamp_ns, poses[:, :3, 3].copy(), turns)  # type: ignore[arg-type]
        if trajectory.stamp_ns is not None and (np.diff(trajectory.stamp_ns) <= 0).any():
            raise ValueError('stamp_ns: expected ascending stamps')
        return trajectory

    @property
    def matrices(self) -> npt.NDArray[np.float64]:
        """The poses as transforms, (S, 4, 4)."""
        pairs = zip(self.xyz.tolist(), self.q_xyzw.tolist(), strict=True)
        return np.array([pose_matrix(xyz, turn) for xyz, turn in pairs]).reshape(-1, 4, 4)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Return the poses in a file; see read_trajectory."""
        return read_trajectory(as_path(path))

    def save(self, path: str | Path) -> None:
        """Write the poses as TUM text, which evo reads; raises FileFormatError."""
        path = as_path(path)
        if self.stamp_ns is None:
            raise FileFormatError(f'{path}: poses without stamps, which TUM text needs')
        write_tum(path, self.stamp_ns, self.matrices)


def write_tum(
    path: str | Path,
    stamp_ns: Sequence[int] | npt.NDArray[np.int64],
    T_fixed_sensor: npt.ArrayLike,
) -> None:
    """
    Write poses as TUM text, one line ``stamp_s x y z qx qy qz qw`` each, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.
    stamp_ns : (S,) int
        Their times.
    T_fixed_sensor : (S, 4, 4) float64
        The poses.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    poses = as_numbers('T_fixed_sensor', T_fixed_sensor).reshape(-1, 4, 4)
    with replace_file(path) as file:
        file.write(TUM_HEADER.encode())
        for stamp, pose in zip(stamp_ns, poses, strict=True):
            numbers = [*pose[:3, 3].tolist(), *q_xyzw(pose).tolist()]
            file.write(f'{seconds(int(stamp))} {" ".join(map(repr, numbers))}\n'.encode())


def read_trajectory(path: str | Path, format_: str | None = None) -> Trajectory:
    """
    Return the poses in a file.

    Parameters
    ----------
    path : str or Path
        The file. KITTI poses take their stamps from a times.txt beside it, if there is one.
    format_ : str, optional
        tum, kitti (matrices) or csv; by default that of the first line.

    Raises
    ------
    FileFormatError
        If the file cannot be read, has no poses, a line is not a pose of the format, or stamps do
        not increase.

    """
    commented = read_lines(path, comments=True)
    texts = commented.texts
    num_comments = next(
        (row for row, text in enumerate(texts) if not is_comment(text)), len(texts)
    )
    headers = [header_of(text) for text in texts[: num_comments + 1]]
    header = next(filter(None, headers), None)
    first = headers.index(header) + 1 if header else 0
    lines = commented.at([row for row in range(first, len(texts)) if not is_comment(texts[row])])
    if header is None and not lines.texts:
        raise FileFormatError(f'{path}: no poses in it, expected a line for each')
    format_ = format_ or ('csv' if header else guessed(path, lines.texts))
    if format_ not in FORMATS:
        expected = ', '.join(FORMATS)
        raise FileFormatError(f'{path}: format {format_!r}, expected one of {expected}')
    if header is not None and format_ in ('csv', 'tum'):
        return named_poses(lines, header)
    readers = {'csv': unnamed_poses, 'kitti': matrix_poses, 'tum': tum_poses, 'g2o': g2o_poses}
    return readers[format_](lines)


def trajectory_beside(path: Path) -> Path | None:
    """Return the trajectory in the directory of a map, or beside its file; None without one."""
    file = (path if path.is_dir() else path.parent) / TRAJECTORY
    return file if file.is_file() else None


def guessed(path: str | Path, texts: Sequence[str]) -> str:
    """Return the format that the first line looks like."""
    line = texts[0]
    words = line.split()
    if words[0].startswith(('VERTEX', 'EDGE', 'FIX', 'PARAMS')):
        return 'g2o'
    separator = separator_of(line)
    if separator:
        return 'kitti' if len(line.split(separator)) in MATRICES else 'csv'
    if len(words) in (TUM, RTABMAP):
        return 'tum'
    if len(words) not in MATRICES:
        raise FileFormatError(
            f'{path}: {len(words)} columns in the first line, expected 8 (TUM; 9 with an id), 12 '
            '(KITTI) or 16 (4 x 4) of a matrix, 13 or 17 with a number or a time before it, '
            f'{VERTEX} (g2o), or a header that names the columns'
        )
    return 'kitti'


def tum_poses(lines: TextLines) -> Trajectory:
    """Return the poses of a TUM file, in seconds or with a unit by the digits of the stamps."""
    width = len(lines.texts[0].split())
    rows = table_rows(lines, width if width == RTABMAP else TUM, meaning=': stamp x y z q')
    stamp_ns = column_ns(rows, 0, unit_of_column(rows, 0))
    poses = quaternion_rows(rows, slice(1, TUM))
    if len(poses) and looks_scalar_first(poses[:, 3:]):
        logger.warning(
            '%s: read as x y z w, it rolls over; read as w x y z, it stays level. If that is '
            'meant, begin the file with # stamp x y z qw qx qy qz',
            lines.path,
        )
    return stamped_poses(lines, stamp_ns, poses)


def looks_scalar_first(quaternions: npt.NDArray[np.float64]) -> bool:
    """Return whether z stays up if quaternions (R, 4) are w x y z, and is down if x y z w."""
    q0, q1, q2, _ = np.square(quaternions.T)
    return bool((1 - 2 * (q1 + q2) > LEVEL).all() and (1 - 2 * (q0 + q1) < -LEVEL).any())


def unit_of_column(rows: Rows, column: int) -> str:
    """Return the unit of the stamps of a column by their digits; empty for seconds."""
    unit = unit_by_digits(rows.words[-1][column]) if len(rows) else 's'
    return '' if unit == 's' else unit


def g2o_poses(lines: TextLines) -> Trajectory:
    """Return the vertices of a g2o file by their numbers; edges and landmarks are left out."""
    at = [row for row, text in enumerate(lines.texts) if text.split()[0] == VERTEX]
    if not at:
        raise FileFormatError(f'{lines.path}: no line {VERTEX}, expected one for each pose')
    rows = table_rows(lines.at(at), 9, meaning=': number x y z q')
    poses = quaternion_rows(rows, slice(2, None))
    number, order = np.unique(rows.numbers([1])[:, 0].astype(np.int64), return_index=True)
    if len(number) < len(rows):
        raise FileFormatError(f'{lines.path}: vertices of equal numbers, expected one for each')
    return numbered_poses(poses[order], number)


def numbered_poses(poses: npt.NDArray[np.float64], number: npt.NDArray[np.int64]) -> Trajectory:
    """Return poses (R, 7) of the scans of some numbers; those of all scans need no numbers."""
    is_all = np.array_equal(number, np.arange(len(number)))
    return Trajectory(None, poses[:, :3], poses[:, 3:], None if is_all else number)


def separator_of(line: str) -> str | None:
    """Return the character between the columns of a line; None for spaces."""
    return next((mark for mark in ',;' if mark in line), None)


def header_of(line: str) -> PoseColumns | None:
    """Return the columns of a stamp and a pose that a line names once each, else None."""
    cells = [column_name(cell) for cell in line.lstrip('#%/ ').split(separator_of(line))]

    def named(pattern: str | re.Pattern[str]) -> list[int]:
        return [at for at, (name, _) in enumerate(cells) if re.fullmatch(pattern, name)]

    pose, halves, stamps = [*map(named, POSE_COLUMNS)], [*map(named, PARTS)], named(STAMP_COLUMN)
    if any(len(columns) != 1 for columns in pose) or not (stamps or all(halves)):
        return None
    columns = [numbers[0] for numbers in pose]
    if all(halves):
        return PoseColumns(len(cells), {halves[0][0]: 's', halves[1][0]: 'ns'}, columns)
    stamp = min(stamps, key=lambda at: 'stamp' not in cells[at][0])  # rostopic's %time is recorded
    match = STAMP_COLUMN.fullmatch(cells[stamp][0])
    return PoseColumns(len(cells), {stamp: cells[stamp][1] or (match and match[1]) or ''}, columns)


def named_poses(lines: TextLines, header: PoseColumns) -> Trajectory:
    """Return the poses of a table by the names of its columns."""
    separator = separator_of(lines.texts[0]) if lines.texts else None
    rows = table_rows(lines, header.width, separator=separator)
    stamps = header.stamps.items()
    parts = [column_ns(rows, at, unit or unit_of_column(rows, at)) for at, unit in stamps]
    stamp_ns = np.array(parts).sum(axis=0)
    return stamped_poses(rows.lines, stamp_ns, quaternion_rows(rows, header.pose))


def unnamed_poses(lines: TextLines) -> Trajectory:
    """Raise FileFormatError, as the order of the columns is not known."""
    names = ', '.join(map(str.strip, lines.texts[0].split(separator_of(lines.texts[0]))))
    raise FileFormatError(
        f'{lines.where(0)}: columns {shorten(names, MOST_SHOWN, placeholder=" ...")}; expected a '
        'header with stamp_s or stamp_ns (or sec, nsec), and one each of x, y, z, qx, qy, qz, qw'
    )


def stamped_poses(
    lines: TextLines, stamp_ns: npt.NDArray[np.int64], poses: npt.NDArray[np.float64]
) -> Trajectory:
    """Return poses (R, 7) with stamps; raise FileFormatError if there are none, or one is late."""
    if not len(stamp_ns):
        raise FileFormatError(f'{lines.path}: no poses in it, only a header or comments')
    back = np.flatnonzero(np.diff(stamp_ns) <= 0)
    if len(back):
        raise FileFormatError(
            f'{lines.where(back[0] + 1)}: stamp is not after that of the pose before'
        )
    return Trajectory(stamp_ns, poses[:, :3], poses[:, 3:])


def column_name(text: str) -> tuple[str, str]:
    """Return name, with _ for marks, and unit of a column: ``timestamp [ns]`` as EuRoC has it."""
    name, _, bracket = text.lower().replace('(', '[').partition('[')
    return re.sub(r'\W+', '_', name).strip('_'), bracket.strip(')] "')


def matrix_poses(lines: TextLines) -> Trajectory:
    """Return the poses of a file of matrices, in a line each, perhaps with a number or a time."""
    separator = separator_of(lines.texts[0])
    width = len(lines.texts[0].split(separator))
    columns = width if width in MATRICES else 12
    rows = table_rows(lines, columns, separator=separator, meaning=': 3 or 4 rows of 4')
    first = width % 4
    poses, skew = matrix_rows(rows, slice(first, first + 12))
    if width >= 16 and not np.allclose(rows.numbers(slice(first + 12, None)), [0, 0, 0, 1]):
        raise FileFormatError(f'{lines.path}: last rows of matrices, expected 0 0 0 1')
    warn_of_skew(lines.path, skew)
    table = np.hstack([poses[:, :3, 3], quaternions(poses)])
    if first:
        number = rows.numbers([0])[:, 0]
        if (number != np.rint(number)).any() or number.max() >= MOST_NUMBER:
            return stamped_poses(lines, column_ns(rows, 0, unit_of_column(rows, 0)), table)
        return numbered_poses(table, number.astype(np.int64))
    stamps = kitti_stamps(Path(lines.path).with_name(KITTI_TIMES), len(poses))
    return Trajectory(stamps, table[:, :3], table[:, 3:])


def kitti_stamps(path: Path, number: int) -> npt.NDArray[np.int64] | None:
    """Return the stamps in a times.txt, which must have one line per pose."""
    if not path.is_file():
        return None
    stamps = read_times(path)
    if len(stamps) != number or (np.diff(stamps) <= 0).any():
        raise FileFormatError(
            f'{path}: {len(stamps)} stamps for {number} poses, expected one for each, ascending'
        )
    return stamps
