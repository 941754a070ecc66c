# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tables in text: points of ASCII PLY and PCD, poses, times, tables of data sets.

``read_table`` reads points by numpy.loadtxt into columns of several types. ``read_lines`` and
``table_rows`` split the other tables into words, since their stamps are read to the nanosecond
(stamps.py); empty lines and comments are left out, and errors name the line in the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
import warnings

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import read_small_file
from surfel_mapper.errors import FileFormatError

MAX_TEXT_BYTES = 1 << 29
"""Size limit of a table that is split into words, bytes: five million poses of 100 characters. A
pose of 8 words takes about 600 bytes while it is read."""


def read_table(
    path: str | Path,
    file: BinaryIO,
    layout: np.dtype[Any],
    count: int,
    *,
    is_last: bool = True,
) -> npt.NDArray[Any]:
    """
    Return the rows of a text, a line each.

    Parameters
    ----------
    path : str or Path
        Named in errors.
    file : binary file
        At the first number.
    layout : dtype
        Structured: the columns, each a number or an array of numbers.
    count : int
        Number of rows.
    is_last : bool
        Whether the file ends after the table; else the rest is not read.

    Raises
    ------
    FileFormatError
        If the text has fewer or more rows, other words than numbers, a number that its type
        cannot hold, or more rows than memory.

    """
    rows = None if is_last else count
    with warnings.catch_warnings():
        warnings.simplefilter('error', DeprecationWarning)  # 1.5 in a column of integers
        warnings.simplefilter('ignore', UserWarning)  # no rows
        try:
            table = np.loadtxt(file, layout, comments=None, ndmin=1, max_rows=rows)
        except (ValueError, DeprecationWarning, MemoryError) as error:
            raise FileFormatError(f'{path}: {str(error).partition("; use")[0]}') from error
    if len(table) != count:
        raise FileFormatError(f'{path}: {len(table)} rows, expected {count} points; truncated?')
    return table


@dataclass(frozen=True, slots=True, eq=False)
class TextLines:
    """
    Lines of a text, without those that are empty or comments.

    Attributes
    ----------
    path : str or Path
        The file, named in errors.
    numbers : list of int
        Number of each line in the file, from 1.
    texts : list of str
        The lines.

    """

    path: str | Path
    numbers: list[int]
    texts: list[str]

    def where(self, row: int) -> str:
        """Return file:line."""
        return f'{self.path}:{self.numbers[row]}'

    def at(self, rows: Sequence[int]) -> TextLines:
        """Return some lines."""
        numbers = [self.numbers[row] for row in rows]
        return TextLines(self.path, numbers, [self.texts[row] for row in rows])


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """
    Rows of a table.

    Attributes
    ----------
    lines : TextLines
        A line a row.
    words : list of list of str
        The columns of each row; with separators, perhaps with spaces at their ends.
    num_columns : int
        Their number.

    """

    lines: TextLines
    words: list[list[str]]
    num_columns: int

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.words)

    def numbers(self, columns: list[int] | slice) -> npt.NDArray[np.float64]:
        """Return columns as finite numbers, (R, C); raise FileFormatError if one is none."""
        texts = np.array(self.words, object).reshape(-1, self.num_columns)[:, columns]
        try:
            values = texts.astype(np.float64)
        except ValueError:
            values = np.full(texts.shape, np.nan)
        for row in np.flatnonzero(~np.isfinite(values).all(axis=1)):
            finite(texts[row].tolist(), self.lines.where(row))
        return values


def finite(texts: Sequence[str], where: str) -> list[float]:
    """Return finite numbers from text; raise FileFormatError if one is none."""
    try:
        values = [float(text) for text in texts]
    except ValueError as error:
        raise FileFormatError(f'{where}: {error}, expected a number') from error
    if not np.isfinite(values).all():
        raise FileFormatError(f'{where}: {", ".join(texts)}: not all are finite')
    return values


def read_lines(path: str | Path, *, comments: bool = False) -> TextLines:
    """
    Return the lines of a text but empty ones and, unless they are asked for, comments.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is no text, or is larger than MAX_TEXT_BYTES.

    """
    try:
        text = read_small_file(path, MAX_TEXT_BYTES).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise FileFormatError(f'{path}: no text, expected a table of numbers') from error
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise FileFormatError(f'{path}: cannot be read: {reason}') from error
    lines = text.replace('\r\n', '\n').replace('\r', '\n').split('\n')
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip()]
    kept = [(n, line) for n, line in numbered if comments or not is_comment(line)]
    return TextLines(path, [number for number, _ in kept], [line for _, line in kept])


def is_comment(line: str) -> bool:
    """Return whether a line that is not empty is a comment."""
    return line.lstrip()[0] in '#%'


def table_rows(
    lines: TextLines, columns: int, *, separator: str | None = None, meaning: str = ''
) -> Rows:
    """
    Return the rows of a table.

    Parameters
    ----------
    lines : TextLines
        Its lines.
    columns : int
        Number of columns that each line has to have.
    separator : str, optional
        The character between two columns; spaces by default.
    meaning : str
        Names of the columns, for errors.

    Raises
    ------
    FileFormatError
        If a line has another number of columns.

    """
    words = [line.split(separator) for line in lines.texts]
    for row, texts in enumerate(words):
        if len(texts) != columns:
            raise FileFormatError(
                f'{lines.where(row)}: {len(texts)} columns, expected {columns}{meaning}'
            )
    return Rows(lines, words, columns)
