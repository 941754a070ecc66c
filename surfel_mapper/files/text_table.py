# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tables of numbers in text, read in pieces within a budget.

Every word of a text is an object of 34 bytes or more. Split as a whole, a file of one-digit
numbers takes 40 times its size; split by pieces, its table of numbers and little more.

``read_table`` reads the points of ASCII PLY and PCD, whose rows may break anywhere; tables with a
row a line are in text_lines.py, on the same pieces and numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget
from surfel_mapper.errors import FileFormatError

PIECE_BYTES = 1 << 14
"""Bytes read at a time: half a megabyte of words at most."""

MAX_WORD_BYTES = 1 << 16
"""Limit of a number, which may have that many digits, and of a line."""

SHORT_BYTES = 6
"""Mean length, with its space, of words that are remembered: few can differ."""

SPACES = b' \t\n\r\x0b\x0c'
"""The characters at which bytes.split splits; str.split and Decimal take others too."""

NO_END = (
    'no end of line after the last number, which may be cut off; truncated? If it is complete, '
    'append an end of line'
)
"""Why a text is refused whose last number may lack digits."""


def read_table(
    path: str | Path,
    file: BinaryIO,
    layout: np.dtype[Any],
    count: int,
    budget: Budget,
    *,
    is_last: bool = True,
) -> npt.NDArray[Any]:
    """
    Return the rows of a text, one word for every number.

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
    budget : Budget
        Of the file.
    is_last : bool
        Whether the file ends after the table; else the rest is not read.

    Raises
    ------
    FileFormatError
        If the text has fewer or more numbers, does not end with an end of line, has other words
        than numbers, or a number that its type cannot hold.

    """
    budget.take(count * layout.itemsize, f'{count} rows of {layout.itemsize} bytes')
    table, width, filled = np.empty(count, layout), num_numbers(layout), 0
    words: list[bytes] = []
    extra = 0
    for piece in pieces_of(file, budget, SPACES):
        if piece[-1:] not in SPACES:
            problem = f'a number of over {MAX_WORD_BYTES} digits'
            raise FileFormatError(f'{path}: {problem if len(piece) > MAX_WORD_BYTES else NO_END}')
        if b'_' in piece:  # Python reads 1_0
            raise FileFormatError(f'{path}: a _ among the numbers')
        words += piece.split()
        rows = min(len(words) // width, count - filled)
        try:
            fill(table[filled : filled + rows], words[: rows * width])
        except (ValueError, OverflowError) as error:
            raise FileFormatError(f'{path}: {error}') from error
        filled += rows
        del words[: rows * width]
        if filled == count:
            extra += len(words)
            words = []
            if not is_last:
                return table
    if filled < count or extra:
        found = filled * width + len(words) + extra
        raise FileFormatError(
            f'{path}: {found} numbers, expected {count * width} for {count} points; truncated?'
        )
    return table


def real(text: str | bytes) -> float:
    """Return a number in text; ValueError for 1_0 and digits beyond ASCII, which Python reads."""
    return float(plain(text))


def whole(text: str | bytes) -> int:
    """Return a whole number in text; ValueError as for ``real``."""
    return int(plain(text))


def plain(text: str | bytes) -> str:
    """Return text in which Python finds the numbers that other languages do, or ValueError."""
    found = text if isinstance(text, str) else text.decode('latin-1')
    if '_' in found or not found.isascii():
        raise ValueError(f'{found!r} is no number')
    return found


def num_numbers(layout: np.dtype[Any]) -> int:
    """Return the number of numbers in a row."""
    return sum(math.prod(layout[name].shape) for name in layout.names or ())


def pieces_of(file: BinaryIO, budget: Budget, ends: bytes) -> Iterator[bytes]:
    """
    Yield a text in pieces that each end after one of some characters.

    A last piece without an end is the rest of the file, or longer than MAX_WORD_BYTES.
    """
    rest = b''
    while piece := file.read(PIECE_BYTES):
        budget.check_time()
        piece = rest + piece
        end = 1 + max(piece.rfind(character) for character in ends)
        if end:
            yield piece[:end]
        rest = piece[end:]
        if len(rest) > MAX_WORD_BYTES:
            break
    if rest:
        yield rest


class Remembered(dict[bytes, float]):
    """Numbers by their words; reading one again takes a fifth of the time."""

    def __missing__(self, word: bytes) -> float:
        """Read a number and keep it."""
        number = self[word] = float(word)
        return number


def reals(words: list[bytes]) -> npt.NDArray[np.float64]:
    """
    Return the numbers of words, (W,) float64; raise ValueError if one is none.

    A number of one digit takes 170 ns to read, remembered 30: the shorter words are, the more
    there are in a file of a size, and the more often they are the same.
    """
    if len(b' '.join(words)) < SHORT_BYTES * len(words):
        return np.fromiter(map(Remembered().__getitem__, words), np.float64, len(words))
    return np.array(words, object).astype(np.float64)


def fill(table: npt.NDArray[Any], words: list[bytes]) -> None:
    """Write the numbers of whole rows into a table; raise ValueError if one does not fit."""
    rows = np.array(words, object).reshape(len(table), -1)
    at = 0
    for name in table.dtype.names or ():
        column = table[name]
        width = math.prod(column.shape[1:])
        values = rows[:, at : at + width]
        # by way of float64, which holds integers of 32 bits and reads 9.0
        is_long = column.dtype.kind in 'iu' and column.dtype.itemsize == 8
        numbers = values.astype(np.int64) if is_long else reals(values.ravel().tolist())
        numbers = numbers.reshape(column.shape)
        with np.errstate(invalid='ignore', over='ignore'):
            column[...] = numbers
        if column.dtype.kind in 'iu' and (column != numbers).any():
            wrong = numbers[column != numbers].flat[0]
            raise ValueError(f'{name}: {wrong}, which {column.dtype} cannot hold')
        at += width
