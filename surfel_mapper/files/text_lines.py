# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tables in text with a row a line: poses, their times, tables of data sets.

``read_lines`` leaves empty lines and comments out and ``table_rows`` splits the others, a piece of
the file at a time and without a step of Python a line: a line takes one at the least, which is 1
us, and a file may have one for each of its bytes. Errors name the line all the same, since each
row keeps its number.

A last line without an end of line may be cut off in its last number; see check_last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
import logging
import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget, open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_table import (
    MAX_WORD_BYTES,
    NO_END,
    pieces_of,
    plain,
    real,
    reals,
    SPACES,
)

logger = logging.getLogger(__name__)

Whole = npt.NDArray[np.int64]

ROW_BYTES, COLUMN_BYTES = 16, 20
"""Memory of a row and of each of its numbers while a file is read: the number, and a copy."""

SAME, MANY = 3, 100
"""
Lines after which a last line without an end is refused if it has fewer decimals than each of them.

The first if all have as many decimals by design, the second if their number varies: the shortest
of 101 numbers is the last one by chance in one of 101 files at most.
"""

MARK = b'\xef\xbb\xbf'
"""Byte order mark of UTF-8, which editors of Windows write."""

NEWLINE, POINT, COMMA = (ord(character) for character in '\n.,')

IS_SPACE = np.isin(np.arange(256), [*SPACES])
"""The bytes of SPACES."""

IS_COMMENT = np.isin(np.arange(256), [*b'#%'])
"""The bytes that begin a comment."""


@dataclass(frozen=True, slots=True, eq=False)
class TextLines:
    """
    Lines of a text one after the other, without those that are empty or comments.

    Attributes
    ----------
    path : str or Path
        The file, named in errors.
    numbers : (L,) int64
        Number of each line in the file, from 1.
    text : bytes
        The lines, each with one end of line.

    """

    path: str | Path
    numbers: Whole
    text: bytes

    def where(self, row: int) -> str:
        """Return file:line."""
        return f'{self.path}:{self.numbers[row]}'

    def first(self) -> str:
        """Return the text of the first line, without spaces at its ends."""
        return self.text[: self.text.index(b'\n')].decode().strip()

    def without_first(self) -> TextLines:
        """Return the lines after the first one."""
        return TextLines(self.path, self.numbers[1:], self.text[self.text.index(b'\n') + 1 :])


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """
    Rows of a table one after the other.

    Attributes
    ----------
    lines : TextLines
        A line a row.
    words : (R, C) object
        The columns, bytes each; with separators, perhaps with spaces at their ends.

    """

    lines: TextLines
    words: npt.NDArray[np.object_]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.words)

    def numbers(self, columns: list[int] | slice) -> npt.NDArray[np.float64]:
        """Return columns as finite numbers, (R, C); raise FileFormatError if one is none."""
        words = self.words[:, columns]
        flat = words.ravel().tolist()
        try:
            if b'_' in self.lines.text and b'_' in b' '.join(flat):  # Python reads 1_0
                raise ValueError('a _ among the numbers')
            values = reals(flat).reshape(words.shape)
        except ValueError:
            for row, texts in enumerate(words.tolist()):
                finite(texts, self.lines.where(row))
            raise
        odd = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(odd):
            finite(words[odd[0]].tolist(), self.lines.where(odd[0]))
        return values


def finite(texts: Sequence[bytes | str], where: str) -> list[float]:
    """Return finite numbers from text; raise FileFormatError if one is none."""
    try:
        values = [real(text) for text in texts]
    except ValueError as error:
        raise FileFormatError(f'{where}: {error}, expected a number') from error
    if not np.isfinite(values).all():
        found = ', '.join(map(plain, texts))
        raise FileFormatError(f'{where}: {found}: not all are finite')
    return values


def read_lines(path: str | Path, budget: Budget) -> Iterator[TextLines]:
    """
    Yield the lines of a text but empty ones and comments; a commented CSV header is kept.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is no text, has a line of over 64 KiB, or a last line that is
        cut off.

    """
    try:
        with open_regular(path) as file:
            decimals = Decimals() if not has_end(file) else None
            number, mark = 1, MARK
            for piece in pieces_of(file, budget, b'\n'):
                if len(piece) > MAX_WORD_BYTES and not piece.endswith(b'\n'):
                    raise too_long(path, number)
                text = piece.removeprefix(mark).replace(b'\r\n', b'\n').replace(b'\r', b'\n')
                mark = b''
                if not text.isascii():
                    text.decode()
                is_whole = text.endswith(b'\n')
                lines, count = kept_lines(path, number, text if is_whole else text + b'\n')
                number += count
                if not lines.text:
                    continue
                if decimals is not None:
                    decimals.add(lines, is_whole=is_whole)
                yield lines
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f'{path}: no text, expected a table of numbers') from error


def has_end(file: BinaryIO) -> bool:
    """Return whether a file ends with an end of line, or is empty; it is then at its start."""
    if os.fstat(file.fileno()).st_size == 0:
        return True
    file.seek(-1, os.SEEK_END)
    last = file.read(1)
    file.seek(0)
    return last in b'\r\n'


def kept_lines(path: str | Path, first: int, text: bytes) -> tuple[TextLines, int]:
    """Return the lines with content of a text that has whole lines, and the number of all."""
    characters = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(characters == NEWLINE)
    lengths = np.diff(ends, prepend=-1)
    if lengths.max() > MAX_WORD_BYTES:
        raise too_long(path, first + int(lengths.argmax()))
    solid = np.cumsum(~IS_SPACE[characters], dtype=np.int32)
    before = np.concatenate([[0], solid[ends[:-1]]])
    is_kept = solid[ends] > before
    marks = np.flatnonzero(IS_COMMENT[characters])
    if len(marks):
        line = np.searchsorted(ends, marks)
        is_comment = np.zeros(len(ends), bool)
        is_comment[line[solid[marks] == before[line] + 1]] = True
        is_comment[np.searchsorted(ends, np.flatnonzero(characters == COMMA))] = False
        is_kept &= ~is_comment
    if not is_kept.all():
        text = characters[np.repeat(is_kept, lengths)].tobytes()
    return TextLines(path, first + np.flatnonzero(is_kept), text), len(ends)


def too_long(path: str | Path, number: int) -> FileFormatError:
    """Return the error of a line beyond the limit."""
    return FileFormatError(f'{path}:{number}: a line of over {MAX_WORD_BYTES} characters')


class Decimals:
    """Decimals of the last numbers of all lines of a file whose last line has no end."""

    def __init__(self) -> None:
        self.least, self.most, self.count = 1 << 62, 0, 0

    def add(self, lines: TextLines, *, is_whole: bool) -> None:
        """Count those of lines; check the last one if it is that without an end."""
        found = num_decimals(lines.text)
        if not is_whole:
            found, last = found[:-1], found[-1]
        if len(found):
            self.least = min(self.least, int(found.min()))
            self.most = max(self.most, int(found.max()))
            self.count += len(found)
        if not is_whole:
            self.check_last(lines.where(-1), int(last))

    def check_last(self, where: str, last: int) -> None:
        """
        Raise FileFormatError if a last number has fewer decimals than all others, else warn.

        Editors and scripts leave the end of the last line out, so most such files are whole; and
        without that end a number that was cut is not told from a short one but by the others.
        """
        needed = SAME if self.least == self.most else MANY
        if self.count >= needed and last < self.least:
            raise FileFormatError(f'{where}: {NO_END}')
        logger.warning('%s: the last line has no end; is the file cut off there?', where)


def num_decimals(text: bytes) -> Whole:
    """Return the number of characters after the point of the last word of each line, (L,)."""
    characters = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(characters == NEWLINE)
    is_gap = IS_SPACE[characters] | (characters == COMMA)
    last = last_before(ends, ~is_gap)
    begin, point = last_before(last, is_gap), last_before(last + 1, characters == POINT)
    start = np.concatenate([[-1], ends[:-1]])
    return np.where(point > np.maximum(begin, start), last - point, 0)


def last_before(places: Whole, mask: npt.NDArray[np.bool_]) -> Whole:
    """Return the last true place of a mask before each of some places, or -1."""
    found = np.concatenate([[-1], np.flatnonzero(mask)])
    return found[np.searchsorted(found, places) - 1]


def table_rows(
    lines: Iterable[TextLines],
    columns: int,
    budget: Budget,
    *,
    separator: bytes | None = None,
    meaning: str = '',
) -> Iterator[Rows]:
    """
    Yield the rows of a table.

    Parameters
    ----------
    lines : iterable of TextLines
        Its lines.
    columns : int
        Number of columns that each line has to have.
    budget : Budget
        Of the file.
    separator : bytes, optional
        The character between two columns; spaces by default.
    meaning : str
        Names of the columns, for errors.

    Raises
    ------
    FileFormatError
        If a line has another number of columns.

    """
    for piece in lines:
        if not piece.text:  # after the header
            continue
        budget.check_time()
        found = num_columns(piece.text, separator)
        odd = np.flatnonzero(found != columns)
        if len(odd):
            raise FileFormatError(
                f'{piece.where(odd[0])}: {found[odd[0]]} columns, expected {columns}{meaning}'
            )
        budget.take(len(found) * (ROW_BYTES + COLUMN_BYTES * columns), f'line {piece.numbers[-1]}')
        text = piece.text
        if separator is not None:
            words = text[:-1].replace(b'\n', separator).split(separator)
        else:
            words = text.split()
        yield Rows(piece, np.array(words, object).reshape(-1, columns))


def num_columns(text: bytes, separator: bytes | None) -> Whole:
    """Return the number of columns of each line, (L,)."""
    characters = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(characters == NEWLINE)
    if separator is not None:
        begins = characters == ord(separator)
    else:
        is_space = IS_SPACE[characters]
        begins = ~is_space & np.concatenate([[True], is_space[:-1]])
    counted = np.cumsum(begins, dtype=np.int32)[ends]
    return np.diff(counted, prepend=0) + (separator is not None)
