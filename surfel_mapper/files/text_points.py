# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points as text: a row each, columns separated by spaces, tabs, commas or semicolons.

Names come from a header (CSV, ASC of CloudCompare), else from what columns look like: XYZ, XYZRGB,
XYZN, and PTS, which begins with the number of its points.
"""

from __future__ import annotations

import io
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.point_columns import Columns, named_columns

ALWAYS = ('.xyz', '.xyzrgb', '.xyzn', '.pts', '.asc')
"""Endings of points; files of other content end in .txt and .csv too."""

SUFFIXES = (*ALWAYS, '.txt', '.csv')

HEAD_BYTES, HEAD_LINES = 16384, 40
"""Beginning of a file in which the first row of numbers has to be."""

UNNAMED = (3, 4, 6, 7)
"""Numbers of columns of points without a header; others are poses, times or calibrations."""

MARKS = ('#', '//', '%')

AXIS = re.compile(r'([xyz])_(mm|cm|m)_?')
"""Coordinates with their unit in a header: x_mm, X (m)."""

METRES = {'m': 1.0, 'cm': 0.01, 'mm': 0.001}

QUATERNION = re.compile(r'(q|orientation|rotation)[_.]?\w*[wxyz]\b|q[wxyz]')
"""Names in a header of poses."""


class TextLayout(NamedTuple):
    """The separator (None: spaces), the number of lines before the first row, and the names."""

    separator: str | None
    skipped: int
    width: int
    names: list[str]

    @property
    def is_points(self) -> bool:
        """Whether the rows have coordinates, and are no poses."""
        if self.names:
            axes = {AXIS.sub(r'\1', name) for name in self.names}
            return axes >= {*'xyz'} and not any(map(QUATERNION.match, self.names))
        return self.width in UNNAMED


def text_layout(path: Path) -> TextLayout | None:
    """Return the layout of a text; None if it has no row of three numbers at its beginning."""
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES).decode('utf-8-sig', 'replace')
    names: list[str] = []
    for number, line in enumerate(head.splitlines()[:HEAD_LINES]):
        separator = next((mark for mark in ',;' if mark in line), None)
        words = [word.strip() for word in line.split(separator)]
        if line.lstrip().startswith(MARKS) or not all(map(is_number, words)):
            title = line.strip().lstrip('#/% ').split(separator)
            names = [column_name(word) for word in title]
        elif len(words) >= 3:
            has_names = len(names) == len(words)
            return TextLayout(separator, number, len(words), names if has_names else [])
    return None


def column_name(word: str) -> str:
    """Return a name of a header in lower case without spaces; ParaView has Points:0 for x."""
    name = re.sub(r'\W+', '_', word.strip(' "')).lower()
    axis = re.fullmatch(r'points\w*_([012])', name)
    return 'xyz'[int(axis[1])] if axis else name


def is_number(word: str) -> bool:
    """Return whether a word is a number; the last column of a row may be empty."""
    try:
        return word == '' or bool(float(word) or True)
    except ValueError:
        return False


def read_points(path: str | Path) -> Columns:
    """
    Return the columns of a text, float64.

    Raises
    ------
    FileFormatError
        If it cannot be read, has no row of three numbers, rows of several lengths, or poses.

    """
    with refusing(path):
        layout = text_layout(Path(path))
        if layout is None or not layout.is_points:
            names = '' if layout is None else ', '.join(layout.names)
            actual = layout and f'{layout.width} columns {names}'.strip()
            raise FileFormatError(
                f'{path}: {actual or "no row of three numbers"}, expected a header with x, y, z, '
                'or rows x y z, x y z intensity, x y z r g b, or x y z intensity r g b'
            )
        with open_regular(path) as file:
            table = np.loadtxt(
                io.TextIOWrapper(file, 'utf-8-sig', 'replace'),  # notes in other encodings
                delimiter=layout.separator,
                skiprows=layout.skipped,
                comments=MARKS,
                ndmin=2,
                usecols=range(layout.width),
            )
    if layout.names:
        columns = {}
        for name, values in zip(layout.names, np.ascontiguousarray(table.T), strict=True):
            axis = AXIS.fullmatch(name)
            columns[axis[1] if axis else name] = METRES[axis[2]] * values if axis else values
        columns.pop('', None)  # pandas' index
        return columns
    num_rows, num_columns = table.shape
    if num_columns > 3 and num_rows >= 10 and (np.diff(table[:, 0]) == 1.0).all():
        raise FileFormatError(
            f'{path}: the first column counts the rows, expected x; name the columns in a header'
        )
    columns = named_columns(table)
    if Path(path).suffix.lower() == '.pts' and 'column_3' in columns:  # Leica's are negative
        columns['intensity'] = columns.pop('column_3')
    return columns
