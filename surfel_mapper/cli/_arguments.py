# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of arguments, groups of arguments and exit codes that several verbs share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
import math
import re

from surfel_mapper.cli._parser import nearest

CUT, APART, INTERRUPTED = 3, 4, 130
"""
Exit codes: a recording ends too early and --strict was given; scans were mapped apart from the
map; Ctrl-C or SIGTERM ended the work.
"""


MAX_COLUMNS = 64
"""Limit of --bin-columns; points of data sets have up to ten numbers."""

DIGITS = re.compile('[0-9]{1,18}')


class UsageError(Exception):
    """Options that do not go together; exit code 2."""


def positive_int(text: str) -> int:
    """Return a whole number of one or more."""
    if not DIGITS.fullmatch(text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a whole number of 1 or more')
    return int(text)


def checked(text: str, is_valid: Callable[[float], bool], expected: str) -> float:
    """Return a number that meets a condition."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_valid(value):
        raise argparse.ArgumentTypeError(f'{text!r}, expected {expected}')
    return value


def finite(text: str) -> float:
    """Return a finite number."""
    return checked(text, math.isfinite, 'a finite number')


def positive_float(text: str) -> float:
    """Return a finite positive number."""
    return checked(text, lambda value: 0.0 < value < math.inf, 'a positive number')


def seconds(text: str) -> float:
    """Return a finite number of zero or more."""
    return checked(text, lambda value: 0.0 <= value < math.inf, 'seconds, zero or more')


def add_bin_columns(parser: argparse._ActionsContainer) -> None:
    """Declare --bin-columns."""
    parser.add_argument(
        '--bin-columns',
        type=bin_columns,
        metavar='N',
        help='numbers a point of .bin files, x y z and further ones (default: by their values)',
    )


def bin_columns(text: str) -> int:
    """Return a number of columns, x y z at least."""
    if not DIGITS.fullmatch(text) or not 3 <= int(text) <= MAX_COLUMNS:
        raise argparse.ArgumentTypeError(f'{text!r}, expected 3 to {MAX_COLUMNS}')
    return int(text)


def add_overwrite(parser: argparse._ActionsContainer) -> None:
    """Declare the option to write where files are."""
    parser.add_argument(
        '--overwrite',
        action='store_true',
        help='replace files that exist; without it a directory must be new or empty',
    )


def add_formats(
    parser: argparse._ActionsContainer,
    names: Sequence[str],
    default: Sequence[str],
    all_formats: Callable[[], Iterable[str]] | None = None,
) -> None:
    """
    Declare the option for the formats to write; None if it is not used.

    Parameters
    ----------
    parser : ArgumentParser or group of one
        Receives the option.
    names, default : sequence of str
        Formats that the help lists, and those that are written without the option.
    all_formats : callable, optional
        Returns all formats, if packages that are not loaded for the help add some.

    """

    def formats(text: str) -> tuple[str, ...]:
        chosen = tuple(text.split(','))
        accepted = list(names if all_formats is None else all_formats())
        for name in chosen:
            if name not in accepted:
                raise argparse.ArgumentTypeError(
                    f'{name!r}, expected some of {", ".join(accepted)}, separated by commas'
                    f'{nearest(name, accepted)}'
                )
        return chosen

    parser.add_argument(
        '--formats',
        type=formats,
        metavar='LIST',
        help=f'comma-separated, of {", ".join(names)} ({",".join(default)})',
    )


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Declare the options for several processes."""
    add = parser.add_argument_group('many bags, many processes').add_argument
    add('--workers', type=positive_int, metavar='N', help='map with N processes')
    add('--scheduler', metavar='ADDRESS', help='map on the workers of a Dask scheduler, tcp://...')
