# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times of scans in files, and the rows of tables that belong to scans.

The time of a scan is in the name of its file, or in a times.txt or timestamps.txt in the folder
of the scans or beside it. Times, and poses without times, have a row for each scan. A longer table
may be that of a whole drive of which some scans were copied: then the name of a scan has to be the
number of its row, from 0, as KITTI numbers its scans (000123.bin). Otherwise the table is refused,
because scans at the poses of others are mapped to the wrong places.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import re

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.scan_files import SUFFIXES
from surfel_mapper.files.stamps import column_ns, nanoseconds, read_dates
from surfel_mapper.files.text_table import read_lines, table_rows
from surfel_mapper.files.trajectory import KITTI_TIMES, unit_of_column

TIME_FILES = (KITTI_TIMES, 'timestamps.txt')
"""Names of files with the times of scans, as in KITTI odometry and raw."""

UNITS = {19: 'ns', 16: 'us', 13: 'ms', 10: 's'}
"""Unit of a time since 1970 that is a whole number, by its number of digits."""


def times_in_names(files: Sequence[Path]) -> dict[Path, int]:
    """Return files with the times in their names, ascending; empty if they name no times."""
    texts = [stem(file) for file in files]
    if not all('.' in text or unit_of(text) for text in texts):
        return {}
    try:
        times = {file: name_ns(file) for file in files}
    except FileFormatError:
        return {}
    if len(set(times.values())) < len(files):
        return {}
    return dict(sorted(times.items(), key=lambda item: item[1]))


def name_ns(file: Path) -> int:
    """Return the time in the name of a file: 1532402927.647951.pcd, 1532402927647951.pcd.bin."""
    text = stem(file)
    return nanoseconds(text, str(file), unit_of(text))


def unit_of(text: str) -> str:
    """Return the unit of a whole number that is a time; empty for others."""
    is_index = not text.isdecimal() or (len(text) == 10 and text[0] == '0')  # KITTI raw
    return '' if is_index else UNITS.get(len(text), '')


def stem(file: Path) -> str:
    """Return the name of a file without its endings of scans, SECONDS_NANOSECONDS with a point."""
    text = file.name
    for suffix in ('.bin', *SUFFIXES):
        if text.lower().endswith(suffix):
            text = text[: -len(suffix)]
    return re.sub(r'^(\d{10})[_-](\d{9})$', r'\1.\2', text)


def times_beside(folder: Path, files: Sequence[Path]) -> tuple[list[int], Path] | None:
    """
    Return the times of scans, ns, and the file in their folder, or beside it, that has them.

    Raises
    ------
    FileFormatError
        If the first of such files cannot be read, or has no ascending times of all scans.

    """
    around = Path(os.path.abspath(folder)).parent
    paths = [directory / name for directory in (folder, around) for name in TIME_FILES]
    path = next(filter(Path.is_file, paths), None)
    if path is None:
        return None
    stamps = read_stamps(path)
    rows = rows_of(files, len(stamps))
    if rows is None:
        raise FileFormatError(
            f'{path}: {len(stamps)} times for {len(files)} scans in {folder}, expected as many, '
            f'or {numbered(len(stamps))}; rename it to map the scans 0.1 s apart'
        )
    times = stamps[rows]
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        row = rows[back[0] + 1]
        raise FileFormatError(
            f'{path}: row {row + 1}: time {stamps[row]} ns is not after that of the scan before'
        )
    return times.tolist(), path


def read_stamps(path: Path) -> npt.NDArray[np.int64]:
    """
    Return the times in a file, (T,) int64, ns, in its order.

    Each line has a date and a clock, seconds, or a whole number of another unit by its digits; the
    first line decides for all.
    """
    lines = read_lines(path)
    if not lines.texts:
        raise FileFormatError(f'{path}: no times in it, expected a line for each scan')
    if len(lines.texts[0].split()) == 2:
        return read_dates(path)
    rows = table_rows(lines, 1, meaning=': a time')
    return column_ns(rows, 0, unit_of_column(rows, 0))


def is_gapless(files: Sequence[Path]) -> bool:
    """Return whether the names of files are no numbers, or numbers that follow each other."""
    names = [stem(file) for file in files]
    return not all(map(str.isdecimal, names)) or int(names[-1]) - int(names[0]) == len(files) - 1


def rows_of(files: Sequence[Path], number: int) -> list[int] | None:
    """
    Return the rows of scans in a table of a number of rows, ascending.

    Row i is that of scan i if there are as many. Of more rows, the names of all files are those of
    their rows; None if they are not.
    """
    if len(files) == number:
        return list(range(number))
    names = [stem(file) for file in files]
    if len(files) > number or not all(map(str.isdecimal, names)):
        return None
    rows = [int(name) for name in names]
    return rows if rows == sorted({*rows}) and rows[-1] < number else None


def numbered(number: int) -> str:
    """Return, for errors, which names scans need in a table of more rows than scans."""
    return f'scans named by the numbers of their rows, 0 to {number - 1}'
