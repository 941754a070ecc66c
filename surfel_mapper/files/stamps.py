# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stamps as decimal text, read to whole nanoseconds without a float.

The resolution of a float64 is only 240 ns for seconds since 1970. Decimal is exact and takes 1 us
a stamp.
"""

from __future__ import annotations

from decimal import Context, Decimal, InvalidOperation
from pathlib import Path
import re

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_table import read_lines, Rows, table_rows

UNITS_NS = {'s': 10**9, 'sec': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}

MOST, MOST_SECONDS = Decimal(2**63), Decimal(10**11)
"""Limits of stamps; a larger one without a unit is not in seconds (3000 years)."""

EXACT = Context(prec=100)
"""Significant digits of a stamp that count in its rounding."""

MOST_NS = 2**63 - 1

DATE = re.compile(r'((?:19|2[01])\d\d-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?)Z?')
"""Date and time, in UTC."""


def nanoseconds(text: str, where: str, unit: str = '') -> int:
    """Return a time rounded to nanoseconds; half of one to even."""
    try:
        number = Decimal(text.strip())
    except InvalidOperation as error:
        raise FileFormatError(f'{where}: {text!r} is no time, expected a number') from error
    if unit and unit not in UNITS_NS:
        raise FileFormatError(f'{where}: unit {unit!r}, expected one of {", ".join(UNITS_NS)}')
    most = MOST if unit else MOST_SECONDS
    if not number.is_finite() or not number.copy_abs() <= most:
        raise FileFormatError(
            f'{where}: time {text!r}, expected seconds (or a CSV column stamp_ns, stamp_us)'
        )
    factor = Decimal(UNITS_NS[unit or 's'])
    stamp_ns = int(EXACT.multiply(number, factor).to_integral_value())
    if not 0 <= stamp_ns <= MOST_NS:
        raise FileFormatError(f'{where}: time {text!r}, expected 0 to 292 years')
    return stamp_ns


def unit_by_digits(text: str) -> str:
    """Return the unit of a time by the digits before its point: ns, us or ms since 1970, or s."""
    try:
        digits = Decimal(text.strip()).adjusted() + 1
    except InvalidOperation:
        return 's'
    return 's' if digits < 12 else 'ms' if digits < 14 else 'us' if digits < 17 else 'ns'


def read_times(path: str | Path) -> npt.NDArray[np.int64]:
    """Return the times in a file of one number of seconds a line, (T,) int64 ns, in its order."""
    return column_ns(table_rows(read_lines(path), 1, meaning=': a time'), 0)


def read_dates(path: str | Path) -> npt.NDArray[np.int64]:
    """
    Return the times in a file of lines 2011-09-26 13:02:25.594360375, (T,) int64, ns since 1970.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or with its line if one has another form or is before 1970.

    """
    rows = table_rows(read_lines(path), 2, meaning=': a date and a time')
    stamps = np.empty(len(rows), np.int64)
    for row, words in enumerate(rows.words):
        date = DATE.fullmatch('T'.join(words))  # numpy warns of zones, and wraps late years
        try:
            stamps[row] = np.datetime64(date[1], 'ns').astype(np.int64) if date else -1
        except ValueError:
            stamps[row] = -1
        if stamps[row] < 0:
            raise FileFormatError(
                f'{rows.lines.where(row)}: {" ".join(words)!r} is no time, expected one from 1970 '
                'on as 2011-09-26 13:02:25.594360375'
            )
    return stamps


def column_ns(rows: Rows, column: int, unit: str = '') -> npt.NDArray[np.int64]:
    """
    Return the times in a column of a table, (R,) int64, rounded as by ``nanoseconds``.

    Raises
    ------
    FileFormatError
        With its line, if a word is no time, or a time is none from 0 to 292 years.

    """
    where = rows.lines.where
    stamps = [nanoseconds(words[column], where(i), unit) for i, words in enumerate(rows.words)]
    return np.array(stamps, np.int64)
