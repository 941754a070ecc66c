# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Types of arguments, groups of arguments and exit codes that several verbs share.

On its own because no verb imports another.
"""

from __future__ import annotations

import argparse
from difflib import get_close_matches
import math
import re
from typing import NoReturn

from surfel_mapper.errors import one_line

CUT, APART, INTERRUPTED = 3, 4, 130
"""
Exit codes: a recording ends too early and --strict was given; scans were mapped apart from the
map; Ctrl-C or SIGTERM ended the work.
"""


DIGITS = re.compile('[0-9]{1,18}')


class UsageError(Exception):
    """Options that do not go together; exit code 2."""


class Parser(argparse.ArgumentParser):
    """Parser that names the nearest option or verb for one that does not exist."""

    def error(self, message: str) -> NoReturn:
        """Print usage and message, with the nearest known words, and exit with 2."""
        found = re.match(r"argument VERB: invalid choice: '([^']*)'", message)
        if found:
            actions = (a for a in self._actions if isinstance(a, argparse._SubParsersAction))
            verbs = [verb for action in actions for verb in action.choices]
            message = (
                f'no verb {found[1]!r}{nearest(found[1], verbs) or ";"} verbs: {", ".join(verbs)}'
            )
        found = re.search(r": invalid choice: '([^']*)' \(choose from (.*)\)$", message)
        if found:
            message += nearest(found[1], re.findall(r"[^', ]+", found[2]))
        super().error(one_line(message))

    def refuse_unknown(self, words: list[str]) -> NoReturn:
        """Exit with 2 for words that are no arguments, naming the nearest option of each."""
        known = [option for action in self._actions for option in action.option_strings]
        options = [word.partition('=')[0] for word in words if word.startswith('-')]
        if not options:
            self.error(f'too many arguments: {" ".join(words)}')
        self.error('; '.join(f'no option {word}{nearest(word, known)}' for word in options))


def nearest(word: str, known: list[str]) -> str:
    """Return a question with the nearest known word; empty if none is near."""
    bare = {each.lstrip('-'): each for each in known}  # dashes alone would look alike
    close = get_close_matches(word.lstrip('-'), bare, n=1)
    return f', did you mean {bare[close[0]]}?' if close else ''


def real(text: str) -> float:
    """Return a number as files have it; ValueError for others that Python reads."""
    from surfel_mapper.files import text_table  # loads numpy, which --help does not need

    return text_table.real(text)


def whole(text: str) -> int:
    """Return a whole number; ValueError as for ``real``."""
    from surfel_mapper.files import text_table

    return text_table.whole(text)


def positive_int(text: str) -> int:
    """Return a whole number of one or more."""
    if not DIGITS.fullmatch(text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a whole number of 1 or more')
    return int(text)


def finite(text: str) -> float:
    """Return a finite number."""
    try:
        value = real(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f'{text!r}, expected a finite number')
    return value


def positive_float(text: str) -> float:
    """Return a finite positive number."""
    try:
        value = real(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a positive number')
    return value


def seconds(text: str) -> float:
    """Return a finite number of zero or more."""
    try:
        value = real(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r}, expected seconds, zero or more')
    return value


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Declare the options for several processes."""
    add = parser.add_argument_group('many bags, many processes').add_argument
    add('--workers', type=positive_int, metavar='N', help='map with N processes')
    add('--scheduler', metavar='ADDRESS', help='map on the workers of a Dask scheduler, tcp://...')
