# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stamps as decimal text: read to whole nanoseconds without a float, and written.

The resolution of a float64 is only 240 ns for seconds since 1970. ``nanoseconds`` reads one stamp
by way of Decimal, ``column_ns`` those of a table: plain decimal numbers by digits in uint64, all
at a time, and others one by one.

On its own because tables of poses, of data sets and names of files have stamps.
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_lines import read_lines, Rows, table_rows
from surfel_mapper.files.text_table import plain, SPACES

UNITS_NS = {'s': 10**9, 'sec': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}

DECIMAL_UNITS_NS = {unit: Decimal(factor) for unit, factor in UNITS_NS.items()}

MOST, MOST_SECONDS = Decimal(2**63), Decimal(10**11)
"""Limits of stamps; a larger one without a unit is not in seconds (3000 years)."""

WIDTHS = 8, 40
"""Characters of numbers that are read all at a time: the time is that of the longest one."""

DIGITS, EXPONENT_DIGITS = 19, 17
"""Leading digits of their mantissas, which uint64 holds, and most digits of their exponents."""

POWERS = 10 ** np.arange(DIGITS + 1, dtype=np.uint64)

MOST_NS = 2**63 - 1

DATE, DATE_OF_NONE = b'0000-00-00T00:00:00', b'1970-01-01T00:00:00'
"""Form of a date and clock, a 0 for each digit, and one in the place of others."""


def nanoseconds(text: str, where: str, unit: str = '') -> int:
    """Return a time rounded to nanoseconds; half of one to even."""
    word = text.strip(SPACES.decode())
    try:
        if not word.isprintable():  # Decimal takes the separators of ASCII for spaces
            raise ValueError(f'{word!r} is no number')
        number = Decimal(plain(word))
    except (InvalidOperation, ValueError) as error:
        raise FileFormatError(f'{where}: {text!r} is no time') from error
    if unit and unit not in UNITS_NS:
        raise FileFormatError(f'{where}: unit {unit!r}, expected one of {", ".join(UNITS_NS)}')
    most = MOST if unit else MOST_SECONDS
    if not number.is_finite() or not number.copy_abs() <= most:
        raise FileFormatError(
            f'{where}: time {text!r}, expected seconds (or a CSV column stamp_ns, stamp_us)'
        )
    stamp_ns = int((number * DECIMAL_UNITS_NS[unit or 's']).to_integral_value())
    if not 0 <= stamp_ns <= MOST_NS:
        raise FileFormatError(f'{where}: time {text!r}, expected 0 to 292 years')
    return stamp_ns


def read_times(path: str | Path) -> npt.NDArray[np.int64]:
    """Return the times in a file of one number of seconds a line, (T,) int64 ns, in its order."""
    budget = Budget.of_file(path, FileFormatError)
    with budget.clock():
        rows = table_rows(read_lines(path, budget), 1, budget, meaning=': a time')
        times = [column_ns(each, 0) for each in rows]
    return np.concatenate([np.empty(0, np.int64), *times])


def read_dates(path: str | Path) -> npt.NDArray[np.int64]:
    """
    Return the times in a file of lines 2011-09-26 13:02:25.594360375, (T,) int64, ns since 1970.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or with its line if one has another form or is before 1970.

    """
    budget = Budget.of_file(path, FileFormatError)
    times: list[npt.NDArray[np.int64]] = [np.empty(0, np.int64)]
    with budget.clock():
        meaning = ': a date and a time'
        for rows in table_rows(read_lines(path, budget), 2, budget, meaning=meaning):
            found, is_read = dates_ns(rows.words.tolist())
            if not is_read.all():
                row = int(is_read.argmin())
                text = b' '.join(rows.words[row]).decode()
                raise FileFormatError(
                    f'{rows.lines.where(row)}: {text!r} is no time, expected one from 1970 on as '
                    '2011-09-26 13:02:25.594360375'
                )
            times.append(found)
    return np.concatenate(times)


def dates_ns(
    words: list[list[bytes]],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the times of dates and clocks, (R,) int64 ns, and which of them were read."""
    text = [b'%bT%b' % (date, clock[:8]) for date, clock in words]
    fractions = [clock[8:] for _, clock in words]
    is_fraction = np.array(
        [not each or (each[:1] == b'.' and each[1:].isdigit()) for each in fractions]
    )
    characters = np.array(text, f'S{len(DATE) + 1}').view(np.uint8).reshape(len(text), -1)
    form = np.frombuffer(DATE + b'\0', np.uint8)
    is_form = np.where(form == ord('0'), characters - form < 10, characters == form)
    is_read = is_fraction & is_form.all(axis=1)
    at = np.array(
        [each if read else DATE_OF_NONE for each, read in zip(text, is_read, strict=True)]
    )
    try:
        second = at.astype('M8[s]').astype(np.int64)
    except ValueError:  # such as a month 13
        is_read &= [*map(is_date, at.tolist())]
        return np.zeros(len(text), np.int64), is_read
    is_read &= in_range(second, 0, MOST_NS // 10**9 - 1)
    digits = [each[1:10].ljust(9, b'0') for each in fractions]
    nanosecond = np.where(is_read, np.array(digits, 'S9'), b'0').astype(np.int64)
    return second * 10**9 + nanosecond, is_read


def is_date(text: bytes) -> bool:
    """Return whether a text in the form of DATE is a date."""
    try:
        np.datetime64(text.decode())
    except ValueError:
        return False
    return True


def column_ns(rows: Rows, column: int, unit: str = '') -> npt.NDArray[np.int64]:
    """
    Return the times in a column of a table, (R,) int64, rounded as by ``nanoseconds``.

    Raises
    ------
    FileFormatError
        With its line, if a word is no time, or a time is none from 0 to 292 years.

    """
    words = rows.words[:, column]
    if b' ' in b''.join(words.tolist()):
        words = np.array([word.strip() for word in words.tolist()], object)
    lengths = np.fromiter(map(len, words), np.int64, len(words))
    stamps, is_read = np.empty(len(words), np.int64), np.zeros(len(words), bool)
    for least, width in zip((0, *WIDTHS), WIDTHS, strict=False):
        (taken,) = np.nonzero(in_range(lengths, least + 1, width))
        if len(taken) and unit in ('', *UNITS_NS):
            padded = words[taken].astype(f'S{width}').view(np.uint8).reshape(-1, width)
            text = padded[:, : lengths[taken].max()]
            unit_ns = UNITS_NS[unit or 's']
            stamps[taken], is_read[taken] = plain_ns(text, lengths[taken], unit_ns)
    others = np.flatnonzero(~is_read)
    lines = rows.lines.numbers[others].tolist()
    for row, line in zip(others.tolist(), lines, strict=True):
        stamps[row] = nanoseconds(words[row].decode(), f'{rows.lines.path}:{line}', unit)
    return stamps


def plain_ns(
    text: npt.NDArray[np.uint8], lengths: npt.NDArray[np.int64], unit_ns: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return times, (R,) int64 ns, of texts (R, W), and which were read: numbers in the range."""
    text = np.ascontiguousarray(text.T)
    digits = text - ord('0')
    is_digit, is_point = digits < 10, text == ord('.')
    is_letter, is_minus = (text | 0x20) == ord('e'), text == ord('-')
    is_sign = is_minus | (text == ord('+'))
    in_exponent = np.logical_or.accumulate(is_letter, axis=0)
    in_fraction = np.logical_or.accumulate(is_point, axis=0) & ~in_exponent
    of_mantissa, of_exponent = is_digit & ~in_exponent, is_digit & in_exponent
    kept = of_mantissa & (np.cumsum(of_mantissa, axis=0, dtype=np.uint8) <= DIGITS)
    is_plain = (
        ((is_digit | is_point | is_letter | is_sign).sum(axis=0) == lengths)
        & (is_point.sum(axis=0) <= 1)
        & ~(is_point & in_exponent).any(axis=0)
        & (is_letter.sum(axis=0) <= 1)
        # a sign is the first character, or follows the letter
        & ~(is_sign[1:] & ~is_letter[:-1]).any(axis=0)
        & kept.any(axis=0)
        & in_range(of_exponent.sum(axis=0), is_letter.any(axis=0), EXPONENT_DIGITS)
    )
    power = value_of(digits, of_exponent).astype(np.int64)
    power[(is_minus & in_exponent).any(axis=0)] *= -1
    power += len(str(unit_ns)) - 1 - (kept & in_fraction).sum(axis=0)
    left = left_of(digits, of_mantissa & ~kept)
    stamps, fits = scaled(value_of(digits, kept), power, left)
    # digits are left out below a nanosecond only
    fits &= ~(of_mantissa & ~kept & ~in_fraction).any(axis=0) & ((power <= 0) | (left == 0))
    fits &= (stamps == 0) | ~(is_minus & ~in_exponent).any(axis=0)
    return stamps, is_plain & fits


def in_range(
    number: npt.NDArray[np.int64], least: int | npt.NDArray[np.bool_], most: int
) -> npt.NDArray[np.bool_]:
    """Return which numbers are in a range, (R,) bool."""
    return (number >= least) & (number <= most)


def value_of(
    digits: npt.NDArray[np.uint8], is_taken: npt.NDArray[np.bool_]
) -> npt.NDArray[np.uint64]:
    """Return the numbers, (R,) uint64, that the digits taken in each column, (W, R), make."""
    value = np.zeros(digits.shape[1], np.uint64)
    for digit, taken in zip(digits, is_taken, strict=True):
        np.copyto(value, value * np.uint64(10) + digit, where=taken)
    return value


NOTHING, BELOW, HALF, ABOVE = range(4)


def left_of(
    digits: npt.NDArray[np.uint8], is_left: npt.NDArray[np.bool_]
) -> npt.NDArray[np.uint8]:
    """Return how the digits left out, as those of a fraction, compare with a half, (R,) uint8."""
    first = is_left & (np.cumsum(is_left, axis=0, dtype=np.uint8) == 1)
    tenths = np.where(first, digits, 0).max(axis=0)
    has_more = (is_left & ~first & (digits > 0)).any(axis=0)
    found = np.where((tenths > 0) | has_more, BELOW, NOTHING)
    found[tenths >= 5] = ABOVE
    found[(tenths == 5) & ~has_more] = HALF
    return found


def scaled(
    mantissa: npt.NDArray[np.uint64], power: npt.NDArray[np.int64], left: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return mantissa * 10^power rounded, half to even, and which of them int64 holds."""
    up = POWERS[np.clip(power, 0, DIGITS)]
    fits = (mantissa <= np.uint64(MOST_NS) // up) & ((power <= DIGITS) | (mantissa == 0))
    down = POWERS[np.clip(-power, 0, DIGITS)]
    whole, rest = np.divmod(mantissa, down)
    other = down - rest
    is_above = (rest > other) | ((rest == other) & (left > NOTHING))
    is_half = (rest == other) & (left == NOTHING)
    is_whole = power == 0
    is_above |= is_whole & (left == ABOVE)
    is_half |= is_whole & (left == HALF)
    whole += is_above | (is_half & (whole % np.uint64(2) == 1))
    whole[power < -DIGITS] = 0  # a tenth of a nanosecond at most
    fits &= whole <= np.uint64(MOST_NS)
    return np.where(power > 0, mantissa * up, whole).astype(np.int64), fits
