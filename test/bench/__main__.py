# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Run benchmarks: a table of each on the terminal, then a line of JSON for every row."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Sequence
from datetime import date
from importlib import import_module
import json
from pathlib import Path
import sys
from time import perf_counter

from surfel_mapper.memory import keep_freed_memory
from test.bench.machine import facts, load
from test.bench.options import cache_directory, Options
from test.bench.report import Row, table

BENCHES = (
    *('real', 'start', 'live', 'robot', 'filters', 'lum', 'registration', 'tsdf', 'models'),
    *('paper', 'quality', 'adaptive'),
)
"""Modules of this folder that have run(options) -> list of rows, in the order to run them."""


def summary(name: str) -> str:
    """Return the first line of the docstring of a bench, without loading it."""
    source = Path(__file__).with_name(f'{name}.py').read_text(encoding='utf-8')
    return (ast.get_docstring(ast.parse(source)) or '').splitlines()[0]


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    benches = '\n'.join(f'  {name:<10}  {summary(name)}' for name in BENCHES)
    result = argparse.ArgumentParser(
        prog='python -m test.bench',
        description='Milliseconds a scan of the simulated street.',
        epilog=f'benches:\n{benches}\n\n'
        'The street is simulated once, 1.6 MB a scan, and kept in --cache. Peers come from PyPI\n'
        'at the first call with --peers, into environments of their own in --cache (1.2 GB), and\n'
        'take about ten minutes. Both may be deleted at any time. Then all benches\n'
        'with --peers take about an hour; each prints its seconds.',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument(
        '--only', action='append', choices=BENCHES, metavar='NAME', help='this one; repeatable'
    )
    result.add_argument('--scans', type=int, metavar='N', help='scans timed (default 100)')
    result.add_argument(
        '--peers', action='store_true', help='compare with Open3D, small_gicp, KISS-ICP as well'
    )
    result.add_argument(
        '--cache', type=Path, default=cache_directory(), metavar='DIR', help='default: %(default)s'
    )
    result.add_argument(
        '--data',
        action='append',
        type=Path,
        default=[],
        metavar='PATH',
        help='for paper: a folder of depth images (TUM RGB-D and others) or a bag of clouds; '
        'repeatable',
    )
    result.add_argument(
        '--frames', type=int, metavar='N', help='for paper: of each data set (default 10)'
    )
    result.add_argument(
        '--record', type=Path, metavar='DIR', help='add the run to the file of each bench in DIR'
    )
    return result


def options(args: argparse.Namespace) -> Options:
    """Return the options that the arguments ask for."""
    numbers = {name: getattr(args, name) for name in ('scans', 'frames')}
    chosen = {name: number for name, number in numbers.items() if number is not None}
    return Options(peers=args.peers, cache=args.cache, data=tuple(args.data), **chosen)


def run(names: Sequence[str], chosen: Options) -> list[Row]:
    """
    Run benches and print the table of each; return all rows with the machine and options.

    Rows go to stderr as they come: a long bench yields each when it is measured.
    """
    found: list[Row] = []
    for name in names:
        load_before, start = load(), perf_counter()
        rows = []
        for row in import_module(f'test.bench.{name}').run(chosen):
            rows.append(row)
            print(f'{name}: {json.dumps(rounded(row))}', file=sys.stderr, flush=True)
        print(f'{name}: {summary(name)}')
        took = f'{perf_counter() - start:.0f} s'
        print(f'{took}, load {load_before} before, {load()} after\n{table(rows)}\n', flush=True)
        found += [{'bench': name, 'load': load_before, **rounded(row)} for row in rows]
    return found


def rounded(row: Row) -> Row:
    """Round the numbers of a row to the accuracy of clocks."""
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}


def record(folder: Path, rows: Sequence[Row], about: Row) -> None:
    """Add rows, with the machine and command of the run, to the files of their benches."""
    for bench in dict.fromkeys(row['bench'] for row in rows):
        path = folder / f'{bench}.json'
        runs = json.loads(path.read_text(encoding='utf-8')) if path.exists() else []
        own = [row for row in rows if row['bench'] == bench]
        figures = [{k: v for k, v in row.items() if k not in ('bench', 'load')} for row in own]
        runs.append({**about, 'load': own[0]['load'], 'rows': figures})
        path.write_text(f'{json.dumps(runs, indent=1)}\n', encoding='utf-8')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benches of the command line."""
    args = parser().parse_args(arguments)
    for name in ('scans', 'frames'):
        if getattr(args, name) is not None and getattr(args, name) < 1:
            parser().error(f'--{name}: {getattr(args, name)}, expected one or more')
    names = args.only or BENCHES
    keep_freed_memory()  # as node and replay do
    machine, chosen = facts(), options(args)
    print(', '.join(f'{name} {value}' for name, value in machine.items()))
    print(f'window {chosen.window}, {chosen.scans} scans timed, {chosen.num_points} points\n')
    settings = {'window': chosen.window, 'points': chosen.num_points}
    rows = run(names, chosen)
    for row in rows:
        print(json.dumps({**settings, **row, **machine}))
    if args.record is not None:
        words = ' '.join(sys.argv[1:] if arguments is None else arguments)
        command = f'python -m test.bench {words.partition(" --record")[0]}'
        about = {'command': command, 'date': date.today().isoformat(), **machine}
        record(args.record, rows, about)
    return 0


if __name__ == '__main__':
    sys.exit(main())
