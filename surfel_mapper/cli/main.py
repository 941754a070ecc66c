# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper VERB ...``: finds the verb, runs it, and turns errors into messages.

A verb is a module of this folder with SUMMARY and EXAMPLE (str), ``add_arguments(parser)`` and
``run(args) -> int``. It imports heavy modules inside ``run``, so that help is fast and a replay
loads no ROS. A verb prints its result on stdout and everything else on stderr. Arguments after
--ros-args are ``args.ros_args``. Modules with a leading underscore are shared by verbs.

Exit code 0: done; 1: refused, with a message; 2: usage, also of no verb at all; 3: done, but the
bag is cut off, with --strict; 4: done, but the map is in doubt or lacks over 5 % of the scans;
130: interrupted, by Ctrl-C or SIGTERM alike, as a replay writes its map after both. A page of
``view`` and the node end with 0 then.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
import logging
import os
from pathlib import Path
import platform
import sys
from types import ModuleType

import surfel_mapper
from surfel_mapper.budget import stated_limit, VARIABLE
from surfel_mapper.cli._arguments import UsageError
from surfel_mapper.cli._parser import Parser
from surfel_mapper.cli._progress import interrupted_by_sigterm
from surfel_mapper.cli._verbosity import set_log_level
from surfel_mapper.errors import LineFormatter, one_line, SurfelMapperError
from surfel_mapper.memory import limit_address_space

VERBS = (
    'node',
    'replay',
    'play',
    'info',
    'filter',
    'filters',
    'extract',
    'resample',
    'simulate',
    'merge',
    'view',
    'evaluate',
    'compile',
)

FILE_VERBS = ('replay', 'info', 'filter', 'extract', 'resample', 'merge', 'evaluate')
"""Verbs whose memory is limited; those of ROS and browsers reserve address space at will."""

_log = logging.getLogger('surfel_mapper.cli')  # __name__ is __main__ with `python -m`

EPILOG = (
    'surfel-mapper VERB --help shows the options of a verb and an example. Tab completes them '
    'after `eval "$(register-python-argcomplete surfel-mapper)"`.'
)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        The arguments; those of the process without.

    """
    if '_ARGCOMPLETE' in os.environ:
        complete()
    replace_closed_streams()
    args = parsed(sys.argv[1:] if argv is None else argv)
    start_logging(args)
    try:
        if argv is None:
            limit_memory(args)
        ends_early = interrupted_by_sigterm(ends_process=argv is None)
        with nullcontext() if args.verb == 'node' else ends_early:  # it handles SIGTERM itself
            code = int(args.run(args))
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except UsageError as error:
        args.parser.print_usage(sys.stderr)
        return refused(args.verb, one_line(error), 2)
    except SurfelMapperError as error:
        return refused(args.verb, str(error))
    except OSError as error:
        named = error.filename and error.strerror
        message = f'{error.filename}: {error.strerror}' if named else str(error)
        return refused(args.verb, one_line(message))
    except MemoryError as error:
        message = f'{named_files(args)}: needs more memory than there is ({error})'
        return refused(args.verb, one_line(f'{message}; {VARIABLE} sets the limit, bytes'))
    except KeyboardInterrupt:
        print(f'surfel-mapper {args.verb}: interrupted', file=sys.stderr)
        return 130


def parsed(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments of a verb; exit with 2 if they are wrong, or there are none."""
    arguments, ros_args = without_ros_args(argv)
    parser = parser_of(arguments)
    if not arguments:  # wrong usage: a script with an empty variable must not seem to succeed
        parser.print_help(sys.stderr)
        parser.exit(2)
    args, surplus = parser.parse_known_args(arguments)
    if surplus:
        args.parser.error(f'too many arguments: {" ".join(surplus)}')
    args.ros_args = ros_args
    return args


def start_logging(args: argparse.Namespace) -> None:
    """Log to stderr, as much as the arguments ask for; begin with the version."""
    handler = logging.StreamHandler()
    handler.setFormatter(LineFormatter(f'surfel-mapper {args.verb}: %(message)s'))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    set_log_level(args)
    python = platform.python_version()
    _log.info('surfel_mapper %s, Python %s', surfel_mapper.__version__, python)


def complete() -> None:
    """Print the words that may follow those in COMP_LINE to a shell that asks for them; exit."""
    import argcomplete

    argcomplete.autocomplete(parser_of([]), always_complete_options=False)


def limit_memory(args: argparse.Namespace) -> None:
    """Limit the memory of this process if its verb reads files and starts no viewer."""
    if args.verb in FILE_VERBS and not getattr(args, 'view', False):
        limit_address_space(stated_limit())


def named_files(args: argparse.Namespace) -> str:
    """Return the files that a verb was given, for errors."""
    inputs = [value for name, value in vars(args).items() if name != 'output']
    files = [file for value in inputs for file in (value if isinstance(value, list) else [value])]
    return ', '.join(str(file) for file in files if isinstance(file, Path))


def replace_closed_streams() -> None:
    """
    Open stdout and stderr to nothing if the caller closed them, as the shell does by ``>&-``.

    Python sets them to None then, and ``print(file=None)`` of errors would go to stdout.
    """
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w'))  # noqa: SIM115 - until the process ends


def refused(verb: str, message: str, code: int = 1) -> int:
    """Print why a verb ended without a result, and return the exit code."""
    print(f'surfel-mapper {verb}: {message}', file=sys.stderr)
    return code


def without_ros_args(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """
    Split arguments at --ros-args into those of the verb and those for ROS.

    A launch file adds the latter to every program, so every verb takes them; the node uses them.
    """
    arguments = list(argv)
    cut = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return arguments[:cut], arguments[cut:]


def parser_of(arguments: Sequence[str]) -> Parser:
    """Return the parser for some arguments; all verbs are loaded only if none is named."""
    about = str(surfel_mapper.__doc__).strip().partition('\n\n')[0]
    parser = Parser(prog='surfel-mapper', description=about, epilog=EPILOG)
    version = f'surfel-mapper {surfel_mapper.__version__}'
    parser.add_argument('--version', action='version', version=version)
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True, title='verbs')
    named = [arguments[0]] if arguments and arguments[0] in VERBS else VERBS
    for verb in named:
        module = import_module(f'surfel_mapper.cli.{verb}')
        add_verb(verbs, verb, module)
    return parser


def add_verb(verbs: argparse._SubParsersAction[Parser], verb: str, module: ModuleType) -> None:
    """Add the parser of one verb."""
    parser = verbs.add_parser(
        verb,
        help=module.SUMMARY,
        description=module.SUMMARY,
        epilog=f'example:\n  {module.EXAMPLE}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    parser.set_defaults(run=module.run, parser=parser)


if __name__ == '__main__':
    sys.exit(main())
