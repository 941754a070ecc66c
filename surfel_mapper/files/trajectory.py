# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Trajectories as text: reading TUM, KITTI and CSV, writing TUM.

Stamps are converted between decimal text and nanoseconds without a float, because the resolution
of a float64 is only 240 ns for seconds since 1970; coordinates are written with the digits that
restore the same float64. Poses are neither sorted nor interpolated here: a pose of the wrong time
maps a scan to the wrong place.

The formats are in one module because they share the class, the check of poses and the stamps.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from itertools import chain
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers, as_path, as_whole, made_array
from surfel_mapper.budget import Budget, open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.text_table import NO_END, plain, real
from surfel_mapper.geometry import check_rigid, pose_matrix, q_xyzw

logger = logging.getLogger(__name__)

FORMATS = ('tum', 'kitti', 'csv')

TRAJECTORY = 'trajectory.tum'
"""File of a replay with the poses of its scans, beside the map and in its frame."""

TUM_HEADER = '# stamp_s x y z qx qy qz qw\n'

KITTI_TIMES = 'times.txt'
"""The file beside KITTI poses with the seconds of each."""

POSE_COLUMNS = (
    ('x', 'tx', 'px', 'p_x', 'p_rs_r_x', 'position_x', 'pos_x'),
    ('y', 'ty', 'py', 'p_y', 'p_rs_r_y', 'position_y', 'pos_y'),
    ('z', 'tz', 'pz', 'p_z', 'p_rs_r_z', 'position_z', 'pos_z'),
    ('qx', 'q_x', 'q_rs_x', 'orientation_x'),
    ('qy', 'q_y', 'q_rs_y', 'orientation_y'),
    ('qz', 'q_z', 'q_rs_z', 'orientation_z'),
    ('qw', 'q_w', 'q_rs_w', 'orientation_w'),
)
"""Names of the seven numbers of a pose in CSV files (those with RS are EuRoC's)."""

STAMP_COLUMNS = ('stamp', 'timestamp', 'time', 't')

UNITS_NS = {'s': 10**9, 'sec': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}

MOST_SECONDS = 10**11
"""Limit of stamps without a unit: a larger one is not in seconds (3000 years)."""

EXACT_SKEW, MAX_SKEW = 1e-5, 2e-3
"""
Largest entries of R R^T - I: of rotations taken as they are, and of those taken at all.

Files of six digits are within the first; the second is that of determinants of 0.999.
"""

SAME = 3
"""Numbers that have as many decimals by design, and not by chance."""

MAX_LINE_BYTES = 1 << 16
"""Limit of the length of a line; poses have some hundred characters."""

POSE_BYTES = 300
"""Memory of a pose while its file is read: twelve numbers, a stamp, and a copy of each."""

CHECK_EVERY = 1024
"""Number of poses after which the time is checked."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """
    Poses of one frame in another over time, by ascending stamp.

    Attributes
    ----------
    stamp_ns : (S,) int64, or None
        None for KITTI poses without a times.txt: pose i is that of scan i.
    xyz : (S, 3) float64, m
    q_xyzw : (S, 4) float64
        Of norm 1 within 1e-3.

    """

    stamp_ns: npt.NDArray[np.int64] | None
    xyz: npt.NDArray[np.float64]
    q_xyzw: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        """Turn lists into arrays; raise ValueError if shapes or types are not as above."""
        for name, width in (('xyz', 3), ('q_xyzw', 4)):
            found = as_numbers(name, getattr(self, name))
            if found.ndim != 2 or found.shape[1] != width:
                raise ValueError(f'{name}: shape {found.shape}, expected (S, {width})')
            object.__setattr__(self, name, found)
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
            raise ValueError(f'positions, rotations, stamps: {lengths}, expected as many of each')

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.xyz)

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
            return Trajectory(stamps, self.xyz[row], self.q_xyzw[row])
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
            return f'Trajectory({len(self)} poses)'
        lasts_s = (self.stamp_ns[-1] - self.stamp_ns[0]) / 1e9
        return f'Trajectory({len(self)} poses in {lasts_s:.3f} s)'

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
        stamps = None if stamp_ns is None else as_array('stamp_ns', stamp_ns)
        if stamps is not None:
            if stamps.dtype.kind not in 'iu':
                raise ValueError(f'stamp_ns: {stamps.dtype}, expected whole nanoseconds (int64)')
            if stamps.shape != poses.shape[:1] or (np.diff(stamps.astype(np.int64)) <= 0).any():
                raise ValueError(
                    f'stamp_ns: shape {stamps.shape}, expected ({len(poses)},), ascending'
                )
            stamps = stamps.astype(np.int64)
        turns = np.array([q_xyzw(pose) for pose in poses]).reshape(-1, 4)
        return cls(stamps, poses[:, :3, 3].copy(), turns)

    @property
    def matrices(self) -> npt.NDArray[np.float64]:
        """The poses as transforms, (S, 4, 4)."""
        pairs = zip(self.xyz.tolist(), self.q_xyzw.tolist(), strict=True)
        return np.array([pose_matrix(xyz, turn) for xyz, turn in pairs]).reshape(-1, 4, 4)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Return the poses in a file, TUM, KITTI or CSV; raises FileFormatError."""
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
        tum, kitti or csv; by default that of the first line: 8 numbers, 12 numbers, or commas.

    Raises
    ------
    FileFormatError
        If the file cannot be read, has no poses, a line is not a pose of the format, or stamps do
        not increase.

    """
    budget = Budget.of_file(path, FileFormatError)
    with budget.clock():
        lines = numbered_lines(path, budget)
        first = next(lines, None)
        if first is None:
            raise FileFormatError(f'{path}: no poses in it, expected a line for each')
        format_ = format_ or guessed(path, first[1])
        lines = chain([first], lines)
        if format_ not in FORMATS:
            expected = ', '.join(FORMATS)
            raise FileFormatError(f'{path}: format {format_!r}, expected one of {expected}')
        if format_ == 'kitti':
            return kitti_poses(path, lines)
        return stamped_poses(path, csv_rows(lines) if format_ == 'csv' else tum_rows(lines))


def stamped_poses(path: str | Path, rows: Iterable[tuple[str, int, list[float]]]) -> Trajectory:
    """Return the poses in rows of file:line, stamp and seven numbers."""
    stamps, numbers = array('q'), array('d')
    for where, stamp_ns, values in rows:
        if stamps and stamp_ns <= stamps[-1]:
            raise FileFormatError(f'{where}: stamp is not after that of the pose before')
        check_pose(where, values)
        stamps.append(stamp_ns)
        numbers.extend(values)
    if not stamps:
        raise FileFormatError(f'{path}: no poses in it, only a header')
    table = np.array(numbers).reshape(-1, 7)
    return Trajectory(np.array(stamps), table[:, :3], table[:, 3:])


def trajectory_beside(path: Path) -> Path | None:
    """Return the trajectory in the directory of a map, or beside its file; None without one."""
    found = (path if path.is_dir() else path.parent) / TRAJECTORY
    return found if found.is_file() else None


def numbered_lines(path: str | Path, budget: Budget) -> Iterator[tuple[str, str]]:
    """Yield file:line and text of all lines but comments; a commented CSV header is kept."""
    try:
        with TextIOWrapper(open_regular(path), encoding='utf-8-sig') as file:
            number, decimals = 0, Counter[int]()
            while line := file.readline(MAX_LINE_BYTES):
                number += 1
                if len(line) == MAX_LINE_BYTES:
                    raise FileFormatError(
                        f'{path}:{number}: a line of over {MAX_LINE_BYTES} characters'
                    )
                if number % CHECK_EVERY == 0:
                    budget.check_time()
                has_end = line.endswith('\n')
                line = line.strip()
                if line and not is_comment(line):
                    budget.take(POSE_BYTES, f'line {number}')
                    if not has_end:
                        check_last(f'{path}:{number}', line, decimals)
                    decimals[num_decimals(line)] += 1
                    yield f'{path}:{number}', line
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f'{path}: no text, expected a file of poses') from error


def check_last(where: str, line: str, decimals: Counter[int]) -> None:
    """
    Raise FileFormatError if a last line without an end lacks decimals of all others, else warn.

    Editors and scripts leave the end of the last line out, so most such files are whole.
    """
    decimals = Counter({number: times for number, times in decimals.items() if number})
    if len(decimals) == 1 and decimals.total() >= SAME and num_decimals(line) < min(decimals):
        raise FileFormatError(f'{where}: {NO_END}')
    logger.warning('%s: the last line has no end; is the file cut off there?', where)


def num_decimals(line: str) -> int:
    """Return the number of characters after the point of the last number of a line."""
    words = line.replace(',', ' ').split() or ['']
    return len(words[-1].partition('.')[2])


def is_comment(line: str) -> bool:
    """Return whether a line is a comment, and not a commented CSV header."""
    return line.startswith(('#', '%')) and ',' not in line


def guessed(path: str | Path, line: str) -> str:
    """Return the format that a first line looks like."""
    if ',' in line:
        return 'csv'
    formats = {8: 'tum', 12: 'kitti'}
    count = len(line.split())
    if count not in formats:
        raise FileFormatError(
            f'{path}: {count} columns in the first line, expected 8 (TUM), 12 (KITTI) or commas '
            '(CSV)'
        )
    return formats[count]


def tum_rows(lines: Iterable[tuple[str, str]]) -> Iterator[tuple[str, int, list[float]]]:
    """Yield file:line, stamp and numbers of every pose of a TUM file."""
    for where, line in lines:
        columns = line.split()
        if len(columns) != 8:
            raise FileFormatError(f'{where}: {len(columns)} columns, expected 8: stamp x y z q')
        yield where, nanoseconds(columns[0], where), floats(columns[1:], where)


def csv_rows(lines: Iterable[tuple[str, str]]) -> Iterator[tuple[str, int, list[float]]]:
    """Yield file:line, stamp and numbers of every pose of a CSV file with a header."""
    lines = iter(lines)
    first, text = next(lines)
    header = [column_name(column) for column in text.lstrip('# ').split(',')]
    names = [name for name, _ in header]
    stamps = [place for place, name in enumerate(names) if name in STAMP_COLUMNS]
    places = [[names.index(alias) for alias in known if alias in names] for known in POSE_COLUMNS]
    if not stamps or not all(places):
        raise FileFormatError(
            f'{first}: columns {", ".join(names)}; expected a header with stamp_s or '
            'stamp_ns, x, y, z, qx, qy, qz, qw'
        )
    wanted = [found[0] for found in places]
    for where, line in lines:
        row = line.split(',')
        if len(row) != len(names):
            raise FileFormatError(f'{where}: {len(row)} columns, expected {len(names)}')
        stamp_ns = nanoseconds(row[stamps[0]], where, header[stamps[0]][1])
        yield where, stamp_ns, floats([row[place] for place in wanted], where)


def column_name(text: str) -> tuple[str, str]:
    """Return name and unit of a CSV column: ``stamp_ns``, or ``timestamp [ns]`` as EuRoC has."""
    name, _, bracket = text.strip().strip('"').lower().partition('[')
    name, unit = name.strip(), bracket.partition(']')[0].strip()
    for suffix in UNITS_NS:
        if name.removesuffix(f'_{suffix}') in STAMP_COLUMNS:
            return name.removesuffix(f'_{suffix}'), unit or name.rpartition('_')[2] * ('_' in name)
    return name, unit


def kitti_poses(path: str | Path, lines: Iterable[tuple[str, str]]) -> Trajectory:
    """Return the poses of a KITTI file, each the upper three rows of a matrix."""
    numbers, most_skew = array('d'), 0.0
    for where, line in lines:
        columns = line.split()
        if len(columns) != 12:
            raise FileFormatError(f'{where}: {len(columns)} columns, expected 12: 3 rows of 4')
        values = np.array(floats(columns, where)).reshape(3, 4)
        skew = skew_of(values[:, :3])
        if not skew <= MAX_SKEW:
            raise FileFormatError(f'{where}: its first three columns are no rotation')
        values[:, :3] = nearest_rotation(values[:, :3])
        most_skew = max(most_skew, skew)
        numbers.extend(values.ravel())
    warn_of_skew(path, most_skew)
    rows = np.array(numbers).reshape(-1, 3, 4)
    turns = np.empty((len(rows), 4))
    pose = np.eye(4)
    for number, pose[:3] in enumerate(rows):
        turns[number] = q_xyzw(pose)
    stamps = kitti_stamps(Path(path).with_name(KITTI_TIMES), len(rows))
    return Trajectory(stamps, rows[:, :, 3].copy(), turns)


def skew_of(matrix: npt.NDArray[np.float64]) -> float:
    """Return the largest entry of R R^T - I of a (3, 3) matrix; inf if it is no rotation."""
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 2.0:
        return math.inf
    skew = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    return skew if np.linalg.det(matrix) > 0.0 else math.inf


def nearest_rotation(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rotation nearest to a (3, 3) matrix; itself if it is within EXACT_SKEW."""
    if skew_of(matrix) <= EXACT_SKEW:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right, np.float64)


def warn_of_skew(path: str | Path, skew: float) -> None:
    """Warn that rotations in a file are not orthonormal, if they are not."""
    if skew > EXACT_SKEW:
        logger.warning(
            '%s: rotations are not orthonormal, R R^T - I has up to %.2g (at most %g is taken); '
            'the nearest orthonormal ones are used',
            *(path, skew, MAX_SKEW),
        )


def kitti_stamps(path: Path, number: int) -> npt.NDArray[np.int64] | None:
    """Return the stamps in a times.txt, which must have one line per pose."""
    if not path.is_file():
        return None
    lines = numbered_lines(path, Budget.of_file(path, FileFormatError))
    stamps = np.array(array('q', (nanoseconds(line, where) for where, line in lines)))
    if len(stamps) != number or (np.diff(stamps) <= 0).any():
        raise FileFormatError(
            f'{path}: {len(stamps)} stamps for {number} poses, expected one for each, ascending'
        )
    return stamps


def check_pose(where: str, values: list[float]) -> None:
    """Raise FileFormatError if seven numbers are not a pose."""
    try:
        pose_matrix(values[:3], values[3:])
    except ValueError as error:
        raise FileFormatError(f'{where}: {error}') from error


def floats(texts: Sequence[str], where: str) -> list[float]:
    """Return finite numbers from text."""
    try:
        values = [real(text) for text in texts]
    except ValueError as error:
        raise FileFormatError(f'{where}: {error}, expected a number') from error
    if not np.isfinite(values).all():
        raise FileFormatError(f'{where}: {", ".join(texts)}: not all are finite')
    return values


def nanoseconds(text: str, where: str, unit: str = '') -> int:
    """Return a time rounded to nanoseconds."""
    try:
        number = Decimal(plain(text.strip()))
    except (InvalidOperation, ValueError) as error:
        raise FileFormatError(f'{where}: {text!r} is no time') from error
    if unit and unit not in UNITS_NS:
        raise FileFormatError(f'{where}: unit {unit!r}, expected one of {", ".join(UNITS_NS)}')
    most = 2**63 if unit else MOST_SECONDS
    if not number.is_finite() or not -most <= number <= most:
        raise FileFormatError(
            f'{where}: time {text!r}, expected seconds (or a CSV column stamp_ns, stamp_us)'
        )
    stamp_ns = int((number * UNITS_NS[unit or 's']).to_integral_value())
    if not 0 <= stamp_ns < 2**63:
        raise FileFormatError(f'{where}: time {text!r}, expected 0 to 292 years')
    return stamp_ns


def seconds(stamp_ns: int) -> str:
    """Return a time in seconds with all nine digits."""
    whole, rest = divmod(stamp_ns, 10**9)
    return f'{whole}.{rest:09d}'
