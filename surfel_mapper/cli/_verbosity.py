# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``--quiet`` and ``--verbose``: how much a verb prints on stderr."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import logging

from surfel_mapper.cli._progress import progress

COMPILATION_LOG = logging.getLogger('surfel_mapper.compilation')
"""Says that kernels compile, which takes long: shown unless --quiet is given."""

LEVELS = (logging.NOTSET, logging.INFO, logging.DEBUG)
"""Levels of our loggers by the number of -v; without one, warnings, as the root logger has it."""


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Declare both options, one of which may be given."""
    add = parser.add_mutually_exclusive_group().add_argument
    add('-q', '--quiet', action='store_true', help='show warnings and the result only')
    add(
        '-v',
        '--verbose',
        action='count',
        default=0,
        help='log each step; twice: log causes of drops and failures too',
    )


def set_log_level(args: argparse.Namespace) -> None:
    """Set the level of the loggers of this package from the arguments; others keep theirs."""
    number = getattr(args, 'verbose', 0)  # the node logs by ROS, and has no such option
    logging.getLogger('surfel_mapper').setLevel(LEVELS[min(number, len(LEVELS) - 1)])
    is_quiet = getattr(args, 'quiet', False)
    COMPILATION_LOG.setLevel(logging.WARNING if is_quiet else logging.INFO)


@contextmanager
def shown_progress(args: argparse.Namespace, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows the progress towards a total, or nothing with --quiet."""
    if args.quiet:
        yield lambda done, total: None
        return
    with progress(args.verb, unit) as show:
        yield show
