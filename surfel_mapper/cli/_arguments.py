# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Types of arguments, groups of arguments and exit codes that several verbs share.

On its own because no verb imports another.
"""

from __future__ import annotations

import argparse
import math

CUT, INTERRUPTED = 3, 130
"""Exit codes: a recording ends too early and --strict was given; Ctrl-C ended the work."""


def positive_int(text: str) -> int:
    """Return a whole number of one or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a whole number of 1 or more')
    return int(text)


def positive_float(text: str) -> float:
    """Return a finite positive number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a positive number')
    return value


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Declare the options for several processes."""
    add = parser.add_argument_group('many bags, many processes').add_argument
    add('--workers', type=positive_int, metavar='N', help='map with N processes')
    add('--scheduler', metavar='ADDRESS', help='map on the workers of a Dask scheduler, tcp://...')
